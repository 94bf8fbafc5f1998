//! Inputs made wrong at random, over the real services without a network between: no panic, no hang, bounded memory.
//!
//! Every input is a valid one that was cut, spliced, flipped or fed with extreme numbers; the same number of inputs is the
//! same inputs. And once more with API keys and TLS, over the network. A few thousand by default; for more:
//!
//!     QEDGIX_FUZZ_INPUTS=1000000 cargo test --release --test fuzz -- --nocapture

#[path = "certificates/mod.rs"]
mod certificates;
#[path = "process/mod.rs"]
mod process;
#[path = "fuzz/secured.rs"]
mod secured;

use std::collections::BTreeMap;
use std::convert::Infallible;
use std::net::Ipv4Addr;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use axum::body::Body;
use axum::http::{Request, Response, header};
use prost::Message;
use qedgix::api::body::{Exchange, IncomingBody};
use qedgix::api::{AllowedHosts, grpc, rest};
use qedgix::checkpoint::{Checkpoint, parameter_layout};
use qedgix::clock::Clock;
use qedgix::config::Config;
use qedgix::inflight::{Budget, Purse};
use qedgix::policy::{FleetGraph, FleetStep, Policy};
use qedgix::server::{self, DataDir};
use qedgix::service::App;
use qedgix::telemetry;
use qedgix::train_config::{Algorithm, Preset, TrainConfig};
use qedgix::wire::{oip, v1};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use serde_json::json;
use tokio_util::sync::CancellationToken;
use tower::util::BoxCloneSyncService;
use tower::{ServiceBuilder, ServiceExt};

use self::secured::Secured;

/// Largest body and message, in bytes.
const LARGEST: usize = 1 << 20;
/// Most memory that one input may take at a time, in bytes.
const MEMORY: u64 = 64 << 20;
/// Ways into the server. TLS only where it is on.
const KINDS: [&str; 5] = ["proto", "JSON", "tensors", "safetensors", "TLS"];
/// An input that takes longer hangs.
const LONGEST: Duration = Duration::from_secs(10);

/// How the inputs reach the server.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Access {
    /// Its services are called directly.
    Open,
    /// Over TLS, with API keys.
    KeysAndTls,
}

/// Numbers, words and shapes that programs trip over.
const TOKENS: [&str; 24] = [
    "0",
    "-1",
    "1e308",
    "1e999",
    "-0.0",
    "18446744073709551615",
    "9223372036854775808",
    "-9223372036854775809",
    "4294967296",
    "NaN",
    "null",
    "true",
    "\"\"",
    "[]",
    "{}",
    "[[[[[[[[",
    "\"\\u0000\"",
    "\"\\ud800\"",
    "1e-320",
    "0x10",
    "00",
    "\"a\":",
    ",,",
    "\u{feff}",
];

/// Makes a valid input wrong, or leaves it.
fn spoil(rng: &mut ChaCha8Rng, valid: &[u8], other: &[u8]) -> Vec<u8> {
    let mut bytes = valid.to_vec();
    for _ in 0..rng.random_range(0..4) {
        let at = rng.random_range(0..=bytes.len());
        let rest = bytes.len() - at;
        match rng.random_range(0..8) {
            0 => bytes.truncate(at),
            1 if rest > 0 => bytes[at] ^= 1 << rng.random_range(0..8),
            2 if rest > 0 => bytes[at] = rng.random(),
            3 => drop(bytes.splice(at..at, (0..rng.random_range(1..9)).map(|_| rng.random::<u8>()).collect::<Vec<_>>())),
            4 => drop(bytes.splice(at..at + rng.random_range(0..=rest.min(16)), [])),
            5 => {
                let from = rng.random_range(0..=other.len());
                let to = rng.random_range(from..=other.len());
                bytes.splice(at..at + rng.random_range(0..=rest), other[from..to].iter().copied());
            }
            6 => {
                // A number or a word of JSON becomes another.
                let word = |b: u8| b.is_ascii_alphanumeric() || matches!(b, b'.' | b'-' | b'+' | b'"' | b'_');
                let begin = (0..at).rev().find(|&i| !word(bytes[i])).map_or(0, |i| i + 1);
                let end = (at..bytes.len()).find(|&i| !word(bytes[i])).unwrap_or(bytes.len());
                bytes.splice(begin..end, TOKENS[rng.random_range(0..TOKENS.len())].bytes());
            }
            _ => {
                let extreme: [u8; 8] = match rng.random_range(0..4) {
                    0 => f64::NAN.to_le_bytes(),
                    1 => f64::INFINITY.to_le_bytes(),
                    2 => u64::MAX.to_le_bytes(),
                    _ => (1_u64 << rng.random_range(0..64)).to_le_bytes(),
                };
                let end = (at + 8).min(bytes.len());
                bytes.splice(at..end, extreme);
            }
        }
    }
    bytes
}

