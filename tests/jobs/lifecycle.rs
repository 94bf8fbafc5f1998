//! Limits of jobs, jobs that come after others, early stops, jobs before the head of the queue, and their output while it arrives.

use std::sync::Arc;

use qedgix::jobs::LocalProcess;
use qedgix::wire::v1;
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};

use super::harness::{Server, Worker, expect, named, signed, tiny, with, within};

async fn finish(server: &Server, worker: Worker, outcome: v1::Outcome) {
    let request = v1::FinishRequest { outcome: outcome.into(), reason: "by the test".into(), ..Default::default() };
    let request = signed(&worker.launch, &worker.launch.token, request);
    server.worker_client().await.finish(request).await.unwrap();
    worker.exit("exit code 0");
}

#[tokio::test]
async fn a_job_has_attempts_and_pauses_of_its_own() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start(dir.path(), 1).await;
    let once = server.submit(&with(&json!({"max_attempts": 1}))).await;
    server.worker().await.exit("exit code 1");
    let job = server.reaches(&once, "failed").await;
    assert_eq!((&job["attempts"], &job["max_attempts"]), (&json!(1), &json!(1)));

    let patient = server.submit(&with(&json!({"backoff": 3600, "timeout": 60}))).await;
    server.worker().await.exit("exit code 1");
    // The next attempt waits, and the next job does not.
    let other = server.submit(&tiny()).await;
    let worker = server.worker().await;
    assert_eq!(worker.job(), other);
    let job = server.get(&format!("/v1/jobs/{patient}")).await;
    assert_eq!((&job["state"], &job["backoff"], &job["timeout"]), (&json!("queued"), &json!(3600), &json!(60)));
    assert!(job["waiting"]["reason"].as_str().unwrap().contains("until"), "{job}");
}

#[tokio::test]
async fn a_job_waits_for_the_jobs_that_it_comes_after() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start(dir.path(), 4).await;
    let after = |ids: &[&String]| with(&json!({"after": ids}));
    let (first, second) = (server.submit(&tiny()).await, server.submit(&tiny()).await);
    let workers = [server.worker().await, server.worker().await];
    let last = server.submit(&after(&[&first, &second])).await;
    let end = server.submit(&after(&[&last])).await;
    let job = server.get(&format!("/v1/jobs/{last}")).await;
    assert_eq!(job["after"], json!([first, second]));
    assert_eq!(job["waiting"]["reason"], "comes after 2 jobs that have not succeeded");
    let [one, two] = workers;
    finish(&server, one, v1::Outcome::Succeeded).await;
    assert_eq!(server.state(&last).await, "queued");
    finish(&server, two, v1::Outcome::Succeeded).await;
    let third = server.worker().await;
    assert_eq!(third.job(), last);
    // A failed job can be retried, so those after it wait. A cancelled one takes them with it.
    server.post(&format!("/v1/jobs/{last}/cancel")).await;
    finish(&server, third, v1::Outcome::Stopped).await;
    server.reaches(&last, "cancelled").await;
    let job = server.get(&format!("/v1/jobs/{end}")).await;
    assert_eq!(job["state"], "cancelled");
    assert!(job["reason"].is_string());

    for (ids, field) in [
        (json!(["me"]), "after[0]"),
        (json!([uuid::Uuid::nil()]), "after[0]"),
        (json!([first, first]), "after[1]"),
        (json!([first, last]), "after[1]"),
    ] {
        let request = server.request(Method::POST, "/v1/jobs").json(&with(&json!({"after": ids})));
        assert_eq!(expect(request, StatusCode::BAD_REQUEST).await["field"], field, "{ids}");
    }
}

#[tokio::test]
async fn a_job_starts_before_the_head_only_where_it_cannot_delay_it() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start(dir.path(), 4).await;
    let threads = |name: &str, threads: usize| with(&json!({"name": name, "threads": threads}));
    server.submit(&threads("running", 2)).await;
    let running = server.worker().await;
    let head = server.submit(&threads("head", 3)).await;
    let wide = server.submit(&threads("wide", 2)).await;
    let narrow = server.submit(&threads("narrow", 1)).await;
    // Beside the head is room for one thread, whatever ends first.
    let backfilled = server.worker().await;
    assert_eq!(backfilled.job(), narrow);
    assert_eq!(server.get(&format!("/v1/jobs/{head}")).await["waiting"]["reason"], "needs 3 threads, 1 free");
    finish(&server, running, v1::Outcome::Succeeded).await;
    let next = server.worker().await;
    assert_eq!(next.job(), head);
    assert_eq!(server.state(&wide).await, "queued");
}

