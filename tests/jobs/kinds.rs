//! Jobs that evaluate policies, and jobs that make others.

use std::process::Command;
use std::sync::Arc;

use qedgix::jobs::{Executor, LocalProcess};
use qedgix::wire::v1;
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};
use tonic::Code;

use super::harness::{Server, Worker, expect, named, signed, tiny, with};
use super::process::PROGRAM;

#[allow(clippy::unnecessary_wraps, reason = "the form that the harness takes")]
fn processes() -> Option<Arc<dyn Executor>> {
    Some(Arc::new(LocalProcess::new(PROGRAM)))
}

#[tokio::test]
async fn an_evaluation_returns_the_report_of_the_command() {
    let dir = tempfile::tempdir().unwrap();
    let server = Server::start_on(dir.path(), 2, |_| {}, processes()).await;
    let trained = server.submit(&named("mine")).await;
    server.reaches(&trained, "succeeded").await;
    let checkpoint = server.get(&format!("/v1/jobs/{trained}/checkpoints")).await;
    let best = checkpoint["checkpoints"].as_array().unwrap().iter().find(|c| c["kind"] == "best").unwrap().clone();
    let bytes = server.request(Method::GET, &format!("/v1/checkpoints/{}", best["id"].as_str().unwrap()));
    let file = dir.path().join("mine.safetensors");
    std::fs::write(&file, bytes.send().await.unwrap().bytes().await.unwrap()).unwrap();

    let job = json!({
        "kind": "evaluate", "name": "report", "threads": 2, "environment": {"slots": 12, "uavs": 2, "users": 3},
        "evaluation": {
            "policies": ["mine", "sweep", "nearest"], "episodes": 5, "lose": {"uav": 1, "slot": 4}, "position_noise": 0.01
        },
    });
    let id = server.submit(&job).await;
    let job = server.reaches(&id, "succeeded").await;
    assert_eq!((&job["kind"], &job["algorithm"], &job["policy"]), (&json!("evaluate"), &json!(null), &json!(null)));
    // Tour is added as a reference.
    assert_eq!(job["progress"], json!({"step": 20, "steps": 20, "steps_per_second": null, "seconds_left": null}));
    assert_eq!(job["evaluation"]["policies"], json!(["mine:1", "sweep", "nearest"]));
    let report = server.get(&format!("/v1/jobs/{id}/result")).await;
    let mut command = Command::new(PROGRAM);
    command.args(["evaluate", "--json", "--episodes", "5", "--slots", "12", "--uavs", "2", "--users", "3"]);
    command.args(["--lose-uav", "1@4", "--position-noise", "0.01", "--policy", "sweep", "--policy", "nearest", "--policy"]);
    let output = command.arg(&file).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let mut expected: Value = serde_json::from_slice(&output.stdout).unwrap();
    for field in ["layouts", "episodes", "environment", "disturbance", "references"] {
        assert_eq!(report[field], expected[field], "{field}");
    }
    let mut summaries = expected["policies"].as_array_mut().unwrap().clone();
    summaries.rotate_right(1);
    summaries[0]["policy"] = json!("mine:1");
    assert_eq!(report["policies"], json!(summaries));
    let mut grpc = server.jobs().await;
    let same = grpc.get_job_result(v1::GetJobResultRequest { id: id.clone() }).await.unwrap().into_inner().result;
    assert_eq!(serde_json::from_str::<Value>(&same).unwrap(), report);

    let none = expect(server.request(Method::GET, &format!("/v1/jobs/{trained}/result")), StatusCode::CONFLICT).await;
    assert_eq!(none["code"], "wrong_state");
    for (evaluation, field) in [
        (json!({"policies": ["absent"]}), "evaluation.policies[0]"),
        (json!({"policies": ["sweep", "mine:2"]}), "evaluation.policies[1]"),
        (json!({"policies": ["mine", "mine:1"]}), "evaluation.policies[1]"),
    ] {
        let request = server.request(Method::POST, "/v1/jobs").json(&json!({"kind": "evaluate", "evaluation": evaluation}));
        assert_eq!(expect(request, StatusCode::BAD_REQUEST).await["field"], field, "{evaluation}");
    }
}