fn scene(users: usize) -> v1::Scene {
    let uav = |i| v1::SceneUav { id: format!("uav-{i}"), x: 0.2 * f64::from(i), y: 0.3, ..Default::default() };
    let user = |j: usize| v1::SceneUser { id: format!("user-{j}"), x: 0.15 * j as f64, y: 0.4, aoi: j as f64, z: None };
    v1::Scene { uavs: (0..3).map(uav).collect(), users: (0..users).map(user).collect() }
}

fn graph() -> v1::Graph {
    let sees = |id: &str, aoi| v1::Detection { target_id: id.into(), rel_x: 0.05, rel_y: -0.02, aoi, rel_z: None };
    let node = |id: &str, kind: v1::NodeKind, detections| v1::Node {
        id: id.into(),
        kind: kind.into(),
        detections,
        position: (kind == v1::NodeKind::Uav).then_some(v1::Position { x: 0.5, y: 0.5, z: None }),
        aoi: (kind == v1::NodeKind::User).then_some(4.0),
        ..Default::default()
    };
    v1::Graph {
        nodes: vec![
            node("a", v1::NodeKind::Uav, vec![sees("b", None), sees("u", Some(4.0))]),
            node("b", v1::NodeKind::Uav, vec![]),
            node("u", v1::NodeKind::User, vec![]),
        ],
    }
}

/// Requests of gRPC: method and message.
fn messages() -> Vec<(&'static str, Vec<u8>)> {
    use v1::act_request::{Memory, Observation};
    let act = |policy: &str, observation, memory| v1::ActRequest {
        policy: policy.into(),
        observation: Some(observation),
        memory,
        step: Some(0),
        return_q_values: true,
        seed: Some(1),
        ..Default::default()
    };
    let scene_act = act("qedgix", Observation::Scene(scene(5)), None);
    let graph_act = act("qedgix", Observation::Graph(graph()), None);
    let session = v1::ActRequest { seed: None, ..act("", Observation::Scene(scene(5)), Some(Memory::SessionId("s".into()))) };
    let batch = v1::ActBatchRequest { requests: vec![scene_act.clone(), graph_act.clone(), session.clone()] };
    let config = Some(prost_types::Struct {
        fields: BTreeMap::from([(
            "users".to_owned(),
            prost_types::Value { kind: Some(prost_types::value::Kind::NumberValue(4.0)) },
        )]),
    });
    let open = v1::OpenSessionRequest {
        policy: "sweep".into(),
        session_id: "s".into(),
        run_id: None,
        seed: Some(3),
        ..Default::default()
    };
    let environment = v1::CreateEnvironmentRequest { environment_id: "e".into(), environment: config, ..Default::default() };
    let observation = graph().nodes.into_iter().find(|node| node.kind == i32::from(v1::NodeKind::Uav));
    let of_kind =
        |kind: v1::NodeKind| graph().nodes.into_iter().filter(|node| node.kind == i32::from(kind)).map(|node| node.id).collect();
    let (uav_ids, user_ids) = (of_kind(v1::NodeKind::Uav), of_kind(v1::NodeKind::User));
    let alone = v1::EncodeRequest { policy: "qedgix".into(), uav_ids, user_ids, observation, ..Default::default() };
    let step = v1::StepRequest { environment_id: "e".into(), ..Default::default() };
    vec![
        ("qedgix.v1.PolicyService/Act", scene_act.encode_to_vec()),
        ("qedgix.v1.PolicyService/Act", graph_act.encode_to_vec()),
        ("qedgix.v1.PolicyService/Act", session.encode_to_vec()),
        ("qedgix.v1.PolicyService/Act", act("tour", Observation::Scene(scene(4)), None).encode_to_vec()),
        ("inference.GRPCInferenceService/ModelInfer", infer(true)),
        ("inference.GRPCInferenceService/ModelInfer", infer(false)),
        ("inference.GRPCInferenceService/ModelStreamInfer", infer(true)),
        ("qedgix.v1.PolicyService/ActStream", scene_act.encode_to_vec()),
        ("qedgix.v1.PolicyService/ActBatch", batch.encode_to_vec()),
        ("qedgix.v1.PolicyService/Encode", alone.encode_to_vec()),
        ("qedgix.v1.PolicyService/OpenSession", open.encode_to_vec()),
        (
            "qedgix.v1.PolicyService/ListSessions",
            v1::ListSessionsRequest { page_size: 2, page_token: "a".into() }.encode_to_vec(),
        ),
        ("qedgix.v1.PolicyService/GetPolicy", v1::GetPolicyRequest { policy: "qedgix:1".into() }.encode_to_vec()),
        ("qedgix.v1.EnvironmentService/CreateEnvironment", environment.encode_to_vec()),
        ("qedgix.v1.EnvironmentService/Step", step.encode_to_vec()),
    ]
}

