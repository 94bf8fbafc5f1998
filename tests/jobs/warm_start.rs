//! Jobs and runs that begin with weights that exist, and jobs that continue others.

use std::process::Command;
use std::sync::Arc;

use qedgix::jobs::{Executor, LocalProcess};
use qedgix::learner::{Event, Trainer};
use qedgix::train_config::TrainConfig;
use qedgix::wire::v1;
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};

use super::harness::{Server, Worker, expect, named, signed, tiny, with};
use super::process::PROGRAM;

#[allow(clippy::unnecessary_wraps, reason = "the form that the harness takes")]
fn processes() -> Option<Arc<dyn Executor>> {
    Some(Arc::new(LocalProcess::new(PROGRAM)))
}

/// The bits of the mean AoI of an evaluation.
async fn aoi(server: &Server, id: &str, step: u64) -> Option<u64> {
    *server.rows(id).await.get(&("eval/mean_aoi".to_owned(), step)).expect("an evaluation at this step")
}

async fn refused(server: &Server, job: &Value) -> String {
    let problem = expect(server.request(Method::POST, "/v1/jobs").json(job), StatusCode::BAD_REQUEST).await;
    problem["field"].as_str().unwrap().to_owned()
}

#[tokio::test]
async fn jobs_begin_with_the_weights_of_policies_and_checkpoints() {
    let dir = tempfile::tempdir().unwrap();
    let server = Server::start_on(dir.path(), 2, |_| {}, processes()).await;
    let base = server.submit(&named("base")).await;
    server.reaches(&base, "succeeded").await;
    let checkpoints = server.get(&format!("/v1/jobs/{base}/checkpoints")).await["checkpoints"].clone();
    let of_kind = |kind: &str| checkpoints.as_array().unwrap().iter().find(|c| c["kind"] == kind).unwrap().clone();
    let (best, last) = (of_kind("best"), of_kind("last"));

    let from_policy = server.submit(&with(&json!({"init": {"policy": "base"}, "seed": 7}))).await;
    let job = server.reaches(&from_policy, "succeeded").await;
    let expected = json!({
        "from": "weights", "policy": "base:1", "checkpoint": null, "job": null, "step": best["step"], "sha256": best["sha256"],
    });
    assert_eq!(job["init"], expected);
    // The evaluation before the first step is that of the weights, on the same layouts.
    assert_eq!(aoi(&server, &from_policy, 0).await, aoi(&server, &base, best["step"].as_u64().unwrap()).await);

    let mut grpc = server.jobs().await;
    let spec = qedgix::api::convert::structs::to_struct(&with(&json!({"init": {"checkpoint": last["id"]}, "training": {
        "steps": 400, "envs": 2, "batch": 2, "buffer": 20, "eval_every": 200, "eval_episodes": 2, "mixer": "vdn",
    }})));
    let job = grpc.submit_job(v1::SubmitJobRequest { spec, ..Default::default() }).await.unwrap().into_inner();
    // The weights are the job's own: it does not matter what becomes of their source.
    let delete = server.request(Method::DELETE, &format!("/v1/jobs/{base}"));
    let last_aoi = aoi(&server, &base, last["step"].as_u64().unwrap()).await;
    expect(delete, StatusCode::NO_CONTENT).await;
    let done = server.reaches(&job.id, "succeeded").await;
    assert_eq!(done["init"]["checkpoint"], last["id"]);
    assert_eq!(aoi(&server, &job.id, 0).await, last_aoi);
    let id = qedgix::store::JobId::parse(&job.id).unwrap();
    assert!(server.app.store.initial_weights(id).await.unwrap().is_some());
    expect(server.request(Method::DELETE, &format!("/v1/jobs/{id}")), StatusCode::NO_CONTENT).await;
    assert!(server.app.store.initial_weights(id).await.unwrap().is_none());
}

#[tokio::test]
async fn weights_that_do_not_fit_are_refused_with_the_field_that_differs() {
    let dir = tempfile::tempdir().unwrap();
    let server = Server::start_on(dir.path(), 1, |_| {}, processes()).await;
    let base = server.submit(&named("base")).await;
    server.reaches(&base, "succeeded").await;
    let init = |fields: Value| {
        let mut job = with(&json!({"init": {"policy": "base"}}));
        for (name, value) in fields.as_object().unwrap() {
            match value.as_object() {
                Some(more) if job[name].is_object() && name != "init" => job[name].as_object_mut().unwrap().extend(more.clone()),
                _ => job[name] = value.clone(),
            }
        }
        job
    };
    for (fields, field) in [
        (json!({"algorithm": "qedgix"}), "algorithm"),
        (json!({"training": {"memory": "own"}}), "training.memory"),
        (json!({"environment": {"hover": true}}), "environment.hover"),
        (json!({"init": {"policy": "absent"}}), "init.policy"),
        (json!({"init": {"policy": "sweep"}}), "init.policy"),
        (json!({"init": {"checkpoint": "absent"}}), "init.checkpoint"),
        (json!({"init": {}}), "init.policy"),
        (json!({"init": {"policy": "base", "checkpoint": base}}), "init.policy"),
    ] {
        assert_eq!(refused(&server, &init(fields.clone())).await, field, "{fields}");
    }
    let sweep = json!({"kind": "sweep", "sweep": {"grid": {"algorithm": ["vdn", "rgcn"]}}});
    assert_eq!(refused(&server, &init(sweep)).await, "sweep.grid.algorithm[1]");
    let evaluation = json!({"kind": "evaluate", "init": {"policy": "base"}, "evaluation": {"policies": ["sweep"]}});
    assert_eq!(refused(&server, &evaluation).await, "init");
    // A fleet of another size is no obstacle for agents that fly any.
    server.submit(&init(json!({"environment": {"uavs": 3}}))).await;
}

