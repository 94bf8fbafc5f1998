//! Logs: formats, levels, and request ids.

use qedgix::wire::v1::ListJobsRequest;
use reqwest::{Client, StatusCode};
use serde_json::{Value, json};
use sqlx::Connection;
use sqlx::sqlite::{SqliteConnectOptions, SqliteConnection};

use super::super::binary::Binary;
use super::super::harness::*;
use super::fly;

fn named<T>(message: T, id: &str) -> tonic::Request<T> {
    let mut request = tonic::Request::new(message);
    request.metadata_mut().insert("x-request-id", id.parse().unwrap());
    request
}

/// The log lines of the request with this id.
fn lines_of<'a>(lines: &'a [Value], id: &str) -> Vec<&'a Value> {
    lines.iter().filter(|line| line["fields"]["request_id"] == id).collect()
}

/// Stops the server and returns its log.
async fn log(binary: Binary) -> Vec<Value> {
    binary.signal("TERM");
    let (code, lines) = binary.ended().await;
    assert_eq!(code, Some(0), "{lines:?}");
    lines.iter().map(|line| serde_json::from_str(line).unwrap_or_else(|e| panic!("{e}: {line}"))).collect()
}

#[tokio::test]
async fn the_access_log_has_a_json_line_per_request() {
    let dir = tempfile::tempdir().unwrap();
    let binary = Binary::start(dir.path(), &["--log-format", "json", "--access-log"]).await;
    fly(&binary, "s", 0).await;
    let mut client = binary.policies().await;
    let answer = client.act(named(in_session("s", Some(1), scene(2, 3, 1)), "mission 7/1")).await.unwrap();
    assert_eq!(answer.metadata().get("x-request-id").unwrap(), "mission 7/1");
    let refusal = client.act(named(in_session("s", Some(9), scene(2, 3, 1)), "\"quoted\" {}")).await.unwrap_err();
    assert_eq!(refusal.metadata().get("x-request-id").unwrap(), "\"quoted\" {}");
    let http = Client::new();
    let shown = http.get(format!("{}/v1/policies/sweep", binary.http)).header("x-request-id", "rest-1").send().await.unwrap();
    assert_eq!(shown.headers()["x-request-id"], "rest-1");
    let unnamed = http.get(format!("{}/livez", binary.http)).send().await.unwrap();
    let given = unnamed.headers()["x-request-id"].to_str().unwrap().to_owned();

    let lines = log(binary).await;
    for (id, method, code) in [
        ("mission 7/1", "qedgix.v1.PolicyService/Act", "OK"),
        ("\"quoted\" {}", "qedgix.v1.PolicyService/Act", "FailedPrecondition"),
        ("rest-1", "GET /v1/policies/{policy}", "200"),
        (&given, "GET /livez", "200"),
    ] {
        let [line] = lines_of(&lines, id)[..] else { panic!("expected one line for {id}: {lines:?}") };
        assert_eq!((&line["level"], &line["target"]), (&json!("INFO"), &json!("qedgix::access")));
        let fields = &line["fields"];
        assert_eq!((&fields["method"], &fields["code"]), (&json!(method), &json!(code)), "{line}");
        assert!(fields["seconds"].as_f64().unwrap() > 0.0);
    }
    assert!(lines.iter().all(|line| line["timestamp"].is_string() && line["level"].is_string()));
}

#[tokio::test]
async fn without_an_access_log_only_failed_and_refused_requests_are_logged() {
    let dir = tempfile::tempdir().unwrap();
    let binary = Binary::start(dir.path(), &["--log-format", "json", "--max-message-size", "4096"]).await;
    fly(&binary, "s", 0).await;
    let mut client = binary.policies().await;
    client.act(named(in_session("s", Some(1), scene(2, 3, 1)), "slot")).await.unwrap();
    client.act(named(in_session("s", Some(9), scene(2, 3, 1)), "mistake")).await.unwrap_err();
    let large = client.act(named(in_session("s", Some(2), scene(2, 300, 1)), "large")).await.unwrap_err();
    assert_eq!(large.code(), tonic::Code::ResourceExhausted, "{large}");

    // Breaks the database while the server runs.
    let file = dir.path().join(qedgix::store::FILE);
    let mut database = SqliteConnection::connect_with(&SqliteConnectOptions::new().filename(file)).await.unwrap();
    sqlx::query("ALTER TABLE jobs RENAME TO elsewhere").execute(&mut database).await.unwrap();
    let broken =
        Client::new().get(format!("{}/v1/jobs", binary.http)).header("x-request-id", "broken-rest").send().await.unwrap();
    assert_eq!(broken.status(), StatusCode::INTERNAL_SERVER_ERROR);
    let problem = broken.text().await.unwrap();
    assert!(problem.contains("\"code\":\"internal\"") && !problem.contains("no such table"), "{problem}");
    let mut jobs = qedgix::wire::v1::job_service_client::JobServiceClient::new(binary.channel().await);
    let status = jobs.list_jobs(named(ListJobsRequest::default(), "broken-grpc")).await.unwrap_err();
    assert_eq!(status.metadata().get("qedgix-code").unwrap(), "internal");
    assert!(!format!("{status:?}").contains("no such table"), "{status:?}");
    sqlx::query("ALTER TABLE elsewhere RENAME TO jobs").execute(&mut database).await.unwrap();

    let lines = log(binary).await;
    assert_eq!((lines_of(&lines, "slot"), lines_of(&lines, "mistake")), (vec![], vec![]));
    for (id, level, method, code, detail) in [
        ("large", "WARN", "qedgix.v1.PolicyService/Act", "ResourceExhausted", "4096"),
        ("broken-rest", "ERROR", "GET /v1/jobs", "500", "no such table"),
        ("broken-grpc", "ERROR", "qedgix.v1.JobService/ListJobs", "Internal", "no such table"),
    ] {
        let [line] = lines_of(&lines, id)[..] else { panic!("expected one line for {id}: {lines:?}") };
        let fields = &line["fields"];
        assert_eq!((&line["level"], &fields["method"], &fields["code"]), (&json!(level), &json!(method), &json!(code)), "{line}");
        assert!(format!("{}{}", fields["error"], fields["detail"]).contains(detail), "{line}");
    }
}

#[tokio::test]
async fn text_logs_have_one_line_per_event_for_any_input() {
    let dir = tempfile::tempdir().unwrap();
    let binary = Binary::start(dir.path(), &["--access-log"]).await;
    let job = json!({"name": "a-name", "labels": {"note": "two\nlines \u{1b}[31mred"}, "preset": "two\nlines"});
    let refused = Client::new().post(format!("{}/v1/jobs", binary.http)).header("x-request-id", "odd").json(&job);
    assert_eq!(refused.send().await.unwrap().status(), StatusCode::UNPROCESSABLE_ENTITY);
    binary.signal("TERM");
    let (_, lines) = binary.ended().await;
    assert!(lines.iter().all(|line| line.starts_with("20") && !line.contains('\u{1b}')), "{lines:?}");
    let found: Vec<&String> = lines.iter().filter(|line| line.contains("request_id=odd")).collect();
    assert_eq!(found.len(), 1, "{lines:?}");
    assert!(
        found[0].contains("method=POST /v1/jobs") && found[0].contains("code=\"422\"") && !found[0].contains("otel."),
        "{found:?}"
    );
}
