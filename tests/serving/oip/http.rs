//! `/v2`: JSON, binary data, and errors in the protocol's words.

use std::sync::Arc;

use proptest::prelude::*;
use proptest::test_runner::TestRunner;
use reqwest::{Client, Method};
use serde_json::{Value, json};

use super::*;

const LENGTH: &str = "inference-header-content-length";

struct Http<'a>(&'a Server, Client);

impl Http<'_> {
    async fn send(&self, method: Method, path: &str, headers: &[(&str, String)], body: Vec<u8>) -> (u16, Option<usize>, Vec<u8>) {
        let mut request = self.1.request(method, self.0.url(path)).body(body);
        for (name, value) in headers {
            request = request.header(*name, value);
        }
        let answer = request.send().await.unwrap();
        assert!(answer.headers().contains_key("x-request-id"));
        let length = answer.headers().get(LENGTH).map(|value| value.to_str().unwrap().parse().unwrap());
        (answer.status().as_u16(), length, answer.bytes().await.unwrap().to_vec())
    }

    async fn json(&self, method: Method, path: &str, body: Value) -> (u16, Value) {
        let body = if body.is_null() { Vec::new() } else { body.to_string().into_bytes() };
        let (status, _, body) = self.send(method, path, &[], body).await;
        (status, serde_json::from_slice(&body).unwrap_or_default())
    }

    /// JSON with binary data after it.
    async fn binary(&self, path: &str, json: &Value, data: &[u8]) -> (u16, Value, Vec<u8>) {
        let head = json.to_string().into_bytes();
        let length = head.len().to_string();
        let (status, length, mut body) = self.send(Method::POST, path, &[(LENGTH, length)], [&head, data].concat()).await;
        let data = body.split_off(length.unwrap_or(body.len()));
        (status, serde_json::from_slice(&body).unwrap(), data)
    }

    async fn refused(&self, path: &str, body: &Value) -> (u16, String, String) {
        let (status, told) = self.json(Method::POST, path, body.clone()).await;
        let text = |name: &str| told[name].as_str().unwrap_or_default().to_owned();
        (status, text("code"), text("field"))
    }
}

async fn server() -> Server {
    let server = Server::start().await;
    server.add("count", 1, Arc::new(TestPolicy::Count));
    server
}

fn slot(parameters: Value) -> Value {
    json!({
        "id": "here",
        "parameters": parameters,
        "inputs": [
            {"name": "uav_positions", "datatype": "FP32", "shape": [2, 2], "data": [0.25, 0.5, 0.75, 0.5]},
            {"name": "user_positions", "datatype": "FP64", "shape": [1, 2], "data": [[0.5, 0.5]]},
            {"name": "user_aoi", "datatype": "FP32", "shape": [1], "data": [3]},
        ],
    })
}

const INFER: &str = "/v2/models/count/infer";

#[tokio::test]
async fn json_in_json_out() {
    let server = server().await;
    let http = Http(&server, Client::new());
    let (status, answer) = http.json(Method::POST, INFER, slot(json!({"seed": 7}))).await;
    assert_eq!(status, 200, "{answer}");
    assert_eq!((&answer["model_name"], &answer["model_version"], &answer["id"]), (&json!("count"), &json!("1"), &json!("here")));
    assert_eq!(answer["outputs"][0], json!({"name": "heading_index", "datatype": "INT32", "shape": [2], "data": [7, 7]}));
    assert_eq!(answer["outputs"][1]["data"], json!([315.0, 315.0]));
    assert_eq!(answer["parameters"]["step"], 0);
    // The next slot hovers, which is no direction. Memory travels as text.
    let state = answer["outputs"][3]["data"][0].as_str().unwrap();
    let mut next = slot(json!({"step": 1}));
    let memory = json!({"name": "recurrent_state", "datatype": "BYTES", "shape": [1], "data": [state]});
    next["inputs"].as_array_mut().unwrap().push(memory);
    next["outputs"] = json!([{"name": "heading_deg"}, {"name": "heading_index"}]);
    let (status, answer) = http.json(Method::POST, "/v2/models/count/versions/1/infer", next).await;
    assert_eq!((status, answer["outputs"].as_array().unwrap().len()), (200, 2), "{answer}");
    assert_eq!((&answer["outputs"][0]["data"], &answer["outputs"][1]["data"]), (&json!([null, null]), &json!([8, 8])));
}