#[tokio::test]
async fn a_job_that_has_ended_is_continued_from_its_weights() {
    let dir = tempfile::tempdir().unwrap();
    let server = Server::start_on(dir.path(), 1, |_| {}, processes()).await;
    let base = server.submit(&with(&json!({"name": "base", "labels": {"a": "b"}}))).await;
    let done = server.reaches(&base, "succeeded").await;
    let path = format!("/v1/jobs/{base}/continue");
    let submit = || server.request(Method::POST, &path).header("idempotency-key", "k").json(&json!({"steps": 600}));
    let job = expect(submit(), StatusCode::CREATED).await;
    let id = job["id"].as_str().unwrap().to_owned();
    assert_eq!(expect(submit(), StatusCode::CREATED).await["id"], id.as_str());
    assert_eq!((&job["name"], &job["labels"], &job["progress"]["steps"]), (&json!("base"), &json!({"a": "b"}), &json!(600)));
    assert_eq!((&job["init"]["from"], &job["init"]["job"], &job["init"]["step"]), (&json!("weights"), &json!(base), &json!(400)));
    let rate = done["training"]["learning_rate"].as_f64().unwrap() * done["training"]["learning_rate_decay"].as_f64().unwrap();
    assert!((job["training"]["learning_rate"].as_f64().unwrap() - rate).abs() < 1e-12);
    let job = server.reaches(&id, "succeeded").await;
    assert_eq!(job["policy"], "base:2");
    assert_eq!(aoi(&server, &id, 0).await, aoi(&server, &base, 400).await);
    let problem = expect(server.request(Method::POST, &path).json(&json!({"steps": 0})), StatusCode::BAD_REQUEST).await;
    assert_eq!(problem["field"], "steps");
    let evaluation = server.submit(&json!({"kind": "evaluate", "evaluation": {"policies": ["sweep"], "episodes": 1}})).await;
    server.reaches(&evaluation, "succeeded").await;
    let request = server.request(Method::POST, &format!("/v1/jobs/{evaluation}/continue")).json(&json!({"steps": 5}));
    assert_eq!(expect(request, StatusCode::CONFLICT).await["code"], "wrong_state");
}

async fn upload_snapshot(server: &Server, worker: &Worker, step: u64, bytes: &[u8]) {
    use v1::upload_snapshot_request::Part;
    let header = v1::SnapshotHeader { step, size: bytes.len() as u64, sha256: hex::encode(Sha256::digest(bytes)) };
    let data = bytes.chunks(1 << 20).map(|part| Part::Data(part.to_vec().into()));
    let parts: Vec<_> = std::iter::once(Part::Header(header)).chain(data).collect();
    let messages = parts.into_iter().map(|part| v1::UploadSnapshotRequest { part: Some(part) });
    let request = signed(&worker.launch, &worker.launch.token, futures::stream::iter(messages.collect::<Vec<_>>()));
    server.worker_client().await.upload_snapshot(request).await.unwrap();
}

