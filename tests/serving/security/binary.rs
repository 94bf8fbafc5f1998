//! The binary: `qedgix keys` next to a running server, commands with keys and certificates, SIGHUP, and logs without secrets.

use std::io::{BufRead, BufReader};
use std::os::unix::fs::PermissionsExt;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use qedgix::wire::v1;
use qedgix::wire::v1::policy_service_client::PolicyServiceClient;
use serde_json::Value;

use super::super::harness::*;
use super::{misspelled, signed, tls};

const PROGRAM: &str = env!("CARGO_BIN_EXE_qedgix");

/// A server on free ports with log level trace; killed when dropped.
struct Process {
    child: Child,
    endpoints: Value,
    dir: tempfile::TempDir,
    lines: Receiver<String>,
    log: Vec<String>,
}

impl Process {
    fn start(dir: tempfile::TempDir, flags: &[&str]) -> Self {
        install_tls_provider();
        let mut child = Command::new(PROGRAM)
            .args(["serve", "--grpc-addr", "127.0.0.1:0", "--http-addr", "127.0.0.1:0", "--data-dir"])
            .arg(dir.path())
            .args(flags)
            .env("QEDGIX_LOG", "trace")
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let (sender, lines) = channel();
        let log = BufReader::new(child.stderr.take().unwrap());
        std::thread::spawn(move || log.lines().map_while(Result::ok).try_for_each(|line| sender.send(line)));
        let mut process = Self { child, endpoints: Value::Null, dir, lines, log: Vec::new() };
        process.says("serving");
        let text = std::fs::read_to_string(process.dir.path().join("endpoints.json")).unwrap();
        process.endpoints = serde_json::from_str(&text).unwrap();
        process
    }

    /// Waits until a log line contains `words`.
    fn says(&mut self, words: &str) {
        loop {
            let line = self.lines.recv_timeout(Duration::from_secs(60)).unwrap_or_else(|_| panic!("{words}: {:#?}", self.log));
            let found = line.contains(words);
            self.log.push(line);
            if found {
                return;
            }
        }
    }

    fn address(&self, of: &str) -> &str {
        self.endpoints[of].as_str().unwrap()
    }

    fn signal(&self, name: &str) {
        assert!(Command::new("kill").args([&format!("-{name}"), &self.child.id().to_string()]).status().unwrap().success());
    }