#[tokio::test]
async fn a_plan_returns_the_document_of_the_command() {
    let dir = tempfile::tempdir().unwrap();
    let server = Server::start_on(dir.path(), 2, |_| {}, processes()).await;
    // The longest AoI of 12 slots is 12: one UAV suffices, and its loss is tried. None keeps 0.5.
    for (target, failures, steps) in [(12.5, true, 3 * 17 - 12), (0.5, false, 0)] {
        let plan = json!({"target_p95": target, "max_uavs": 2, "failures": failures});
        let job = json!({
            "kind": "evaluate", "environment": {"slots": 12, "users": 3},
            "evaluation": {"policies": ["nearest"], "episodes": 3, "plan": plan},
        });
        let id = server.submit(&job).await;
        let job = server.reaches(&id, "succeeded").await;
        assert_eq!(job["evaluation"]["plan"], plan);
        assert!(job["progress"]["step"].as_u64().unwrap() >= steps, "{}", job["progress"]);
        let result = server.get(&format!("/v1/jobs/{id}/result")).await;
        let mut command = Command::new(PROGRAM);
        command.args(["plan", "--json", "--policy", "nearest", "--users", "3", "--slots", "12", "--episodes", "3"]);
        command.args(["--max-uavs", "2", "--target-p95", &target.to_string()]);
        let output = if failures { command.arg("--failures") } else { &mut command }.output().unwrap();
        assert_eq!(output.status.code(), Some(i32::from(target < 1.0)), "{}", String::from_utf8_lossy(&output.stderr));
        let expected: Value = serde_json::from_slice(&output.stdout).unwrap();
        for (field, value) in expected.as_object().unwrap() {
            assert_eq!(result[field], *value, "{field}");
        }
        assert_eq!(result["failures"].as_array().unwrap().len(), if failures { 8 } else { 0 });
    }
    for (evaluation, field) in [
        (json!({"policies": ["sweep"], "plan": {"target_p95": 0}}), "evaluation.plan.target_p95"),
        (json!({"policies": ["sweep"], "plan": {"target_p95": 1, "max_uavs": 257}}), "evaluation.plan.max_uavs"),
        (json!({"policies": ["sweep", "nearest"], "plan": {"target_p95": 1}}), "evaluation.policies"),
        (json!({"policies": ["sweep"], "position_noise": 0.1, "plan": {"target_p95": 1}}), "evaluation.plan"),
    ] {
        let request = server.request(Method::POST, "/v1/jobs").json(&json!({"kind": "evaluate", "evaluation": evaluation}));
        assert_eq!(expect(request, StatusCode::BAD_REQUEST).await["field"], field, "{evaluation}");
    }
}

fn sweep() -> Value {
    with(&json!({
        "kind": "sweep", "name": "gammas",
        "sweep": {"grid": {"training.gamma": [0.5, 0.9]}, "seeds": 2},
    }))
}

#[tokio::test]
async fn a_sweep_that_was_disturbed_has_the_numbers_of_one_that_was_not() {
    let mut results = Vec::new();
    for disturbed in [false, true] {
        let dir = tempfile::tempdir().unwrap();
        let mut server = Server::start_on(dir.path(), 2, |_| {}, processes()).await;
        let id = server.submit(&sweep()).await;
        let children = format!("/v1/jobs?parent={id}&sort=created");
        if disturbed {
            let first = server.get(&children).await["jobs"][0]["id"].as_str().unwrap().to_owned();
            server.reaches(&first, "running").await;
            server.crash().await;
            server = Server::start_on(dir.path(), 2, |_| {}, processes()).await;
        }
        let job = server.reaches(&id, "succeeded").await;
        assert_eq!((&job["progress"]["step"], &job["progress"]["steps"]), (&json!(1600), &json!(1600)));
        let jobs = server.get(&children).await["jobs"].as_array().unwrap().clone();
        assert_eq!(jobs.iter().map(|job| job["seed"].as_u64().unwrap()).collect::<Vec<_>>(), [1, 2, 1, 2]);
        assert!(jobs.iter().all(|job| job["parent"] == id.as_str()));
        let result = server.get(&format!("/v1/jobs/{id}/result")).await;
        assert_eq!((&result["jobs"], &result["states"]), (&json!(4), &json!({"succeeded": 4})));
        let points = result["points"].as_array().unwrap();
        assert_eq!(points[1]["fields"], json!({"training.gamma": 0.9}));
        let aoi = &points[1]["metrics"]["eval/mean_aoi"];
        assert_eq!(aoi["seeds"], 2);
        assert!(aoi["best"]["low"].as_f64() <= aoi["best"]["mean"].as_f64(), "{aoi}");
        results.push(points.iter().map(|point| point["metrics"].clone()).collect::<Vec<_>>());
    }
    assert_eq!(results[0], results[1]);
}

