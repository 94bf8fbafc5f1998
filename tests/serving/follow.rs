//! Replicas: they take policies, versions and aliases from a primary, keep them while it is away, and refuse changes.

use std::sync::Arc;
use std::time::Duration;

use qedgix::config::{Config, FollowConfig};
use qedgix::serving::PolicySpec;
use qedgix::wire::v1;
use qedgix::wire::v1::job_service_client::JobServiceClient;
use reqwest::{Method, StatusCode};
use rustls::crypto::ring;
use rustls::{ClientConfig, RootCertStore};
use serde_json::{Value, json};
use tonic::Code;
use tonic_types::StatusExt;

use super::harness::*;
use super::policies::numbered;
use super::published::publish;
use super::rest::Rest;

fn follow(url: String) -> FollowConfig {
    let tls = ClientConfig::builder_with_provider(Arc::new(ring::default_provider()));
    let tls = tls.with_safe_default_protocol_versions().unwrap().with_root_certificates(RootCertStore::empty());
    FollowConfig { url, authorization: None, tls: tls.with_no_client_auth() }
}

fn following(primary: &Server) -> impl FnOnce(&mut Config) + use<> {
    let url = primary.url("");
    move |config| config.follow = Some(follow(url))
}

async fn manifest(server: &Server) -> (StatusCode, Value) {
    Rest::new(server).get("/v1/manifest").await
}

/// Lets the replica ask its primary until `reached` holds.
async fn until(replica: &Server, reached: impl AsyncFn() -> bool) {
    with_timeout(async {
        while !reached().await {
            replica.advance(1);
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    })
    .await;
}

/// Waits until the replica has what the primary has, and returns that.
async fn caught_up(replica: &Server, primary: &Server) -> Value {
    let expected = manifest(primary).await;
    until(replica, async || manifest(replica).await == expected).await;
    expected.1
}

async fn set_alias(server: &Server, alias: &str, version: u64) {
    let path = format!("/v1/policies/mine/aliases/{alias}");
    let (status, answer) = Rest::new(server).send(Method::PUT, &path, json!({"version": version}).to_string()).await;
    assert!(status.is_success(), "{answer}");
}

async fn delete(server: &Server, path: &str) {
    let (status, answer) = Rest::new(server).send(Method::DELETE, path, "").await;
    assert!(status.is_success(), "{answer}");
}

/// A metric of a server; `None` if it has no value.
async fn metric(server: &Server, name: &str) -> Option<f64> {
    let text = reqwest::get(server.url("/metrics")).await.unwrap().text().await.unwrap();
    let line = text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' ').map(str::to_owned));
    line.map(|value| value.parse().unwrap())
}

/// An `Act` of `mine@live`: the digest of its policy, and the headings.
async fn act(server: &Server) -> (String, Vec<u32>) {
    let request = held("mine@live", bytes::Bytes::new(), scene(3, 5, 0));
    let answer = server.grpc().await.act(request).await.unwrap().into_inner();
    (answer.policy.unwrap().digest, answer.actions.iter().map(|action| action.heading_index).collect())
}

