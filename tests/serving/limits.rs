//! Malformed and oversized messages, deadlines, full queues and panics over gRPC, and their status codes.

use std::sync::Arc;

use bytes::{Buf, BufMut, Bytes};
use qedgix::wire::v1;
use tonic::codec::{Codec, DecodeBuf, Decoder, EncodeBuf, Encoder};
use tonic::{Code, Request, Status};

use super::harness::*;

/// A codec that sends and receives raw bytes.
#[derive(Default)]
pub struct Raw;

impl Codec for Raw {
    type Encode = Bytes;
    type Decode = Bytes;
    type Encoder = Self;
    type Decoder = Self;
    fn encoder(&mut self) -> Self {
        Self
    }
    fn decoder(&mut self) -> Self {
        Self
    }
}

impl Encoder for Raw {
    type Item = Bytes;
    type Error = Status;
    fn encode(&mut self, item: Bytes, dst: &mut EncodeBuf<'_>) -> Result<(), Status> {
        dst.put(item);
        Ok(())
    }
}

impl Decoder for Raw {
    type Item = Bytes;
    type Error = Status;
    fn decode(&mut self, src: &mut DecodeBuf<'_>) -> Result<Option<Bytes>, Status> {
        Ok(Some(src.copy_to_bytes(src.remaining())))
    }
}

async fn raw(server: &Server, path: &'static str, message: Bytes) -> (Code, String, String) {
    let mut client = tonic::client::Grpc::new(server.channel().await);
    client.ready().await.unwrap();
    refused(client.unary(Request::new(message), path.parse().unwrap(), Raw).await)
}

/// Fields with a number below 16, empty.
fn empties(number: u8, count: usize) -> Vec<u8> {
    [number << 3 | 2, 0].repeat(count)
}

#[tokio::test]
async fn requests_that_would_take_far_more_memory_than_their_size_are_refused() {
    let server = Server::start().await;
    let count = 2_000_000;
    let nested = |number: u8, inner: Vec<u8>| {
        let mut bytes = vec![number << 3 | 2];
        prost::encoding::encode_varint(inner.len() as u64, &mut bytes);
        [bytes, inner].concat()
    };
    for (method, field, message) in [
        ("/qedgix.v1.PolicyService/ActBatch", "requests", empties(1, count)),
        ("/qedgix.v1.PolicyService/Act", "graph.nodes", nested(2, empties(1, count))),
        ("/qedgix.v1.PolicyService/Act", "scene.users", nested(3, empties(2, count))),
        ("/qedgix.v1.PolicyService/ActStream", "graph.nodes", nested(2, empties(1, count))),
        ("/inference.GRPCInferenceService/ModelInfer", "inputs", empties(5, count)),
        ("/inference.GRPCInferenceService/ModelStreamInfer", "raw_input_contents", empties(7, 4 * count)),
    ] {
        let mut client = tonic::client::Grpc::new(server.channel().await);
        client.ready().await.unwrap();
        let path = method.parse().unwrap();
        let status = client.unary(Request::new(Bytes::from(message)), path, Raw).await.map(drop).unwrap_err();
        assert!(status.message().starts_with(&format!("{field}: too many elements")), "{method}: {status:?}");
        assert_eq!(refused::<()>(Err(status)).1, "too_large", "{method}");
    }
    // Small ones are decoded, and refused as before.
    let few = raw(&server, "/qedgix.v1.PolicyService/ActBatch", empties(1, 1025).into()).await;
    assert_eq!(few, (Code::InvalidArgument, "invalid_argument".into(), "requests".into()));
}

#[tokio::test]
async fn malformed_and_oversized_messages_are_refused() {
    let server = Server::start().await;
    let act = "/qedgix.v1.PolicyService/Act";
    for garbage in [&b"\xff\xff\xff\xff"[..], b"\x12\x7f", b"\x0a\x02\xff\xfe"] {
        let (code, reason, field) = raw(&server, act, Bytes::from_static(garbage)).await;
        assert_eq!((code, reason.as_str(), field.as_str()), (Code::InvalidArgument, "invalid_argument", "message"));
    }
    let (code, reason, _) = raw(&server, act, vec![0; 17_000_000].into()).await;
    assert_eq!((code, reason.as_str()), (Code::ResourceExhausted, "too_large"));
    for unknown in ["/qedgix.v1.PolicyService/Nothing", "/no.such.Service/Act"] {
        assert_eq!(raw(&server, unknown, Bytes::new()).await.0, Code::Unimplemented);
    }
}

