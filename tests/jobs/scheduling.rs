//! The scheduler: order, CPU budget, cancel, pause, failures, restarts, draining.

use std::time::Duration;

use qedgix::jobs::SchedulerConfig;
use qedgix::wire::v1;
use reqwest::{Method, StatusCode};
use serde_json::json;
use sha2::{Digest, Sha256};
use tonic::Code;

use super::harness::{Server, TIMEOUT, Worker, expect, named, signed, tiny, with, within};

async fn finish(server: &Server, worker: &Worker, outcome: v1::Outcome) {
    let request = v1::FinishRequest { outcome: outcome.into(), reason: "by the test".into(), ..Default::default() };
    let request = signed(&worker.launch, &worker.launch.token, request);
    server.worker_client().await.finish(request).await.unwrap();
}

fn without_grace(settings: &mut SchedulerConfig) {
    settings.cancel_grace = Duration::ZERO;
    settings.pause_grace = Duration::ZERO;
}

#[tokio::test]
async fn jobs_start_in_order_within_the_cpu_budget() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start(dir.path(), 2).await;
    let one = server.submit(&named("one")).await;
    let two = server.submit(&named("two")).await;
    let wide = server.submit(&with(&json!({"name": "wide", "threads": 2}))).await;
    let narrow = server.submit(&named("narrow")).await;
    let (first, second) = (server.worker().await, server.worker().await);
    assert_eq!((first.job(), second.job()), (one.clone(), two.clone()));

    // One thread is free: `narrow` would fit, but `wide` came first and needs both.
    finish(&server, &first, v1::Outcome::Succeeded).await;
    server.reaches(&one, "succeeded").await;
    first.exit("exit code 0");
    finish(&server, &second, v1::Outcome::Succeeded).await;
    // The job has succeeded, but its process still occupies a thread.
    server.reaches(&two, "succeeded").await;
    assert_eq!((server.state(&wide).await.as_str(), server.state(&narrow).await.as_str()), ("queued", "queued"));
    assert!(server.workers.try_recv().is_err());
    second.exit("exit code 0");
    let third = server.worker().await;
    assert_eq!(third.job(), wide);
    assert_eq!(server.state(&narrow).await, "queued");
    finish(&server, &third, v1::Outcome::Succeeded).await;
    third.exit("exit code 0");
    assert_eq!(server.worker().await.job(), narrow);
}

#[tokio::test]
async fn higher_priority_starts_first() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start(dir.path(), 1).await;
    server.submit(&tiny()).await;
    let running = server.worker().await;
    let low = server.submit(&with(&json!({"priority": -1}))).await;
    let normal = server.submit(&tiny()).await;
    let high = server.submit(&with(&json!({"priority": 5}))).await;
    let mut order = Vec::new();
    let mut worker = running;
    for _ in 0..3 {
        finish(&server, &worker, v1::Outcome::Succeeded).await;
        worker.exit("exit code 0");
        worker = server.worker().await;
        order.push(worker.job());
    }
    assert_eq!(order, [high, normal, low]);
}

#[tokio::test]
async fn queued_job_is_cancelled_at_once() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start(dir.path(), 1).await;
    server.submit(&tiny()).await;
    let _busy = server.worker().await;
    let waiting = server.submit(&tiny()).await;
    let job = server.post(&format!("/v1/jobs/{waiting}/cancel")).await;
    assert_eq!(job["state"], "cancelled");
    // A second cancel is accepted; a resume is refused.
    server.post(&format!("/v1/jobs/{waiting}/cancel")).await;
    let resume = server.request(Method::POST, &format!("/v1/jobs/{waiting}/resume"));
    expect(resume, StatusCode::CONFLICT).await;
}

#[tokio::test]
async fn running_job_is_cancelled_by_its_worker() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start(dir.path(), 1).await;
    let id = server.submit(&tiny()).await;
    let worker = server.worker().await;
    let job = server.post(&format!("/v1/jobs/{id}/cancel")).await;
    assert_eq!((&job["state"], &job["wanted"]), (&json!("running"), &json!("cancel")));
    let heartbeat = signed(&worker.launch, &worker.launch.token, v1::HeartbeatRequest {});
    let answer = server.worker_client().await.heartbeat(heartbeat).await.unwrap().into_inner();
    assert_eq!(answer.directive(), v1::Directive::Cancel);
    finish(&server, &worker, v1::Outcome::Stopped).await;
    let job = server.reaches(&id, "cancelled").await;
    assert_eq!(job["failures"], 0);
    worker.exit("exit code 0");
}

#[tokio::test]
async fn worker_that_ignores_a_cancel_is_killed() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start_with(dir.path(), 1, without_grace).await;
    let id = server.submit(&tiny()).await;
    let worker = server.worker().await;
    server.post(&format!("/v1/jobs/{id}/cancel")).await;
    worker.killed().await;
    server.reaches(&id, "cancelled").await;
}

