//! Tensors in, tensors out: the same slot as `Act` sees, the same answer.

use std::sync::Arc;

use proptest::prelude::*;
use qedgix::api::convert::tensors::{Data, Tensor, fleet_input};
use qedgix::policy::EnvParams;
use qedgix::policy::baselines::{LIST, by_name};
use qedgix::policy::{FleetStep, RequiredInput};

use super::*;

/// The request for `scene` as `form`, and the message of Act that says the same.
fn both(policy: &str, form: &str, scene: &v1::Scene, ask: Ask) -> (Ask, v1::ActRequest) {
    let with_memory = |observation| v1::ActRequest {
        policy: policy.into(),
        observation: Some(observation),
        seed: Some(5),
        return_q_values: true,
        ..Default::default()
    };
    if form == "scene" {
        let request = with_memory(v1::act_request::Observation::Scene(scene.clone()));
        return (ask.scene(scene).ids(scene), request);
    }
    // In 32 bits relative coordinates are rounded; Act is told the same.
    let mut graph = graph(scene, 0.28, form == "graph");
    let node = |id: &str| graph.nodes.iter().position(|node| node.id == id).unwrap();
    let (mut ends, mut relative) = (Vec::new(), Vec::new());
    for (from, node_of) in graph.nodes.iter().enumerate() {
        for detection in &node_of.detections {
            ends.extend([from, node(&detection.target_id)]);
            relative.extend([detection.rel_x, detection.rel_y]);
        }
    }
    if !ask.wide {
        let seen = graph.nodes.iter_mut().flat_map(|node| &mut node.detections);
        seen.for_each(|d| (d.rel_x, d.rel_y) = (f64::from(d.rel_x as f32), f64::from(d.rel_y as f32)));
    }
    let own: Vec<f64> = scene.uavs.iter().flat_map(|u| [u.x, u.y]).collect();
    let edges = ends.len() / 2;
    let ask = ask
        .ids(scene)
        .integers("uav_count", &[1], &[scene.uavs.len()])
        .numbers("edge_relative", &[edges, 2], &relative)
        .ages(scene)
        .integers("edge_index", &[edges, 2], &ends)
        .numbers("uav_positions", &[scene.uavs.len(), 2], &own);
    (ask, with_memory(v1::act_request::Observation::Graph(graph)))
}

#[tokio::test]
async fn the_answers_of_act_to_the_bit() {
    let server = Server::start().await;
    let (mut oip, mut act) = (client(&server).await, server.grpc().await);
    for policy in ["qedgix", "qmix", "sweep", "nearest", "random"] {
        for form in ["scene", "graph", "graph of UAVs"] {
            for (how, wide) in [(As::Raw, false), (As::Raw, true), (As::Typed, false), (As::Typed, true)] {
                let (mut memory, mut held) = (Bytes::new(), Bytes::new());
                for step in 0..4 {
                    let mut scene = narrow(3, 5, 10 * step + 1);
                    scene.uavs.rotate_left(step as usize % 3);
                    scene.users.reverse();
                    let (ask, mut request) = both(policy, form, &scene, Ask::new(policy, how, wide));
                    let ask = ask.byte_strings("recurrent_state", &[&memory]).int("step", step as i64).int("seed", 5);
                    let answer = oip.model_infer(ask.request).await.unwrap().into_inner();
                    request.memory = Some(v1::act_request::Memory::RecurrentState(held));
                    let expected = act.act(request).await.unwrap().into_inner();
                    let place = format!("{policy}, {form}, {how:?}, wide {wide}, step {step}");
                    let headings: Vec<u32> = expected.actions.iter().map(|a| a.heading_index).collect();
                    assert_eq!(indices(&answer), headings, "{place}");
                    let degrees: Vec<f64> = expected.actions.iter().map(|a| a.heading_deg.unwrap()).collect();
                    assert_eq!(floats(&answer, "heading_deg").into_iter().map(f64::from).collect::<Vec<_>>(), degrees);
                    let values: Vec<f32> = expected.actions.iter().flat_map(|a| a.q_values.clone()).collect();
                    if values.is_empty() {
                        assert!(raw(&answer, "q_values").is_none(), "{place}");
                    } else {
                        assert_eq!(floats(&answer, "q_values"), values, "{place}");
                    }
                    assert_eq!((answer.model_name.as_str(), answer.model_version.as_str()), (policy, "1"));
                    (memory, held) = (state(&answer), expected.recurrent_state);
                    assert_eq!(memory, held, "{place}");
                }
            }
        }
    }
}