type Change = fn(&mut v1::ActRequest);

fn nodes(request: &mut v1::ActRequest) -> &mut Vec<v1::Node> {
    match &mut request.observation {
        Some(v1::act_request::Observation::Graph(graph)) => &mut graph.nodes,
        _ => unreachable!("these requests hold graphs"),
    }
}

fn in_scene(request: &mut v1::ActRequest) -> &mut v1::Scene {
    match &mut request.observation {
        Some(v1::act_request::Observation::Scene(scene)) => scene,
        _ => unreachable!("these requests hold scenes"),
    }
}

#[tokio::test]
async fn errors_of_invalid_scenes_name_the_field() {
    let server = Server::start().await;
    let mut client = server.grpc().await;
    let cases: &[(&str, &str, Change)] = &[
        ("observation", "", |r| r.observation = None),
        ("scene", "no UAV", |r| in_scene(r).uavs.clear()),
        ("scene", "20001 UAVs and users", |r| in_scene(r).users = scene(1, 19_998, 0).users),
        ("scene.uavs[1].x", "NaN", |r| in_scene(r).uavs[1].x = f64::NAN),
        ("scene.uavs[0].y", "inf", |r| in_scene(r).uavs[0].y = f64::INFINITY),
        ("scene.users[2].x", "1e300", |r| in_scene(r).users[2].x = 1e300),
        ("scene.users[2].aoi", "-1", |r| in_scene(r).users[2].aoi = -1.0),
        ("scene.users[2].aoi", "NaN", |r| in_scene(r).users[2].aoi = f64::NAN),
        ("scene.users[2].aoi", "1000000000", |r| in_scene(r).users[2].aoi = 1e20),
        ("scene.uavs[2].id", "\"\"", |r| in_scene(r).uavs[2].id.clear()),
        ("scene.users[0].id", "\"xxx", |r| in_scene(r).users[0].id = "x".repeat(129)),
        ("scene.uavs[1].id", "\"uav-0\"", |r| in_scene(r).uavs[1].id = "uav-0".into()),
        ("scene.users[1].id", "\"uav-0\"", |r| in_scene(r).users[1].id = "uav-0".into()),
        ("policy", "\"no such:policy\"", |r| r.policy = "no such:policy".into()),
        ("run_id", "\"\"", |r| r.run_id = Some(String::new())),
        ("session_id", "\"\"", |r| r.memory = Some(v1::act_request::Memory::SessionId(String::new()))),
    ];
    for (field, value, change) in cases {
        let mut request = held("sweep", Bytes::new(), scene(3, 5, 1));
        change(&mut request);
        assert_invalid(client.act(request).await, field, value);
    }
    // As many nodes as are allowed, all in one place: refused for what they would cost, not for their number.
    let mut request = held("qedgix", Bytes::new(), scene(100, 3996, 1));
    in_scene(&mut request).uavs.iter_mut().for_each(|u| (u.x, u.y) = (0.5, 0.5));
    in_scene(&mut request).users.iter_mut().for_each(|u| (u.x, u.y) = (0.5, 0.5));
    assert_invalid(client.act(request).await, "scene", "more than");
}

