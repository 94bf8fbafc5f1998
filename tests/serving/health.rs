//! `grpc.health.v1`: known and unknown services, failures, and draining.

use std::sync::Arc;

use bytes::Bytes;
use qedgix::api::grpc::SERVICES;
use sqlx::Connection;
use sqlx::sqlite::{SqliteConnectOptions, SqliteConnection};
use tonic::transport::Channel;
use tonic::{Code, Streaming};
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;
use tonic_health::pb::{HealthCheckRequest, HealthCheckResponse};

use super::harness::*;

fn ask(service: &str) -> HealthCheckRequest {
    HealthCheckRequest { service: service.into() }
}

async fn status(health: &mut HealthClient<Channel>, service: &str) -> ServingStatus {
    health.check(ask(service)).await.unwrap().into_inner().status()
}

async fn next(states: &mut Streaming<HealthCheckResponse>) -> Option<ServingStatus> {
    with_timeout(states.message()).await.unwrap().map(|state| state.status())
}

#[tokio::test]
async fn every_service_has_a_health_status_and_others_are_not_found() {
    let server = Server::start().await;
    let mut health = HealthClient::new(server.channel().await);
    assert!(SERVICES.len() >= 4);
    for service in SERVICES.iter().chain(&[""]) {
        assert_eq!(status(&mut health, service).await, ServingStatus::Serving, "{service}");
    }
    for unknown in ["no.such.Service", "qedgix.v1", "qedgix.v1.PolicyService "] {
        let (code, reason, message) = refused(health.check(ask(unknown)).await);
        assert_eq!((code, reason.as_str()), (Code::NotFound, "not_found"), "{message}");
    }
}

#[tokio::test]
async fn health_watches_report_draining_and_do_not_delay_it() {
    let mut server = Server::start().await;
    let gate = Arc::new(Gate::default());
    server.add("slow", 1, Arc::new(TestPolicy::Wait(gate.clone())));
    let mut flying = server.grpc().await;
    let in_flight = tokio::spawn(async move { flying.act(held("slow", Bytes::new(), scene(2, 2, 0))).await });
    gate.reached(1).await;
    let mut health = HealthClient::new(server.channel().await);
    let mut known = health.watch(ask("qedgix.v1.PolicyService")).await.unwrap().into_inner();
    let mut whole = health.watch(ask("")).await.unwrap().into_inner();
    let mut unknown = health.watch(ask("no.such.Service")).await.unwrap().into_inner();
    assert_eq!(next(&mut known).await, Some(ServingStatus::Serving));
    assert_eq!(next(&mut whole).await, Some(ServingStatus::Serving));
    assert_eq!(next(&mut unknown).await, Some(ServingStatus::ServiceUnknown));
    server.begin_stop();
    for states in [&mut known, &mut whole] {
        assert_eq!(next(states).await, Some(ServingStatus::NotServing));
        assert_eq!(next(states).await, None);
    }
    assert_eq!(next(&mut unknown).await, None);
    // The clients still hold their streams open, and a request is in flight.
    gate.open();
    assert_eq!(with_timeout(in_flight).await.unwrap().unwrap().into_inner().actions.len(), 2);
    with_timeout(server.stopped()).await;
    drop((known, whole, unknown));
}

#[tokio::test]
async fn server_with_a_damaged_database_is_not_ready() {
    let server = Server::start().await;
    let ready = async || {
        let answer = reqwest::get(server.url("/readyz")).await.unwrap();
        let (status, retry) = (answer.status().as_u16(), answer.headers().contains_key("retry-after"));
        let problem: serde_json::Value = answer.json().await.unwrap_or_default();
        (status, retry, problem["code"].as_str().unwrap_or_default().to_owned())
    };
    assert_eq!(ready().await.0, 200);
    let file = server.dir.path().join(qedgix::store::FILE);
    let mut database = SqliteConnection::connect_with(&SqliteConnectOptions::new().filename(file)).await.unwrap();
    for statement in [
        "PRAGMA writable_schema = ON",
        "UPDATE sqlite_schema SET sql = 'CREATE TABLE damaged (' WHERE name = 'policies'",
        "PRAGMA schema_version = 1000",
    ] {
        sqlx::query(statement).execute(&mut database).await.unwrap();
    }
    assert_eq!(ready().await, (503, true, "unavailable".into()));
    let probe = reqwest::get(server.url("/v2/health/ready")).await.unwrap();
    assert_eq!(probe.status(), 503);
    let mut health = HealthClient::new(server.channel().await);
    let mut states = health.watch(ask("")).await.unwrap().into_inner();
    while next(&mut states).await != Some(ServingStatus::NotServing) {}
    assert_eq!(reqwest::get(server.url("/livez")).await.unwrap().status(), 200);
}

#[tokio::test]
async fn the_job_service_is_not_serving_while_its_queue_is_unreadable() {
    let server = Server::start().await;
    let mut health = HealthClient::new(server.channel().await);
    let mut states = health.watch(ask("qedgix.v1.JobService")).await.unwrap().into_inner();
    assert_eq!(next(&mut states).await, Some(ServingStatus::Serving));
    let file = server.dir.path().join(qedgix::store::FILE);
    let mut database = SqliteConnection::connect_with(&SqliteConnectOptions::new().filename(file)).await.unwrap();
    sqlx::query("ALTER TABLE jobs RENAME TO elsewhere").execute(&mut database).await.unwrap();
    server.app.scheduler.job_changed(0);
    assert_eq!(next(&mut states).await, Some(ServingStatus::NotServing));
    // Other services are not affected.
    assert_eq!(status(&mut health, "qedgix.v1.PolicyService").await, ServingStatus::Serving);
    assert_eq!(status(&mut health, "").await, ServingStatus::Serving);
    sqlx::query("ALTER TABLE elsewhere RENAME TO jobs").execute(&mut database).await.unwrap();
    assert_eq!(next(&mut states).await, Some(ServingStatus::Serving));
}