#[tokio::test]
async fn a_large_fleet() {
    let server = Server::start().await;
    let scene = narrow(60, 1500, 3);
    let ask = Ask::new("nearest", As::Raw, true).scene(&scene).int("seed", 1);
    let answer = client(&server).await.model_infer(ask.request).await.unwrap().into_inner();
    let request = v1::ActRequest { seed: Some(1), ..held("nearest", Bytes::new(), scene) };
    let expected = server.grpc().await.act(request).await.unwrap().into_inner();
    assert_eq!(indices(&answer), expected.actions.iter().map(|a| a.heading_index).collect::<Vec<_>>());
}

#[tokio::test]
async fn outputs_are_what_was_asked_for() {
    let server = Server::start().await;
    server.add("hovers", 1, Arc::new(TestPolicy::Count));
    let mut client = client(&server).await;
    let ask = || Ask::new("hovers", As::Raw, false).scene(&narrow(2, 1, 0)).int("seed", 8);
    let names = |answer: &oip::ModelInferResponse| answer.outputs.iter().map(|o| o.name.clone()).collect::<Vec<_>>();
    let all = client.model_infer(ask().request).await.unwrap().into_inner();
    assert_eq!(names(&all), ["heading_index", "heading_deg", "q_values", "recurrent_state"]);
    assert_eq!(all.outputs.iter().map(|o| o.datatype.as_str()).collect::<Vec<_>>(), ["INT32", "FP32", "FP32", "BYTES"]);
    assert_eq!(
        (raw(&all, "q_values").unwrap().0, &floats(&all, "q_values")[..9]),
        (&[2, 9][..], &[0., 1., 2., 3., 4., 5., 6., 7., 8.][..])
    );
    assert_eq!(indices(&all), [8, 8]);
    assert!(floats(&all, "heading_deg").iter().all(|x| x.is_nan()), "hovering has no direction");
    let some = client.model_infer(ask().asking(&["q_values", "heading_index"]).request).await.unwrap().into_inner();
    assert_eq!(names(&some), ["q_values", "heading_index"]);
    let none = Ask::new("sweep", As::Raw, false).scene(&narrow(2, 1, 0)).asking(&["q_values"]);
    let none = client.model_infer(none.request).await.unwrap().into_inner();
    assert_eq!((raw(&none, "q_values").unwrap().0, floats(&none, "q_values").iter().all(|x| x.is_nan())), (&[2, 8][..], true));
    let mut request = ask().request;
    (request.id, request.model_name) = ("an id".into(), "hovers:1".into());
    let answer = client.model_infer(request).await.unwrap().into_inner();
    assert_eq!((answer.id.as_str(), answer.model_name.as_str(), answer.model_version.as_str()), ("an id", "hovers:1", "1"));
    let parameter = |name: &str| answer.parameters[name].parameter_choice.clone().unwrap();
    assert_eq!(parameter("step"), ParameterChoice::Int64Param(0));
    assert_eq!(parameter("digest"), ParameterChoice::StringParam("01".repeat(32)));
}

type Change = fn(&mut oip::ModelInferRequest);

fn input<'a>(request: &'a mut oip::ModelInferRequest, name: &str) -> &'a mut oip::model_infer_request::InferInputTensor {
    request.inputs.iter_mut().find(|input| input.name == name).unwrap()
}

fn raw_of<'a>(request: &'a mut oip::ModelInferRequest, name: &str) -> &'a mut Bytes {
    let at = request.inputs.iter().position(|input| input.name == name).unwrap();
    &mut request.raw_input_contents[at]
}

fn remove(request: &mut oip::ModelInferRequest, name: &str) {
    let at = request.inputs.iter().position(|input| input.name == name).unwrap();
    request.inputs.remove(at);
    request.raw_input_contents.remove(at);
}

fn parameter(request: &mut oip::ModelInferRequest, name: &str, value: ParameterChoice) {
    request.parameters.insert(name.into(), oip::InferParameter { parameter_choice: Some(value) });
}

