//! REST: the same use cases as JSON, and errors as problem details.

use reqwest::{Client, Method, StatusCode};
use serde_json::{Value, json};

use super::harness::*;

pub struct Rest<'a> {
    server: &'a Server,
    http: Client,
}

impl<'a> Rest<'a> {
    pub fn new(server: &'a Server) -> Self {
        Self { server, http: Client::new() }
    }

    pub async fn send(&self, method: Method, path: &str, body: impl Into<reqwest::Body>) -> (StatusCode, Value) {
        let request = self.http.request(method, self.server.url(path)).header("content-type", "application/json").body(body);
        let answer = request.send().await.unwrap();
        let (status, kind) = (answer.status(), answer.headers().get("content-type").cloned());
        assert!(answer.headers().contains_key("x-request-id"));
        let text = answer.text().await.unwrap();
        if !status.is_success() {
            assert_eq!(kind.unwrap(), "application/problem+json", "{text}");
        }
        (status, serde_json::from_str(&text).unwrap_or(Value::String(text)))
    }

    pub async fn post(&self, path: &str, body: &Value) -> (StatusCode, Value) {
        self.send(Method::POST, path, body.to_string()).await
    }

    pub async fn get(&self, path: &str) -> (StatusCode, Value) {
        self.send(Method::GET, path, "").await
    }

    /// Status and code of the problem, and the field that is not accepted (empty if the problem is about no field).
    pub async fn refused(&self, path: &str, body: &str) -> (u16, String, String) {
        let (status, problem) = self.send(Method::POST, path, body.to_owned()).await;
        assert_eq!(problem["status"], status.as_u16());
        let text = |name: &str| problem[name].as_str().unwrap_or_default().to_owned();
        (status.as_u16(), text("code"), text("field"))
    }
}

fn slot(session: &str, step: u64) -> Value {
    let scene = scene(3, 5, step);
    json!({
        "session_id": session,
        "step": step,
        "scene": {
            "uavs": scene.uavs.iter().map(|u| json!({"id": u.id, "x": u.x, "y": u.y})).collect::<Vec<_>>(),
            "users": scene.users.iter().map(|u| json!({"id": u.id, "x": u.x, "y": u.y, "aoi": u.aoi})).collect::<Vec<_>>(),
        },
    })
}

#[tokio::test]
async fn both_transports_agree() {
    let server = Server::start().await;
    let (rest, mut grpc) = (Rest::new(&server), server.grpc().await);
    let (status, session) = rest.post("/v1/sessions", &json!({"policy": "sweep", "session_id": "r", "seed": 0})).await;
    assert_eq!((status, &session["session_id"], &session["policy"]["version"]), (StatusCode::CREATED, &json!("r"), &json!(1)));
    grpc.open_session(open("sweep", "g")).await.unwrap();
    for step in 0..5 {
        let (status, answer) = rest.post("/v1/act", &slot("r", step)).await;
        assert_eq!(status, StatusCode::OK, "{answer}");
        let expected = grpc.act(in_session("g", Some(step), scene(3, 5, step))).await.unwrap().into_inner();
        for (a, b) in answer["actions"].as_array().unwrap().iter().zip(&expected.actions) {
            assert_eq!((&a["uav_id"], &a["heading_index"]), (&json!(b.uav_id), &json!(b.heading_index)));
            assert_eq!(a["heading_deg"], json!(b.heading_deg));
        }
        assert_eq!(answer["step"], step);
        assert!(answer["timings"]["compute"].as_str().unwrap().ends_with('s'));
    }
    assert_eq!(rest.get("/v1/sessions/r").await.1["steps"], 5);
    let names: Vec<Value> =
        rest.get("/v1/sessions").await.1["sessions"].as_array().unwrap().iter().map(|s| s["session_id"].clone()).collect();
    assert_eq!(names, [json!("g"), json!("r")]);
    let page = rest.get("/v1/sessions?page_size=1").await.1;
    assert_eq!((page["sessions"].as_array().unwrap().len(), &page["next_page_token"]), (1, &json!("g")));
    assert_eq!(rest.send(Method::DELETE, "/v1/sessions/r", "").await.0, StatusCode::OK);
    assert_eq!(rest.get("/v1/sessions/r").await.0, StatusCode::NOT_FOUND);
}

#[tokio::test]
async fn memory_kept_by_the_caller_travels_in_base64() {
    let server = Server::start().await;
    let rest = Rest::new(&server);
    let mut request = slot("", 0);
    request.as_object_mut().unwrap().remove("session_id");
    request["policy"] = json!("sweep");
    let first = rest.post("/v1/act", &request).await.1;
    let mut next = request.clone();
    (next["step"], next["recurrent_state"]) = (json!(1), first["recurrent_state"].clone());
    let (status, second) = rest.post("/v1/act", &next).await;
    assert_eq!((status, &second["step"]), (StatusCode::OK, &json!(1)), "{second}");
    next["recurrent_state"] = json!("not base64!");
    let (status, code, field) = rest.refused("/v1/act", &next.to_string()).await;
    assert_eq!((status, code.as_str(), field.as_str()), (422, "invalid_schema", "recurrent_state"));
}

