//! Versions of policies: read into memory when they are asked for, deleted by callers and by the rules of retention, listed in
//! pages.

use bytes::Bytes;
use futures::future::join_all;
use jiff::Timestamp;
use qedgix::checkpoint::digest;
use qedgix::service::policies::{Retention, delete_excess_checkpoints, delete_excess_versions};
use qedgix::store::{FILE, NewPolicyVersion, Store};
use qedgix::wire::v1;
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};
use sqlx::SqlitePool;
use tonic::Code;

use super::harness::*;
use super::policies::numbered;
use super::published::publish;
use super::rest::Rest;

async fn restarted(mut server: Server) -> Server {
    server.begin_stop();
    with_timeout(server.restarted()).await
}

/// A connection to the database of a server, beside the server's own.
async fn database(dir: &std::path::Path) -> SqlitePool {
    SqlitePool::connect(&format!("sqlite://{}", dir.join(FILE).display())).await.unwrap()
}

#[tokio::test]
async fn a_version_is_read_once_when_many_ask_for_it() {
    let server = Server::start().await;
    publish(&server, "mine", &numbered(1)).await;
    let server = restarted(server).await;
    assert_eq!((server.app.loads.count(), server.app.registry.memory_used()), (0, 0), "the start reads no checkpoint");
    let clients = join_all((0..20).map(|_| server.grpc())).await;
    let act = async |mut client: v1::policy_service_client::PolicyServiceClient<tonic::transport::Channel>| {
        client.act(held("mine", Bytes::new(), scene(3, 5, 0))).await.unwrap().into_inner().actions
    };
    let answers = join_all(clients.into_iter().map(act)).await;
    assert!(answers.windows(2).all(|pair| pair[0] == pair[1]));
    assert_eq!(server.app.loads.count(), 1);
    assert!(server.app.registry.memory_used() > 0);
    let metrics = Rest::new(&server).get("/metrics").await.1;
    assert!(metrics.as_str().unwrap().contains("qedgix_policy_memory_bytes"));
}

#[tokio::test]
async fn versions_leave_memory_but_not_under_their_sessions() {
    let size = numbered(1).to_bytes().len();
    let memory = (2 * size + size / 2).max(1 << 20);
    let fit = memory / size;
    let server = Server::with(|config| config.policy_memory = memory).await;
    for seed in 0..fit as u64 + 2 {
        publish(&server, "mine", &numbered(seed)).await;
    }
    let mut client = server.grpc().await;
    client.open_session(open("mine:1", "s")).await.unwrap();
    let first = client.act(in_session("s", Some(0), scene(3, 5, 0))).await.unwrap().into_inner();
    let answer = client.act(held("mine:1", Bytes::new(), scene(3, 5, 0))).await.unwrap().into_inner();
    // One after the other, all others are read; the one of the session stays.
    for version in 2..=fit as u64 + 2 {
        client.act(held(&format!("mine:{version}"), Bytes::new(), scene(3, 5, 0))).await.unwrap();
        assert!(server.app.registry.memory_used() <= memory);
    }
    let reads = server.app.loads.count();
    assert!(reads >= 2, "{reads}");
    assert_eq!(client.act(held("mine:1", Bytes::new(), scene(3, 5, 0))).await.unwrap().into_inner().actions, answer.actions);
    client.act(in_session("s", Some(1), scene(3, 5, 1))).await.unwrap();
    assert_eq!(server.app.loads.count(), reads, "the version of the session was in memory");
    assert_eq!(first.actions, answer.actions);
    // Callers do not notice which versions are in memory.
    let shown = Rest::new(&server).get("/v1/policies/mine").await.1;
    assert_eq!(shown["loaded_versions"], shown["versions"]);

    // Sessions on all that fit leave no memory for another version.
    for version in 2..=fit as u64 {
        client.open_session(open(&format!("mine:{version}"), &format!("s{version}"))).await.unwrap();
    }
    let another = held(&format!("mine:{}", fit + 1), Bytes::new(), scene(3, 5, 0));
    let (code, reason, _) = refused(client.act(another.clone()).await);
    assert_eq!((code, reason.as_str()), (Code::ResourceExhausted, "resource_exhausted"));
    client.close_session(v1::CloseSessionRequest { session_id: "s2".into() }).await.unwrap();
    client.act(another).await.unwrap();
}

