//! Logs: formats, levels, and request ids.

use std::process::{Command, Stdio};

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

/// `qedgix serve` on free ports.
fn serve(dir: &std::path::Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_qedgix"));
    command.args(["serve", "--grpc-addr", "127.0.0.1:0", "--http-addr", "127.0.0.1:0", "--data-dir"]).arg(dir);
    command
}

#[tokio::test]
async fn a_log_that_nobody_reads_does_not_stop_the_server() {
    install_tls_provider();
    for signals in [1, 2] {
        let dir = tempfile::tempdir().unwrap();
        let mut command = serve(dir.path());
        command.args(["--access-log", "--drain-timeout", "0s"]).env("QEDGIX_LOG", "debug");
        // The pipe is never read.
        let mut child = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
        let url = with_timeout(async {
            loop {
                if let Ok(text) = std::fs::read_to_string(dir.path().join(qedgix::server::ENDPOINTS)) {
                    let endpoints: Value = serde_json::from_str(&text).unwrap();
                    break format!("http://{}", endpoints["http"].as_str().unwrap());
                }
                tokio::time::sleep(std::time::Duration::from_millis(5)).await;
            }
        })
        .await;
        let client = Client::new();
        // Until the queue is full, too.
        with_timeout(async {
            loop {
                for _ in 0..1000 {
                    assert_eq!(client.get(format!("{url}/livez")).send().await.unwrap().status(), 200);
                }
                let metrics = client.get(format!("{url}/metrics")).send().await.unwrap().text().await.unwrap();
                let dropped =
                    metrics.lines().find_map(|line| line.strip_prefix("qedgix_log_lines_dropped_total ")).unwrap_or("0");
                if dropped != "0" {
                    break;
                }
            }
        })
        .await;
        let ended = with_timeout(async {
            for _ in 0..signals {
                let sent = Command::new("kill").args(["-TERM", &child.id().to_string()]).status().unwrap();
                assert!(sent.success());
            }
            loop {
                if let Some(status) = child.try_wait().unwrap() {
                    break status.code();
                }
                tokio::time::sleep(std::time::Duration::from_millis(5)).await;
            }
        });
        // The second signal may find the process ended.
        let code = ended.await;
        assert!(code == Some(0) || signals == 2 && code == Some(143), "{code:?}");
    }
}

#[test]
fn a_start_that_fails_names_the_setting() {
    let dir = tempfile::tempdir().unwrap();
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let addr = taken.local_addr().unwrap().to_string();
    let failed = |flags: &[&str], filter: &str| {
        let output = Command::new(env!("CARGO_BIN_EXE_qedgix"))
            .args(["serve", "--data-dir"])
            .arg(dir.path())
            .args(flags)
            .env("QEDGIX_LOG", filter)
            .output()
            .unwrap();
        assert_eq!(output.status.code(), Some(1));
        String::from_utf8(output.stderr).unwrap()
    };
    let misspelled = failed(&[], "inf");
    assert!(misspelled.starts_with("error: QEDGIX_LOG: got \"inf\"") && misspelled.contains("debug"), "{misspelled}");
    let free = "127.0.0.1:0";
    for (flags, flag) in [
        (["--grpc-addr", &addr, "--http-addr", free], "--grpc-addr"),
        (["--grpc-addr", free, "--http-addr", &addr], "--http-addr"),
    ] {
        let error = failed(&flags, "");
        // After the log.
        let last = error.lines().last().unwrap();
        assert!(last.starts_with(&format!("error: {flag}: cannot listen on {addr}")), "{error}");
    }
}

#[cfg(target_os = "linux")]
#[tokio::test]
async fn the_limit_of_open_files_is_raised_or_connections_are_limited() {
    install_tls_provider();
    for (soft, hard, warned) in [(200, 4000, false), (400, 400, true)] {
        let dir = tempfile::tempdir().unwrap();
        let limits = format!("ulimit -Sn {soft} && ulimit -Hn {hard} && exec \"$0\" \"$@\"");
        let inner = serve(dir.path());
        let mut command = Command::new("sh");
        command.args(["-c", &limits]).arg(inner.get_program()).args(inner.get_args()).args(["--max-connections", "300"]);
        let mut child = command.env_remove("QEDGIX_LOG").stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
        with_timeout(async {
            while !dir.path().join(qedgix::server::ENDPOINTS).exists() {
                assert!(child.try_wait().unwrap().is_none());
                tokio::time::sleep(std::time::Duration::from_millis(5)).await;
            }
        })
        .await;
        let limits = std::fs::read_to_string(format!("/proc/{}/limits", child.id())).unwrap();
        let files = limits.lines().find(|line| line.starts_with("Max open files")).unwrap();
        assert_eq!(files.split_whitespace().nth(3), Some(hard.to_string().as_str()), "{limits}");
        assert!(Command::new("kill").args(["-TERM", &child.id().to_string()]).status().unwrap().success());
        let log = String::from_utf8(child.wait_with_output().unwrap().stderr).unwrap();
        assert_eq!(log.contains("fewer connections are accepted limit=400 wanted=300 connections=200"), warned, "{log}");
    }
}