#[tokio::test]
async fn errors_of_invalid_graphs_name_the_field() {
    let server = Server::start().await;
    let mut client = server.grpc().await;
    let at = |id: &str, x: f64| v1::SceneUav { id: id.into(), x, y: 0.5, ..Default::default() };
    let user = |id: &str, x: f64| v1::SceneUser { id: id.into(), x, y: 0.5, aoi: 4.0, z: None };
    // Nodes 0 and 1 are UAVs, 2 and 3 are users. All detect each other, in this order.
    let scene = v1::Scene { uavs: vec![at("a", 0.5), at("b", 0.55)], users: vec![user("u", 0.6), user("w", 0.65)] };
    let request = || v1::ActRequest {
        policy: "sweep".into(),
        observation: Some(v1::act_request::Observation::Graph(graph(&scene, 0.28, true))),
        ..Default::default()
    };
    client.act(request()).await.unwrap();
    let cases: &[(&str, &str, Change)] = &[
        ("graph.nodes", "no UAV", |r| nodes(r).clear()),
        ("graph.nodes[1].kind", "0", |r| nodes(r)[1].kind = 0),
        ("graph.nodes[1].kind", "17", |r| nodes(r)[1].kind = 17),
        ("graph.nodes[3].id", "\"u\"", |r| nodes(r)[3].id = "u".into()),
        ("graph.nodes[2].id", "\"\"", |r| nodes(r)[2].id.clear()),
        ("graph.nodes[0].detections[1].target_id", "\"x\"", |r| nodes(r)[0].detections[1].target_id = "x".into()),
        ("graph.nodes[0].detections[1].target_id", "\"a\"", |r| nodes(r)[0].detections[1].target_id = "a".into()),
        ("graph.nodes[0].detections[2].target_id", "\"u\"", |r| nodes(r)[0].detections[2].target_id = "u".into()),
        ("graph.nodes[2].detections[0].rel_x", "NaN", |r| nodes(r)[2].detections[0].rel_x = f64::NAN),
        ("graph.nodes[2].detections[0].rel_y", "-inf", |r| nodes(r)[2].detections[0].rel_y = f64::NEG_INFINITY),
        ("graph.nodes[0].detections[1].aoi", "", |r| nodes(r)[0].detections[1].aoi = None),
        ("graph.nodes[0].detections[0].aoi", "4", |r| nodes(r)[0].detections[0].aoi = Some(4.0)),
        ("graph.nodes[0].detections[1].aoi", "-2", |r| nodes(r)[0].detections[1].aoi = Some(-2.0)),
        ("graph.nodes[2].aoi", "NaN", |r| nodes(r)[2].aoi = Some(f64::NAN)),
        ("graph.nodes[0].aoi", "3", |r| nodes(r)[0].aoi = Some(3.0)),
        ("graph.nodes[2].position", "(0, 0)", |r| nodes(r)[2].position = Some(v1::Position { x: 0.0, y: 0.0, z: None })),
        ("graph.nodes[1].position", "", |r| nodes(r)[1].position = None),
        ("graph.nodes[1].position.x", "NaN", |r| nodes(r)[1].position = Some(v1::Position { x: f64::NAN, y: 0.0, z: None })),
        ("scene", "", |r| r.policy = "greedy-global".into()),
    ];
    for (field, value, change) in cases {
        let mut request = request();
        change(&mut request);
        assert_invalid(client.act(request).await, field, value);
    }
    // Two nodes need not agree, about an AoI or a position, but another unit is noticed.
    let noisy: &[Change] = &[
        |r| nodes(r)[1].detections[1].aoi = Some(5.0),
        |r| nodes(r)[1].detections[0].rel_x = 0.05,
        |r| nodes(r)[3].detections[0].rel_x = -0.2801,
    ];
    for change in noisy {
        let mut request = request();
        change(&mut request);
        client.act(request).await.unwrap();
    }
    let mut metres = request();
    nodes(&mut metres)[3].detections[0].rel_x = -280.0;
    assert_eq!(refused(client.act(metres).await).2, "graph.nodes[3].detections[0].rel_x");
}

/// Sends an Act with a `grpc-timeout` but without a client timer. Returns `grpc-status` and `qedgix-code`.
async fn act_within(server: &Server, timeout: &'static str, request: v1::ActRequest) -> (String, String) {
    use prost::Message;
    let socket = tokio::net::TcpStream::connect(server.endpoints.grpc).await.unwrap();
    let (client, connection) = h2::client::handshake(socket).await.unwrap();
    tokio::spawn(connection);
    let head = axum::http::Request::post(format!("http://{}/qedgix.v1.PolicyService/Act", server.endpoints.grpc))
        .header("content-type", "application/grpc")
        .header("te", "trailers")
        .header("grpc-timeout", timeout);
    let (answer, mut body) = client.ready().await.unwrap().send_request(head.body(()).unwrap(), false).unwrap();
    let mut framed = bytes::BytesMut::new();
    framed.put_u8(0);
    framed.put_u32(request.encoded_len() as u32);
    request.encode(&mut framed).unwrap();
    body.send_data(framed.freeze(), true).unwrap();
    let answer = with_timeout(answer).await.unwrap();
    let header = |name: &str| answer.headers().get(name).map_or("", |value| value.to_str().unwrap()).to_owned();
    (header("grpc-status"), header("qedgix-code"))
}

