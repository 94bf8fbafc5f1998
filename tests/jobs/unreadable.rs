//! Rows that this version cannot read, as after a downgrade: each fails alone.

use std::path::Path;
use std::time::Duration;

use qedgix::wire::v1;
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};
use sqlx::sqlite::{SqliteConnectOptions, SqliteConnection};
use sqlx::{ConnectOptions, Connection};

use super::harness::{Server, expect, named, tiny};

/// Changes the database behind the server's back.
async fn change(data_dir: &Path, sql: &'static str, id: &str) {
    let options = SqliteConnectOptions::new().filename(data_dir.join(qedgix::store::FILE)).busy_timeout(Duration::from_secs(10));
    let mut database: SqliteConnection = options.connect().await.unwrap();
    let changed = sqlx::query(sql).bind(id).execute(&mut database).await.unwrap();
    assert_eq!(changed.rows_affected(), 1, "{sql}");
    database.close().await.unwrap();
}

const UNKNOWN_FIELD: &str = "UPDATE jobs SET spec = json_set(spec, '$.config.training.from_the_future', 1) WHERE id = ?";
const NO_JSON: &str = "UPDATE jobs SET spec = '{\"kind\": ' WHERE id = ?";

#[tokio::test]
async fn jobs_that_cannot_be_read_are_shown_cancelled_and_deleted() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start(dir.path(), 1).await;
    // One job holds the CPU budget, and another one is the head of the queue, so that those behind it stay where they are.
    server.submit(&tiny()).await;
    server.worker().await;
    server.submit(&tiny()).await;
    for change_of_spec in [UNKNOWN_FIELD, NO_JSON] {
        let id = server.submit(&named("of-the-future")).await;
        change(dir.path(), change_of_spec, &id).await;
        let path = format!("/v1/jobs/{id}");
        let job = server.get(&path).await;
        let document = job["unreadable"]["document"].as_str().unwrap().to_owned();
        assert!(document.starts_with("{\"kind\"") && !job["unreadable"]["reason"].as_str().unwrap().is_empty());
        assert_eq!((&job["environment"], &job["training"]), (&Value::Null, &Value::Null));
        assert_eq!((&job["name"], &job["algorithm"], &job["seed"]), (&json!("of-the-future"), &json!("vdn"), &json!(1)));
        let list = server.get("/v1/jobs").await;
        assert_eq!(list["jobs"][0]["unreadable"], job["unreadable"]);
        assert_eq!(list["jobs"].as_array().unwrap().last().unwrap()["unreadable"], Value::Null);

        let mut grpc = server.jobs().await;
        let got = grpc.get_job(v1::GetJobRequest { id: id.clone() }).await.unwrap().into_inner();
        assert_eq!(got.unreadable.as_ref().unwrap().document, document);
        let listed = grpc.list_jobs(v1::ListJobsRequest::default()).await.unwrap().into_inner();
        assert_eq!(listed.jobs[0].unreadable, got.unreadable);

        assert_eq!(server.post(&format!("{path}/cancel")).await["state"], "cancelled");
        expect(server.request(Method::DELETE, &path), StatusCode::NO_CONTENT).await;
    }
}

#[tokio::test]
async fn jobs_that_cannot_be_read_hold_back_neither_the_queue_nor_the_start() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start_with(dir.path(), 1, |s| s.cancel_grace = Duration::ZERO).await;
    let running = server.submit(&tiny()).await;
    let worker = server.worker().await;
    let unreadable = [server.submit(&tiny()).await, server.submit(&tiny()).await];
    let readable = server.submit(&tiny()).await;
    change(dir.path(), UNKNOWN_FIELD, &unreadable[0]).await;
    change(dir.path(), NO_JSON, &unreadable[1]).await;
    server.post(&format!("/v1/jobs/{running}/cancel")).await;
    worker.killed().await;
    let worker = server.worker().await;
    assert_eq!(worker.job(), readable);
    for id in unreadable {
        let job = server.reaches(&id, "failed").await;
        assert!(job["reason"].is_string() && job["unreadable"].is_object(), "{job}");
        assert_eq!(job["attempts"], 0);
    }
    // The start ends the attempts of the last server, also of a job that became unreadable while it ran.
    change(dir.path(), UNKNOWN_FIELD, &readable).await;
    change(dir.path(), "UPDATE jobs SET created_at = 9223372036854775807 WHERE id = ?", &readable).await;
    server.crash().await;
    let mut server = Server::start(dir.path(), 1).await;
    server.reaches(&readable, "failed").await;
    let next = server.submit(&tiny()).await;
    assert_eq!(server.worker().await.job(), next);
}

#[tokio::test]
async fn a_checkpoint_with_documents_of_another_version_is_listed() {
    let dir = tempfile::tempdir().unwrap();
    let server = Server::start(dir.path(), 1).await;
    let id = server.submit(&tiny()).await;
    let sql = "INSERT INTO checkpoints (id, job, kind, attempt, step, sha256, config, metrics, created_at, size, bytes)
               SELECT '00000000-0000-7000-8000-000000000001', number, 'best', 1, 5, 'x', 'no JSON', '[]', 0, 1, x'00'
               FROM jobs WHERE id = ?";
    change(dir.path(), sql, &id).await;
    let listed = server.get(&format!("/v1/jobs/{id}/checkpoints")).await;
    assert_eq!(listed["checkpoints"][0]["config"], "no JSON");
    assert_eq!(listed["checkpoints"][0]["step"], 5);
}