/// A slot of the Open Inference Protocol, its values raw or typed.
fn infer(raw: bool) -> Vec<u8> {
    use oip::infer_parameter::ParameterChoice as P;
    use oip::model_infer_request::{InferInputTensor, InferRequestedOutputTensor};
    let tensors: [(&str, &[i64], Vec<f32>); 3] = [
        ("uav_positions", &[2, 2], vec![0.1, 0.2, 0.3, 0.4]),
        ("user_positions", &[3, 2], vec![0.5, 0.1, 0.2, 0.2, 0.9, 0.9]),
        ("user_aoi", &[3], vec![1.0, 2.0, 3.0]),
    ];
    let input = |(name, shape, values): &(&str, &[i64], Vec<f32>)| InferInputTensor {
        name: (*name).into(),
        datatype: "FP32".into(),
        shape: shape.to_vec(),
        contents: (!raw).then(|| oip::InferTensorContents { fp32_contents: values.clone(), ..Default::default() }),
        ..Default::default()
    };
    let bytes = |values: &[f32]| values.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>().into();
    let parameter = |choice| oip::InferParameter { parameter_choice: Some(choice) };
    oip::ModelInferRequest {
        model_name: "qedgix".into(),
        id: "1".into(),
        parameters: [("sequence_id", P::Int64Param(5)), ("sequence_start", P::BoolParam(true)), ("seed", P::Int64Param(3))]
            .map(|(name, choice)| (name.to_owned(), parameter(choice)))
            .into(),
        inputs: tensors.iter().map(input).collect(),
        outputs: vec![InferRequestedOutputTensor { name: "q_values".into(), ..Default::default() }],
        raw_input_contents: if raw { tensors.iter().map(|(_, _, values)| bytes(values)).collect() } else { Vec::new() },
        ..Default::default()
    }
    .encode_to_vec()
}

/// The same over HTTP: its JSON, and what follows it.
fn tensors(binary: bool) -> (String, Vec<u8>) {
    let values = [0.1_f32, 0.2, 0.3, 0.4];
    let positions = if binary {
        json!({"name": "uav_positions", "datatype": "FP32", "shape": [2, 2], "parameters": {"binary_data_size": 16}})
    } else {
        json!({"name": "uav_positions", "datatype": "FP32", "shape": [2, 2], "data": [0.1, 0.2, 0.3, 0.4]})
    };
    let document = json!({
        "id": "7",
        "parameters": {"sequence_id": "a", "sequence_start": true, "binary_data_output": binary},
        "inputs": [
            positions,
            {"name": "edge_index", "datatype": "INT64", "shape": [1, 2], "data": [[0, 2]]},
            {"name": "edge_relative", "datatype": "FP32", "shape": [1, 2], "data": [[0.1, 0.0]]},
            {"name": "user_aoi", "datatype": "FP32", "shape": [3], "data": [1, 2, 3]},
            {"name": "uav_ids", "datatype": "BYTES", "shape": [2], "data": ["a", "b"]},
        ],
        "outputs": [{"name": "heading_index"}, {"name": "q_values", "parameters": {"binary_data": binary}}],
    });
    (document.to_string(), if binary { values.iter().flat_map(|x| x.to_le_bytes()).collect() } else { Vec::new() })
}