fn le(values: &[f32]) -> Bytes {
    values.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<_>>().into()
}

#[tokio::test]
async fn what_cannot_be_used_is_named() {
    let server = Server::start().await;
    let mut client = client(&server).await;
    let scene = narrow(2, 3, 4);
    let good = || Ask::new("sweep", As::Raw, false).scene(&scene).ids(&scene).request;
    client.model_infer(good()).await.unwrap();
    let cases: &[(&str, &str, Change)] = &[
        ("model_name", "\"\"", |r| r.model_name.clear()),
        ("model_name", "\"a b\"", |r| r.model_name = "a b".into()),
        ("model_version", "\"0\"", |r| r.model_version = "0".into()),
        ("model_version", "\"-1\"", |r| r.model_version = "-1".into()),
        ("model_version", "\"2\"", |r| (r.model_name, r.model_version) = ("sweep:1".into(), "2".into())),
        ("model_version", "\"1\"", |r| (r.model_name, r.model_version) = ("sweep@live".into(), "1".into())),
        ("inputs[1].name", "\"users\"", |r| input(r, "user_positions").name = "users".into()),
        ("inputs[2].name", "\"user_aoi\"", |r| input(r, "user_positions").name = "user_aoi".into()),
        ("raw_input_contents", "4 entries", |r| drop(r.raw_input_contents.pop())),
        ("inputs[0].contents", "values", |r| input(r, "uav_positions").contents = Some(oip::InferTensorContents::default())),
        ("user_aoi", "0 values", |r| {
            r.raw_input_contents.clear();
            r.inputs.iter_mut().for_each(|input| input.contents = None);
        }),
        ("uav_positions.datatype", "\"INT32\"", |r| input(r, "uav_positions").datatype = "INT32".into()),
        ("uav_positions.datatype", "\"fp32\"", |r| input(r, "uav_positions").datatype = "fp32".into()),
        ("uav_positions.datatype", "\"BYTES\"", |r| input(r, "uav_positions").datatype = "BYTES".into()),
        ("uav_ids.datatype", "\"FP32\"", |r| input(r, "uav_ids").datatype = "FP32".into()),
        ("uav_positions", "16 bytes", |r| input(r, "uav_positions").datatype = "FP64".into()),
        ("uav_positions", "15 bytes", |r| *raw_of(r, "uav_positions") = Bytes::from_static(&[0; 15])),
        ("uav_positions.shape", "[]", |r| input(r, "uav_positions").shape.clear()),
        ("uav_positions", "no UAV", |r| {
            input(r, "uav_positions").shape = vec![0, 2];
            input(r, "uav_ids").shape = vec![0];
        }),
        ("uav_positions.shape", "[4]", |r| input(r, "uav_positions").shape = vec![4]),
        ("uav_positions.shape", "[2, 2, 1]", |r| input(r, "uav_positions").shape = vec![2, 2, 1]),
        ("uav_positions.shape", "[-2, 2]", |r| input(r, "uav_positions").shape = vec![-2, 2]),
        ("uav_positions.shape", "[4611686018427387904, 2]", |r| input(r, "uav_positions").shape = vec![1 << 62, 2]),
        ("uav_positions.shape", "[20001, 2]", |r| input(r, "uav_positions").shape = vec![20_001, 2]),
        ("user_aoi.shape", "[9223372036854775807]", |r| input(r, "user_aoi").shape = vec![i64::MAX]),
        ("user_aoi", "12 bytes", |r| input(r, "user_aoi").shape = vec![4]),
        ("user_positions.shape", "[2, 2]", |r| input(r, "user_positions").shape = vec![2, 2]),
        ("user_ids.shape", "[2]", |r| input(r, "user_ids").shape = vec![2]),
        ("uav_ids", "3 UAVs", |r| input(r, "uav_ids").shape = vec![3]),
        ("uav_positions[1].x", "NaN", |r| *raw_of(r, "uav_positions") = le(&[0.0, 0.0, f32::NAN, 0.0])),
        ("user_positions[2].y", "inf", |r| *raw_of(r, "user_positions") = le(&[0.0, 0.0, 0.0, 0.0, 0.0, f32::INFINITY])),
        ("user_positions[0].x", "20000", |r| *raw_of(r, "user_positions") = le(&[20_000.0, 0.0, 0.0, 0.0, 0.0, 0.0])),
        ("user_aoi[1]", "-1", |r| *raw_of(r, "user_aoi") = le(&[0.0, -1.0, 0.0])),
        ("uav_ids", "6 bytes", |r| *raw_of(r, "uav_ids") = Bytes::from_static(b"\x05\0\0\0ab")),
        ("uav_ids", "8 bytes, 8 of them for element 0", |r| {
            *raw_of(r, "uav_ids") = Bytes::from_static(b"\x05\0\0\0abcd");
        }),
        ("uav_ids", "8 bytes, 8 of them for element 0", |r| {
            *raw_of(r, "uav_ids") = Bytes::from_static(b"\xff\xff\xff\xffabcd");
        }),
        ("uav_ids", "11 bytes, 1 of them for element 2", |r| {
            *raw_of(r, "uav_ids") = Bytes::from_static(b"\x01\0\0\0a\x01\0\0\0bc");
        }),
        ("uav_ids[1]", "\"\u{fffd}\"", |r| *raw_of(r, "uav_ids") = Bytes::from_static(b"\x01\0\0\0a\x01\0\0\0\xff")),
        ("uav_ids[0]", "\"\"", |r| *raw_of(r, "uav_ids") = Bytes::from_static(b"\0\0\0\0\x01\0\0\0b")),
        ("uav_ids[1]", "\"a\"", |r| *raw_of(r, "uav_ids") = Bytes::from_static(b"\x01\0\0\0a\x01\0\0\0a")),
        ("user_aoi", "", |r| remove(r, "user_aoi")),
        ("uav_positions", "", |r| remove(r, "uav_positions")),
        ("user_positions", "", |r| remove(r, "user_positions")),
        ("outputs[0].name", "\"headings\"", |r| r.outputs = Ask::new("", As::Raw, false).asking(&["headings"]).request.outputs),
        ("outputs[1].name", "\"heading_deg\"", |r| {
            r.outputs = Ask::new("", As::Raw, false).asking(&["heading_deg", "heading_deg"]).request.outputs;
        }),
        ("inputs[2].parameters", "\"shared_memory_region\"", |r| {
            let parameters = Ask::new("", As::Raw, false).flag("shared_memory_region").request.parameters;
            input(r, "user_aoi").parameters = parameters;
        }),
        ("outputs[0].parameters", "\"classification\"", |r| {
            r.outputs = Ask::new("", As::Raw, false).asking(&["heading_deg"]).request.outputs;
            r.outputs[0].parameters = Ask::new("", As::Raw, false).int("classification", 3).request.parameters;
        }),
        ("parameters", "\"sequence_strat\"", |r| parameter(r, "sequence_strat", ParameterChoice::BoolParam(true))),
        ("parameters.sequence_start", "1", |r| parameter(r, "sequence_start", ParameterChoice::Int64Param(1))),
        ("parameters.sequence_id", "", |r| parameter(r, "sequence_start", ParameterChoice::BoolParam(true))),
        ("parameters.sequence_id", "true", |r| parameter(r, "sequence_id", ParameterChoice::BoolParam(true))),
        ("parameters.sequence_id", "\"xxx", |r| parameter(r, "sequence_id", ParameterChoice::StringParam("x".repeat(129)))),
        ("parameters.step", "-1", |r| parameter(r, "step", ParameterChoice::Int64Param(-1))),
        ("parameters.step", "1.0", |r| parameter(r, "step", ParameterChoice::DoubleParam(1.0))),
        ("parameters.seed", "\"7\"", |r| parameter(r, "seed", ParameterChoice::StringParam("7".into()))),
        ("parameters.timeout", "", |r| drop(r.parameters.insert("timeout".into(), oip::InferParameter::default()))),
    ];
    for (field, value, change) in cases {
        let mut request = good();
        change(&mut request);
        assert_invalid(client.model_infer(request).await, field, value);
    }
    let mut typed = Ask::new("sweep", As::Typed, false).scene(&scene).request;
    input(&mut typed, "user_aoi").contents.as_mut().unwrap().fp32_contents.pop();
    assert_invalid(client.model_infer(typed).await, "user_aoi", "2 values");
}