#[tokio::test]
async fn the_cpu_budget_changes_while_jobs_run() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start(dir.path(), 1).await;
    let put = |threads: Value| server.request(Method::PUT, "/v1/server/budget").json(&json!({"threads": threads}));
    let refused = expect(put(json!(0)), StatusCode::BAD_REQUEST).await;
    assert_eq!(refused["field"], "threads");
    expect(server.request(Method::POST, "/v1/jobs").json(&with(&json!({"threads": 2}))), StatusCode::BAD_REQUEST).await;
    assert_eq!(expect(put(json!(3)), StatusCode::OK).await, json!({"threads": 3, "threads_busy": 0}));
    server.submit(&with(&json!({"threads": 2}))).await;
    let wide = server.worker().await;
    assert_eq!(server.get("/v1/server/budget").await, json!({"threads": 3, "threads_busy": 2}));
    // What runs stays; what waits fits into the smaller budget.
    let request = expect(server.request(Method::PUT, "/v1/server/budget").json(&json!({"threads": 1})), StatusCode::OK).await;
    assert_eq!(request["threads_busy"], 2);
    let next = server.submit(&named("next")).await;
    assert_eq!(server.state(&next).await, "queued");
    finish(&server, wide, v1::Outcome::Succeeded).await;
    assert_eq!(server.worker().await.job(), next);
}

#[tokio::test]
async fn training_ends_early() {
    let dir = tempfile::tempdir().unwrap();
    let server = Server::start_on(dir.path(), 1, |_| {}, Some(Arc::new(LocalProcess::new(env!("CARGO_BIN_EXE_qedgix"))))).await;
    let early = json!({"name": "early", "stop": {"metric": "eval/mean_aoi", "at_most": 1e9}});
    let id = server.submit(&with(&early)).await;
    let job = server.reaches(&id, "succeeded").await;
    assert_eq!((&job["progress"]["step"], &job["policy"]), (&json!(0), &json!("early:1")));
    assert_eq!(job["reason"], "stopped early: eval/mean_aoi is at most 1000000000");
    let result = server.request(Method::GET, &format!("/v1/jobs/{id}/result"));
    let problem = expect(result, StatusCode::CONFLICT).await;
    assert_eq!(problem["detail"], format!("job {id} has no result; a training job has one only with publish.alias"));
    assert_eq!(job["stop"], json!({"metric": "eval/mean_aoi", "at_most": 1e9, "at_least": null, "patience": null}));
    let never = with(&json!({"stop": {"metric": "eval/mean_aoi", "at_most": -1, "patience": 100}}));
    let job = server.reaches(&server.submit(&never).await, "succeeded").await;
    assert_eq!((&job["progress"]["step"], &job["reason"]), (&job["progress"]["steps"], &Value::Null));
    // Iterations of 8 episodes with 10 slots are whole.
    let rounded = with(&json!({"training": {"steps": 50}}));
    let job = server.reaches(&server.submit(&rounded).await, "succeeded").await;
    assert_eq!((&job["progress"]["step"], &job["progress"]["steps"]), (&json!(80), &json!(80)));
}

#[tokio::test]
async fn output_is_followed_over_all_attempts_until_the_job_has_ended() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start(dir.path(), 1).await;
    let id = server.submit(&tiny()).await;
    let first = server.worker().await;
    first.launch.log.push(b"one\n");
    let mut rest = server.request(Method::GET, &format!("/v1/jobs/{id}/logs/events")).send().await.unwrap();
    let mut grpc = server.jobs().await;
    let mut lines = grpc.watch_job_logs(v1::WatchJobLogsRequest { id: id.clone() }).await.unwrap().into_inner();
    let mut next = async || within(lines.message()).await.unwrap().map(|output| (output.attempt, output.text));
    assert_eq!(next().await, Some((1, "one\n".into())));
    first.launch.log.push(b"two\nthr");
    assert_eq!(next().await, Some((1, "two\n".into())));
    first.launch.log.push(b"ee");
    first.exit("exit code 1");
    assert_eq!(next().await, Some((1, "three".into())));
    let second = server.worker().await;
    second.launch.log.push(b"again\n");
    assert_eq!(next().await, Some((2, "again\n".into())));
    finish(&server, second, v1::Outcome::Succeeded).await;
    assert_eq!(next().await, None);
    let mut text = String::new();
    while let Some(part) = within(rest.chunk()).await.unwrap() {
        text += std::str::from_utf8(&part).unwrap();
    }
    let data: Vec<Value> =
        text.lines().filter_map(|line| line.strip_prefix("data: ")).map(|data| serde_json::from_str(data).unwrap()).collect();
    let all: String = data.iter().map(|data| data["text"].as_str().unwrap()).collect();
    assert_eq!(all, "one\ntwo\nthreeagain\n");
    assert_eq!(data.last().unwrap()["attempt"], 2);

    // After the end, the output of the last attempt.
    let mut lines = grpc.watch_job_logs(v1::WatchJobLogsRequest { id: id.clone() }).await.unwrap().into_inner();
    assert_eq!(within(lines.message()).await.unwrap().unwrap().text, "again\n");
    assert_eq!(within(lines.message()).await.unwrap(), None);
    let attempts = grpc.get_job_logs(v1::GetJobLogsRequest { id: id.clone() }).await.unwrap().into_inner().attempts;
    assert_eq!(attempts.iter().map(|attempt| attempt.log.as_str()).collect::<Vec<_>>(), ["one\ntwo\nthree", "again\n"]);
    grpc.delete_job(v1::DeleteJobRequest { id: id.clone() }).await.unwrap();
    expect(server.request(Method::GET, &format!("/v1/jobs/{id}")), StatusCode::NOT_FOUND).await;
}