/// Requests of REST: method, path, content type, body.
fn documents() -> Vec<(&'static str, &'static str, &'static str, Vec<u8>)> {
    let json = |value: serde_json::Value| value.to_string().into_bytes();
    let users: Vec<_> = (0..3).map(|j| json!({"id": format!("u{j}"), "x": 0.1 * f64::from(j), "y": 0.5, "aoi": j})).collect();
    let scene = json!({"uavs": [{"id": "a", "x": 0.1, "y": 0.2}, {"id": "b", "x": 0.4, "y": 0.2}], "users": users});
    let nodes = json!([
        {"id": "a", "kind": "uav", "position": {"x": 0.5, "y": 0.5},
         "detections": [{"target_id": "u", "rel_x": 0.1, "rel_y": -0.1, "aoi": 3}]},
        {"id": "u", "kind": "user", "aoi": 3},
    ]);
    const JSON: &str = "application/json";
    vec![
        ("POST", "/v1/act", JSON, json(json!({"policy": "qedgix", "scene": scene, "return_q_values": true, "seed": 5}))),
        ("POST", "/v1/act", JSON, json(json!({"policy": "sweep", "graph": {"nodes": nodes}}))),
        ("POST", "/v1/act", JSON, json(json!({"session_id": "t", "scene": scene, "step": 0, "run_id": "r"}))),
        (
            "POST",
            "/v1/encode",
            JSON,
            json(json!({"policy": "qedgix", "uav_ids": ["a"], "user_ids": ["u"], "observation": nodes[0]})),
        ),
        ("POST", "/v1/sessions", JSON, json(json!({"policy": "qedgix", "session_id": "t", "seed": 1}))),
        ("POST", "/v2/models/qedgix/infer", JSON, tensors(false).0.into_bytes()),
        ("POST", "/v2/models/sweep/versions/1/infer", JSON, tensors(false).0.into_bytes()),
        ("POST", "/v2/repository/models/nobody/load", JSON, json(json!({"parameters": {"config": "{}"}}))),
        ("POST", "/v1/environments", JSON, json(json!({"environment": {"users": 4, "slots": 20}, "seed": 1}))),
    ]
}

struct Subject {
    app: Arc<App>,
    rest: BoxCloneSyncService<Request<Body>, Response<Body>, Infallible>,
    grpc: BoxCloneSyncService<Request<Body>, Response<Body>, Infallible>,
    /// Where the server requires keys and speaks TLS.
    secured: Option<Secured>,
    checkpoint: Vec<u8>,
    graph: FleetGraph,
}

impl Subject {
    async fn new(dir: &std::path::Path, access: Access) -> Self {
        let mut config = Config::new(dir);
        config.environment_memory = 1 << 20;
        config.max_message_size = LARGEST;
        (config.max_sessions, config.max_environments) = (64, 16);
        telemetry::install_metrics();
        let (app, rest, grpc, secured) = match access {
            Access::Open => {
                let data = DataDir::lock(dir).unwrap();
                let app = server::open(&config, &data, Clock::system()).await.unwrap();
                let health = grpc::Health::new(app.draining.clone(), CancellationToken::new());
                let services =
                    grpc::services(&app, &health, LARGEST, tokio::runtime::Handle::current(), CancellationToken::new());
                let purse = Purse::new(Budget::new(1 << 30));
                let incoming = move |body| IncomingBody::http1(body, Exchange::http1(purse.clone(), false), LONGEST);
                let grpc = ServiceBuilder::new()
                    .map_request(move |request: Request<Body>| request.map(&incoming))
                    .map_response(|r: Response<_>| r.map(Body::new))
                    .service(services);
                let rest = rest::router(
                    app.clone(),
                    telemetry::render_metrics,
                    LARGEST,
                    AllowedHosts::new(Ipv4Addr::LOCALHOST.into(), &[]),
                    tokio::runtime::Handle::current(),
                );
                (app, BoxCloneSyncService::new(rest), BoxCloneSyncService::new(grpc), None)
            }
            Access::KeysAndTls => {
                let secured = Secured::start(dir, config).await;
                (secured.app.clone(), secured.service(false), secured.service(true), Some(secured))
            }
        };
        let mut config = TrainConfig::preset(Algorithm::Vdn, Preset::Practical);
        config.environment.reward_scale = Some(1.0);
        let weights = (0..parameter_layout(&config).len()).map(|i| (i % 7) as f32 * 0.01).collect();
        let points = |n: usize| (0..n).map(|i| [0.1 * i as f64, 0.2]).collect::<Vec<_>>();
        Self {
            app,
            rest,
            grpc,
            secured,
            checkpoint: Checkpoint::new(config, 1, None, weights).unwrap().to_bytes(),
            graph: FleetGraph::from_scene(&points(3), &points(5), &[1.0; 5], 0.28),
        }
    }