#[tokio::test]
async fn requests_past_their_deadline_do_not_advance_the_session() {
    let server = Server::with(|config| config.engine.threads = 1).await;
    let gate = Arc::new(Gate::default());
    server.add("slow", 1, Arc::new(TestPolicy::Wait(gate.clone())));
    let mut client = server.grpc().await;
    client.open_session(open("slow", "s")).await.unwrap();
    client.open_session(open("sweep", "t")).await.unwrap();
    for (session, while_it) in [("s", "computes"), ("t", "waits for the engine"), ("t", "has no time left")] {
        let timeout = if while_it == "has no time left" { "1n" } else { "30m" };
        let (status, code) = act_within(&server, timeout, in_session(session, Some(0), scene(2, 2, 0))).await;
        assert_eq!((status.as_str(), code.as_str()), ("4", "deadline_exceeded"), "while it {while_it}");
    }
    gate.open();
    for session in ["s", "t"] {
        let answer = with_timeout(client.act(in_session(session, Some(0), scene(2, 2, 0)))).await.unwrap().into_inner();
        assert_eq!(answer.step, 0, "the session has not advanced");
    }
    let (status, _) = act_within(&server, "99999999H", in_session("t", Some(1), scene(2, 2, 0))).await;
    assert_eq!(status, "", "a successful response has its status in trailers");
}

#[tokio::test]
async fn a_retry_during_the_first_attempt_returns_the_same_response() {
    let server = Server::start().await;
    let gate = Arc::new(Gate::default());
    server.add("slow", 1, Arc::new(TestPolicy::Wait(gate.clone())));
    let mut client = server.grpc().await;
    client.open_session(open("slow", "s")).await.unwrap();
    let attempt = || {
        let mut client = client.clone();
        tokio::spawn(async move { client.act(in_session("s", Some(0), scene(2, 2, 0))).await.unwrap().into_inner() })
    };
    let first = attempt();
    gate.reached(1).await;
    let second = attempt();
    gate.open();
    let (first, second) = (with_timeout(first).await.unwrap(), with_timeout(second).await.unwrap());
    assert_eq!(first, second);
    let next = client.act(in_session("s", None, scene(2, 2, 0))).await.unwrap().into_inner();
    assert_eq!(next.step, 1, "the session advanced once");
}

#[tokio::test]
async fn a_full_queue_refuses_requests_and_recovers() {
    let server = Server::with(|config| (config.engine.threads, config.engine.queue) = (1, 1)).await;
    let gate = Arc::new(Gate::default());
    server.add("slow", 1, Arc::new(TestPolicy::Wait(gate.clone())));
    let client = server.grpc().await;
    let attempt = || {
        let mut client = client.clone();
        Box::pin(tokio::spawn(async move { client.act(held("slow", Bytes::new(), scene(2, 2, 0))).await }))
    };
    let first = attempt();
    gate.reached(1).await;
    let (answered, _, mut waiting) = with_timeout(futures::future::select_all([attempt(), attempt()])).await;
    let status = answered.unwrap().unwrap_err();
    assert_eq!(status.code(), Code::ResourceExhausted);
    assert_eq!(status.metadata().get("retry-after").unwrap(), "1");
    gate.open();
    assert!(with_timeout(first).await.unwrap().is_ok());
    assert!(with_timeout(waiting.remove(0)).await.unwrap().is_ok());
}

#[tokio::test]
async fn open_sessions_are_limited() {
    let server = Server::with(|config| config.max_sessions = 1).await;
    let mut client = server.grpc().await;
    client.open_session(open("sweep", "a")).await.unwrap();
    assert_eq!(refused(client.open_session(open("sweep", "b")).await).0, Code::ResourceExhausted);
    server.advance(601);
    client.open_session(open("sweep", "b")).await.unwrap();
    assert_eq!(refused(client.open_session(open("nearest", "b")).await).0, Code::AlreadyExists);
    assert_eq!(refused(client.open_session(open("swoop", "c")).await).0, Code::NotFound);
}

#[tokio::test]
async fn a_panicking_policy_returns_an_internal_error() {
    let server = Server::with(|config| config.engine.threads = 1).await;
    server.add("panics", 1, Arc::new(TestPolicy::Panic));
    let mut client = server.grpc().await;
    client.open_session(open("panics", "s")).await.unwrap();
    for _ in 0..3 {
        let (code, reason, _) = refused(client.act(in_session("s", Some(0), scene(2, 2, 0))).await);
        assert_eq!((code, reason.as_str()), (Code::Internal, "internal"));
    }
    client.act(held("sweep", Bytes::new(), scene(2, 2, 0))).await.unwrap();
}
