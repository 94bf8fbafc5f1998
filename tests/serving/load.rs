//! `qedgix bench act` as a command: its output and its errors, not its speed.

use std::process::{Command, Output};

use serde_json::Value;

fn bench(flags: &[&str]) -> Output {
    let short = ["bench", "act", "--duration", "100ms", "--warmup", "20ms", "--rounds", "2"];
    Command::new(env!("CARGO_BIN_EXE_qedgix")).args(short).args(flags).output().unwrap()
}

fn results(flags: &[&str]) -> Value {
    let output = bench(&[flags, &["--json"]].concat());
    assert!(output.status.success(), "{flags:?}: {}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

#[test]
fn act_and_echo_are_measured_in_one_run() {
    for flags in [
        &["--sessions", "3", "--connections", "2"][..],
        &["--observation", "graph", "--uavs", "4", "--users", "9", "--range", "0.1"],
        &["--stream", "--sessions", "2", "--policy", "sweep"],
        &["--rate", "200", "--sessions", "2"],
    ] {
        let document = results(flags);
        for side in ["act", "echo"] {
            assert!(document[side]["answers"].as_u64().unwrap() > 0, "{flags:?}: {document}");
            for field in ["throughput_per_s", "p50_us", "p99_us", "p999_us", "max_us"] {
                assert!(document[side][field].as_f64().unwrap() > 0.0, "{flags:?}, {side}.{field}: {document}");
            }
            assert_eq!(document[side]["errors"], serde_json::json!({}));
        }
        for field in ["throughput", "p50", "p99", "p999"] {
            assert!(document["ratio"][field].as_f64().unwrap() > 0.0, "{flags:?}, ratio.{field}: {document}");
        }
        assert!(document["request_bytes"].as_u64().unwrap() > 100);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn remote_server_is_measured_beside_an_echo_server() {
    let server = super::harness::Server::start().await;
    let address = server.endpoints.grpc.to_string();
    let text = tokio::task::spawn_blocking(move || bench(&["--server", &address])).await.unwrap();
    let text = String::from_utf8(text.stdout).unwrap();
    assert!(text.contains("Act / echo"), "{text}");
    assert_eq!(server.app.sessions.len(), 0, "the benchmark closes its sessions");
}

#[test]
fn errors_name_the_option_at_fault() {
    for (flags, hint) in [
        (["--policy", "nobody"], "nobody"),
        (["--server", "127.0.0.1:1"], "127.0.0.1:1"),
        (["--users", "0"], "users"),
        (["--connections", "2"], "--connections"),
    ] {
        let output = bench(&flags);
        let text = String::from_utf8_lossy(&output.stderr);
        assert!(!output.status.success() && text.contains(hint), "{flags:?}: {text}");
    }
}