#[tokio::test]
async fn binary_data_before_and_after() {
    let server = server().await;
    let http = Http(&server, Client::new());
    let data: Vec<u8> = [0.25_f32, 0.5, 0.75, 0.5, 3.0].iter().flat_map(|x| x.to_le_bytes()).collect();
    let ask = |default: bool| {
        let mut ask = slot(json!({"seed": 3, "binary_data_output": default}));
        for (i, size) in [(0, 16), (2, 4)] {
            ask["inputs"][i].as_object_mut().unwrap().remove("data");
            ask["inputs"][i]["parameters"] = json!({"binary_data_size": size});
        }
        ask
    };
    let (status, answer, after) = http.binary(INFER, &ask(true), &data).await;
    assert_eq!(status, 200, "{answer}");
    let sizes: Vec<u64> =
        answer["outputs"].as_array().unwrap().iter().map(|o| o["parameters"]["binary_data_size"].as_u64().unwrap()).collect();
    assert_eq!((sizes[..3].to_vec(), sizes.iter().sum::<u64>()), (vec![8, 8, 72], after.len() as u64));
    assert_eq!(after[..8], [3, 0, 0, 0, 3, 0, 0, 0]);
    assert_eq!(after[8..16], [135.0_f32.to_le_bytes(), 135.0_f32.to_le_bytes()].concat());

    let mut mixed = ask(true);
    mixed["outputs"] = json!([{"name": "heading_deg", "parameters": {"binary_data": false}}, {"name": "heading_index"}]);
    let (_, answer, after) = http.binary(INFER, &mixed, &data).await;
    assert_eq!((&answer["outputs"][0]["data"], after.len()), (&json!([135.0, 135.0]), 8));
    assert_eq!(
        answer["outputs"][1],
        json!({"name": "heading_index", "datatype": "INT32", "shape": [2], "parameters": {"binary_data_size": 8}})
    );
    let (_, answer, after) = http.binary(INFER, &ask(false), &data).await;
    assert_eq!((&answer["outputs"][0]["data"], after.len()), (&json!([3, 3]), 0));

    for (ask, data, field, value) in [
        (ask(true), &data[..19], "inputs[2].parameters.binary_data_size", "4"),
        (ask(true), &[&data[..], &[0]].concat()[..], "body", "1 further bytes"),
        (slot(json!({})), &data[..], "body", "20 further bytes"),
    ] {
        let (status, answer, _) = http.binary(INFER, &ask, data).await;
        assert_eq!((status, &answer["code"]), (400, &json!("invalid_argument")));
        assert_eq!((&answer["field"], &answer["value"]), (&json!(field), &json!(value)), "{answer}");
    }
    let body = slot(json!({})).to_string().into_bytes();
    for length in ["-1", "1e3", "", "99999999999999999999", "100000"] {
        let (status, _, answer) = http.send(Method::POST, INFER, &[(LENGTH, length.into())], body.clone()).await;
        let answer: Value = serde_json::from_slice(&answer).unwrap();
        assert_eq!((status, &answer["field"]), (400, &json!("Inference-Header-Content-Length")), "{answer}");
    }
    let (status, _, answer) = http.send(Method::POST, INFER, &[("content-encoding", "gzip".into())], body.clone()).await;
    let answer: Value = serde_json::from_slice(&answer).unwrap();
    assert_eq!((status, &answer["field"]), (400, &json!("body")), "{answer}");
    let (status, _, answer) = http.send(Method::POST, INFER, &[("content-encoding", "br".into())], body).await;
    let answer: Value = serde_json::from_slice(&answer).unwrap();
    assert_eq!((status, &answer["field"]), (415, &json!("content-encoding")), "{answer}");
}