#[tokio::test]
async fn edges_that_cannot_be_used_are_named() {
    let server = Server::start().await;
    let mut client = client(&server).await;
    let send = |ends: &[usize], relative: &[f64]| {
        let edges = [ends.len() / 2, 2];
        Ask::new("random", As::Typed, true)
            .integers("uav_count", &[1], &[2])
            .numbers("user_aoi", &[2], &[3.0, 4.0])
            .integers("edge_index", &edges, ends)
            .numbers("edge_relative", &edges, relative)
    };
    client.model_infer(send(&[0, 2, 0, 1, 2, 0], &[0.1, 0.0, 0.0, 0.1, -0.1, 0.0]).request).await.unwrap();
    // Two nodes need not agree, and a sensor may be inexact.
    client.model_infer(send(&[0, 1, 1, 0], &[0.1, 0.0, 0.1, 0.3]).request).await.unwrap();
    let cases = [
        (send(&[0, 4], &[0.1, 0.0]), "edge_index[0]", "4"),
        (send(&[0, 2, usize::MAX, 1], &[0.1, 0.0, 0.1, 0.0]), "edge_index[1]", "-1"),
        (send(&[1, 1], &[0.1, 0.0]), "edge_index[0]", "[1, 1]"),
        (send(&[0, 1, 2, 1, 0, 1], &[0.1, 0.0, 0.1, 0.1, 0.1, 0.0]), "edge_index[2]", "[0, 1]"),
        (send(&[0, 2], &[0.1, f64::NAN]), "edge_relative[0][1]", "NaN"),
        (send(&[0, 1, 0, 2], &[0.1, 0.0, 0.6, 0.0]), "edge_relative[1]", "(0.6, 0)"),
        (send(&[], &[]).numbers("user_positions", &[2, 2], &[0.0; 4]), "user_positions", "a tensor"),
        (send(&[0, 1], &[0.1, 0.0]).integers("uav_ids", &[1], &[2]), "uav_ids", "1 UAVs"),
    ];
    for (ask, field, value) in cases {
        assert_invalid(client.model_infer(ask.request).await, field, value);
    }
    let mut zero = send(&[], &[]);
    zero.request.inputs[0].contents.as_mut().unwrap().int64_contents = vec![0];
    assert_invalid(client.model_infer(zero.request).await, "uav_count", "0");
    let mut own = send(&[0, 2], &[0.1, 0.0]).request;
    own.model_name = "sweep".into();
    assert_invalid(client.model_infer(own).await, "uav_positions", "");
}