    /// The ways into this server.
    fn kinds(&self) -> &'static [&'static str] {
        if self.secured.is_some() { &KINDS } else { &KINDS[..4] }
    }

    /// Sends a message; the code of the status.
    async fn call(&self, method: &str, message: &[u8]) -> String {
        let mut body = vec![0];
        body.extend((message.len() as u32).to_be_bytes());
        body.extend(message);
        let request = Request::post(format!("http://here/{method}"))
            .header(header::CONTENT_TYPE, "application/grpc")
            .header("te", "trailers")
            .body(Body::from(body));
        let response = self.grpc.clone().oneshot(request.unwrap()).await.unwrap();
        let (head, body) = response.into_parts();
        let body = http_body_util::BodyExt::collect(body).await.unwrap();
        let status = head.headers.get("grpc-status").or_else(|| body.trailers()?.get("grpc-status"));
        status.map_or_else(|| "none".to_owned(), |status| status.to_str().unwrap().to_owned())
    }

    async fn send(&self, (verb, path, content_type, _): &(&str, &str, &str, Vec<u8>), body: Vec<u8>) -> String {
        let request = Request::builder()
            .method(*verb)
            .uri(*path)
            .header(header::HOST, "localhost")
            .header(header::CONTENT_TYPE, *content_type);
        let response = self.rest.clone().oneshot(request.body(Body::from(body)).unwrap()).await.unwrap();
        let status = response.status().as_u16();
        axum::body::to_bytes(response.into_body(), usize::MAX).await.unwrap();
        status.to_string()
    }

    /// Sends a document followed by tensors; sometimes the length that tells them apart is wrong.
    async fn send_binary(&self, body: Vec<u8>, length: usize) -> String {
        let request = Request::post("/v2/models/qedgix/infer")
            .header(header::HOST, "localhost")
            .header("inference-header-content-length", length);
        let response = self.rest.clone().oneshot(request.body(Body::from(body)).unwrap()).await.unwrap();
        let status = response.status().as_u16();
        axum::body::to_bytes(response.into_body(), usize::MAX).await.unwrap();
        status.to_string()
    }

    /// Reads a file; one that is accepted must fly.
    fn read(&self, bytes: &[u8]) -> String {
        let Ok(checkpoint) = Checkpoint::from_bytes(bytes) else { return "refused".into() };
        let policy = checkpoint.policy();
        if policy.check_fleet(3, 5).is_err() {
            return "of another fleet".into();
        }
        let (mut memory, mut headings) = (vec![0.0; policy.memory_len(3, 5)], [0; 3]);
        policy.start(3, 5, 1, &mut memory);
        policy.act(&mut [FleetStep {
            env: policy.env(),
            graph: &self.graph,
            profile: None,
            step: 0,
            memory: &mut memory,
            headings: &mut headings,
            q_values: None,
        }]);
        assert!(headings.iter().all(|&heading| usize::from(heading) < policy.actions()));
        "accepted".into()
    }
}