#[tokio::test]
async fn a_failed_job_is_continued_from_its_snapshot() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start_with(dir.path(), 1, |config| config.max_attempts = 1).await;
    let id = server.submit(&tiny()).await;
    let worker = server.worker().await;
    let path = format!("/v1/jobs/{id}/continue");
    let early = server.request(Method::POST, &path).json(&json!({"steps": 100}));
    assert_eq!(expect(early, StatusCode::CONFLICT).await["code"], "wrong_state");
    let mut client = server.worker_client().await;
    let task = client.fetch(signed(&worker.launch, &worker.launch.token, v1::FetchRequest {})).await.unwrap().into_inner();
    let config: TrainConfig = serde_json::from_str(&task.config).unwrap();
    let mut trainer = Trainer::new(config, 1).unwrap();
    assert!(trainer.by_ref().any(|event| matches!(event, Event::Iteration(_))));
    let (step, snapshot) = (trainer.env_steps(), trainer.snapshot());
    upload_snapshot(&server, &worker, step, &snapshot).await;
    worker.exit("exit code 1");
    server.reaches(&id, "failed").await;

    let few = server.request(Method::POST, &path).json(&json!({"steps": 1}));
    let problem = expect(few, StatusCode::BAD_REQUEST).await;
    let expected = format!("steps: got 1, expected a number from 380 to {}", TrainConfig::MAX_STEPS - step);
    assert_eq!(problem["detail"], format!("{expected}: the snapshot of the job is at step 20 of 400"));
    let mut grpc = server.jobs().await;
    let request = v1::ContinueJobRequest { id: id.clone(), steps: 1000, idempotency_key: String::new() };
    let job = grpc.continue_job(request).await.unwrap().into_inner();
    assert_eq!((job.step, job.steps), (step, step + 1000));
    let shown = server.get(&format!("/v1/jobs/{}", job.id)).await;
    assert_eq!(
        (&shown["init"]["from"], &shown["init"]["job"], &shown["init"]["step"]),
        (&json!("snapshot"), &json!(id), &json!(step))
    );
    // The copy does not depend on its source.
    expect(server.request(Method::DELETE, &format!("/v1/jobs/{id}")), StatusCode::NO_CONTENT).await;
    let worker = server.worker().await;
    let sign = || signed(&worker.launch, &worker.launch.token, v1::FetchRequest {});
    let task = client.fetch(sign()).await.unwrap().into_inner();
    assert_eq!((task.snapshot_step, task.initial_weights), (Some(step), false));
    let request = signed(&worker.launch, &worker.launch.token, v1::DownloadSnapshotRequest {});
    let mut chunks = client.download_snapshot(request).await.unwrap().into_inner();
    let mut bytes = Vec::new();
    while let Some(chunk) = chunks.message().await.unwrap() {
        bytes.extend_from_slice(&chunk.data);
    }
    assert!(bytes == snapshot);
}

#[test]
fn a_run_that_was_extended_is_one_that_had_more_steps() {
    let job = tiny();
    let config = |steps: u64| {
        let mut training = job["training"].as_object().unwrap().clone();
        training.extend([("steps".into(), json!(steps)), ("learning_rate_decay".into(), json!(1.0))]);
        let environment = job["environment"].as_object().unwrap();
        TrainConfig::resolve(qedgix::learner::Algorithm::Vdn, qedgix::learner::Preset::Practical, environment, &training, 1)
            .unwrap()
    };
    let mut whole = Trainer::new(config(800), 1).unwrap();
    assert!(whole.by_ref().last().is_some());
    for stop_at in [200, 400] {
        let mut first = Trainer::new(config(400), 1).unwrap();
        first.by_ref().find(|event| matches!(event, Event::Evaluation(e) if e.env_steps == stop_at));
        if stop_at == 400 {
            assert!(first.by_ref().last().is_some() && first.finished());
        }
        let mut extended = Trainer::restore(&first.snapshot(), 1).unwrap();
        assert!(extended.extend_to(300).is_err());
        extended.extend_to(800).unwrap();
        assert!(extended.by_ref().last().is_some());
        assert!(extended.checkpoint().unwrap() == whole.checkpoint().unwrap(), "stopped at {stop_at}");
    }
}

#[test]
fn the_command_begins_with_a_checkpoint_file() {
    let dir = tempfile::tempdir().unwrap();
    let run = |words: &[&str]| {
        let common = ["train", "--threads", "1", "--uavs", "2", "--users", "2", "--slots", "10", "--steps", "400"];
        let small = ["--set", "training.eval_episodes=2", "--set", "training.batch=4"];
        let output = Command::new(PROGRAM).current_dir(dir.path()).args(common).args(small).args(words).output().unwrap();
        (output.status.code(), String::from_utf8([output.stdout, output.stderr].concat()).unwrap())
    };
    let (code, output) = run(&["--algorithm", "vdn", "--out", "a.safetensors"]);
    assert_eq!(code, Some(0), "{output}");
    let init = ["--algorithm", "vdn", "--init", "a.safetensors", "--out", "b.safetensors", "--metrics", "b.csv", "--seed", "2"];
    let (code, output) = run(&init);
    assert_eq!(code, Some(0), "{output}");
    let weights = qedgix::checkpoint::Checkpoint::from_bytes(&std::fs::read(dir.path().join("a.safetensors")).unwrap()).unwrap();
    let curve = std::fs::read_to_string(dir.path().join("b.csv")).unwrap();
    let first = curve.lines().find_map(|line| line.strip_prefix("0,eval/mean_aoi,")).unwrap();
    assert_eq!(first.parse::<f64>().unwrap(), weights.metrics().unwrap().mean_aoi);
    for (words, says) in [
        (&["--algorithm", "rgcn", "--init", "a.safetensors"][..], "algorithm: got \"rgcn\", expected \"vdn\""),
        (&["--algorithm", "vdn", "--init", "absent"], "--init absent"),
        (&["--init", "b.csv"], "--init b.csv"),
    ] {
        let (code, output) = run(words);
        assert!(code == Some(1) && output.contains(says), "{words:?}: {output}");
    }
}