fn datatype() -> impl Strategy<Value = String> {
    let known = prop::sample::select(vec!["FP32", "FP64", "INT32", "INT64", "BYTES"]).prop_map(str::to_owned);
    prop_oneof![30 => known, 1 => "[A-Z0-9]{0,5}"]
}

/// Values that often fit: bytes of small numbers and lengths, or typed.
fn data() -> impl Strategy<Value = Data> {
    let small = prop_oneof![3 => Just(0_u8), 1 => Just(1), 1 => any::<u8>()];
    let number = prop_oneof![5 => -0.3..0.3_f64, 1 => any::<f64>()];
    prop_oneof![
        4 => prop::collection::vec(small, 0..40).prop_map(|raw| Data::Raw(raw.into())),
        1 => prop::collection::vec(-1..5_i32, 0..8).prop_map(Data::Int32),
        1 => prop::collection::vec(prop_oneof![9 => -1..5_i64, 1 => any::<i64>()], 0..8).prop_map(Data::Int64),
        1 => prop::collection::vec(-0.3..90.0_f32, 0..8).prop_map(Data::Fp32),
        2 => prop::collection::vec(number, 0..8).prop_map(Data::Fp64),
        1 => prop::collection::vec("\\PC{0,3}".prop_map(|s| Bytes::from(s.into_bytes())), 0..4).prop_map(Data::Bytes),
    ]
}

/// A tensor of any shape and values.
fn wild(name: &'static str) -> impl Strategy<Value = Tensor> {
    let size = prop_oneof![20 => 0..4_i64, 1 => any::<i64>()];
    let parts = (datatype(), prop::collection::vec(size, 0..4), data());
    parts.prop_map(move |(datatype, shape, data)| Tensor { name: name.into(), datatype, shape, data })
}

