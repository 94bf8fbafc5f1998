//! Sessions, sequences, environments and jobs belong to the key that made them, and so do names of policies.

use qedgix::service::keys;
use qedgix::wire::v1;
use qedgix::wire::v1::environment_service_client::EnvironmentServiceClient;
use qedgix::wire::v1::job_service_client::JobServiceClient;
use reqwest::{Client, Method};
use serde_json::{Value, json};
use tonic::Code;

use super::super::harness::*;
use super::super::policies::numbered;
use super::{make, refresh, signed};

const JSON: &str = "application/json";

/// A caller over REST.
struct Caller<'a> {
    server: &'a Server,
    key: String,
    id: String,
}

impl<'a> Caller<'a> {
    async fn new(server: &'a Server, scopes: &str) -> Self {
        let created = make(server, scopes, |_| {}).await;
        Self { server, key: created.key, id: created.info.id }
    }

    async fn send(&self, method: Method, path: &str, body: Option<Value>) -> (u16, Value) {
        let request = Client::new().request(method, self.server.url(path)).bearer_auth(&self.key);
        let request = match body {
            Some(body) => request.header("content-type", JSON).body(body.to_string()),
            None => request,
        };
        let answer = with_timeout(request.send()).await.unwrap();
        let (status, text) = (answer.status().as_u16(), answer.text().await.unwrap());
        (status, serde_json::from_str(&text).unwrap_or(Value::Null))
    }

    async fn get(&self, path: &str) -> (u16, Value) {
        self.send(Method::GET, path, None).await
    }

    async fn post(&self, path: &str, body: Value) -> (u16, Value) {
        self.send(Method::POST, path, Some(body)).await
    }

    /// The values of `field` in a list, all pages of one item each.
    async fn list(&self, what: &str, field: &str) -> Vec<Value> {
        let (mut all, mut token) = (Vec::new(), String::new());
        loop {
            let (status, page) = self.get(&format!("/v1/{what}?page_size=1&page_token={token}")).await;
            assert_eq!(status, 200, "{page}");
            all.extend(page[what].as_array().unwrap().iter().map(|item| item[field].clone()));
            match page["next_page_token"].as_str().unwrap() {
                "" => return all,
                next => next.clone_into(&mut token),
            }
        }
    }
}

async fn three(server: &Server) -> [Caller<'_>; 3] {
    [Caller::new(server, "read,act,jobs").await, Caller::new(server, "read,act,jobs").await, Caller::new(server, "admin").await]
}

