//! A real server process with real worker processes, and what happens when either of them dies.

use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Arc;

use qedgix::checkpoint::Checkpoint;
use qedgix::env::EpisodeMetrics;
use qedgix::jobs::LocalProcess;
use qedgix::learner::{Event, Preset, TrainConfig, Trainer, evaluate, layout_list};
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};

use super::harness::{Rest, Server, tiny, within};
use super::process::rest::{Rows, bits};
use super::process::{self, POLL, PROGRAM, no_worker, signal, workers};

/// A `qedgix serve` that snapshots often, and its client.
pub struct Process {
    process: process::Process,
    pub rest: Rest,
}

impl Process {
    pub async fn start(data_dir: &Path) -> Self {
        Self::start_program(Path::new(PROGRAM), data_dir).await
    }

    async fn start_program(program: &Path, data_dir: &Path) -> Self {
        let mut command = process::serve_by(program, data_dir);
        command.args(["--cpu-budget", "1", "--snapshot-every", "0.05"]);
        let process = process::Process::start(command).await;
        let rest = Rest::new(format!("http://{}", process.http));
        Self { process, rest }
    }

    pub fn kill(&mut self) {
        self.process.kill();
    }
}

/// A job of a few seconds.
fn job() -> Value {
    json!({
        "algorithm": "vdn",
        "seed": 3,
        "environment": {"slots": 20, "uavs": 2, "users": 3},
        "training": {"steps": 8_000, "envs": 4, "batch": 16, "buffer": 200, "eval_every": 1_000, "eval_episodes": 8},
    })
}

/// The metrics and the best policy of the same training, uninterrupted, in this process.
fn uninterrupted(spec: &Value) -> (Rows, Checkpoint) {
    let object = |field: &str| spec[field].as_object().unwrap().clone();
    let algorithm = serde_json::from_value(spec["algorithm"].clone()).unwrap();
    let (environment, training) = (object("environment"), object("training"));
    let seed = spec["seed"].as_u64().unwrap();
    let config = TrainConfig::resolve(algorithm, Preset::default(), &environment, &training, seed).unwrap();
    let reference = |checkpoint: &Checkpoint| {
        let seeds = layout_list("eval-v1").unwrap().seeds(config.training.eval_episodes);
        EpisodeMetrics::mean(&evaluate(&checkpoint.policy(), &config.environment, &seeds, 1).unwrap()).mean_aoi
    };
    let mut trainer = Trainer::new(config.clone(), 1).unwrap();
    let mut rows = Rows::new();
    let mut add = |step, name: &str, value| rows.insert((name.to_owned(), step), bits(name, value));
    add(0, "eval-v1/mean_aoi", reference(&trainer.checkpoint().unwrap()));
    for event in trainer.by_ref() {
        if let Event::Iteration(done) = event {
            add(done.env_steps, "env_steps_per_s", 0.0);
        }
        for (step, name, value) in event.rows() {
            add(step, name, value);
        }
    }
    let best = trainer.best().unwrap().unwrap();
    add(trainer.env_steps(), "eval-v1/mean_aoi", reference(&best));
    (rows, best)
}

/// Compares row by row, so that a failure shows one row.
fn assert_same(found: &Rows, expected: &Rows) {
    for (key, value) in expected {
        assert_eq!(found.get(key), Some(value), "{key:?}");
    }
    let more: Vec<_> = found.keys().filter(|key| !expected.contains_key(key)).collect();
    assert!(more.is_empty(), "unexpected rows: {more:?}");
}

/// Waits until the job is past this step.
async fn passes(rest: &Rest, id: &str, step: u64) {
    within(async {
        loop {
            let job = rest.get(&format!("/v1/jobs/{id}")).await;
            if job["progress"]["step"].as_u64().unwrap() >= step {
                assert_eq!(job["state"], "running", "the job must not end before it is interrupted");
                return;
            }
            tokio::time::sleep(POLL).await;
        }
    })
    .await;
}

/// The attempts. All but the first must have resumed from a snapshot.
async fn attempts(rest: &Rest, id: &str) -> Vec<Value> {
    let attempts = rest.get(&format!("/v1/jobs/{id}/logs")).await["attempts"].as_array().unwrap().clone();
    for attempt in &attempts[1..] {
        let log = attempt["log"].as_str().unwrap();
        assert!(log.contains("from_step="), "the attempt starts from the beginning: {log}");
    }
    attempts
}