#[tokio::test]
async fn acknowledged_cancel_wins_over_a_worker_that_succeeds() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start(dir.path(), 1).await;
    let id = server.submit(&tiny()).await;
    let worker = server.worker().await;
    server.post(&format!("/v1/jobs/{id}/cancel")).await;
    finish(&server, &worker, v1::Outcome::Succeeded).await;
    assert_eq!(server.state(&id).await, "cancelled");
}

#[tokio::test]
async fn worker_without_heartbeats_is_killed_and_its_job_retried() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start_with(dir.path(), 1, |s| s.heartbeat_timeout = Duration::from_millis(50)).await;
    let id = server.submit(&tiny()).await;
    server.worker().await.killed().await;
    let second = server.worker().await;
    assert_eq!(second.launch.lease.attempt, 2);
    let logs = server.get(&format!("/v1/jobs/{id}/logs")).await;
    assert_eq!(logs["attempts"][0]["outcome"], "failed");
    assert!(logs["attempts"][0]["reason"].as_str().unwrap().contains("0.05 s"), "{logs}");
}

#[tokio::test]
async fn job_fails_after_max_attempts_with_reason_and_log() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start(dir.path(), 1).await;
    let id = server.submit(&tiny()).await;
    for attempt in 1..=3 {
        let worker = server.worker().await;
        assert_eq!(worker.launch.lease.attempt, attempt);
        worker.launch.log.push(format!("output of attempt {attempt}\n").as_bytes());
        let live = server.get(&format!("/v1/jobs/{id}/logs")).await;
        assert_eq!(live["attempts"][attempt as usize - 1]["log"], format!("output of attempt {attempt}\n"));
        worker.exit("exit code 101");
    }
    let job = server.reaches(&id, "failed").await;
    assert!(job["reason"].as_str().unwrap().ends_with("exit code 101"), "{job}");
    assert_eq!((&job["attempts"], &job["failures"]), (&json!(3), &json!(3)));
    let logs = server.get(&format!("/v1/jobs/{id}/logs")).await;
    for (i, attempt) in logs["attempts"].as_array().unwrap().iter().enumerate() {
        assert_eq!(attempt["log"], format!("output of attempt {}\n", i + 1));
        assert_eq!(attempt["outcome"], "failed");
    }
    assert!(server.workers.try_recv().is_err());
}

/// Uploads a snapshot of these bytes, taken at `step`.
async fn upload(server: &Server, worker: &Worker, step: u64, bytes: &'static [u8]) {
    use v1::upload_snapshot_request::Part;
    let header = v1::SnapshotHeader { step, size: bytes.len() as u64, sha256: hex::encode(Sha256::digest(bytes)) };
    let parts = [Part::Header(header), Part::Data(bytes.into())].map(|part| v1::UploadSnapshotRequest { part: Some(part) });
    let request = signed(&worker.launch, &worker.launch.token, futures::stream::iter(parts));
    server.worker_client().await.upload_snapshot(request).await.unwrap();
}

#[tokio::test]
async fn failures_that_progress_lies_between_do_not_add_up() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start_with(dir.path(), 1, |s| s.max_attempts = 2).await;
    let id = server.submit(&tiny()).await;
    for (step, snapshot) in [(20, &b"at 20"[..]), (40, b"at 40"), (60, b"at 60")] {
        let worker = server.worker().await;
        upload(&server, &worker, step, snapshot).await;
        worker.exit("killed by signal 9");
    }
    // The third of them has uploaded what it started from: that is no progress.
    let worker = server.worker().await;
    upload(&server, &worker, 60, b"at 60").await;
    worker.exit("killed by signal 9");
    let job = server.reaches(&id, "failed").await;
    assert_eq!((&job["attempts"], &job["failures"]), (&json!(4), &json!(4)));
}

#[tokio::test]
async fn a_failed_job_keeps_its_snapshot_and_can_be_retried() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start_with(dir.path(), 1, |s| s.max_attempts = 2).await;
    let id = server.submit(&tiny()).await;
    let retry = format!("/v1/jobs/{id}/retry");
    let first = server.worker().await;
    // A job that has not failed stays as it is.
    assert_eq!(server.post(&retry).await["state"], "running");
    upload(&server, &first, 20, b"at 20").await;
    first.exit("exit code 1");
    server.worker().await.exit("exit code 1");
    server.reaches(&id, "failed").await;
    let job = server.post(&retry).await;
    assert_eq!((&job["reason"], &job["ended_at"]), (&json!(null), &json!(null)));
    // A lost response: the caller repeats the request, here over gRPC.
    server.jobs().await.retry_job(v1::RetryJobRequest { id: id.clone() }).await.unwrap();
    let third = server.worker().await;
    let fetch = signed(&third.launch, &third.launch.token, v1::FetchRequest {});
    let task = server.worker_client().await.fetch(fetch).await.unwrap().into_inner();
    assert_eq!(task.snapshot_step, Some(20));
    // Its earlier failures do not count any more.
    third.exit("exit code 1");
    let fourth = server.worker().await;
    finish(&server, &fourth, v1::Outcome::Succeeded).await;
    fourth.exit("exit code 0");
    server.reaches(&id, "succeeded").await;
    expect(server.request(Method::POST, &retry), StatusCode::CONFLICT).await;
    let missing = format!("/v1/jobs/{}/retry", uuid::Uuid::nil());
    expect(server.request(Method::POST, &missing), StatusCode::NOT_FOUND).await;
}