#[tokio::test]
async fn a_graph_says_the_same_as_a_scene() {
    let server = Server::start().await;
    let rest = Rest::new(&server);
    let graph = graph(&scene(3, 5, 0), 0.28, true);
    let nodes: Vec<Value> = graph
        .nodes
        .iter()
        .map(|n| {
            let sees = |d: &qedgix::wire::v1::Detection| {
                let mut seen = json!({"target_id": d.target_id, "rel_x": d.rel_x, "rel_y": d.rel_y});
                if let Some(aoi) = d.aoi {
                    seen["aoi"] = json!(aoi);
                }
                seen
            };
            let mut node = json!({"id": n.id, "detections": n.detections.iter().map(sees).collect::<Vec<_>>()});
            if let Some(p) = &n.position {
                node["position"] = json!({"x": p.x, "y": p.y});
            }
            node["kind"] = json!(if n.kind == 1 { "NODE_KIND_UAV" } else { "user" });
            node
        })
        .collect();
    let (status, by_graph) = rest.post("/v1/act", &json!({"policy": "sweep", "graph": {"nodes": nodes}})).await;
    assert_eq!(status, StatusCode::OK, "{by_graph}");
    let mut by_scene = slot("", 0);
    by_scene.as_object_mut().unwrap().remove("session_id");
    by_scene["policy"] = json!("sweep");
    assert_eq!(by_graph["actions"], rest.post("/v1/act", &by_scene).await.1["actions"]);
}