#[tokio::test]
async fn worker_runs_a_job_to_its_end() {
    let dir = tempfile::tempdir().unwrap();
    let server = Process::start(dir.path()).await;
    let rest = &server.rest;
    let id = rest.submit(&job()).await;
    let done = rest.reaches(&id, "succeeded").await;
    assert_eq!((&done["attempts"], &done["failures"], &done["progress"]["step"]), (&json!(1), &json!(0), &json!(8_000)));
    let (expected, best) = uninterrupted(&job());
    assert_same(&rest.rows(&id).await, &expected);

    let list = rest.get(&format!("/v1/jobs/{id}/checkpoints")).await["checkpoints"].as_array().unwrap().clone();
    let found = list.iter().find(|c| c["kind"] == "best").unwrap();
    let path = format!("/v1/checkpoints/{}", found["id"].as_str().unwrap());
    let bytes = rest.request(Method::GET, &path).send().await.unwrap().bytes().await.unwrap();
    assert_eq!(found["sha256"], hex::encode(Sha256::digest(&bytes)));
    assert_eq!(Checkpoint::from_bytes(&bytes).unwrap(), best);
    assert_eq!(found["metrics"]["eval/mean_aoi"], json!(best.metrics().unwrap().mean_aoi));
    assert!(list.iter().any(|c| c["kind"] == "last" && c["step"] == 8_000));
    let policy = format!("job-{}:1", &id[id.len() - 8..]);
    assert_eq!(done["policy"], policy);
    let policy = rest.get(&format!("/v1/policies/{policy}")).await;
    assert_eq!(policy["ref"]["digest"], found["sha256"], "{policy}");
    no_worker(&id).await;
}

#[tokio::test]
async fn killed_worker_is_replaced_without_lost_or_duplicate_metrics() {
    let dir = tempfile::tempdir().unwrap();
    let server = Process::start(dir.path()).await;
    let id = server.rest.submit(&job()).await;
    passes(&server.rest, &id, 2_000).await;
    for worker in workers(&id) {
        assert!(signal("KILL", worker));
    }
    let done = server.rest.reaches(&id, "succeeded").await;
    assert_eq!((&done["attempts"], &done["failures"]), (&json!(2), &json!(1)));
    let attempts = attempts(&server.rest, &id).await;
    assert_eq!(attempts[0]["outcome"], "failed");
    assert!(attempts[0]["reason"].as_str().unwrap().contains("killed by signal 9"), "{}", attempts[0]["reason"]);
    assert!(attempts[0]["log"].as_str().unwrap().contains("training"), "{}", attempts[0]["log"]);
    assert_same(&server.rest.rows(&id).await, &uninterrupted(&job()).0);
}

#[tokio::test]
async fn killed_server_resumes_its_jobs() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Process::start(dir.path()).await;
    let id = server.rest.submit(&job()).await;
    let waiting = server.rest.submit(&tiny()).await;
    passes(&server.rest, &id, 2_000).await;
    server.kill();
    // The worker ends by itself.
    no_worker(&id).await;

    let server = Process::start(dir.path()).await;
    let done = server.rest.reaches(&id, "succeeded").await;
    assert_eq!((&done["attempts"], &done["failures"]), (&json!(2), &json!(0)));
    let attempts = attempts(&server.rest, &id).await;
    assert_eq!(attempts[0]["outcome"], "interrupted");
    assert!(attempts[0]["log"].as_str().unwrap().contains("training"), "{}", attempts[0]["log"]);
    assert_same(&server.rest.rows(&id).await, &uninterrupted(&job()).0);
    server.rest.reaches(&waiting, "succeeded").await;
}

#[tokio::test]
async fn terminated_server_snapshots_its_jobs() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Process::start(dir.path()).await;
    let id = server.rest.submit(&job()).await;
    passes(&server.rest, &id, 2_000).await;
    assert!(server.process.terminate().await.success());
    assert!(workers(&id).is_empty());

    let server = Process::start(dir.path()).await;
    let done = server.rest.reaches(&id, "succeeded").await;
    assert_eq!((&done["attempts"], &done["failures"]), (&json!(2), &json!(0)));
    assert_eq!(attempts(&server.rest, &id).await[0]["outcome"], "interrupted");
    assert_same(&server.rest.rows(&id).await, &uninterrupted(&job()).0);
}

#[tokio::test]
async fn paused_job_resumes_exactly_and_cancelled_job_stops() {
    let dir = tempfile::tempdir().unwrap();
    let server = Process::start(dir.path()).await;
    let rest = &server.rest;
    let id = rest.submit(&job()).await;
    passes(rest, &id, 1_000).await;
    rest.post(&format!("/v1/jobs/{id}/pause")).await;
    rest.reaches(&id, "paused").await;
    no_worker(&id).await;
    rest.post(&format!("/v1/jobs/{id}/resume")).await;
    rest.reaches(&id, "succeeded").await;
    assert_eq!(attempts(rest, &id).await[0]["outcome"], "paused");
    assert_same(&rest.rows(&id).await, &uninterrupted(&job()).0);

    let mut long = job();
    long["training"]["steps"] = json!(1_000_000_000);
    let id = rest.submit(&long).await;
    passes(rest, &id, 80).await;
    rest.post(&format!("/v1/jobs/{id}/cancel")).await;
    rest.reaches(&id, "cancelled").await;
    no_worker(&id).await;
    let logs = rest.get(&format!("/v1/jobs/{id}/logs")).await;
    assert_eq!(logs["attempts"][0]["outcome"], "cancelled", "{logs}");
}