#[tokio::test]
async fn two_keys_use_the_same_session_id_without_seeing_each_other() {
    let server = Server::start().await;
    let [a, b, admin] = three(&server).await;
    let open = |seed: u64| json!({"policy": "random", "session_id": "s/1", "seed": seed});
    assert_eq!(a.post("/v1/sessions", open(1)).await.0, 201);
    assert_eq!(b.get("/v1/sessions/s%2F1").await.1["code"], "not_found");
    assert_eq!(b.send(Method::DELETE, "/v1/sessions/s%2F1", None).await.1["code"], "not_found");
    assert_eq!(b.list("sessions", "session_id").await, Vec::<Value>::new());
    // The gRPC calls of another key fail as for a session that does not exist.
    let mut client = server.grpc().await;
    let step = |key: &str| signed(key, in_session("s/1", None, scene(2, 3, 0)));
    assert_eq!(client.act(step(&b.key)).await.unwrap_err().code(), Code::NotFound);
    assert_eq!(client.act(step(&admin.key)).await.unwrap_err().code(), Code::NotFound, "nobody steps the fleet of another owner");
    let get = |key: &str| signed(key, v1::GetSessionRequest { session_id: "s/1".into() });
    assert_eq!(client.get_session(get(&b.key)).await.unwrap_err().code(), Code::NotFound);
    assert_eq!(client.get_session(get(&a.key)).await.unwrap().into_inner().owner, a.id);
    // Other options for the same name are no conflict, and the steps of the two are counted apart.
    assert_eq!(b.post("/v1/sessions", open(2)).await.0, 201);
    for _ in 0..2 {
        client.act(step(&a.key)).await.unwrap();
    }
    client.act(step(&b.key)).await.unwrap();
    assert_eq!(
        [a.get("/v1/sessions/s%2F1").await.1["steps"].clone(), b.get("/v1/sessions/s%2F1").await.1["steps"].clone()],
        [2, 1]
    );
    let batch = |key: &str| signed(key, v1::ActBatchRequest { requests: vec![in_session("s/1", Some(1), scene(2, 3, 1))] });
    let results = [client.act_batch(batch(&a.key)).await, client.act_batch(batch(&b.key)).await];
    let steps = results.map(|r| match r.unwrap().into_inner().results.remove(0).result.unwrap() {
        v1::act_result::Result::Response(response) => response.step,
        v1::act_result::Result::Error(error) => panic!("{error:?}"),
    });
    assert_eq!(steps, [1, 1]);
    // `admin` sees all of them, with their owners, over several pages.
    let mut owners = [json!(a.id), json!(b.id)];
    owners.sort_by_key(ToString::to_string);
    assert_eq!(admin.list("sessions", "owner").await, owners);
    assert_eq!(admin.list("sessions", "session_id").await, ["s/1", "s/1"]);
    assert_eq!(admin.send(Method::DELETE, "/v1/sessions/s%2F1", None).await.0, 200);
    assert_eq!(admin.list("sessions", "owner").await.len(), 1);
    // An expired session of one owner is not known to another.
    server.advance(100_000);
    let codes = [a.get("/v1/sessions/s%2F1").await.1, b.get("/v1/sessions/s%2F1").await.1];
    assert_eq!(codes.iter().filter(|problem| problem["code"] == "session_expired").count(), 1, "{codes:?}");
}

#[tokio::test]
async fn sequences_of_the_open_inference_protocol_belong_to_their_key() {
    let server = Server::start().await;
    let [a, b, _] = three(&server).await;
    let slot = |start: bool| {
        json!({
            "parameters": {"sequence_id": 7, "sequence_start": start},
            "inputs": [
                {"name": "uav_positions", "shape": [1, 2], "datatype": "FP64", "data": [0.5, 0.5]},
                {"name": "user_positions", "shape": [1, 2], "datatype": "FP64", "data": [0.1, 0.1]},
                {"name": "user_aoi", "shape": [1], "datatype": "FP64", "data": [0]}
            ]
        })
    };
    let infer = "/v2/models/sweep/infer";
    let (status, begun) = a.post(infer, slot(true)).await;
    assert_eq!(status, 200, "{begun}");
    assert_eq!(b.post(infer, slot(false)).await.1["code"], "sequence_not_started");
    assert_eq!(b.post(infer, slot(true)).await.0, 200, "it does not replace that of the other key");
    assert_eq!(a.post(infer, slot(false)).await.1["parameters"]["step"], 1);
    assert_eq!(b.list("sessions", "session_id").await, ["sequence:sweep:7"]);
}

#[tokio::test]
async fn two_keys_use_the_same_environment_id_without_seeing_each_other() {
    let server = Server::start().await;
    let [a, b, admin] = three(&server).await;
    let create = |uavs: u64| json!({"environment_id": "e", "environment": {"uavs": uavs, "users": 2}});
    assert_eq!(a.post("/v1/environments", create(2)).await.1["owner"], a.id);
    let foreign = [
        b.get("/v1/environments/e").await,
        b.post("/v1/environments/e/reset", json!({})).await,
        b.post("/v1/environments/e/step", json!({"actions": [{"headings": [0, 0]}]})).await,
        b.send(Method::DELETE, "/v1/environments/e", None).await,
    ];
    assert!(foreign.iter().all(|(status, problem)| *status == 404 && problem["code"] == "not_found"), "{foreign:?}");
    let mut client = EnvironmentServiceClient::new(server.channel().await);
    let get = v1::GetEnvironmentRequest { environment_id: "e".into() };
    assert_eq!(client.get_environment(signed(&b.key, get.clone())).await.unwrap_err().code(), Code::NotFound);
    assert_eq!(client.get_environment(signed(&a.key, get)).await.unwrap().into_inner().owner, a.id);
    assert_eq!(b.post("/v1/environments", create(3)).await.1["environment"]["uavs"], 3);
    assert_eq!(b.post("/v1/environments/e/reset", json!({})).await.0, 200);
    assert_eq!(a.list("environments", "owner").await, [json!(a.id)]);
    assert_eq!(admin.list("environments", "owner").await.len(), 2);
    assert_eq!(admin.get("/v1/environments/e").await.0, 200);
}

