//! Jobs of the kind `experiment` have the report of `qedgix experiment`.

use std::process::Command;
use std::sync::Arc;

use qedgix::jobs::LocalProcess;
use qedgix::wire::v1;
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};

use super::harness::{Server, expect, signed, within};
use super::process::{POLL, PROGRAM};

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

    let data = tempfile::tempdir().unwrap();
    let start = async || Server::start_on(data.path(), 2, |_| {}, Some(Arc::new(LocalProcess::new(PROGRAM)))).await;
    let mut server = start().await;
    let address = server.rest.address().to_owned();
    let submit = ["jobs", "submit", "--experiment", "tiny.toml", "--steps", "400", "--name", "tiny", "--server", &address];
    let words: Vec<String> = submit.iter().map(|word| (*word).to_owned()).collect();
    let dir_path = dir.path().to_owned();
    let submitted =
        tokio::task::spawn_blocking(move || Command::new(PROGRAM).current_dir(dir_path).args(words).output().unwrap());
    let output = submitted.await.unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let id = String::from_utf8(output.stdout).unwrap().trim().to_owned();

    let early = server.get(&format!("/v1/jobs/{id}/result")).await;
    assert_eq!((&early["jobs"], &early["report"]), (&json!(4), &Value::Null));
    // The server dies when the first run has begun.
    let first = early["runs"][0]["id"].as_str().unwrap().to_owned();
    within(async {
        while server.state(&first).await == "queued" {
            tokio::time::sleep(POLL).await;
        }
    })
    .await;
    server.crash().await;
    let server = start().await;
    let job = server.reaches(&id, "succeeded").await;
    assert_eq!((&job["kind"], &job["progress"]["steps"]), (&json!("experiment"), &json!(4 * 448)));
    assert_eq!(job["experiment"]["overrides"], json!({"training": {"steps": 400}}));
    for _ in 0..2 {
        let result = server.get(&format!("/v1/jobs/{id}/result")).await;
        assert_eq!(result["states"], json!({"succeeded": 4}));
        assert_eq!(result["report"], results);
        let runs = result["runs"].as_array().unwrap().iter().map(|run| (run["point"].clone(), run["seed"].clone()));
        let [two, three] = ["2 users", "3 users"].map(Value::from);
        let expected = [(&two, 1), (&three, 1), (&two, 2), (&three, 2)].map(|(point, seed)| (point.clone(), json!(seed)));
        assert_eq!(runs.collect::<Vec<_>>(), expected);
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
        (with("overrides", json!({"seed": 4})), "experiment.overrides.seed"),
        (with("overrides", json!({"num_seeds": 0})), "experiment.overrides.num_seeds"),
        (with("overrides", json!({"series": ["absent"]})), "experiment.series"),
    ] {
        let response = server.request(Method::POST, "/v1/jobs").json(&job).send().await.unwrap();
        assert!(response.status().is_client_error() && response.status() != StatusCode::NOT_FOUND);
        let problem: Value = serde_json::from_slice(&response.bytes().await.unwrap()).unwrap();
        assert_eq!(problem["field"], field, "{problem}");
    }
    expect(server.request(Method::DELETE, &format!("/v1/jobs/{id}")), StatusCode::NO_CONTENT).await;
    assert_eq!(server.get("/v1/jobs").await["jobs"], json!([]));
}

#[tokio::test]
async fn runs_that_failed_are_shown_and_repeated() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start(dir.path(), 1).await;
    let mut document: Value = toml::from_str(TINY).unwrap();
    document["overrides"] = json!({"num_seeds": 1});
    let id = server.submit(&json!({"kind": "experiment", "experiment": document})).await;
    let path = |verb: &str| format!("/v1/jobs/{id}/{verb}");
    finish(&mut server, v1::Outcome::Failed).await;
    finish(&mut server, v1::Outcome::Succeeded).await;
    assert_eq!(server.reaches(&id, "failed").await["reason"], "1 of 2 jobs failed");
    let result = server.get(&path("result")).await;
    let run = &result["runs"][0];
    assert_eq!((&run["series"], &run["point"], &run["seed"]), (&json!("VDN"), &json!("2 users"), &json!(1)));
    assert_eq!((&run["state"], &run["reason"], &result["report"]), (&json!("failed"), &json!("by the test"), &Value::Null));
    assert_eq!(server.post(&path("retry")).await["state"], "running");
    finish(&mut server, v1::Outcome::Succeeded).await;
    server.reaches(&id, "succeeded").await;
    assert_eq!(server.get(&path("result")).await["states"], json!({"succeeded": 2}));
}

async fn finish(server: &mut Server, outcome: v1::Outcome) {
    let worker = server.worker().await;
    let request =
        v1::FinishRequest { outcome: outcome.into(), reason: "by the test".into(), permanent: true, ..Default::default() };
    let request = signed(&worker.launch, &worker.launch.token, request);
    server.worker_client().await.finish(request).await.unwrap();
    worker.exit("exit code 0");
}
