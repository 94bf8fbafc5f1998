//! Checkpoints: they are read back as written, the same content gives the same bytes, and no bytes cause a panic.

use proptest::prelude::*;
use qedgix::checkpoint::{self, Checkpoint, Error};
use qedgix::env::EpisodeMetrics;
use qedgix::learner::{Algorithm, MixerKind, Preset, TrainConfig, evaluate, layout_list};
use qedgix::policy::{Advice, FleetGraph, FleetStep, Policy};
use rand::RngExt;
use serde_json::{Value, json};

fn config() -> TrainConfig {
    let mut config = TrainConfig::preset(Algorithm::Qedgix, Preset::Practical);
    config.training.steps = 1000;
    (config.training.advice, config.training.advice_margin) = (Advice::None, 0.0);
    config
}

/// Weights of typical size, all different.
fn weights(config: &TrainConfig) -> Vec<f32> {
    (0..checkpoint::parameter_layout(config).len()).map(|i| ((i * 7919 % 1000) as f32 / 1000.0 - 0.5) * 0.2).collect()
}

fn example(config: TrainConfig) -> Checkpoint {
    let weights = weights(&config);
    let metrics = EpisodeMetrics { mean_aoi: 11.5, peak_aoi: 60.0, p95_aoi: 33.0, coverage: 0.9, fairness: 0.8 };
    Checkpoint::new(config, 12_800, Some(metrics), weights).unwrap()
}

/// A file's header and data.
fn parts(bytes: &[u8]) -> (Value, Vec<u8>) {
    let n = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    (serde_json::from_slice(&bytes[8..8 + n]).unwrap(), bytes[8 + n..].to_vec())
}

/// A file with this header and data.
fn file(header: &Value, data: &[u8]) -> Vec<u8> {
    let header = header.to_string();
    let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
    bytes.extend(header.as_bytes());
    bytes.extend(data);
    bytes
}

/// The error of reading the example after `change` of its header.
fn error_after(change: impl FnOnce(&mut Value)) -> Error {
    let (mut header, data) = parts(&example(config()).to_bytes());
    change(&mut header);
    Checkpoint::from_bytes(&file(&header, &data)).unwrap_err()
}

#[test]
fn checkpoints_are_read_back_as_written() {
    for algorithm in [Algorithm::Qedgix, Algorithm::Qmix, Algorithm::Vdn, Algorithm::Iql] {
        for preset in [Preset::Paper, Preset::Authors, Preset::Practical] {
            let checkpoint = example(TrainConfig::preset(algorithm, preset));
            let bytes = checkpoint.to_bytes();
            assert_eq!(Checkpoint::from_bytes(&bytes).unwrap(), checkpoint);
            assert_eq!(bytes.len() % 4, 0);
        }
    }
    let without = Checkpoint::new(config(), 0, None, weights(&config())).unwrap();
    assert_eq!(Checkpoint::from_bytes(&without.to_bytes()).unwrap().metrics(), None);
}