#[tokio::test]
async fn the_table_of_errors() {
    let server = Server::start().await;
    let rest = Rest::new(&server);
    rest.post("/v1/sessions", &json!({"policy": "sweep", "session_id": "s"})).await;
    let with = |path: &[&str], value: Value| {
        let mut request = slot("s", 0);
        let mut field = &mut request;
        for name in path {
            field = match name.parse::<usize>() {
                Ok(i) => &mut field[i],
                Err(_) => &mut field[*name],
            };
        }
        *field = value;
        request.to_string()
    };
    let good = slot("s", 0).to_string();
    let cases = [
        (with(&["scene", "users", "2", "aoi"], json!(-1.0)), 400, "invalid_argument", "scene.users[2].aoi"),
        (with(&["scene", "uavs", "1", "x"], json!("east")), 422, "invalid_schema", "scene.uavs[1].x"),
        (with(&["scene", "uavs", "1", "x"], Value::Null), 422, "invalid_schema", "scene.uavs[1].x"),
        (with(&["scene", "uavs", "1", "w"], json!(1)), 422, "invalid_schema", "scene.uavs[1].w"),
        (with(&["scene", "uavs", "0"], json!({"id": "a", "x": 0})), 422, "invalid_schema", "scene.uavs[0].y"),
        (with(&["world"], json!({"boundary": 9})), 422, "invalid_schema", "world.boundary"),
        (with(&["graph"], json!({"nodes": []})), 422, "invalid_schema", "graph"),
        (with(&["recurrent_state"], json!("")), 422, "invalid_schema", "session_id"),
        (with(&["hello"], json!(1)), 422, "invalid_schema", "hello"),
        (with(&["step"], json!(-1)), 422, "invalid_schema", "step"),
        (with(&["step"], json!(3)), 409, "wrong_step", ""),
        (with(&["session_id"], json!("nobody")), 404, "not_found", ""),
        (good[..good.len() / 2].to_owned(), 400, "invalid_argument", "body"),
        (format!("{good}{good}"), 400, "invalid_argument", "body"),
        (good.replacen("0.", "1e999", 1), 400, "invalid_argument", "body"),
        (String::new(), 400, "invalid_argument", "body"),
        ("[".repeat(100_000), 422, "invalid_schema", "body"),
        ("null".into(), 422, "invalid_schema", "body"),
        (" ".repeat(20_000_000), 413, "too_large", ""),
    ];
    for (body, status, code, field) in cases {
        let shown: String = body.chars().take(200).collect();
        let refused = rest.refused("/v1/act", &body).await;
        assert_eq!((refused.0, refused.1.as_str(), refused.2.as_str()), (status, code, field), "{shown}");
    }
    assert_eq!(rest.refused("/v1/sessions", r#"{"policy": "swoop"}"#).await.0, 404);
    assert_eq!(rest.refused("/v1/sessions", r#"{"policy": "sweep", "sesion_id": "x"}"#).await.0, 422);
    assert_eq!(rest.refused("/v1/sessions", r#"{"policy": "nearest", "session_id": "s"}"#).await.0, 409);
    server.advance(601);
    assert_eq!(rest.refused("/v1/act", &good).await.1, "session_expired");
    for (method, path, status) in [
        (Method::GET, "/nothing/here", 404),
        (Method::PUT, "/v1/act", 405),
        (Method::from_bytes(b"INVENTED").unwrap(), "/livez", 405),
        (Method::GET, "/v1/policies/swoop", 404),
        (Method::GET, "/v1/policies/sw%20p", 400),
        (Method::GET, "/v1/policies/%ff", 400),
        (Method::GET, "/v1/policies?page_size=minus", 400),
        (Method::GET, "/v1/policies?size=1", 400),
        (Method::GET, "/v1/policies?page_size=100000", 400),
    ] {
        assert_eq!(rest.send(method.clone(), path, "").await.0.as_u16(), status, "{method} {path}");
    }
}

#[tokio::test]
async fn a_body_that_does_not_say_its_size_is_bounded_too() {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    let server = Server::start().await;
    let mut stream = tokio::net::TcpStream::connect(server.endpoints.http).await.unwrap();
    let head = "POST /v1/act HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\ncontent-type: application/json\r\ntransfer-encoding: chunked\r\n\r\n";
    stream.write_all(head.as_bytes()).await.unwrap();
    let chunk = format!("{:x}\r\n{}\r\n", 100_000, " ".repeat(100_000));
    for _ in 0..200 {
        stream.write_all(chunk.as_bytes()).await.unwrap();
    }
    stream.write_all(b"0\r\n\r\n").await.unwrap();
    let mut answer = String::new();
    with_timeout(stream.read_to_string(&mut answer)).await.unwrap();
    assert!(answer.starts_with("HTTP/1.1 413 "), "{answer}");
}

#[tokio::test]
async fn browsers_get_the_dashboard_and_programs_the_index() {
    let server = Server::start().await;
    let client = reqwest::Client::new();
    let get = |path: &str, header: (&str, &str)| client.get(server.url(path)).header(header.0, header.1).send();
    let page = get("/", ("accept", "text/html,application/xhtml+xml,*/*;q=0.8")).await.unwrap();
    assert_eq!((page.status(), page.headers()["vary"].to_str().unwrap()), (StatusCode::OK, "accept"));
    assert!(page.headers()["content-type"].to_str().unwrap().starts_with("text/html"));
    let tag = page.headers()["etag"].to_str().unwrap().to_owned();
    let text = page.text().await.unwrap();
    assert!(
        !text.contains("<style") && !text.contains("style=") && !text.contains("onload"),
        "the security policy forbids these"
    );
    let files: Vec<&str> = text.split('"').filter(|part| part.starts_with("ui/")).collect();
    assert!(files.contains(&"ui/app.js"), "{files:?}");
    for file in files {
        assert_eq!(get(&format!("/{file}"), ("accept", "*/*")).await.unwrap().status(), StatusCode::OK, "{file}");
    }
    assert_eq!(get("/ui/index.html", ("if-none-match", &tag)).await.unwrap().status(), StatusCode::NOT_MODIFIED);
    assert_eq!(get("/", ("accept", "application/json")).await.unwrap().json::<Value>().await.unwrap()["name"], "qedgix");
    assert_eq!(Rest::new(&server).get("/ui/nothing.js").await.1["code"], "not_found");
}

#[tokio::test]
async fn probes_metrics_and_policies() {
    let server = Server::start().await;
    let rest = Rest::new(&server);
    assert_eq!(rest.get("/livez").await, (StatusCode::OK, json!("ok\n")));
    assert_eq!(rest.get("/readyz").await.0, StatusCode::OK);
    assert_eq!(rest.get("/").await.1["name"], "qedgix");
    let sweep = rest.get("/v1/policies/sweep:1").await.1;
    assert_eq!((&sweep["kind"], &sweep["needs"]), (&json!("POLICY_KIND_BASELINE"), &json!("NEEDS_OWN_POSITIONS")));
    assert_eq!(rest.get("/v1/policies").await.1["policies"].as_array().unwrap().len(), server.app.registry.len());
    rest.post("/v1/act", &json!({})).await;
    let text = rest.get("/metrics").await.1;
    let text = text.as_str().unwrap();
    for line in [
        "http_requests_total{method=\"POST\",route=\"/v1/act\",status=\"400\"}",
        "http_request_duration_seconds_bucket",
        "qedgix_policy_versions",
    ] {
        assert!(text.contains(line), "{line} in {text}");
    }
    server.app.draining.begin();
    assert_eq!(rest.get("/readyz").await.0, StatusCode::SERVICE_UNAVAILABLE);
    assert_eq!(rest.get("/livez").await.0, StatusCode::OK);
    assert_eq!(rest.refused("/v1/sessions", r#"{"policy": "sweep"}"#).await.0, 503);
}