#[tokio::test]
async fn a_replica_follows_versions_aliases_and_deletions() {
    let primary = Server::start().await;
    for seed in 1..=3 {
        publish(&primary, "mine", &numbered(seed)).await;
    }
    set_alias(&primary, "live", 2).await;
    set_alias(&primary, "old", 1).await;
    let replica = Server::with(following(&primary)).await;
    let found = caught_up(&replica, &primary).await;
    assert_eq!(found["policies"]["mine"]["aliases"], json!({"live": 2, "old": 1}));
    assert_eq!(act(&replica).await, act(&primary).await);
    let created = async |server: &Server| Rest::new(server).get("/v1/policies/mine:1").await.1["created_at"].clone();
    assert_eq!(created(&replica).await, created(&primary).await);

    // A deleted number stays free, and a version that was published again under another number moves there with its alias.
    set_alias(&primary, "live", 3).await;
    delete(&primary, "/v1/policies/mine/versions/2").await;
    Rest::new(&primary).send(Method::POST, "/v1/policies/mine:1/unload", "").await;
    let found = caught_up(&replica, &primary).await;
    let versions = found["policies"]["mine"]["versions"].as_array().unwrap();
    let versions: Vec<_> = versions.iter().map(|v| (v["version"].as_u64().unwrap(), v["loaded"].as_bool().unwrap())).collect();
    assert_eq!(versions, [(1, false), (3, true)]);
    delete(&primary, "/v1/policies/mine/aliases/live").await;
    delete(&primary, "/v1/policies/mine/versions/3").await;
    assert_eq!(publish(&primary, "mine", &numbered(3)).await.version, 4);
    set_alias(&primary, "live", 4).await;
    caught_up(&replica, &primary).await;
    assert_eq!(act(&replica).await, act(&primary).await);

    // A replica of a replica has the same, and takes deletions of whole policies.
    let second = Server::with(following(&replica)).await;
    caught_up(&second, &primary).await;
    delete(&primary, "/v1/policies/mine/aliases/live").await;
    delete(&primary, "/v1/policies/mine/aliases/old").await;
    delete(&primary, "/v1/policies/mine").await;
    caught_up(&replica, &primary).await;
    assert_eq!(caught_up(&second, &primary).await["policies"]["mine"], Value::Null);
}

#[tokio::test]
async fn a_replica_serves_what_it_has_while_its_primary_is_away() {
    let mut primary = Server::start().await;
    publish(&primary, "mine", &numbered(1)).await;
    set_alias(&primary, "live", 1).await;
    let expected = act(&primary).await;
    let mut replica = Server::with(following(&primary)).await;
    let found = caught_up(&replica, &primary).await;
    let follow_again = following(&primary);
    let address = primary.endpoints.http;
    primary.begin_stop();
    primary.ended().await;

    let since = metric(&replica, "qedgix_replica_age_seconds").await.unwrap();
    replica.advance(1000);
    assert_eq!(metric(&replica, "qedgix_replica_age_seconds").await.unwrap(), since + 1000.0);
    assert_eq!(Rest::new(&replica).get("/readyz").await.0, StatusCode::OK);
    assert_eq!(act(&replica).await, expected);

    // The replica restarts, still without its primary.
    replica.begin_stop();
    replica.ended().await;
    let Server { dir, .. } = replica;
    let replica = Server::on(dir, follow_again).await;
    assert_eq!(Rest::new(&replica).get("/readyz").await.0, StatusCode::OK);
    assert_eq!((act(&replica).await, manifest(&replica).await.1), (expected, found));

    // The primary comes back, with something new.
    let Server { dir, .. } = primary;
    let primary = Server::on(dir, |config| config.http_addr = address).await;
    publish(&primary, "mine", &numbered(2)).await;
    caught_up(&replica, &primary).await;
    let newest = replica.app.registry.describe(&"mine".parse::<PolicySpec>().unwrap()).unwrap();
    assert_eq!(newest.state.reference.version, 2);
    until(&replica, async || metric(&replica, "qedgix_replica_age_seconds").await.is_some_and(|age| age < 3.0)).await;
}

#[tokio::test]
async fn a_replica_is_ready_when_it_has_the_policies_of_its_primary() {
    let mut primary = Server::start().await;
    let (dir, address) = (tempfile::tempdir().unwrap(), primary.endpoints.http);
    primary.begin_stop();
    primary.ended().await;
    let replica = Server::on(dir, following(&primary)).await;
    for path in ["/readyz", "/v1/manifest"] {
        let (status, problem) = Rest::new(&replica).get(path).await;
        assert_eq!((status, &problem["code"]), (StatusCode::SERVICE_UNAVAILABLE, &json!("unavailable")), "{path}");
    }
    let Server { dir, .. } = primary;
    let _primary = Server::on(dir, |config| config.http_addr = address).await;
    until(&replica, async || Rest::new(&replica).get("/readyz").await.0 == StatusCode::OK).await;
}