#[tokio::test]
async fn sequences_over_http_are_those_over_grpc() {
    let server = server().await;
    let http = Http(&server, Client::new());
    let heading =
        async |parameters: Value| http.json(Method::POST, INFER, slot(parameters)).await.1["outputs"][0]["data"][0].clone();
    assert_eq!(heading(json!({"sequence_id": 5, "sequence_start": true, "sequence_end": false, "seed": 1})).await, 1);
    assert_eq!(heading(json!({"sequence_id": "5", "sequence_start": true, "seed": 4})).await, 4);
    assert_eq!(heading(json!({"sequence_id": 5, "step": 1})).await, 2);
    assert_eq!(heading(json!({"sequence_id": 5, "step": 1})).await, 2);
    assert_eq!(heading(json!({"sequence_id": "5", "sequence_end": true})).await, 5);
    let ask = Ask::new("count", As::Raw, false).scene(&narrow(2, 1, 0)).int("sequence_id", 5);
    assert_eq!(indices(client(&server).await.model_infer(ask.request).await.unwrap().get_ref()), [3, 3]);
    let (status, code, _) = http.refused(INFER, &slot(json!({"sequence_id": "5"}))).await;
    assert_eq!((status, code.as_str()), (409, "sequence_not_started"));
}

#[tokio::test]
async fn the_server_and_its_models() {
    let server = server().await;
    let http = Http(&server, Client::new());
    let get = async |path: &str| http.json(Method::GET, path, Value::Null).await;
    assert_eq!(get("/v2").await.1["name"], "qedgix");
    assert_eq!(get("/v2/health/live").await, (200, json!({"live": true})));
    assert_eq!(get("/v2/health/ready").await, (200, json!({"ready": true})));
    assert_eq!(get("/v2/models/sweep/ready").await.0, 200);
    assert_eq!(get("/v2/models/sweep%3A1/versions/1/ready").await.0, 200);
    assert_eq!(get("/v2/models/sweep/versions/1").await.1["versions"], json!(["1"]));
    assert_eq!(get("/v2/models/sweep/config").await.1["input"][0]["data_type"], "TYPE_FP32");
    assert_eq!(get("/v2/models/sweep/versions/1/config").await.1["output"][0]["data_type"], "TYPE_INT32");
    let post = async |path: &str, body: Value| http.json(Method::POST, path, body).await;
    let states = async || {
        let index = post("/v2/repository/index", Value::Null).await.1;
        let of = |name: &str| index.as_array().unwrap().iter().find(|m| m["name"] == name).unwrap()["state"].clone();
        (of("sweep"), of("count"))
    };
    assert_eq!(post("/v2/repository/models/count/unload", json!({"parameters": {"unload_dependents": false}})).await.0, 200);
    assert_eq!(states().await, (json!("READY"), json!("UNAVAILABLE")));
    assert_eq!(
        post("/v2/repository/index", json!({"ready": true})).await.1.as_array().unwrap().len() + 1,
        server.app.registry.len()
    );
    let (status, code, _) = http.refused(INFER, &slot(json!({}))).await;
    assert_eq!((status, code.as_str()), (409, "policy_unloaded"));
    for path in ["/v2/models/count/ready", "/v2/models/count", "/v2/models/count/config", "/v2/models/count/versions/1"] {
        let (status, problem) = get(path).await;
        assert_eq!((status, &problem["code"]), (409, &json!("policy_unloaded")), "{path}");
    }
    server.add("count", 1, Arc::new(TestPolicy::Count));
    assert_eq!(post("/v2/repository/models/sweep/unload", Value::Null).await.0, 200);
    assert_eq!(states().await, (json!("UNAVAILABLE"), json!("READY")));
    assert_eq!(post("/v2/repository/models/sweep/load", Value::Null).await.0, 200);
    assert_eq!(states().await, (json!("READY"), json!("READY")));
    assert_eq!(post(INFER, slot(json!({}))).await.0, 200);
    server.app.draining.begin();
    assert_eq!(get("/v2/health/ready").await.0, 503);
    assert_eq!(post(INFER, slot(json!({}))).await.1["code"], "draining");
}