    /// Stops the server and returns its log.
    fn end(mut self) -> String {
        self.signal("TERM");
        assert!(self.child.wait().unwrap().success());
        let rest: Vec<String> = self.lines.iter().collect();
        self.log.extend(rest);
        self.log.join("\n")
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn run(words: &[&str], key: Option<&str>) -> Output {
    let mut command = Command::new(PROGRAM);
    command.args(words).env("QEDGIX_LOG", "trace");
    if let Some(key) = key {
        command.env("QEDGIX_API_KEY", key);
    }
    command.output().unwrap()
}

/// Standard output of a command that succeeds.
fn printed(words: &[&str], key: Option<&str>) -> String {
    let output = run(words, key);
    assert!(output.status.success(), "{words:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap().trim_end().to_owned()
}

/// Standard output and standard error of a command that fails.
fn failed(words: &[&str], key: Option<&str>) -> String {
    let output = run(words, key);
    assert!(!output.status.success(), "{words:?}");
    String::from_utf8([output.stdout, output.stderr].concat()).unwrap()
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

#[test]
fn keys_are_created_listed_rotated_and_revoked() {
    let dir = tempfile::tempdir().unwrap();
    let data = dir.path().join("new");
    fn in_order<'a>(data: &'a Path, words: &[&'a str]) -> Vec<&'a str> {
        [&["keys", "--data-dir", text(data)], words].concat()
    }
    let nothing = failed(&in_order(&data, &["list"]), None);
    assert!(nothing.contains("--data-dir") && !data.exists(), "{nothing}");
    let key = printed(
        &in_order(&data, &["create", "--name", "my fleet", "--scopes", "read,act", "--expires", "90d", "--rate", "500"]),
        None,
    );
    assert!(key.starts_with("qdx_") && key.len() == 58 && !key.contains('\n'), "{key}");
    let table = printed(&in_order(&data, &["list"]), None);
    let id = &key[4..14];
    for word in [id, "my fleet", "read,act", "active", "500/s"] {
        assert!(table.contains(word), "{word}: {table}");
    }
    let list = || -> Value { serde_json::from_str(&printed(&in_order(&data, &["list", "--json"]), None)).unwrap() };
    assert_eq!(list()["keys"][0]["scopes"], serde_json::json!(["read", "act"]));
    let rotated: Value = serde_json::from_str(&printed(&in_order(&data, &["rotate", id, "--json"]), None)).unwrap();
    assert_eq!(rotated["name"], "my fleet");
    assert_ne!(rotated["key"], key);
    printed(&in_order(&data, &["revoke", rotated["key"].as_str().unwrap()]), None);
    let states: Vec<Value> = list()["keys"].as_array().unwrap().iter().map(|key| key["state"].clone()).collect();
    assert_eq!(states, ["expired", "revoked"]);
    for (wrong, named) in [
        (&["create", "--name", "k", "--scopes", "all"][..], "--scopes"),
        (&["create", "--name", "k", "--scopes", "read", "--expires", "90"], "90d"),
        (&["create", "--name", "k", "--scopes", "read", "--rate", "0"], "rate:"),
        (&["create", "--name", "", "--scopes", "read"], "name"),
        (&["revoke", "0000000000"], "no API key"),
    ] {
        let output = failed(&in_order(&data, wrong), None);
        assert!(output.contains(named), "{output}");
    }
    let all = format!("{table}{}", list());
    assert!(!all.contains(&key[15..]) && !all.contains(&rotated["key"].as_str().unwrap()[15..]), "{all}");
}

#[tokio::test(flavor = "multi_thread")]
async fn secrets_appear_in_no_log_response_or_error() {
    let dir = tempfile::tempdir().unwrap();
    let create = |scopes| printed(&["keys", "create", "--name", "k", "--scopes", scopes, "--data-dir", text(dir.path())], None);
    let (admin, limited) = (create("admin"), create("jobs"));
    let wrong = misspelled(&admin);
    let process = Process::start(dir, &[]);
    let (http, grpc) = (process.address("http").to_owned(), process.address("grpc").to_owned());
    let mut output = String::new();

    let client = reqwest::Client::new();
    for (key, status) in [(&admin, 200), (&limited, 403), (&wrong, 401)] {
        let get = || client.get(format!("http://{http}/v1/policies"));
        for request in [get().bearer_auth(key), get().header("x-api-key", key)] {
            let answer = request.send().await.unwrap();
            assert_eq!(answer.status(), status);
            output += &[format!("{:?}", answer.headers()), answer.text().await.unwrap()].concat();
        }
        let mut client = PolicyServiceClient::connect(format!("http://{grpc}")).await.unwrap();
        let answer = client.list_policies(signed(key, v1::ListPoliciesRequest::default())).await;
        assert_eq!(answer.is_ok(), status == 200);
        output.extend([format!("{answer:?}")]);
    }

    let evaluate = ["evaluate", "--policy", "sweep", "--episodes", "1", "--slots", "3", "--server", &grpc];
    output += &printed(&evaluate, Some(&admin));
    output += &failed(&evaluate, Some(&wrong));
    assert!(output.contains("is unknown"), "{output}");
    output += &failed(&evaluate, Some(&limited));
    assert!(output.contains("the scope act"), "{output}");
    let train = ["train", "--server", &http, "--steps", "100"];
    output += &failed(&train, Some(&wrong));
    output += &failed(&train, Some(&format!("{admin}\u{1}")));
    assert!(output.contains("--api-key: not an API key"), "{output}");
    for help in [["train", "--help"], ["evaluate", "--help"], ["keys", "--help"]] {
        output += &printed(&help, Some(&admin));
    }
    output += &printed(&["bench", "act", "--help"], Some(&admin));
    assert!(output.contains("QEDGIX_API_KEY"), "{output}");

    let log = process.end();
    let id = &admin[4..14];
    assert!(log.contains("TRACE") && log.contains(id), "the log has level trace and contains the id of the key");
    for key in [&admin, &limited, &wrong] {
        let secret = &key[15..];
        assert!(!output.contains(secret), "{output}");
        assert!(!log.contains(secret), "{}", log.lines().find(|line| line.contains(secret)).unwrap());
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_job_runs_on_a_server_with_keys_and_client_certificates() {
    let dir = tempfile::tempdir().unwrap();
    let (ours, clients) = (tls::Authority::new("ours"), tls::Authority::new("clients"));
    let files = tls::write(dir.path(), &ours.issue(), Some(&clients));
    let own = clients.issue();
    let path = |name: &str, text: &str| -> PathBuf {
        std::fs::write(dir.path().join(name), text).unwrap();
        dir.path().join(name)
    };
    let (ca, cert, key) = (path("ca.pem", &ours.pem()), path("own.pem", &own.cert), path("own.key", &own.key));
    let certificates = ["--ca-cert", text(&ca), "--client-cert", text(&cert), "--client-key", text(&key)];
    let server = Server::with(|config| {
        config.tls = Some(files);
        config.max_connections = 4;
        config.worker = Some(PROGRAM.into());
    })
    .await;
    let trainer = super::key(&server, "read,jobs").await;
    let pilot = super::key(&server, "act").await;
    let rest = format!("https://localhost:{}", server.endpoints.http.port());
    let run = move |words: Vec<String>, key: String| {
        let words: Vec<&str> = words.iter().map(String::as_str).collect();
        printed(&words, Some(&key))
    };
    let words = |first: &[&str]| -> Vec<String> { first.iter().chain(&certificates).map(|word| (*word).to_owned()).collect() };
    let out = dir.path().join("trained.safetensors");
    let train = words(&[
        "train",
        "--out",
        text(&out),
        "--algorithm",
        "vdn",
        "--uavs",
        "2",
        "--users",
        "2",
        "--slots",
        "10",
        "--steps",
        "400",
        "--threads",
        "1",
        "--set",
        "training.envs=2",
        "--set",
        "training.batch=2",
        "--set",
        "training.buffer=20",
        "--set",
        "training.eval_every=200",
        "--set",
        "training.eval_episodes=2",
        "--server",
        &rest,
        "--name",
        "over-tls",
    ]);
    let trained = tokio::task::spawn_blocking({
        let (run, train, trainer) = (run, train.clone(), trainer.clone());
        move || run(train, trainer)
    });
    assert!(with_timeout(trained).await.unwrap().contains("policy over-tls:1\n"));
    let fly = words(&[
        "evaluate",
        "--policy",
        "over-tls:1",
        "--uavs",
        "2",
        "--users",
        "2",
        "--slots",
        "10",
        "--episodes",
        "1",
        "--server",
        &format!("127.0.0.1:{}", server.endpoints.grpc.port()),
    ]);
    let flown = tokio::task::spawn_blocking(move || run(fly, pilot));
    assert!(with_timeout(flown).await.unwrap().contains("over-tls:1"));
    // Without a client certificate the server cannot be reached.
    let output = tokio::task::spawn_blocking(move || {
        let bare: Vec<&str> =
            train.iter().map(String::as_str).filter(|word| !word.contains("client-") && !word.contains("own.")).collect();
        failed(&bare, Some(&trainer))
    });
    assert!(with_timeout(output).await.unwrap().contains("cannot reach https://localhost"));
}

#[tokio::test(flavor = "multi_thread")]
async fn sighup_reloads_certificates() {
    let dir = tempfile::tempdir().unwrap();
    let [first, second] = ["first", "second"].map(tls::Authority::new);
    let [early, late] = ["early", "late"].map(tls::Authority::new);
    let (of_early, of_late) = (early.issue(), late.issue());
    let files = tls::write(dir.path(), &first.issue(), Some(&early));
    let (cert, key, client_ca) = (text(&files.cert), text(&files.key), text(files.client_ca.as_ref().unwrap()));
    let flags = ["--tls-cert", cert, "--tls-key", key, "--tls-client-ca", client_ca];
    let mut process = Process::start(tempfile::tempdir().unwrap(), &flags);
    let url = format!("https://{}/livez", process.address("http"));
    let old = tls::caller(&first, Some(&of_early));
    assert_eq!(tls::get(&old, false, &url).await.unwrap().0, 200);
    let open = tls::channel(&old, process.address("grpc")).await.unwrap();
    tls::policies(open.clone()).await.unwrap();

    let fresh = second.issue();
    tls::write(dir.path(), &fresh, Some(&late));
    process.signal("HUP");
    process.says("TLS certificates reloaded");
    let new = tls::caller(&second, Some(&of_late));
    assert_eq!(tls::get(&new, false, &url).await.unwrap().0, 200);
    tls::policies(tls::channel(&new, process.address("grpc")).await.unwrap()).await.unwrap();
    // Open connections continue; new connections with the old certificates are refused.
    tls::policies(open.clone()).await.unwrap();
    assert!(tls::get(&tls::caller(&first, Some(&of_late)), false, &url).await.is_err());
    assert!(tls::get(&tls::caller(&second, Some(&of_early)), false, &url).await.is_err());

    for (file, garbage) in [(&files.key, "no key"), (&files.cert, ""), (files.client_ca.as_ref().unwrap(), "nobody")] {
        let good = std::fs::read(file).unwrap();
        std::fs::write(file, garbage).unwrap();
        process.signal("HUP");
        process.says("cannot reload TLS certificates");
        assert!(process.log.last().unwrap().contains(text(file)), "{:?}", process.log.last());
        assert_eq!(tls::get(&new, false, &url).await.unwrap().0, 200);
        std::fs::write(file, good).unwrap();
    }
    tls::policies(open).await.unwrap();
    let log = process.end();
    assert!(!log.contains("PRIVATE KEY") && !log.contains(fresh.key.lines().nth(1).unwrap()));
}

/// What a command that must fail prints.
fn refused(command: &mut Command) -> String {
    let output = command.output().unwrap();
    assert!(!output.status.success(), "{output:?}");
    String::from_utf8(output.stderr).unwrap()
}

#[tokio::test]
async fn missing_permissions_are_named_with_the_user() {
    let (dir, program) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let data = dir.path().join("data");
    std::fs::create_dir(&data).unwrap();
    qedgix::store::Store::open(&data).await.unwrap().close().await;
    // Other users may not search the directory of the build.
    let copy = program.path().join("qedgix");
    std::fs::copy(PROGRAM, &copy).unwrap();
    for (path, mode) in [(dir.path(), 0o755), (program.path(), 0o755), (data.as_path(), 0o700)] {
        std::fs::set_permissions(path, std::fs::Permissions::from_mode(mode)).unwrap();
    }
    let as_other = |words: &[&str]| {
        let mut command = Command::new(&copy);
        command.args(words).arg("--data-dir").arg(&data).current_dir("/").uid(4_000_000).gid(4_000_000);
        command
    };
    if as_other(&["--version"]).output().is_err() {
        println!("skipped: needs root");
        return;
    }
    let expected = format!("permission denied: {} (this process runs as user 4000000)", data.join("qedgix.sqlite").display());
    let commands: [&[&str]; 3] =
        [&["keys", "list"], &["keys", "create", "--name", "k", "--scopes", "read"], &["backup", "/tmp/b"]];
    for words in commands {
        for mode in [0o700, 0o755] {
            std::fs::set_permissions(&data, std::fs::Permissions::from_mode(mode)).unwrap();
            let text = refused(&mut as_other(words));
            assert!(text.contains(&expected), "{words:?}, {mode:o}: {text}");
        }
    }
}

#[tokio::test]
async fn the_limit_of_open_files_is_no_error_of_the_disk() {
    let dir = tempfile::tempdir().unwrap();
    qedgix::store::Store::open(dir.path()).await.unwrap().close().await;
    let mut named = 0;
    // The runtime needs some files, and SQLite a few more.
    for files in 3..40 {
        let mut command = Command::new("sh");
        command.args(["-c", &format!("ulimit -n {files}; exec \"$0\" keys list --data-dir \"$1\""), PROGRAM]).arg(dir.path());
        let text = String::from_utf8_lossy(&command.output().unwrap().stderr).into_owned();
        assert!(!text.contains("error of the disk") && !text.contains("the disk of the database"), "{files}: {text}");
        assert!(!text.contains("code: 14"), "{files}: {text}");
        named += usize::from(text.contains("too many files and connections are open"));
    }
    assert!(named > 0);
}
