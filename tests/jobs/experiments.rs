//! Jobs of the kind `experiment` have the report of `qedgix experiment`.

use std::process::Command;
use std::sync::Arc;

use qedgix::jobs::LocalProcess;
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};

use super::harness::{Server, expect};
use super::process::PROGRAM;

const TINY: &str = r#"
title = "Tiny"
figure = "parameter"
seeds = [1, 2]
layouts = "valid-v1"
episodes = 4
baselines = ["sweep"]

[run]
environment = { uavs = 2, slots = 8 }
training = { steps = 600, eval_every = 200, eval_episodes = 4, batch = 8, buffer = 32 }

[[series]]
name = "VDN"
algorithm = "vdn"

[[points]]
name = "2 users"
x = 2
environment = { users = 2 }

[[points]]
name = "3 users"
x = 3
environment = { users = 3 }
"#;

#[tokio::test]
async fn an_experiment_has_the_report_of_the_command() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("tiny.toml"), TINY).unwrap();
    let run = |words: &[&str]| {
        let output = Command::new(PROGRAM).current_dir(dir.path()).args(words).output().unwrap();
        assert!(output.status.success(), "{words:?}: {}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap().trim().to_owned()
    };
    run(&["experiment", "tiny.toml", "--out", "here", "--steps", "400", "--threads", "1"]);
    let results: Value = serde_json::from_slice(&std::fs::read(dir.path().join("here/results.json")).unwrap()).unwrap();

    let program = PROGRAM.into();
    let data = tempfile::tempdir().unwrap();
    let server = Server::start_on(data.path(), 2, |_| {}, Some(Arc::new(LocalProcess { program }))).await;
    let address = server.rest.address().to_owned();
    let submit = ["jobs", "submit", "--experiment", "tiny.toml", "--steps", "400", "--name", "tiny", "--server", &address];
    let words: Vec<String> = submit.iter().map(|word| (*word).to_owned()).collect();
    let dir_path = dir.path().to_owned();
    let submitted = tokio::task::spawn_blocking(move || Command::new(PROGRAM).current_dir(dir_path).args(words).output().unwrap());
    let output = submitted.await.unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let id = String::from_utf8(output.stdout).unwrap().trim().to_owned();

    let early = server.get(&format!("/v1/jobs/{id}/result")).await;
    assert_eq!((&early["jobs"], &early["report"]), (&json!(4), &Value::Null));
    let job = server.reaches(&id, "succeeded").await;
    assert_eq!((&job["kind"], &job["progress"]["steps"]), (&json!("experiment"), &json!(1600)));
    assert_eq!(job["experiment"]["overrides"], json!({"training": {"steps": 400}}));
    for _ in 0..2 {
        let result = server.get(&format!("/v1/jobs/{id}/result")).await;
        assert_eq!(result["states"], json!({"succeeded": 4}));
        assert_eq!(result["report"], results);
    }

    let document: Value = toml::from_str(TINY).unwrap();
    let with = |field: &str, value: Value| {
        let mut document = document.clone();
        document[field] = value;
        json!({"kind": "experiment", "experiment": document})
    };
    for (job, field) in [
        (json!({"kind": "experiment"}), "experiment"),
        (json!({"experiment": document}), "experiment"),
        (with("figure", json!("pie")), "experiment.figure"),
        (with("overrides", json!({"environment": {"users": 4}})), "experiment.overrides.environment.users"),
    ] {
        let response = server.request(Method::POST, "/v1/jobs").json(&job).send().await.unwrap();
        assert!(response.status().is_client_error() && response.status() != StatusCode::NOT_FOUND);
        let problem: Value = serde_json::from_slice(&response.bytes().await.unwrap()).unwrap();
        assert_eq!(problem["field"], field, "{problem}");
    }
    expect(server.request(Method::DELETE, &format!("/v1/jobs/{id}")), StatusCode::NO_CONTENT).await;
    assert_eq!(server.get("/v1/jobs").await["jobs"], json!([]));
}