#[tokio::test]
async fn output_and_exit_code_of_a_worker_are_stored() {
    let dir = tempfile::tempdir().unwrap();
    // A program that fails with the arguments of a worker.
    let executor = LocalProcess::new("/bin/ls");
    let server = Server::start_on(dir.path(), 1, |_| {}, Some(Arc::new(executor))).await;
    let id = server.submit(&tiny()).await;
    let job = server.reaches(&id, "failed").await;
    assert!(job["reason"].as_str().unwrap().ends_with("exit code 2"), "{job}");
    let logs = server.get(&format!("/v1/jobs/{id}/logs")).await;
    assert_eq!(logs["attempts"].as_array().unwrap().len(), 3);
    assert!(logs["attempts"][2]["log"].as_str().unwrap().contains("tethered"), "{logs}");
}

#[tokio::test]
async fn a_worker_that_cannot_be_started_is_not_a_failure_of_the_job() {
    let dir = tempfile::tempdir().unwrap();
    let program = dir.path().join("qedgix");
    let executor = LocalProcess::new(&program);
    let server = Server::start_on(dir.path(), 1, |s| s.max_attempts = 1, Some(Arc::new(executor))).await;
    let id = server.submit(&tiny()).await;
    let logs = format!("/v1/jobs/{id}/logs");
    let tried = async || {
        within(async {
            while !server.get(&logs).await["attempts"][0]["log"].as_str().unwrap_or("").contains("No such file") {
                tokio::time::sleep(POLL).await;
            }
        })
        .await;
    };
    tried().await;
    // It can be paused, resumed and cancelled meanwhile, as any job.
    server.post(&format!("/v1/jobs/{id}/pause")).await;
    server.reaches(&id, "paused").await;
    server.post(&format!("/v1/jobs/{id}/resume")).await;
    let cancelled = server.submit(&tiny()).await;
    server.post(&format!("/v1/jobs/{cancelled}/cancel")).await;
    // The trouble of the host ends.
    std::fs::copy(env!("CARGO_BIN_EXE_qedgix"), &program).unwrap();
    let job = server.reaches(&id, "succeeded").await;
    assert_eq!((&job["failures"], &job["attempts"]), (&json!(0), &json!(2)));
    assert_eq!(server.state(&cancelled).await, "cancelled");
}

#[tokio::test]
async fn a_server_whose_program_was_replaced_starts_workers() {
    let dir = tempfile::tempdir().unwrap();
    let program = dir.path().join("qedgix");
    std::fs::copy(env!("CARGO_BIN_EXE_qedgix"), &program).unwrap();
    let server = Process::start_program(&program, dir.path()).await;
    std::fs::remove_file(&program).unwrap();
    std::fs::write(&program, "another version").unwrap();
    let id = server.rest.submit(&tiny()).await;
    server.rest.reaches(&id, "succeeded").await;
}

#[tokio::test]
async fn orphaned_worker_ends_although_nobody_reads_its_output() {
    let mut command = Command::new(PROGRAM);
    command.args(["worker", "--tethered"]).env("QEDGIX_ATTEMPT", "1").env("QEDGIX_TOKEN", "of a server that has ended");
    // Nothing listens there, and workers try for long to reach their server.
    command.env("QEDGIX_WORKER_SERVER", "http://127.0.0.1:1").env("QEDGIX_JOB", uuid::Uuid::nil().to_string());
    let mut worker = command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    drop((worker.stdout.take(), worker.stderr.take()));
    drop(worker.stdin.take());
    let status = within(async {
        loop {
            match worker.try_wait().unwrap() {
                Some(status) => break status,
                None => tokio::time::sleep(POLL).await,
            }
        }
    })
    .await;
    assert_eq!(status.code(), Some(3));
}

#[tokio::test]
async fn worker_without_assignment_or_valid_token_fails() {
    let output = Command::new(PROGRAM).arg("worker").env_remove("QEDGIX_WORKER_SERVER").output().unwrap();
    assert!(!output.status.success());
    assert!(String::from_utf8_lossy(&output.stderr).contains("QEDGIX_WORKER_SERVER"));

    let dir = tempfile::tempdir().unwrap();
    let server = Process::start(dir.path()).await;
    let endpoints: Value = serde_json::from_slice(&std::fs::read(dir.path().join("endpoints.json")).unwrap()).unwrap();
    let output = Command::new(PROGRAM)
        .arg("worker")
        .env("QEDGIX_WORKER_SERVER", format!("http://{}", endpoints["grpc"].as_str().unwrap()))
        .env("QEDGIX_JOB", uuid::Uuid::nil().to_string())
        .env("QEDGIX_ATTEMPT", "1")
        .env("QEDGIX_TOKEN", "guessed")
        .output()
        .unwrap();
    assert!(!output.status.success());
    assert!(String::from_utf8_lossy(&output.stderr).contains("Unauthenticated"), "{output:?}");
    let jobs = server.rest.request(Method::GET, "/v1/jobs").send().await.unwrap();
    assert_eq!(jobs.status(), StatusCode::OK);
}