#[tokio::test]
async fn a_deleted_version_is_gone_and_its_number_is_not_given_again() {
    let server = Server::start().await;
    for seed in 1..=3 {
        publish(&server, "mine", &numbered(seed)).await;
    }
    let rest = Rest::new(&server);
    let delete = async |path: &str| rest.send(Method::DELETE, path, "").await;
    let version = |number: u64| format!("/v1/policies/mine/versions/{number}");
    assert_eq!(rest.send(Method::PUT, "/v1/policies/mine/aliases/live", r#"{"version": 1}"#).await.0, StatusCode::CREATED);
    let mut client = server.grpc().await;
    client.open_session(open("mine:2", "s")).await.unwrap();
    for (path, status, code) in [
        (version(1), 409, "wrong_state"),
        (version(2), 409, "wrong_state"),
        ("/v1/policies/mine".to_owned(), 409, "wrong_state"),
        (version(9), 404, "not_found"),
        ("/v1/policies/nobody".to_owned(), 404, "not_found"),
        ("/v1/policies/sweep".to_owned(), 409, "no_checkpoint"),
        ("/v1/policies/sweep/versions/1".to_owned(), 409, "no_checkpoint"),
        ("/v1/policies/qedgix".to_owned(), 409, "wrong_state"),
        ("/v1/policies/qedgix/versions/1".to_owned(), 409, "wrong_state"),
        ("/v1/policies/mine:3".to_owned(), 400, "invalid_argument"),
    ] {
        let (found, problem) = delete(&path).await;
        assert_eq!((found.as_u16(), &problem["code"]), (status, &json!(code)), "{path}: {problem}");
    }
    // Another version is deleted while a session flies its own.
    assert_eq!(delete(&version(3)).await.0, StatusCode::NO_CONTENT);
    assert_eq!(rest.get("/v1/policies/mine:3").await.0, StatusCode::NOT_FOUND);
    assert_eq!(refused(client.act(held("mine:3", Bytes::new(), scene(3, 5, 0))).await).1, "not_found");
    client.act(in_session("s", Some(0), scene(3, 5, 0))).await.unwrap();
    client.close_session(v1::CloseSessionRequest { session_id: "s".into() }).await.unwrap();
    assert_eq!(publish(&server, "mine", &numbered(3)).await.version, 4, "the same bytes are a new version");

    let request = v1::DeletePolicyVersionRequest { name: "mine".into(), version: 2 };
    client.delete_policy_version(request.clone()).await.unwrap();
    assert_eq!(refused(client.delete_policy_version(request).await).0, Code::NotFound);
    assert_eq!(delete("/v1/policies/mine/aliases/live").await.0, StatusCode::NO_CONTENT);
    client.delete_policy(v1::DeletePolicyRequest { name: "mine".into() }).await.unwrap();
    for path in ["/v1/policies/mine", "/v1/policies/mine/versions", "/v1/policies/mine/aliases", "/v1/policies/mine/history"] {
        assert_eq!(rest.get(path).await.0, StatusCode::NOT_FOUND, "{path}");
    }
    let server = restarted(server).await;
    assert_eq!(publish(&server, "mine", &numbered(1)).await.version, 5, "also after a restart");
    let history = Rest::new(&server).get("/v1/policies/mine/history").await.1;
    assert_eq!(history["history"][0]["previous"], json!(1), "the history has the numbers of deleted versions");
}

#[tokio::test]
async fn a_deletion_among_requests_is_before_or_after_each() {
    let server = Server::start().await;
    for round in 1..=10_u64 {
        publish(&server, "mine", &numbered(round)).await;
        let policy = format!("mine:{round}");
        let fly = async |mut client: v1::policy_service_client::PolicyServiceClient<tonic::transport::Channel>| {
            for _ in 0..20 {
                if let Err(status) = client.act(held(&policy, Bytes::new(), scene(3, 5, 0))).await {
                    assert_eq!(status.code(), Code::NotFound, "{status}");
                }
            }
        };
        let (one, two, rest) = (server.grpc().await, server.grpc().await, Rest::new(&server));
        let delete = async {
            loop {
                let (status, problem) = rest.send(Method::DELETE, &format!("/v1/policies/mine/versions/{round}"), "").await;
                match status {
                    StatusCode::NO_CONTENT => break,
                    // A request in flight uses it.
                    _ => assert_eq!(problem["code"], "wrong_state", "{problem}"),
                }
            }
        };
        Box::pin(with_timeout(async { tokio::join!(fly(one), fly(two), delete) })).await;
        assert_eq!(rest.get(&format!("/v1/policies/{policy}")).await.0, StatusCode::NOT_FOUND);
    }
}

#[tokio::test]
async fn old_versions_without_alias_are_deleted_at_publishing() {
    let server = Server::with(|config| config.retention = Retention { versions: 2, ..Retention::default() }).await;
    let rest = Rest::new(&server);
    publish(&server, "mine", &numbered(1)).await;
    assert_eq!(rest.send(Method::PUT, "/v1/policies/mine/aliases/live", r#"{"version": 1}"#).await.0, StatusCode::CREATED);
    let mut client = server.grpc().await;
    publish(&server, "mine", &numbered(2)).await;
    client.open_session(open("mine:2", "s")).await.unwrap();
    for seed in 3..=5 {
        publish(&server, "mine", &numbered(seed)).await;
    }
    delete_excess_versions(&server.app).await.unwrap();
    let versions = async || rest.get("/v1/policies/mine").await.1["versions"].clone();
    assert_eq!(versions().await, json!([1, 2, 4, 5]), "1 has an alias, 2 a session");
    client.close_session(v1::CloseSessionRequest { session_id: "s".into() }).await.unwrap();
    let body = numbered(6).to_bytes();
    let upload =
        reqwest::Client::new().post(server.url("/v1/policies/mine/versions")).header("content-type", "application/octet-stream");
    assert_eq!(upload.body(body).send().await.unwrap().status(), StatusCode::CREATED);
    assert_eq!(versions().await, json!([1, 5, 6]));
    assert_eq!(rest.get("/v1/policies/qedgix").await.1["versions"], json!([1]));
    assert_eq!(delete_excess_checkpoints(&server.app, 0).await.unwrap(), None, "0 keeps all");
}

#[tokio::test]
async fn ten_thousand_versions_are_listed_in_pages_and_none_is_read_at_the_start() {
    let dir = tempfile::tempdir().unwrap();
    let store = Store::open(dir.path()).await.unwrap();
    let bytes = numbered(1).to_bytes();
    let digest = digest(&bytes);
    let now = Timestamp::UNIX_EPOCH;
    let (name, info, alias, by, owner, any_name) = ("mine", "of another program", None, None, None, true);
    let new = NewPolicyVersion { name, digest: &digest, checkpoint: &bytes, info, now, alias, by, owner, any_name };
    store.publish_policy(new).await.unwrap();
    drop(store);
    let database = database(dir.path()).await;
    // Their checkpoints cannot be read.
    let sql = "WITH RECURSIVE n(i) AS (SELECT 2 UNION ALL SELECT i + 1 FROM n WHERE i < 10000)
               INSERT INTO policy_versions (name, version, digest, checkpoint, created_at)
               SELECT 'mine', i, printf('%064x', i), x'00', 0 FROM n";
    sqlx::query(sql).execute(&database).await.unwrap();
    database.close().await;

    let server = Server::on(dir, |_| {}).await;
    let rest = Rest::new(&server);
    assert_eq!(server.app.loads.count(), 0);
    let (mut listed, mut token) = (Vec::new(), String::new());
    loop {
        let page = rest.get(&format!("/v1/policies/mine/versions?page_size=999&page_token={token}")).await.1;
        let versions = page["versions"].as_array().unwrap().clone();
        assert!(versions.len() <= 999);
        listed.extend(versions.iter().map(|version| version["ref"]["version"].as_u64().unwrap()));
        token = page["next_page_token"].as_str().unwrap().to_owned();
        if token.is_empty() {
            break;
        }
    }
    assert!(listed.iter().copied().eq((1..=10_000).rev()));
    let mut client = server.grpc().await;
    let request = v1::ListPolicyVersionsRequest { name: "mine".into(), page_size: 2, page_token: "3".into() };
    let page = client.list_policy_versions(request).await.unwrap().into_inner();
    let numbers: Vec<u64> = page.versions.iter().map(|version| version.r#ref.as_ref().unwrap().version).collect();
    assert_eq!((numbers, page.next_page_token.as_str()), (vec![2, 1], ""));

    // A readable one is described and served; the description is made from the checkpoint. Damaged ones fail alone.
    let (status, one) = rest.get("/v1/policies/mine:1").await;
    assert_eq!((status, &one["version_count"], &one["metrics"]["step"]), (StatusCode::OK, &json!(10_000), &json!(1234)));
    let shown: Vec<u64> = serde_json::from_value(one["versions"].clone()).unwrap();
    assert!(shown.into_iter().eq(9901..=10_000));
    client.act(held("mine:1", Bytes::new(), scene(3, 5, 0))).await.unwrap();
    assert_eq!(refused(client.act(held("mine:7", Bytes::new(), scene(3, 5, 0))).await).1, "internal");
    let all = rest.get("/v1/policies").await.1;
    let names: Vec<&Value> = all["policies"].as_array().unwrap().iter().map(|policy| &policy["ref"]["name"]).collect();
    assert!(names.contains(&&json!("qedgix")) && !names.contains(&&json!("mine")), "{names:?}");
    for (query, field) in [("page_size=1001", "page_size"), ("page_token=x", "page_token"), ("pagesize=3", "pagesize")] {
        let (status, problem) = rest.get(&format!("/v1/policies/mine/versions?{query}")).await;
        assert_eq!((status.as_u16(), &problem["field"]), (400, &json!(field)), "{problem}");
    }
}

#[tokio::test]
async fn aliases_are_listed_in_pages() {
    let server = Server::start().await;
    publish(&server, "mine", &numbered(1)).await;
    let rest = Rest::new(&server);
    for alias in ["a", "b", "c"] {
        rest.send(Method::PUT, &format!("/v1/policies/mine/aliases/{alias}"), r#"{"version": 1}"#).await;
    }
    let page = rest.get("/v1/policies/mine/aliases?page_size=2").await.1;
    assert_eq!(page["aliases"], json!([{"alias": "a", "version": 1}, {"alias": "b", "version": 1}]));
    assert_eq!(page["next_page_token"], "b");
    let page = rest.get("/v1/policies/mine/aliases?page_size=2&page_token=b").await.1;
    assert_eq!((&page["aliases"][0]["alias"], &page["next_page_token"]), (&json!("c"), &json!("")));
}