/// A tensor of `count` rows of `inner` values that may well be used.
fn fitting(name: &'static str, rows: usize, inner: usize, nodes: usize) -> impl Strategy<Value = Tensor> {
    let number = prop_oneof![30 => -0.15..0.15_f64, 1 => any::<f64>()];
    (prop::collection::vec(number, rows * inner), any::<bool>()).prop_map(move |(values, raw)| {
        let whole = |x: &f64| (x.abs() * 1e4) as i64 % nodes as i64;
        let (datatype, data) = match name {
            "uav_ids" | "user_ids" => {
                let id = |(i, x): (usize, &f64)| Bytes::from(format!("{}{i}{}", &name[..2], whole(x)));
                ("BYTES", Data::Bytes(values.iter().enumerate().map(id).collect()))
            }
            "edge_index" => ("INT64", Data::Int64(values.iter().map(whole).collect())),
            "user_aoi" => ("FP32", Data::Fp32(values.iter().map(|x| x.abs() as f32).collect())),
            _ => ("FP64", Data::Fp64(values)),
        };
        let data = if raw { Data::Raw(data.into_raw()) } else { data };
        let shape = [rows as i64, inner as i64][..if inner == 1 { 1 } else { 2 }].to_vec();
        Tensor { name: name.into(), datatype: datatype.into(), shape, data }
    })
}

/// Tensors that fit together, of which some are left out and some are replaced.
fn tensors() -> impl Strategy<Value = Vec<Tensor>> {
    (1..4_usize, 1..4_usize, 0..5_usize, any::<bool>()).prop_flat_map(|(uavs, users, edges, scene)| {
        let part = |name, rows, inner, weight: f64| {
            let tensor = prop_oneof![24 => fitting(name, rows, inner, uavs + users), 1 => wild(name)];
            prop::option::weighted(weight, tensor)
        };
        let (scene, graph) = if scene { (0.99, 0.01) } else { (0.01, 0.99) };
        let form = (
            part("user_positions", users, 2, scene),
            part("edge_index", edges, 2, graph),
            part("edge_relative", edges, 2, graph),
        );
        let ids = (part("uav_ids", uavs, 1, 0.3), part("user_ids", users, 1, 0.3));
        let count =
            Tensor { name: "uav_count".into(), datatype: "INT32".into(), shape: vec![1], data: Data::Int32(vec![uavs as i32]) };
        let count = prop::option::weighted(0.2, prop_oneof![9 => Just(count), 1 => wild("uav_count")]);
        let rest = (part("uav_positions", uavs, 2, 0.9), part("user_aoi", users, 1, 0.99), count);
        (form, ids, rest).prop_map(|((a, b, c), (d, e), (f, g, h))| [a, b, c, d, e, f, g, h].into_iter().flatten().collect())
    })
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 8000, failure_persistence: None, ..ProptestConfig::default() })]

    /// Whatever is sent is refused with the name of a tensor, or is a slot that every policy it fits can decide.
    #[test]
    fn tensors_never_panic(mut tensors in tensors()) {
        let observation = match fleet_input(&mut tensors) {
            Ok(observation) => observation,
            Err(refused) => {
                prop_assert!(!refused.field.is_empty() && !refused.expected.is_empty(), "{refused}");
                return Ok(());
            }
        };
        let (uavs, users) = (observation.uavs(), observation.users());
        prop_assert_eq!(observation.canonical_of_request.len(), uavs);
        for baseline in LIST.iter().filter(|baseline| baseline.needs != RequiredInput::FullScene) {
            let policy = by_name(baseline.name, EnvParams::default()).unwrap();
            let Ok(slot) = observation.clone().into_fleet_graph(&*policy) else { continue };
            let mut memory = vec![0.0; policy.memory_len(uavs, users)];
            policy.start(uavs, users, 3, &mut memory);
            let mut headings = vec![0; uavs];
            policy.act(&mut [FleetStep { env: policy.env(), graph: &slot, profile: None, step: 0, memory: &mut memory, headings: &mut headings, q_values: None }]);
        }
    }
}