#[tokio::test]
async fn errors_in_the_words_of_the_protocol() {
    let server = server().await;
    server.add("panics", 1, Arc::new(TestPolicy::Panic));
    let http = Http(&server, Client::new());
    let with = |path: &str, value: Value| {
        let mut ask = slot(json!({}));
        *ask.pointer_mut(path).unwrap() = value;
        ask
    };
    let cases = [
        (with("/inputs/0/data", json!([0.25, 0.5, 0.75])), 400, "uav_positions"),
        (with("/inputs/0/data", json!([[0.25, 0.5, 0.75, 0.5]])), 400, "uav_positions.data"),
        (with("/inputs/0/data", json!([[0.25, 0.5], [0.75]])), 400, "uav_positions.data"),
        (with("/inputs/0/data", json!([[0.25, 0.5], 0.75, 0.5])), 400, "uav_positions.data"),
        (with("/inputs/0/data", json!([0.25, 0.5, 0.75, "x"])), 400, "uav_positions.data"),
        (with("/inputs/0/data", json!([0.25, 0.5, 0.75, null])), 422, "inputs[0].data[3]"),
        (with("/inputs/0/data", json!([0.25, 0.5, 0.75, true])), 422, "inputs[0].data[3]"),
        (with("/inputs/0/data", json!(0.25)), 422, "inputs[0].data"),
        (with("/inputs/0/data", Value::Null), 422, "inputs[0].data"),
        (with("/inputs/2/data", json!([1e39])), 400, "user_aoi[0]"),
        (with("/inputs/2/datatype", json!("INT32")), 400, "user_aoi.datatype"),
        (with("/inputs/2/datatype", json!("UINT8")), 400, "user_aoi.datatype"),
        (with("/inputs/0/shape", json!([2, 2.5])), 422, "inputs[0].shape[1]"),
        (with("/inputs/0", json!({"name": "uav_positions"})), 422, "inputs[0].shape"),
        (with("/parameters", json!({"step": [1]})), 422, "parameters.step"),
        (with("/parameters", json!({"binary_data_output": 1})), 422, "parameters.binary_data_output"),
        (with("/parameters", json!({"stop": 1})), 400, "parameters"),
        (with("/id", json!(5)), 422, "id"),
        (json!({"inputs": [], "input": []}), 422, "input"),
        (json!([]), 422, "body"),
    ];
    for (body, status, field) in cases {
        let (found, code, field_found) = http.refused(INFER, &body).await;
        assert_eq!((found, field_found.as_str()), (status, field), "{body}");
        assert_eq!(code, if status == 400 { "invalid_argument" } else { "invalid_schema" });
    }
    let edges = json!({"inputs": [
        {"name": "user_aoi", "datatype": "FP32", "shape": [1], "data": [3]},
        {"name": "uav_count", "datatype": "INT32", "shape": [1], "data": [2]},
        {"name": "edge_index", "datatype": "INT32", "shape": [1, 2], "data": [0, 4_294_967_296_u64]},
        {"name": "edge_relative", "datatype": "FP32", "shape": [1, 2], "data": [0, 0.1]},
    ]});
    assert_eq!(http.refused(INFER, &edges).await.2, "edge_index.data[1]");
    for (method, path, status, code) in [
        (Method::GET, "/v2/nothing", 404, "not_found"),
        (Method::GET, "/v2/models/count/infer", 405, "method_not_allowed"),
        (Method::GET, "/v2/models/nobody", 404, "not_found"),
        (Method::GET, "/v2/models/count/versions/2", 404, "not_found"),
        (Method::GET, "/v2/models/count/versions/x", 400, "invalid_argument"),
        (Method::GET, "/v2/models/%ff/ready", 400, "invalid_argument"),
        (Method::POST, "/v2/repository/models/nobody/load", 404, "not_found"),
        (Method::POST, "/v2/repository/models/nobody/unload", 404, "not_found"),
    ] {
        let (found, told) = http.json(method.clone(), path, Value::Null).await;
        assert_eq!((found, &told["code"]), (status, &json!(code)), "{method} {path}: {told}");
        assert!(!told["error"].as_str().unwrap().is_empty());
    }
    assert_eq!(http.refused("/v2/repository/index", &json!({"raedy": true})).await.0, 422);
    let load = json!({"parameters": {"config": "{}"}});
    assert_eq!(http.refused("/v2/repository/models/count/load", &load).await.2, "parameters");
    let panicked = http.refused("/v2/models/panics/infer", &slot(json!({}))).await;
    assert_eq!((panicked.0, panicked.1.as_str()), (500, "internal"));
    let (status, _, answer) = http.send(Method::POST, INFER, &[], vec![b' '; 20_000_000]).await;
    let answer: Value = serde_json::from_slice(&answer).unwrap();
    assert_eq!((status, &answer["code"]), (413, &json!("too_large")));
    let deep = "[".repeat(100_000);
    let body = format!("{{\"inputs\":[{{\"name\":\"user_aoi\",\"shape\":[1],\"datatype\":\"FP32\",\"data\":{deep}");
    assert_eq!(http.send(Method::POST, INFER, &[], body.into_bytes()).await.0, 400);
}

