//! Policies over REST: checkpoints in and out, what is loaded, and the command line that talks to it.

use std::collections::BTreeMap;

use bytes::Bytes;
use jiff::Timestamp;
use qedgix::checkpoint::{Checkpoint, digest};
use qedgix::service::policies::{IndexEntry, index};
use qedgix::store::{CheckpointKind, EndedAttempt, JobId, JobSpec, NewCheckpoint, NewJob, Store, SubmitResult, WorkerResult};
use qedgix::train_config::{Algorithm, Preset};
use qedgix::wire::v1;
use reqwest::{Client, Method, Response, StatusCode};
use serde_json::{Value, json};
use tonic::Code;

use super::harness::*;
use super::published::{checkpoint, publish};
use super::rest::Rest;

/// Checkpoints that differ in their weights.
pub fn numbered(seed: u64) -> Checkpoint {
    checkpoint(Algorithm::Qmix, Preset::Practical, seed)
}

const BYTES: &str = "application/octet-stream";

async fn sent(server: &Server, path: &str, kind: Option<&str>, body: impl Into<reqwest::Body>) -> (StatusCode, Value, Response) {
    let mut request = Client::new().post(server.url(path)).body(body);
    if let Some(kind) = kind {
        request = request.header("content-type", kind);
    }
    let answer = request.send().await.unwrap();
    let empty = Response::from(axum::http::Response::builder().body("").unwrap());
    let (status, headers) = (answer.status(), answer.headers().clone());
    let body = answer.text().await.unwrap();
    let mut head = empty;
    *head.headers_mut() = headers;
    (status, serde_json::from_str(&body).unwrap_or(Value::String(body)), head)
}

#[tokio::test]
async fn a_checkpoint_that_is_sent_is_served() {
    let server = Server::start().await;
    let (mine, rest) = (numbered(1).to_bytes(), Rest::new(&server));
    let path = "/v1/policies/mine/versions";
    let (status, policy, head) = sent(&server, path, Some(BYTES), mine.clone()).await;
    assert_eq!((status, &head.headers()["location"]), (StatusCode::CREATED, &"/v1/policies/mine:1".parse().unwrap()));
    assert_eq!((&policy["ref"]["version"], &policy["ref"]["digest"]), (&json!(1), &json!(digest(&mine))), "{policy}");
    assert_eq!((&policy["loaded"], &policy["metrics"]["step"]), (&json!(true), &json!(1234)));
    let answer = server.grpc().await.act(held("mine", Bytes::new(), scene(3, 5, 0))).await.unwrap().into_inner();
    assert_eq!(answer.policy.unwrap().digest, digest(&mine));

    let (status, again, head) = sent(&server, path, Some("Application/Octet-Stream; x=y"), mine.clone()).await;
    assert_eq!(
        (status, &again["ref"], &head.headers()["location"]),
        (StatusCode::OK, &policy["ref"], &"/v1/policies/mine:1".parse().unwrap())
    );
    let (status, next, _) = sent(&server, &format!("{path}?alias=live"), Some(BYTES), numbered(2).to_bytes()).await;
    assert_eq!((status, &next["ref"]["version"], &next["aliases"]), (StatusCode::CREATED, &json!(2), &json!(["live"])));
    let (status, back, _) = sent(&server, &format!("{path}?alias=live"), Some(BYTES), mine).await;
    assert_eq!((status, &back["ref"]["version"], &back["aliases"]), (StatusCode::OK, &json!(1), &json!(["live"])));
    let moves = rest.get("/v1/policies/mine/history").await.1["history"].clone();
    let moves: Vec<_> = moves.as_array().unwrap().iter().map(|m| (m["previous"].clone(), m["version"].clone())).collect();
    assert_eq!(moves, [(json!(2), json!(1)), (json!(null), json!(2))]);
}

