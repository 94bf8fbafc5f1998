//! Commands whose standard output or standard error cannot be written: no panic, one clear error, the conventional exit status.

use std::fs::File;
use std::path::Path;
use std::process::{Command, Output, Stdio};

use super::binary::Binary;
use super::harness::Server;

const PROGRAM: &str = env!("CARGO_BIN_EXE_qedgix");
/// Status of a process that SIGPIPE ends, as shells report it.
const BROKEN_PIPE: i32 = 141;

/// A pipe whose reading end is closed.
fn closed_pipe() -> Stdio {
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    writer.into()
}

fn full_disk() -> Stdio {
    File::options().write(true).open("/dev/full").unwrap().into()
}

fn run(words: &[&str], stdout: Stdio) -> Output {
    Command::new(PROGRAM).args(words).stdout(stdout).stderr(Stdio::piped()).output().unwrap()
}

/// Runs a command with a closed pipe, then with a full disk, as standard output. `notes`: whether it also writes to standard error.
fn check(words: &[&str], notes: bool) {
    let closed = run(words, closed_pipe());
    let stderr = String::from_utf8_lossy(&closed.stderr);
    assert_eq!(closed.status.code(), Some(BROKEN_PIPE), "{words:?}: {stderr}");
    assert!(notes || stderr.is_empty(), "{words:?}: {stderr}");
    if Path::new("/dev/full").exists() {
        let full = run(words, full_disk());
        let stderr = String::from_utf8_lossy(&full.stderr);
        assert_eq!(full.status.code(), Some(1), "{words:?}: {stderr}");
        let errors: Vec<&str> = stderr.lines().filter(|line| line.starts_with("error: ")).collect();
        let [error] = errors[..] else { panic!("{words:?}: {stderr}") };
        assert!(error.contains("cannot write to standard output"), "{words:?}: {error}");
        assert!(notes || stderr.lines().count() == 1, "{words:?}: {stderr}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn commands_survive_an_output_that_cannot_be_written() {
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name).to_str().unwrap().to_owned();
    let server = Server::start().await;
    let http = server.endpoints.http.to_string();
    let keys = path("keys");
    let (weights, experiment) = (path("weights.safetensors"), path("experiment.toml"));
    std::fs::write(
        &experiment,
        "title = \"Test\"\nfigure = \"convergence\"\nseeds = [1]\n[[series]]\nname = \"QMIX\"\nalgorithm = \"qmix\"\n",
    )
    .unwrap();
    let commands: &[(&[&str], bool)] = &[
        (&["--help"], false),
        (&["serve", "--help"], false),
        (&["--version"], false),
        (&["policies", "list", "--server", &http], false),
        (&["policies", "get", "sweep", "--server", &http, "--json"], false),
        (&["policies", "history", "sweep", "--server", &http], false),
        (&["keys", "--data-dir", &keys, "create", "--name", "test", "--scopes", "read"], true),
        (&["keys", "--data-dir", &keys, "list"], false),
        (&["keys", "--data-dir", &keys, "list", "--json"], false),
        (&["evaluate", "--policy", "sweep", "--episodes", "2", "--json"], true),
        (&["evaluate", "--policy", "sweep", "--episodes", "2"], true),
        (&["experiment", &experiment, "--dry-run"], false),
        (&["train", "--steps", "80", "--slots", "10", "--set", "training.envs=1", "--out", &weights], true),
    ];
    tokio::task::spawn_blocking({
        let commands: Vec<(Vec<String>, bool)> =
            commands.iter().map(|(words, notes)| (words.iter().map(|&word| word.to_owned()).collect(), *notes)).collect();
        move || {
            for (words, notes) in commands {
                check(&words.iter().map(String::as_str).collect::<Vec<_>>(), notes);
            }
        }
    })
    .await
    .unwrap();
}

/// The server logs to standard error. If the reader of standard error has gone, the server must continue.
#[tokio::test(flavor = "multi_thread")]
async fn a_server_survives_when_its_log_cannot_be_written() {
    let dir = tempfile::tempdir().unwrap();
    let binary = Binary::start(dir.path(), &["--access-log"]).await;
    binary.close_log();
    for _ in 0..3 {
        let response = reqwest::get(format!("{}/v1/policies", binary.http)).await.unwrap();
        assert_eq!(response.status(), 200);
    }
    binary.signal("TERM");
    assert_eq!(binary.ended().await.0, Some(0));
}

#[test]
fn durations_that_are_too_long_are_refused() {
    for flag in ["--drain-timeout", "--session-ttl", "--read-timeout"] {
        let dir = tempfile::tempdir().unwrap();
        let words = ["serve", "--data-dir", dir.path().to_str().unwrap(), flag, "1e19"];
        let output = run(&words, Stdio::null());
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{stderr}");
        assert!(stderr.starts_with(&format!("error: {flag}")), "{stderr}");
    }
}