/// Ends the process when one input takes too long: a loop that never waits cannot be ended otherwise.
fn watch(current: &Arc<Mutex<(Instant, u64)>>) {
    let current = Arc::downgrade(current);
    std::thread::spawn(move || {
        while let Some(current) = current.upgrade() {
            let (began, number) = *current.lock().unwrap();
            if began.elapsed() > LONGEST {
                eprintln!("input number {number} hangs");
                std::process::exit(1);
            }
            std::thread::sleep(Duration::from_millis(100));
        }
    });
}

#[test]
fn wrong_inputs_are_refused_and_nothing_else_happens() {
    fuzz(Access::Open);
}

#[test]
fn wrong_inputs_are_refused_and_nothing_else_happens_with_keys_and_tls() {
    fuzz(Access::KeysAndTls);
}

fn fuzz(access: Access) {
    let inputs: u64 =
        std::env::var("QEDGIX_FUZZ_INPUTS").map_or(6000, |text| text.parse().expect("QEDGIX_FUZZ_INPUTS: a number"));
    let dir = tempfile::tempdir().unwrap();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    let subject = runtime.block_on(Subject::new(dir.path(), access));
    let (messages, documents) = (messages(), documents());
    let mut rng = qedgix::rng::stream(1, "fuzz", 0);
    let mut answers: BTreeMap<(&str, String), u64> = BTreeMap::new();
    let watched = Arc::new(Mutex::new((Instant::now(), 0)));
    watch(&watched);
    let (mut slowest, mut largest) = (Duration::ZERO, 0);
    for number in 0..inputs {
        let kind = subject.kinds()[rng.random_range(0..subject.kinds().len())];
        let began = Instant::now();
        *watched.lock().unwrap() = (began, number);
        let (mut input, mut answer) = (Vec::new(), String::new());
        let used = allocation_counter::measure(|| match kind {
            "proto" => {
                let (method, valid) = &messages[rng.random_range(0..messages.len())];
                let other = &messages[rng.random_range(0..messages.len())].1;
                input = spoil(&mut rng, valid, other);
                answer = runtime.block_on(subject.call(method, &input));
            }
            "JSON" => {
                let document = &documents[rng.random_range(0..documents.len())];
                let other = &documents[rng.random_range(0..documents.len())].3;
                input = spoil(&mut rng, &document.3, other);
                answer = runtime.block_on(subject.send(document, input.clone()));
            }
            "tensors" => {
                let (document, rest) = tensors(true);
                let document = spoil(&mut rng, document.as_bytes(), &rest);
                let rest = spoil(&mut rng, &rest, document.as_slice());
                let length = if rng.random_range(0..8) == 0 { rng.random_range(0..2000) } else { document.len() };
                input = [document, rest].concat();
                answer = runtime.block_on(subject.send_binary(input.clone(), length));
            }
            "TLS" => {
                let secured = subject.secured.as_ref().expect("a kind of secured servers only");
                (input, answer) = runtime.block_on(secured.shake_hands(|hello| spoil(&mut rng, hello, hello)));
            }
            _ => {
                input = spoil(&mut rng, &subject.checkpoint, &subject.checkpoint);
                answer = subject.read(&input);
            }
        });
        let took = began.elapsed();
        let shown = || String::from_utf8_lossy(&input[..input.len().min(2000)]).into_owned();
        assert!(!["500", "13", "2"].contains(&answer.as_str()), "a fault of the server ({kind} {answer}): {}", shown());
        assert!(took < LONGEST, "{took:?} for {kind}: {}", shown());
        assert!(used.bytes_max < MEMORY, "{} bytes for {kind}: {}", used.bytes_max, shown());
        (slowest, largest) = (slowest.max(took), largest.max(used.bytes_max));
        *answers.entry((kind, answer)).or_default() += 1;
    }
    for ((kind, answer), count) in &answers {
        println!("{count:>9}  {kind} {answer}");
    }
    println!("{inputs} inputs; the slowest took {slowest:?}, the largest {largest} bytes");
    println!("sessions {}, environments {}", subject.app.sessions.len(), subject.app.environments.table().len());
    for &kind in subject.kinds() {
        assert!(answers.keys().filter(|(of, _)| *of == kind).count() > 1, "some of {kind} are right and some are wrong");
    }
}