async fn finish(server: &Server, worker: Worker, outcome: v1::Outcome) {
    let request =
        v1::FinishRequest { outcome: outcome.into(), reason: "by the test".into(), permanent: true, ..Default::default() };
    let request = signed(&worker.launch, &worker.launch.token, request);
    server.worker_client().await.finish(request).await.unwrap();
    worker.exit("exit code 0");
}

#[tokio::test]
async fn a_sweep_follows_its_jobs_and_they_follow_it() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start(dir.path(), 1).await;
    let submit = server.request(Method::POST, "/v1/jobs").header("idempotency-key", "k").json(&sweep());
    let id = expect(submit, StatusCode::CREATED).await["id"].as_str().unwrap().to_owned();
    let again = server.request(Method::POST, "/v1/jobs").header("idempotency-key", "k").json(&sweep());
    assert_eq!(expect(again, StatusCode::CREATED).await["id"], id.as_str());
    let path = |verb: &str| format!("/v1/jobs/{id}/{verb}");
    assert_eq!(server.state(&id).await, "running");
    assert_eq!(server.get(&format!("/v1/jobs?parent={id}")).await["jobs"].as_array().unwrap().len(), 4);

    let first = server.worker().await;
    finish(&server, first, v1::Outcome::Failed).await;
    let second = server.worker().await;
    server.post(&path("pause")).await;
    assert_eq!(server.get(&path("result")).await["states"], json!({"failed": 1, "paused": 2, "running": 1}));
    finish(&server, second, v1::Outcome::Stopped).await;
    server.reaches(&id, "paused").await;
    assert_eq!(server.post(&path("resume")).await["state"], "running");
    for _ in 0..3 {
        let worker = server.worker().await;
        finish(&server, worker, v1::Outcome::Succeeded).await;
    }
    let failed = server.reaches(&id, "failed").await;
    assert_eq!(failed["reason"], "1 of 4 jobs failed");
    let result = server.get(&path("result")).await;
    assert_eq!(result["points"][0]["jobs"][0]["reason"], "by the test");
    // A retry repeats only what failed.
    assert_eq!(server.post(&path("retry")).await["state"], "running");
    let worker = server.worker().await;
    assert_eq!(server.post(&path("cancel")).await["state"], "running");
    finish(&server, worker, v1::Outcome::Stopped).await;
    server.reaches(&id, "cancelled").await;
    expect(server.request(Method::POST, &path("retry")), StatusCode::CONFLICT).await;
    expect(server.request(Method::DELETE, &format!("/v1/jobs/{id}")), StatusCode::NO_CONTENT).await;
    assert_eq!(server.get("/v1/jobs").await["jobs"], json!([]));

    let wrong = json!({"kind": "sweep", "sweep": {"grid": {"training.gamma": [2.0]}}});
    let problem = expect(server.request(Method::POST, "/v1/jobs").json(&wrong), StatusCode::BAD_REQUEST).await;
    assert_eq!(problem["field"], "sweep.grid.training.gamma[0]");
    let mut grpc = server.jobs().await;
    let spec = qedgix::api::convert::structs::to_struct(&with(&json!({"kind": "sweep"})));
    let status = grpc.submit_job(v1::SubmitJobRequest { spec, ..Default::default() }).await.unwrap_err();
    assert_eq!(status.code(), Code::InvalidArgument);
    server.submit(&tiny()).await;
}