#[tokio::test]
async fn a_replica_refuses_changes_and_names_its_primary() {
    let primary = Server::start().await;
    let replica = Server::with(following(&primary)).await;
    caught_up(&replica, &primary).await;
    let rest = Rest::new(&replica);
    let job = json!({"training": {"steps": 100}}).to_string();
    for (method, path, body) in [
        (Method::POST, "/v1/policies/mine/versions", "x"),
        (Method::PUT, "/v1/policies/qedgix/aliases/live", r#"{"version": 1}"#),
        (Method::DELETE, "/v1/policies/qedgix/aliases/live", ""),
        (Method::POST, "/v1/policies/qedgix/unload", ""),
        (Method::DELETE, "/v1/policies/qedgix", ""),
        (Method::POST, "/v1/jobs", job.as_str()),
        (Method::PUT, "/v1/server/budget", r#"{"threads": 1}"#),
    ] {
        let (status, problem) = rest.send(method.clone(), path, body.to_owned()).await;
        assert_eq!((status.as_u16(), &problem["code"]), (409, &json!("read_only")), "{method} {path}: {problem}");
        assert_eq!(problem["primary"], primary.url(""), "{method} {path}");
    }
    let unload = reqwest::Client::new().post(replica.url("/v2/repository/models/qedgix/unload")).body("{}");
    let problem: Value = unload.send().await.unwrap().json().await.unwrap();
    assert_eq!((&problem["code"], &problem["primary"]), (&json!("read_only"), &json!(primary.url(""))));
    let submitted = JobServiceClient::new(replica.channel().await).submit_job(v1::SubmitJobRequest::default()).await;
    let status = submitted.unwrap_err();
    let info = status.get_error_details().error_info().cloned().unwrap();
    assert_eq!((status.code(), info.reason.as_str()), (Code::FailedPrecondition, "READ_ONLY"));
    assert_eq!(info.metadata["primary"], primary.url(""));

    // Reading, acting, sessions and environments work.
    assert_eq!(rest.get("/v1/policies/qedgix").await.0, StatusCode::OK);
    assert_eq!(rest.get("/v1/jobs").await.0, StatusCode::OK);
    assert_eq!(rest.post("/v1/sessions", &json!({"policy": "qedgix"})).await.0, StatusCode::CREATED);
}

#[tokio::test]
async fn versions_of_the_replica_itself_stay() {
    let primary = Server::start().await;
    publish(&primary, "mine", &numbered(1)).await;
    publish(&primary, "mine", &numbered(2)).await;
    let dir = tempfile::tempdir().unwrap();
    let mut former = Server::on(dir, |_| {}).await;
    // Number 1 has another checkpoint here; 2 is the same; nobody else has the other policy.
    publish(&former, "mine", &numbered(7)).await;
    publish(&former, "mine", &numbered(2)).await;
    publish(&former, "other", &numbered(3)).await;
    former.begin_stop();
    former.ended().await;
    let Server { dir, .. } = former;
    let replica = Server::on(dir, following(&primary)).await;
    let rest = Rest::new(&replica);
    let digest = async |policy: &str| rest.get(&format!("/v1/policies/{policy}")).await.1["ref"]["digest"].clone();
    until(&replica, async || metric(&replica, "qedgix_replica_missing_versions").await == Some(1.0)).await;
    let expected = |seed| json!(qedgix::checkpoint::digest(&numbered(seed).to_bytes()));
    assert_eq!([digest("mine:1").await, digest("mine:2").await, digest("other:1").await], [7, 2, 3].map(expected));
    // What both have is deleted with the primary's; the rest is not.
    publish(&primary, "mine", &numbered(4)).await;
    delete(&primary, "/v1/policies/mine/versions/2").await;
    until(&replica, async || digest("mine:2").await == Value::Null && digest("mine:3").await == expected(4)).await;
    assert_eq!([digest("mine:1").await, digest("other:1").await], [7, 3].map(expected));
}

#[tokio::test]
async fn flags_that_contradict_a_replica_are_refused() {
    let mut config = Config::new("data");
    config.follow = Some(follow("http://127.0.0.1:1".into()));
    assert!(config.validate().is_ok());
    config.retention.versions = 1;
    assert_eq!(config.validate().unwrap_err().field, "--keep-versions");
}