/// A job that never starts: the queue is blocked by workers that cannot be started.
fn job(name: Option<&str>) -> Value {
    json!({"name": name, "algorithm": "vdn", "environment": {"slots": 10}, "training": {"steps": 400, "batch": 2, "buffer": 20}})
}

#[tokio::test]
async fn jobs_belong_to_their_key() {
    let server = Server::with(|config| config.worker = Some("/no/such/worker".into())).await;
    let [a, b, admin] = three(&server).await;
    let submit = async |caller: &Caller<'_>, body: Value| {
        let request = Client::new().post(server.url("/v1/jobs")).bearer_auth(&caller.key).header("content-type", JSON);
        let answer = request.header("idempotency-key", "k").body(body.to_string()).send().await.unwrap();
        let (status, text) = (answer.status().as_u16(), answer.text().await.unwrap());
        (status, serde_json::from_str::<Value>(&text).unwrap())
    };
    let (status, mine) = submit(&a, job(None)).await;
    assert_eq!((status, &mine["owner"]), (201, &json!(a.id)), "{mine}");
    let (status, theirs) = submit(&b, job(Some("another"))).await;
    assert_eq!((status, theirs["id"] != mine["id"]), (201, true), "an idempotency key belongs to its API key: {theirs}");
    assert_eq!(submit(&a, job(None)).await.1["id"], mine["id"]);
    assert_eq!(submit(&a, job(Some("another"))).await.1["code"], "idempotency_conflict");

    let path = format!("/v1/jobs/{}", mine["id"].as_str().unwrap());
    for part in ["", "/metrics", "/checkpoints", "/logs", "/events"] {
        assert_eq!(b.get(&format!("{path}{part}")).await.1["code"], "not_found", "{part}");
        if part != "/events" {
            assert_eq!(a.get(&format!("{path}{part}")).await.0, 200, "{part}");
            assert_eq!(admin.get(&format!("{path}{part}")).await.0, 200, "{part}");
        }
    }
    for action in ["cancel", "pause", "resume"] {
        assert_eq!(b.send(Method::POST, &format!("{path}/{action}"), None).await.1["code"], "not_found", "{action}");
    }
    assert_eq!(b.send(Method::DELETE, &path, None).await.1["code"], "not_found");
    let mut client = JobServiceClient::new(server.channel().await);
    let id = mine["id"].as_str().unwrap().to_owned();
    let get = v1::GetJobRequest { id: id.clone() };
    assert_eq!(client.get_job(signed(&b.key, get.clone())).await.unwrap_err().code(), Code::NotFound);
    assert_eq!(client.get_job(signed(&a.key, get)).await.unwrap().into_inner().owner, a.id);
    let watch = v1::WatchJobRequest { id, after: 0 };
    assert_eq!(client.watch_job(signed(&b.key, watch)).await.map(|_| ()).unwrap_err().code(), Code::NotFound);
    assert_eq!(b.list("jobs", "id").await, [theirs["id"].clone()]);
    assert_eq!(admin.list("jobs", "id").await, [theirs["id"].clone(), mine["id"].clone()]);
    assert_eq!(admin.send(Method::POST, &format!("{path}/cancel"), None).await.0, 200);
}