#[tokio::test]
async fn what_cannot_be_published_is_refused_and_leaves_nothing() {
    let server = Server::start().await;
    let good = numbered(1).to_bytes();
    let before = server.app.store.policy_versions().await.unwrap();
    let mut torn = good.clone();
    torn.truncate(good.len() / 2);
    let json = Some("application/json");
    let nowhere = r#"{"checkpoint_id": "01a202d1-93be-769e-80f7-75eef9496f12"}"#;
    let cases = [
        ("mine", Some(BYTES), b"hello".to_vec(), 400, "invalid_argument", "checkpoint"),
        ("mine", Some(BYTES), Vec::new(), 400, "invalid_argument", "checkpoint"),
        ("mine", Some(BYTES), torn, 400, "invalid_argument", "checkpoint"),
        ("mine", Some(BYTES), vec![b' '; (64 << 20) + 1], 413, "too_large", ""),
        ("mine", None, good.clone(), 415, "unsupported_media_type", "content-type"),
        ("mine", Some("text/plain"), good.clone(), 415, "unsupported_media_type", "content-type"),
        ("sweep", Some(BYTES), good.clone(), 400, "invalid_argument", "name"),
        ("mine:1", Some(BYTES), good.clone(), 400, "invalid_argument", "name"),
        ("mine?alias=a:b", Some(BYTES), good.clone(), 400, "invalid_argument", "alias"),
        ("mine?allias=live", Some(BYTES), good.clone(), 400, "invalid_argument", "allias"),
        ("mine", json, nowhere.into(), 404, "not_found", ""),
        ("mine", json, br#"{"checkpoint_id": "../../x"}"#.to_vec(), 404, "not_found", ""),
        ("mine", json, br#"{"checkpoint": 3}"#.to_vec(), 422, "invalid_schema", "checkpoint"),
        ("mine", json, good, 400, "invalid_argument", "body"),
    ];
    for (name, kind, body, status, code, field) in cases {
        let (policy, query) = name.split_once('?').map_or((name, String::new()), |(name, query)| (name, format!("?{query}")));
        let (found, problem, head) = sent(&server, &format!("/v1/policies/{policy}/versions{query}"), kind, body).await;
        assert_eq!((found.as_u16(), &problem["code"]), (status, &json!(code)), "{problem}");
        assert_eq!(head.headers()["content-type"], "application/problem+json");
        assert_eq!(problem["field"].as_str().unwrap_or_default(), field, "{problem}");
    }
    assert_eq!(server.app.store.policy_versions().await.unwrap(), before);
}

#[tokio::test]
async fn a_checkpoint_of_a_job_is_published_by_its_id() {
    let dir = tempfile::tempdir().unwrap();
    let store = Store::open(dir.path()).await.unwrap();
    let (mine, now) = (numbered(5), Timestamp::UNIX_EPOCH);
    let config = mine.config().clone();
    let spec = JobSpec::train(config);
    let new = NewJob {
        id: JobId(uuid::Uuid::from_u128(7)),
        owner: None,
        any_name: false,
        spec,
        notes: String::new(),
        beginning: None,
        parent: None,
        now,
        idempotency: None,
    };
    let SubmitResult::Created(job) = store.submit_job(new).await.unwrap() else { panic!("a new job") };
    let lease = store.begin_attempt(job.id, [0; 32], now).await.unwrap().unwrap();
    let bytes = mine.to_bytes();
    let new = NewCheckpoint { kind: CheckpointKind::Best, step: 1234, sha256: digest(&bytes), metrics: BTreeMap::new(), bytes };
    let id = store.store_checkpoint(lease, new, now).await.unwrap().unwrap();
    let ended = EndedAttempt { lease, result: &WorkerResult::Succeeded, publish: None, document: None, max_attempts: 1, now };
    store.end_attempt(ended).await.unwrap().unwrap();
    drop(store);

    let server = Server::on(dir, |_| {}).await;
    let body = json!({"checkpoint_id": id}).to_string();
    let (status, policy, _) = sent(&server, "/v1/policies/mine/versions?alias=live", Some("application/json"), body).await;
    assert_eq!((status, &policy["ref"]["digest"]), (StatusCode::CREATED, &json!(digest(&mine.to_bytes()))), "{policy}");
    assert_eq!(policy["aliases"], json!(["live"]));
    server.grpc().await.act(held("mine@live", Bytes::new(), scene(3, 5, 0))).await.unwrap();
}

#[tokio::test]
async fn what_is_exported_is_what_was_published() {
    let server = Server::start().await;
    let bytes = numbered(3).to_bytes();
    publish(&server, "mine", &numbered(2)).await;
    publish(&server, "mine", &numbered(3)).await;
    let export = |policy: &str| Client::new().get(server.url(&format!("/v1/policies/{policy}/export"))).send();
    sent(&server, "/v1/policies/mine/unload", None, "").await;
    for policy in ["mine", "mine:2"] {
        let answer = export(policy).await.unwrap();
        assert_eq!(answer.status(), StatusCode::OK);
        let header = |name: &str| answer.headers()[name].to_str().unwrap().to_owned();
        assert_eq!(header("content-type"), BYTES);
        assert_eq!(header("etag"), format!("\"{}\"", digest(&bytes)));
        assert_eq!(header("content-disposition"), "attachment; filename=\"mine-2.safetensors\"");
        assert_eq!(answer.bytes().await.unwrap(), bytes);
    }
    let (status, other, _) = sent(&server, "/v1/policies/other/versions", Some(BYTES), bytes.clone()).await;
    assert_eq!((status, &other["ref"]["digest"]), (StatusCode::CREATED, &json!(digest(&bytes))));
    for (policy, status, code) in [("sweep", 409, "no_checkpoint"), ("mine:3", 404, "not_found"), ("mine@live", 404, "not_found")]
    {
        let answer = export(policy).await.unwrap();
        assert_eq!(answer.status().as_u16(), status, "{policy}");
        assert_eq!(answer.json::<Value>().await.unwrap()["code"], code);
    }
    for name in ["qedgix", "qmix"] {
        let bundled = export(name).await.unwrap().bytes().await.unwrap();
        Checkpoint::from_bytes(&bundled).unwrap();
    }
}

#[tokio::test]
async fn an_unloaded_version_serves_nobody_new_and_those_that_fly_it_go_on() {
    let mut server = Server::start().await;
    publish(&server, "mine", &numbered(1)).await;
    publish(&server, "mine", &numbered(2)).await;
    let rest = Rest::new(&server);
    assert_eq!(rest.send(Method::PUT, "/v1/policies/mine/aliases/live", r#"{"version": 2}"#).await.0, StatusCode::CREATED);
    let mut client = server.grpc().await;
    client.open_session(open("mine@live", "s")).await.unwrap();
    client.act(in_session("s", Some(0), scene(3, 5, 0))).await.unwrap();
    let first = client.act(held("mine", Bytes::new(), scene(3, 5, 0))).await.unwrap().into_inner();
    let older = client.act(held("mine:1", Bytes::new(), scene(3, 5, 0))).await.unwrap().into_inner();

    let (status, shown) = rest.post("/v1/policies/mine:2/unload", &Value::Null).await;
    assert_eq!((status, &shown["loaded"], &shown["loaded_versions"]), (StatusCode::OK, &json!(false), &json!([1])), "{shown}");
    assert_eq!((&shown["versions"], &shown["aliases"]), (&json!([1, 2]), &json!(["live"])));
    for policy in ["mine", "mine:2", "mine@live"] {
        let refusals = [
            refused(client.act(held(policy, Bytes::new(), scene(3, 5, 0))).await),
            refused(client.act(held(policy, first.recurrent_state.clone(), scene(3, 5, 1))).await),
            refused(client.open_session(open(policy, "t")).await),
        ];
        for (code, reason, message) in refusals {
            assert_eq!((code, reason.as_str()), (Code::FailedPrecondition, "policy_unloaded"), "{message}");
        }
    }
    let on = client.act(in_session("s", Some(1), scene(3, 5, 1))).await.unwrap().into_inner();
    assert_eq!(on.policy.unwrap().version, 2, "a session ends on the version it began with");
    // An episode on version 1, whose memory the caller keeps, does not mind what the name means now.
    client.act(held("mine", older.recurrent_state, scene(3, 5, 1))).await.unwrap();
    let asked = v1::GetPolicyRequest { policy: "mine@live".into() };
    let grpc = client.get_policy(asked.clone()).await.unwrap().into_inner();
    assert_eq!((grpc.loaded, grpc.versions, grpc.loaded_versions), (false, vec![1, 2], vec![1]));

    // Nothing brings it back but loading it: not the same bytes, not a restart.
    let (status, again, _) = sent(&server, "/v1/policies/mine/versions", Some(BYTES), numbered(2).to_bytes()).await;
    assert_eq!((status, &again["loaded"]), (StatusCode::OK, &json!(false)));
    let (status, problem, _) = sent(&server, "/v1/policies/mine/versions?alias=x", Some(BYTES), numbered(2).to_bytes()).await;
    assert_eq!((status.as_u16(), &problem["code"]), (409, &json!("policy_unloaded")));
    assert_eq!(rest.send(Method::PUT, "/v1/policies/mine/aliases/x", r#"{"version": 2}"#).await.1["code"], "policy_unloaded");
    rest.post("/v1/policies/sweep/unload", &Value::Null).await;
    server.begin_stop();
    let server = with_timeout(server.restarted()).await;
    let rest = Rest::new(&server);
    let of = |name: &str| index(&server.app).into_iter().filter(|entry| entry.name == name).collect::<Vec<_>>();
    let entry = |version, loaded| {
        let reason = if loaded { String::new() } else { "unloaded".into() };
        IndexEntry { name: "mine".into(), version, loaded, reason }
    };
    assert_eq!(of("mine"), [entry(1, true), entry(2, false)]);
    assert!(!of("sweep")[0].loaded && of("nearest")[0].loaded);
    let mut client = server.grpc().await;
    assert_eq!(refused(client.act(held("sweep", Bytes::new(), scene(3, 5, 0))).await).1, "policy_unloaded");

    let (status, shown) = rest.post("/v1/policies/mine:2/load", &Value::Null).await;
    assert_eq!((status, &shown["loaded"]), (StatusCode::OK, &json!(true)));
    rest.post("/v1/policies/sweep/load", &Value::Null).await;
    client.act(held("sweep", Bytes::new(), scene(3, 5, 0))).await.unwrap();
    let back = client.act(held("mine@live", Bytes::new(), scene(3, 5, 0))).await.unwrap().into_inner();
    assert_eq!((back.actions, back.recurrent_state), (first.actions, first.recurrent_state), "the same bits");
}

#[tokio::test]
async fn a_name_loads_and_unloads_all_its_versions() {
    let server = Server::start().await;
    let rest = Rest::new(&server);
    for seed in 1..=3 {
        publish(&server, "mine", &numbered(seed)).await;
    }
    let loaded = async |verb: &str, policy: &str| {
        let (status, shown) = rest.post(&format!("/v1/policies/{policy}/{verb}"), &Value::Null).await;
        assert_eq!(status, StatusCode::OK, "{shown}");
        shown["loaded_versions"].clone()
    };
    assert_eq!(loaded("unload", "mine").await, json!([]));
    assert_eq!(loaded("unload", "mine").await, json!([]), "twice is once");
    assert_eq!(loaded("load", "mine:2").await, json!([2]));
    publish(&server, "mine", &numbered(4)).await;
    assert_eq!(loaded("load", "mine:4").await, json!([2, 4]), "what is new is served");
    assert_eq!(loaded("load", "mine").await, json!([1, 2, 3, 4]));
    assert_eq!(loaded("unload", "random").await, json!([]));
    let listed = rest.get("/v1/policies").await.1;
    let random = listed["policies"].as_array().unwrap().iter().find(|p| p["ref"]["name"] == "random").unwrap().clone();
    assert_eq!((&random["loaded"], &random["versions"]), (&json!(false), &json!([1])));
    assert_eq!(loaded("load", "random").await, json!([1]));
    for (policy, status) in [("mine:9", 404), ("nobody", 404), ("mine@live", 400), ("mi%20ne", 400)] {
        for verb in ["load", "unload"] {
            let refused = rest.post(&format!("/v1/policies/{policy}/{verb}"), &Value::Null).await;
            assert_eq!(refused.0.as_u16(), status, "{}", refused.1);
        }
    }
}

/// What the command prints; it has to succeed.
async fn qedgix(server: &Server, words: &[&str]) -> String {
    let (code, out, err) = run(server, words).await;
    assert_eq!(code, Some(0), "{words:?}: {err}");
    out
}

async fn run(server: &Server, words: &[&str]) -> (Option<i32>, String, String) {
    let mut command = tokio::process::Command::new(env!("CARGO_BIN_EXE_qedgix"));
    let command = command.arg("policies").args(words).env("QEDGIX_SERVER", server.endpoints.http.to_string());
    let output = command.output().await.unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    (output.status.code(), text(output.stdout), text(output.stderr))
}

#[tokio::test]
async fn the_command_line_does_all_of_it() {
    let server = Server::start().await;
    let (one, two) = (server.dir.path().join("one"), server.dir.path().join("two"));
    std::fs::write(&one, numbered(1).to_bytes()).unwrap();
    std::fs::write(&two, numbered(2).to_bytes()).unwrap();
    let (one, two) = (one.to_str().unwrap(), two.to_str().unwrap());
    assert!(qedgix(&server, &["upload", "mine", one, "--alias", "live"]).await.contains("mine:1"));
    let second: Value = serde_json::from_str(&qedgix(&server, &["upload", "mine", two, "--json"]).await).unwrap();
    assert_eq!(second["ref"]["version"], 2);
    assert_eq!(
        qedgix(&server, &["alias", "set", "mine", "live", "2", "--expected", "1"]).await,
        "mine@live points to mine:2 (previously mine:1)\n"
    );
    let (code, _, err) = run(&server, &["alias", "set", "mine", "live", "1", "--expected", "1"]).await;
    assert_eq!((code, err.contains("(alias_moved)")), (Some(1), true), "{err}");
    assert!(qedgix(&server, &["alias", "list", "mine"]).await.contains("live"));
    let history = qedgix(&server, &["history", "mine"]).await;
    let lines: Vec<&str> = history.lines().filter(|line| line.contains("live")).collect();
    assert_eq!(lines.len(), 2, "{history}");
    let table = qedgix(&server, &["list"]).await;
    let row = table.lines().find(|line| line.contains("mine")).unwrap();
    assert!(row.contains("checkpoint") && row.contains("live") && row.contains("any"), "{table}");
    assert!(table.contains("sweep"));
    let list: Value = serde_json::from_str(&qedgix(&server, &["list", "--json"]).await).unwrap();
    assert_eq!(list["policies"].as_array().unwrap().len(), server.app.registry.list("", 1000).0.len());
    assert!(qedgix(&server, &["unload", "mine:1"]).await.contains("loaded"));
    assert!(!index(&server.app).iter().any(|entry| entry.name == "mine" && entry.version == 1 && entry.loaded));
    qedgix(&server, &["load", "mine"]).await;
    assert!(qedgix(&server, &["get", "mine:1"]).await.contains(&digest(&numbered(1).to_bytes())));
    let out = server.dir.path().join("out");
    let exported = qedgix(&server, &["export", "mine@live", "--out", out.to_str().unwrap()]).await;
    assert!(exported.contains("mine:2"), "{exported}");
    assert_eq!(std::fs::read(&out).unwrap(), numbered(2).to_bytes());
    assert_eq!(qedgix(&server, &["alias", "delete", "mine", "live"]).await, "deleted mine@live\n");
    for (words, says) in [
        (&["get", "mine@live"][..], "(not_found)"),
        (&["export", "sweep"], "(no_checkpoint)"),
        (&["upload", "mine", "/no/such/file"], "/no/such/file"),
        (&["upload", "sweep", one], "(invalid_argument)"),
        (&["unload", "a/../b"], "(invalid_argument)"),
    ] {
        let (code, _, err) = run(&server, words).await;
        assert_eq!((code, err.contains(says)), (Some(1), true), "{words:?}: {err}");
    }
}