#[tokio::test]
async fn output_of_a_running_worker_survives_a_crash_of_the_server() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start(dir.path(), 1).await;
    let id = server.submit(&tiny()).await;
    let worker = server.worker().await;
    worker.launch.log.push(b"training\n");
    let row = server.app.store.job(worker.launch.lease.job_id).await.unwrap().unwrap();
    within(async {
        while server.app.store.attempts(row.id).await.unwrap()[0].log.is_empty() {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    })
    .await;
    server.crash().await;
    let restarted = Server::start(dir.path(), 1).await;
    let logs = restarted.get(&format!("/v1/jobs/{id}/logs")).await;
    assert_eq!((&logs["attempts"][0]["log"], &logs["attempts"][0]["outcome"]), (&json!("training\n"), &json!("interrupted")));
}

#[tokio::test]
async fn reported_failure_keeps_its_reason() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start_with(dir.path(), 1, |s| s.max_attempts = 1).await;
    let id = server.submit(&tiny()).await;
    let worker = server.worker().await;
    finish(&server, &worker, v1::Outcome::Failed).await;
    worker.exit("exit code 1");
    assert_eq!(server.reaches(&id, "failed").await["reason"], "by the test");
}

#[tokio::test]
async fn paused_job_stops_and_resumes() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start(dir.path(), 1).await;
    let id = server.submit(&tiny()).await;
    let worker = server.worker().await;
    server.post(&format!("/v1/jobs/{id}/pause")).await;
    let early = server.request(Method::POST, &format!("/v1/jobs/{id}/resume"));
    expect(early, StatusCode::CONFLICT).await;
    finish(&server, &worker, v1::Outcome::Stopped).await;
    worker.exit("exit code 0");
    server.reaches(&id, "paused").await;
    server.post(&format!("/v1/jobs/{id}/resume")).await;
    let again = server.worker().await;
    assert_eq!((again.job(), again.launch.lease.attempt), (id.clone(), 2));
    let logs = server.get(&format!("/v1/jobs/{id}/logs")).await;
    assert_eq!(logs["attempts"][0]["outcome"], "paused");
}

#[tokio::test]
async fn restart_queues_running_jobs_and_fences_their_workers() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start(dir.path(), 1).await;
    let id = server.submit(&tiny()).await;
    let waiting = server.submit(&named("waiting")).await;
    let old = server.worker().await;
    server.crash().await;
    let mut restarted = Server::start(dir.path(), 1).await;
    let new = restarted.worker().await;
    assert_eq!((new.job(), new.launch.lease.attempt), (id.clone(), 2));
    assert_eq!(restarted.state(&waiting).await, "queued");
    let logs = restarted.get(&format!("/v1/jobs/{id}/logs")).await;
    assert_eq!(logs["attempts"][0]["outcome"], "interrupted");
    assert_eq!(restarted.get(&format!("/v1/jobs/{id}")).await["failures"], 0);
    let heartbeat = signed(&old.launch, &old.launch.token, v1::HeartbeatRequest {});
    let status = restarted.worker_client().await.heartbeat(heartbeat).await.unwrap_err();
    assert_eq!(status.code(), Code::FailedPrecondition);
}

#[tokio::test]
async fn draining_pauses_workers_and_queues_their_jobs() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start_with(dir.path(), 2, without_grace).await;
    let pausing = server.submit(&named("pausing")).await;
    let ignoring = server.submit(&named("ignoring")).await;
    let (first, second) = (server.worker().await, server.worker().await);
    server.app.draining.begin();
    let scheduler = server.app.scheduler.clone();
    let drain = tokio::spawn(async move { scheduler.drain(TIMEOUT).await });
    within(async {
        while !server.app.draining.begun() {
            tokio::task::yield_now().await;
        }
    })
    .await;
    let heartbeat = signed(&first.launch, &first.launch.token, v1::HeartbeatRequest {});
    let answer = server.worker_client().await.heartbeat(heartbeat).await.unwrap().into_inner();
    assert_eq!(answer.directive(), v1::Directive::Pause);
    finish(&server, &first, v1::Outcome::Stopped).await;
    first.exit("exit code 0");
    second.killed().await;
    within(drain).await.unwrap();
    for id in [&pausing, &ignoring] {
        let job = server.get(&format!("/v1/jobs/{id}")).await;
        assert_eq!((&job["state"], &job["failures"]), (&json!("queued"), &json!(0)));
    }
    let refused = server.request(Method::POST, "/v1/jobs").json(&tiny());
    expect(refused, StatusCode::SERVICE_UNAVAILABLE).await;
}