/// Whatever is done to a body, it is answered or refused, and never a fault.
#[tokio::test]
async fn damaged_bodies_are_no_fault() {
    use tower::ServiceExt;
    let server = server().await;
    let app = server.app.clone();
    let background = tokio::runtime::Handle::current();
    let router = qedgix::api::rest::router(app, qedgix::telemetry::render_metrics, 1 << 20, localhost(), background);
    let mut ask = slot(json!({"sequence_id": 3, "sequence_start": true}));
    ask["inputs"][2].as_object_mut().unwrap().remove("data");
    ask["inputs"][2]["parameters"] = json!({"binary_data_size": 4});
    let head = ask.to_string().into_bytes();
    let length = head.len();
    let body = [&head[..], &3.0_f32.to_le_bytes()].concat();
    let damage = (prop::collection::vec((0..body.len(), any::<u8>()), 0..4), 0..body.len() + 1, length - 3..length + 4);
    let mut runner = TestRunner::deterministic();
    let mut answered = 0;
    for case in 0..2000 {
        let (changes, cut, length) = if case == 0 {
            (Vec::new(), body.len(), length)
        } else {
            let tree = damage.new_tree(&mut runner).unwrap();
            let (changes, cut, length) = proptest::strategy::ValueTree::current(&tree);
            (changes, if case % 3 == 0 { cut } else { body.len() }, if case % 5 == 0 { length } else { head.len() })
        };
        let mut damaged = body.clone();
        changes.into_iter().for_each(|(at, byte)| damaged[at] = byte);
        damaged.truncate(cut);
        let request = axum::http::Request::post(INFER)
            .header("host", "localhost")
            .header(LENGTH, length)
            .body(axum::body::Body::from(damaged.clone()));
        let status = router.clone().oneshot(request.unwrap()).await.unwrap().status();
        answered += usize::from(status == 200);
        assert!(!status.is_server_error(), "{status}: {}", String::from_utf8_lossy(&damaged));
    }
    assert!((1..2000).contains(&answered), "{answered}");
}