#[tokio::test]
async fn a_name_of_another_owner_or_of_a_bundled_policy_needs_admin() {
    let server = Server::with(|config| config.worker = Some("/no/such/worker".into())).await;
    let [a, b, admin] = three(&server).await;
    let upload = Client::new().post(server.url("/v1/policies/mine/versions")).bearer_auth(&admin.key);
    let upload = upload.header("content-type", "application/octet-stream").body(numbered(1).to_bytes());
    assert_eq!(upload.send().await.unwrap().status(), 201);
    for name in ["qedgix", "mine"] {
        let (status, problem) = a.post("/v1/jobs", job(Some(name))).await;
        assert_eq!(
            (status, &problem["code"], &problem["required_scope"]),
            (403, &json!("permission_denied"), &json!("admin")),
            "{problem}"
        );
        assert_eq!(admin.post("/v1/jobs", job(Some(name))).await.0, 201, "{name}");
    }
    let (status, problem) = a.post("/v1/jobs", job(Some("sweep"))).await;
    assert_eq!((status, &problem["field"]), (400, &json!("name")), "{problem}");
    // Both may ask for a new name. Who publishes first owns it; the other one is refused when it publishes.
    let publisher =
        |caller: &Caller<'_>| qedgix::service::policies::Publisher { owner: Some(caller.id.clone()), any_name: false, key: None };
    let publish = async |caller, weights| {
        let bytes = numbered(weights).to_bytes();
        let published = qedgix::service::policies::publish_bytes(&server.app, publisher(caller), "new", bytes).await;
        published.map(|policy| policy.version).map_err(|error| error.code().as_str())
    };
    assert_eq!(a.post("/v1/jobs", job(Some("new"))).await.0, 201);
    assert_eq!(b.post("/v1/jobs", job(Some("new"))).await.0, 201);
    assert_eq!(publish(&a, 1).await, Ok(1));
    assert_eq!(publish(&b, 2).await, Err("permission_denied"));
    assert_eq!(publish(&b, 1).await, Err("permission_denied"), "the same bytes do not help");
    assert_eq!(publish(&a, 3).await, Ok(2));
    assert_eq!(b.post("/v1/jobs", job(Some("new"))).await.0, 403);
    assert_eq!(a.post("/v1/jobs", job(Some("new"))).await.0, 201);
}

#[tokio::test]
async fn a_rotated_and_an_accompanying_key_have_the_same_owner() {
    let server = Server::start().await;
    let a = Caller::new(&server, "read,act").await;
    a.post("/v1/sessions", json!({"policy": "sweep", "session_id": "s"})).await;
    let rotated = keys::rotate(&server.app.store, &a.id, std::time::Duration::ZERO, server.app.clock.now()).await.unwrap();
    let monitor = make(&server, "read", |new| new.owner = Some(rotated.info.id.clone())).await;
    let stranger = make(&server, "read", |_| {}).await;
    refresh(&server).await;
    for (created, status) in [(rotated, 200), (monitor, 200), (stranger, 404)] {
        let caller = Caller { server: &server, key: created.key, id: created.info.id };
        assert_eq!(caller.get("/v1/sessions/s").await.0, status, "{}", created.info.owner);
    }
    let unknown = keys::NewKey { owner: Some("nobody".into()), ..of_a_test() };
    let refused = keys::create(&server.app.store, unknown, server.app.clock.now()).await.err().unwrap();
    assert_eq!(refused.code(), qedgix::error_code::ErrorCode::NotFound);
}

fn of_a_test() -> keys::NewKey {
    keys::NewKey { name: "k".into(), scopes: "read".parse().unwrap(), owner: None, lifetime: None, rate: None, burst: None }
}

#[tokio::test]
async fn what_was_made_without_keys_is_for_admins_only() {
    let server = Server::start().await;
    let (status, _) =
        super::super::rest::Rest::new(&server).post("/v1/sessions", &json!({"policy": "sweep", "session_id": "s"})).await;
    assert_eq!(status, 201);
    let [a, _, admin] = three(&server).await;
    assert_eq!(a.get("/v1/sessions/s").await.0, 404);
    assert_eq!(admin.get("/v1/sessions/s").await.1["owner"], Value::Null);
    assert_eq!(admin.list("sessions", "session_id").await, ["s"]);
}