#[test]
fn the_same_content_gives_the_same_bytes() {
    let (a, b) = (example(config()).to_bytes(), example(config()).to_bytes());
    assert_eq!(a, b);
    assert_eq!(checkpoint::digest(&a), checkpoint::digest(&b));
    assert_eq!(checkpoint::digest(b"abc"), "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
    let mut other = weights(&config());
    other[5] += 1e-6;
    let other = Checkpoint::new(config(), 12_800, None, other).unwrap();
    assert_ne!(checkpoint::digest(&other.to_bytes()), checkpoint::digest(&a));
    // A checkpoint that was read is written with the same bytes.
    assert_eq!(Checkpoint::from_bytes(&a).unwrap().to_bytes(), a);
}

#[test]
fn names_and_shapes_equal_the_golden_files() {
    for name in ["qmix", "vdn", "qedgix_paper", "qedgix_authors", "qedgix_set_phase", "qedgix_set_token"] {
        let path = format!("{}/tests/golden/{name}.safetensors", env!("CARGO_MANIFEST_DIR"));
        let (golden, _) = parts(&std::fs::read(path).unwrap());
        let given = &golden["__metadata__"];
        let is = |key: &str, value: &str| given[key] == value;
        let number = |key: &str| given[key].as_str().unwrap().parse::<usize>().unwrap();
        let algorithm = match (is("gnn", "none"), is("mixer", "vdn")) {
            (true, true) => Algorithm::Vdn,
            (true, false) => Algorithm::Qmix,
            _ => Algorithm::Qedgix,
        };
        let mut config = TrainConfig::preset(algorithm, Preset::Paper);
        config.environment.uavs = number("M");
        config.environment.users = number("N");
        config.environment.hover = is("A", "9");
        config.training.layers = number("layers");
        config.training.self_position = is("self_position", "True");
        config.training.observation = serde_json::from_value(given["encoder"].clone()).unwrap();
        config.training.identity = serde_json::from_value(given["ident"].clone()).unwrap();
        config.training.mixer = serde_json::from_value(given["mixer"].clone()).unwrap();
        let (header, _) = parts(&example(config).to_bytes());
        let shapes = |header: &Value| -> Vec<(String, Value)> {
            let tensors = header.as_object().unwrap().iter();
            let ours = tensors.filter(|(name, _)| name.starts_with("agent.") || name.starts_with("mixer."));
            ours.map(|(name, t)| (name.clone(), t["shape"].clone())).collect()
        };
        assert_eq!(shapes(&header), shapes(&golden), "{name}");
    }
}

#[test]
fn mixer_tensors_are_optional() {
    let (mut header, data) = parts(&example(config()).to_bytes());
    // Names sort `agent` before `mixer`, so the agent's data comes first.
    let tensors = header.as_object_mut().unwrap();
    tensors.retain(|name, _| !name.starts_with("mixer."));
    let end = tensors.values().filter_map(|t| t["data_offsets"][1].as_u64()).max().unwrap() as usize;
    let lean = Checkpoint::from_bytes(&file(&header, &data[..end])).unwrap();
    let full = example(config());
    let seeds = layout_list("eval-v1").unwrap().seeds(4);
    let metrics = |c: &Checkpoint| evaluate(&c.policy(), &config().environment, &seeds, 1).unwrap();
    assert_eq!(metrics(&lean), metrics(&full));
    assert_eq!(Checkpoint::from_bytes(&lean.to_bytes()).unwrap(), lean);
}

#[test]
fn metadata_errors_name_the_entry() {
    let meta = |key: &'static str, value: Value| move |h: &mut Value| h["__metadata__"][key] = value;
    assert_eq!(error_after(meta("format", json!("pt"))), Error::Format { found: Some("pt".into()) });
    assert_eq!(error_after(meta("version", json!("2"))), Error::Version { found: Some("2".into()) });
    for (key, value) in [("step", "-1"), ("metrics", "{"), ("config", "{}")] {
        let error = error_after(meta(key, json!(value)));
        assert!(matches!(error, Error::Metadata { field, .. } if field == key), "{error}");
    }
    let mut bad = config();
    bad.environment.speed = -1.0;
    let bad = serde_json::to_string(&bad).unwrap();
    let Error::Config(invalid) = error_after(meta("config", json!(bad))) else { panic!("the configuration is invalid") };
    assert_eq!((invalid.field.as_str(), invalid.value.as_deref()), ("environment.speed", Some("-1")));
    let without_metadata = error_after(|h| drop(h.as_object_mut().unwrap().remove("__metadata__")));
    assert_eq!(without_metadata, Error::Format { found: None });
}

#[test]
fn tensors_must_match_the_configuration() {
    let renamed = |from: &'static str, to: &'static str| {
        error_after(move |h| {
            let tensor = h.as_object_mut().unwrap().remove(from).unwrap();
            h[to] = tensor;
        })
    };
    assert_eq!(renamed("agent.fc.bias", "agent.fc.bais"), Error::Missing { name: "agent.fc.bias".into() });
    assert_eq!(renamed("mixer.b1.bias", "other.bias"), Error::Missing { name: "mixer.b1.bias".into() });
    let (mut header, mut data) = parts(&example(config()).to_bytes());
    header["extra"] = json!({"dtype": "F32", "shape": [1], "data_offsets": [data.len(), data.len() + 4]});
    data.extend([0; 4]);
    let error = Checkpoint::from_bytes(&file(&header, &data)).unwrap_err();
    assert_eq!(error, Error::Unexpected { name: "extra".into() });
    let reshaped = error_after(|h| h["agent.rnn.weight_hh"]["shape"] = json!([64, 192]));
    let name = "agent.rnn.weight_hh".into();
    assert_eq!(reshaped, Error::Shape { name, found: vec![64, 192], expected: vec![192, 64] });
    let retyped = error_after(|h| h["agent.fc.bias"]["dtype"] = json!("I32"));
    assert_eq!(retyped, Error::Type { name: "agent.fc.bias".into(), found: "I32".into() });
    // Another configuration has other parameters.
    let mut other = config();
    other.training.mixer = MixerKind::Qmix;
    let other = serde_json::to_string(&other).unwrap();
    let error = error_after(|h| h["__metadata__"]["config"] = json!(other));
    assert!(matches!(&error, Error::Shape { name, .. } if name.starts_with("mixer.")), "{error}");
}

#[test]
fn values_must_be_finite_and_not_too_large() {
    for bad in [f32::NAN, f32::INFINITY, -f32::INFINITY, 1e30] {
        let (header, mut data) = parts(&example(config()).to_bytes());
        let at = header["agent.fc.weight"]["data_offsets"][0].as_u64().unwrap() as usize;
        data[at + 8..at + 12].copy_from_slice(&bad.to_le_bytes());
        let error = Checkpoint::from_bytes(&file(&header, &data)).unwrap_err();
        assert!(matches!(&error, Error::Value { name, index: 2, .. } if name == "agent.fc.weight"), "{error}");
        let mut flat = weights(&config());
        flat[9] = bad;
        assert!(matches!(Checkpoint::new(config(), 0, None, flat), Err(Error::Value { .. })));
    }
    assert!(Checkpoint::new(config(), 0, None, vec![0.0; 3]).is_err());
}

#[test]
fn inconsistent_containers_are_rejected() {
    let good = example(config()).to_bytes();
    let length = u64::from_le_bytes(good[..8].try_into().unwrap());
    let with_length = |length: u64| {
        let mut bytes = good.clone();
        bytes[..8].copy_from_slice(&length.to_le_bytes());
        Checkpoint::from_bytes(&bytes).unwrap_err()
    };
    for absurd in [u64::MAX, 1 << 63, 1 << 40, (16 << 20) + 1] {
        assert_eq!(with_length(absurd), Error::HeaderTooLarge { found: absurd, limit: 16 << 20 });
    }
    assert_eq!(with_length(16 << 20), Error::Truncated { found: good.len(), header: 16 << 20 });
    assert!(matches!(with_length(length - 8), Error::Header(_)));
    assert!(matches!(with_length(0), Error::Header(_)));
    for cut in 0..8 {
        assert_eq!(Checkpoint::from_bytes(&good[..cut]), Err(Error::Truncated { found: cut, header: 0 }));
    }
    let offsets = |name: &'static str, from: u64, to: u64| error_after(move |h| h[name]["data_offsets"] = json!([from, to]));
    // Names are in the order of their data: the first tensor is agent.fc.bias, 256 bytes.
    let (header, data) = parts(&good);
    let first = "agent.fc.bias";
    assert_eq!(header[first]["data_offsets"], json!([0, 256]));
    let second = "agent.fc.weight";
    let end = header[second]["data_offsets"][1].as_u64().unwrap();
    for (case, from, to) in [("overlap", 0, end), ("the same data twice", 0, 256), ("a gap", 260, end), ("backwards", end, 256)] {
        let error = offsets(second, from, to);
        assert!(matches!(error, Error::Offsets { .. }), "{case}: {error}");
    }
    assert_eq!(offsets(first, 0, 255), Error::Size { name: first.into(), shape: vec![64], found: 255 });
    let huge = offsets(first, 0, usize::MAX as u64);
    assert!(matches!(huge, Error::Offsets { len, .. } if len == data.len()), "{huge}");
    let overflowing = error_after(|h| h[first]["shape"] = json!([1_u64 << 62, 1_u64 << 62]));
    assert_eq!(overflowing, Error::Size { name: first.into(), shape: vec![1 << 62, 1 << 62], found: 256 });
    let longer = Checkpoint::from_bytes(&[&good[..], &[0; 4]].concat()).unwrap_err();
    assert_eq!(longer, Error::TrailingData { found: data.len() + 4, expected: data.len() });
    assert!(matches!(error_after(|h| h[first]["color"] = json!("red")), Error::Header(_)));
    assert!(matches!(error_after(|h| h[first]["shape"] = json!([-1])), Error::Header(_)));
    let text = header.to_string();
    for name in [first, "__metadata__"] {
        let entry = format!("\"{name}\":{}", header[name]);
        let twice = text.replacen(&entry, &format!("{entry},{entry}"), 1);
        let bytes = [&(twice.len() as u64).to_le_bytes()[..], twice.as_bytes(), &data].concat();
        let error = Checkpoint::from_bytes(&bytes).unwrap_err();
        assert!(matches!(error, Error::Header(_)), "duplicate {name:?}: {error}");
    }
    let deep = format!("{{\"a\":{}", "[".repeat(1 << 20));
    let bytes = [&(deep.len() as u64).to_le_bytes()[..], deep.as_bytes()].concat();
    assert!(matches!(Checkpoint::from_bytes(&bytes), Err(Error::Header(_))));
}

/// Runs the policy for a few slots with the fleet of its training and, if possible, with others.
fn run_policy(checkpoint: &Checkpoint, seed: u64) {
    let (policy, dims) = (checkpoint.policy(), checkpoint.config().dims());
    let policy: &dyn Policy = &policy;
    for (uavs, users) in [(dims.uavs, dims.users), (1, 1), (5, 9)] {
        // Larger fleets are tested in `service`, where observations are bounded.
        if policy.check_fleet(uavs, users).is_err() || uavs + users > 64 {
            continue;
        }
        let mut rng = qedgix::rng::stream(seed, "test-flight", 0);
        let mut place = || [rng.random_range(-0.2..1.2), rng.random_range(-0.2..1.2)];
        let mut memory = vec![0.0; policy.memory_len(uavs, users)];
        policy.start(uavs, users, seed, &mut memory);
        for step in 0..3 {
            let (at, of): (Vec<_>, Vec<_>) = ((0..uavs).map(|_| place()).collect(), (0..users).map(|_| place()).collect());
            let aoi: Vec<f32> = (0..users).map(|user| (user * 1000) as f32).collect();
            let graph = FleetGraph::from_scene(&at, &of, &aoi, policy.env().detection_range);
            let (mut headings, mut q) = (vec![255; uavs], vec![0.0; uavs * policy.actions()]);
            policy.act(&mut [FleetStep {
                env: policy.env(),
                graph: &graph,
                profile: None,
                step,
                memory: &mut memory,
                headings: &mut headings,
                q_values: Some(&mut q),
            }]);
            assert!(headings.iter().all(|&heading| usize::from(heading) < policy.actions()), "{headings:?}");
        }
    }
}

/// Small configurations with every kind of agent and mixer.
fn configurations() -> impl Strategy<Value = TrainConfig> {
    let algorithm = prop::sample::select(vec!["qmix", "vdn", "iql", "qedgix", "agggnn", "rgcn"]);
    let preset = prop::sample::select(vec!["paper", "authors", "practical"]);
    let sizes = (1..5_usize, 1..6_usize, 1..4_usize, 1..4_usize);
    let observation = prop::sample::select(vec!["flat", "set"]);
    let identity = prop::sample::select(vec!["onehot", "phase", "token", "none"]);
    let range = prop::sample::select(vec![0.12, 0.28, 2.0]);
    (algorithm, preset, sizes, observation, identity, range, any::<[bool; 4]>()).prop_filter_map(
        "hops are for agents without a graph",
        |(algorithm, preset, (uavs, users, layers, hops), observation, identity, range, [position, loops, normalise, hover])| {
            let environment = json!({"uavs": uavs, "users": users, "detection_range": range, "hover": hover});
            let training = json!({"layers": layers, "hops": hops, "observation": observation, "identity": identity,
                "self_position": position, "self_loops": loops, "normalise": normalise});
            let named = |name: &str| serde_json::from_value(json!(name)).unwrap();
            let object = |value: &Value| value.as_object().unwrap().clone();
            let preset = serde_json::from_value(json!(preset)).unwrap();
            TrainConfig::resolve(named(algorithm), preset, &object(&environment), &object(&training), 1).ok()
        },
    )
}

/// The JSON pointers of all values in a document.
fn pointers(value: &Value, at: &str, found: &mut Vec<String>) {
    found.push(at.to_owned());
    match value {
        Value::Object(fields) => fields.iter().for_each(|(name, value)| pointers(value, &format!("{at}/{name}"), found)),
        Value::Array(items) => items.iter().enumerate().for_each(|(i, value)| pointers(value, &format!("{at}/{i}"), found)),
        _ => {}
    }
}

/// Replaces a value of `document` by another of its values, or by an unusual value.
fn disarrange(document: &mut Value, (to, from, other): (usize, usize, usize)) {
    let mut all = Vec::new();
    pointers(document, "", &mut all);
    let odd = [
        json!(null),
        json!(0),
        json!(-1),
        json!(1e300),
        json!(u64::MAX),
        json!(""),
        json!("F32"),
        json!([]),
        json!({}),
        json!(true),
    ];
    let value = if other < odd.len() { odd[other].clone() } else { document.pointer(&all[from % all.len()]).unwrap().clone() };
    *document.pointer_mut(&all[to % all.len()]).unwrap() = value;
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn damaged_bytes_do_not_panic(cut in 0.0..1.0_f64, flips in prop::collection::vec((0.0..1.0_f64, 0..8_u32), 0..4), head: bool) {
        let mut bytes = example(config()).to_bytes();
        // In half of the cases, only the header is damaged, because it is a small part of the file.
        let reach = if head { parts(&bytes).0.to_string().len() + 8 } else { bytes.len() };
        for (at, bit) in &flips {
            bytes[(at * reach as f64) as usize] ^= 1 << bit;
        }
        if flips.len() % 2 == 0 {
            bytes.truncate((cut * bytes.len() as f64) as usize);
            prop_assert!(Checkpoint::from_bytes(&bytes).is_err(), "a truncated file is an error");
        } else if let Ok(checkpoint) = Checkpoint::from_bytes(&bytes) {
            prop_assert!(checkpoint.parameters().iter().all(|x| x.is_finite()));
            run_policy(&checkpoint, 1);
        }
    }

    #[test]
    fn every_valid_checkpoint_runs(config in configurations(), scale in prop::sample::select(vec![0.1, 10.0, 1e6]), seed: u64) {
        let mut rng = qedgix::rng::stream(seed, "test-weights", 0);
        let weights = (0..checkpoint::parameter_layout(&config).len()).map(|_| rng.random_range(-scale..scale)).collect();
        let bytes = Checkpoint::new(config, 1, None, weights).unwrap().to_bytes();
        run_policy(&Checkpoint::from_bytes(&bytes).unwrap(), seed);
    }

    #[test]
    fn disarranged_headers_are_rejected_or_run(
        config in configurations(),
        changes in prop::collection::vec((any::<usize>(), any::<usize>(), 0..20_usize), 1..3),
        inner: bool,
    ) {
        let (mut header, data) = parts(&example(config).to_bytes());
        for &change in &changes {
            if inner {
                let mut inside: Value = serde_json::from_str(header["__metadata__"]["config"].as_str().unwrap()).unwrap();
                disarrange(&mut inside, change);
                header["__metadata__"]["config"] = inside.to_string().into();
            } else {
                disarrange(&mut header, change);
                if header["__metadata__"]["config"].as_str().is_none() {
                    break;
                }
            }
        }
        if let Ok(checkpoint) = Checkpoint::from_bytes(&file(&header, &data)) {
            run_policy(&checkpoint, 1);
        }
    }

    #[test]
    fn random_bytes_are_rejected(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
        prop_assert!(Checkpoint::from_bytes(&bytes).is_err());
    }
}
