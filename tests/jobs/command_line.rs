//! `qedgix jobs` and `qedgix train --server` against a real server process with real workers.

use std::fs;
use std::path::Path;
use std::process::Stdio;

use serde_json::{Value, json};
use tokio::io::{AsyncBufReadExt, BufReader};
use tokio::process::Command;

use super::harness::{Rest, tiny, within};
use super::process::{POLL, PROGRAM, Process, serve, signal, workers};

/// A server with one thread for jobs, and the command line that talks to it.
struct Bed {
    process: Process,
    rest: Rest,
    dir: tempfile::TempDir,
}

struct Printed {
    code: Option<i32>,
    out: String,
    err: String,
}

impl Bed {
    async fn start() -> Self {
        let dir = tempfile::tempdir().unwrap();
        let mut command = serve(&dir.path().join("data"));
        command.args(["--cpu-budget", "1", "--snapshot-every", "0.05", "--max-attempts", "1"]);
        let process = Process::start(command).await;
        let rest = Rest::new(format!("http://{}", process.http));
        Self { process, rest, dir }
    }

    /// Kills the server and starts it again on the same ports.
    async fn restart(&mut self) {
        self.process.kill();
        let data = self.dir.path().join("data");
        let mut command = std::process::Command::new(PROGRAM);
        command.args(["serve", "--cpu-budget", "1", "--http-addr", &self.process.http, "--grpc-addr", &self.process.grpc]);
        self.process = Process::start(with_data_dir(command, &data)).await;
    }

    fn command(&self, words: &[&str]) -> Command {
        let mut command = Command::new(PROGRAM);
        command.args(words).env("QEDGIX_SERVER", &self.process.http).current_dir(self.dir.path());
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped()).kill_on_drop(true);
        command
    }

    async fn run(&self, words: &[&str]) -> Printed {
        let output = within(self.command(words).output()).await.unwrap();
        let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
        Printed { code: output.status.code(), out: text(output.stdout), err: text(output.stderr) }
    }

    /// What a command prints that has to succeed.
    async fn ok(&self, words: &[&str]) -> String {
        let Printed { code, out, err } = self.run(words).await;
        assert_eq!(code, Some(0), "{words:?}: {out}{err}");
        out.trim_end().to_owned()
    }

    async fn json(&self, words: &[&str]) -> Value {
        serde_json::from_str(&self.ok(&[words, &["--json"]].concat()).await).unwrap()
    }

    fn file(&self, name: &str) -> Vec<u8> {
        fs::read(self.dir.path().join(name)).unwrap_or_else(|e| panic!("{name}: {e}"))
    }

    fn write(&self, name: &str, document: &Value) {
        fs::write(self.dir.path().join(name), document.to_string()).unwrap();
    }
}

fn with_data_dir(mut command: std::process::Command, data: &Path) -> std::process::Command {
    command.arg("--data-dir").arg(data);
    command
}

/// A job that does not end by itself during a test.
fn endless() -> Value {
    let mut job = tiny();
    job["training"]["steps"] = json!(1_000_000_000_u64);
    job["training"]["eval_every"] = json!(100_000);
    job
}

#[tokio::test(flavor = "multi_thread")]
async fn jobs_are_submitted_followed_compared_and_exported() {
    let bed = Bed::start().await;
    bed.write("tiny.json", &tiny());
    let mut ids = Vec::new();
    for seed in ["1", "2"] {
        let words = ["jobs", "submit", "--file", "tiny.json", "--seed", seed, "--name", "mine", "--label", "set=a"];
        ids.push(bed.ok(&words).await);
        let watched = bed.ok(&["jobs", "watch", &ids[ids.len() - 1]]).await;
        assert!(watched.contains("running") && watched.contains("step      400") && watched.ends_with("succeeded"), "{watched}");
    }
    let events = bed.ok(&["jobs", "watch", &ids[0], "--json"]).await;
    let events: Vec<Value> = events.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(events.last().unwrap()["data"]["state"], "succeeded");

    let shown = bed.json(&["jobs", "show", &ids[0]]).await;
    assert_eq!((&shown["id"], &shown["labels"]["set"], &shown["seed"]), (&json!(ids[0]), &json!("a"), &json!(1)));
    // Ids begin with their time, so a beginning that ends within the random part is unique.
    assert_eq!(bed.json(&["jobs", "show", &ids[0][..30].to_uppercase()]).await["id"], json!(ids[0]));
    assert!(bed.ok(&["jobs", "show", &ids[0]]).await.contains("training.gamma"));
    let logs = bed.ok(&["jobs", "logs", "-f", &ids[0]]).await;
    assert_eq!(logs, bed.ok(&["jobs", "logs", &ids[0]]).await);
    assert_eq!(bed.json(&["jobs", "logs", &ids[0], "--attempt", "1"]).await["attempts"].as_array().unwrap().len(), 1);

    let compared = bed.json(&["jobs", "compare", &ids[0], &ids[1], "--svg", "curves.svg"]).await;
    let group = &compared["groups"][0];
    assert_eq!((&group["seeds"], compared["groups"].as_array().unwrap().len()), (&json!([1, 2]), 1), "{compared}");
    let [low, high] = [0, 1].map(|i| group["best"]["interval"][i].as_f64().unwrap());
    let best: Vec<f64> = compared["jobs"].as_array().unwrap().iter().map(|job| job["best"][1].as_f64().unwrap()).collect();
    assert!((low + high - best[0] - best[1]).abs() < 1e-9, "{compared}");
    assert!(String::from_utf8(bed.file("curves.svg")).unwrap().contains("2 seeds"));
    let compared = bed.json(&["jobs", "compare", &ids[0], "--svg", "one.svg", "--figures", "pdf,png"]).await;
    assert_eq!(compared["figures"], json!(["one.pdf", "one.png"]));
    assert!(bed.file("one.pdf").starts_with(b"%PDF") && bed.file("one.png").starts_with(b"\x89PNG"));

    bed.ok(&["jobs", "export", &ids[0], "--out", "exported"]).await;
    let digests = bed.rest.digests(&ids[0]).await;
    for kind in ["best", "last"] {
        assert_eq!(qedgix::checkpoint::digest(&bed.file(&format!("exported/{kind}.safetensors"))), digests[kind]);
    }
    assert_eq!(bed.file("exported/metrics.csv").split(|&byte| byte == b'\n').count() - 1, bed.rest.rows(&ids[0]).await.len() + 1);
    // What is exported can be submitted again.
    let again = bed.ok(&["jobs", "submit", "--file", "exported/config.json", "--watch"]).await;
    assert!(again.ends_with("succeeded"), "{again}");
    let newest = bed.rest.get("/v1/jobs?page_size=1").await["jobs"][0]["id"].as_str().unwrap().to_owned();
    assert_eq!(bed.rest.digests(&newest).await, digests);

    // A sweep means its jobs, and has a result.
    let mut sweep = tiny();
    (sweep["kind"], sweep["sweep"]) = (json!("sweep"), json!({"grid": {"training.gamma": [0.5, 0.9]}, "seeds": 2}));
    bed.write("sweep.json", &sweep);
    let limits = ["--after", &ids[0], "--timeout", "10m", "--memory", "2G"];
    bed.ok(&[&["jobs", "submit", "--file", "sweep.json", "--name", "gammas", "--watch"][..], &limits[..]].concat()).await;
    let shown = bed.json(&["jobs", "show", "gammas"]).await;
    assert_eq!((&shown["after"], &shown["timeout"], &shown["memory"]), (&json!([ids[0]]), &json!(600), &json!(2_u64 << 30)));
    let compared = bed.json(&["jobs", "compare", "gammas"]).await;
    let groups = compared["groups"].as_array().unwrap();
    assert_eq!((compared["jobs"].as_array().unwrap().len(), groups.len()), (4, 2));
    assert!(groups.iter().all(|group| group["best"]["interval"].is_array()), "{compared}");
    bed.ok(&["jobs", "export", "gammas", "--out", "sweep"]).await;
    let result: Value = serde_json::from_slice(&bed.file("sweep/result.json")).unwrap();
    assert_eq!(result["states"], json!({"succeeded": 4}));

    bed.ok(&["jobs", "delete", &ids[0], &ids[1]]).await;
    for (words, says) in [
        (["jobs", "show", &ids[0]], "(not_found)"),
        (["jobs", "watch", "nonsense"], "no such job"),
        (["jobs", "cancel", "01ff"], "no such job"),
        (["jobs", "pause", &newest], "(wrong_state)"),
        (["jobs", "submit", "--webhook=http://127.0.0.1/"], "webhooks[0].url"),
    ] {
        let Printed { code, err, .. } = bed.run(&words).await;
        assert_eq!((code, err.contains(says)), (Some(1), true), "{words:?}: {err}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn jobs_are_listed_paused_resumed_and_cancelled() {
    let bed = Bed::start().await;
    bed.write("endless.json", &endless());
    let submit = ["jobs", "submit", "--file", "endless.json", "--label", "set=b"];
    let (first, second) = (bed.ok(&submit).await, bed.ok(&submit).await);
    bed.rest.reaches(&first, "running").await;
    let Printed { code, err, .. } = bed.run(&["jobs", "show", "0"]).await;
    assert!(code == Some(1) && err.contains(&first) && err.contains(&second), "both jobs begin like this: {err}");

    let listed = bed.json(&["jobs", "list", "--state", "queued", "--label", "set=b", "--kind", "train"]).await;
    assert_eq!(listed["jobs"].as_array().unwrap().iter().map(|job| &job["id"]).collect::<Vec<_>>(), [&json!(second)]);
    let table = bed.ok(&["jobs", "list", "--since", "1d", "--sort", "last:loss"]).await;
    assert!(!bed.ok(&["jobs", "list", "--until", "1d"]).await.contains("running"));
    assert!(table.contains("running") && table.contains("queued") && table.contains("train vdn"), "{table}");

    assert!(bed.ok(&["jobs", "pause", &second]).await.contains("paused"));
    assert!(bed.ok(&["jobs", "resume", &second]).await.contains("queued"));
    let watching = bed.command(&["jobs", "watch", &first]).spawn().unwrap();
    bed.ok(&["jobs", "cancel", &first, &second]).await;
    let watched = within(watching.wait_with_output()).await.unwrap();
    assert_eq!(watched.status.code(), Some(4), "{}", String::from_utf8_lossy(&watched.stderr));
    bed.rest.reaches(&first, "cancelled").await;
}

/// A run of about a second, as flags.
const RUN: [&str; 17] = [
    "train",
    "--algorithm",
    "vdn",
    "--uavs",
    "2",
    "--users",
    "3",
    "--slots",
    "20",
    "--steps",
    "2e4",
    "--set",
    "training.batch=16",
    "--set",
    "training.eval_every=2000",
    "--set",
    "training.eval_episodes=8",
];

#[tokio::test(flavor = "multi_thread")]
async fn a_run_on_a_server_survives_its_restart_and_gives_the_files_of_a_local_run() {
    let mut bed = Bed::start().await;
    let flags = &RUN[..];
    let local = [flags, &["--out", "local.safetensors"]].concat();
    let mut command = bed.command(&local);
    let output = within(command.env_remove("QEDGIX_SERVER").output()).await.unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));

    let address = bed.process.http.clone();
    let remote = [flags, &["--out", "remote.safetensors", "--metrics", "remote.csv", "--server", &address]].concat();
    let mut child = bed.command(&remote).spawn().unwrap();
    let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
    within(async { while !lines.next_line().await.unwrap().expect("the command follows the job").contains("step     2080") {} })
        .await;
    bed.restart().await;
    let mut rest = String::new();
    while let Some(line) = within(lines.next_line()).await.unwrap() {
        rest = rest + &line + "\n";
    }
    let output = within(child.wait_with_output()).await.unwrap();
    let out = String::from_utf8(output.stdout).unwrap();
    assert_eq!(output.status.code(), Some(0), "{out}{rest}");
    assert!(out.starts_with("job ") && out.contains("best weights by validation"), "{out}");
    assert!(bed.file("remote.safetensors") == bed.file("local.safetensors"), "the same command gives the same weights");
    let csv = String::from_utf8(bed.file("remote.csv")).unwrap();
    assert!(csv.starts_with("step,name,value\n0,") && csv.contains("\n20000,eval/mean_aoi,"), "{csv}");

    let Printed { code, err, .. } = bed.run(&["jobs", "list", "--server", &bed.process.grpc]).await;
    assert!(code == Some(1) && err.contains("is the gRPC port"), "{err}");
    let evaluate = ["evaluate", "--policy", "sweep", "--episodes", "1", "--server", &bed.process.http];
    let Printed { code, err, .. } = bed.run(&evaluate).await;
    assert!(code == Some(1) && err.contains("is the REST port"), "{err}");
    for refused in [&["--snapshot", "x"][..], &["--resume", "x"], &["--overwrite"], &["--out", "missing/x"]] {
        let Printed { code, err, .. } = bed.run(&[flags, refused].concat()).await;
        assert!(matches!(code, Some(1 | 2)), "{refused:?}: {err}");
    }
    assert_eq!(bed.rest.get("/v1/jobs").await["jobs"].as_array().unwrap().len(), 1, "what is refused makes no job");
}

#[tokio::test(flavor = "multi_thread")]
async fn exit_statuses_tell_that_a_job_goes_on_or_failed() {
    let bed = Bed::start().await;
    for (name, code) in [("INT", 130), ("TERM", 143)] {
        let words = ["train", "--algorithm", "vdn", "--slots", "10", "--steps", "1e9", "--set", "training.eval_episodes=2"];
        let mut child = bed.command(&words).spawn().unwrap();
        let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
        let id = within(lines.next_line()).await.unwrap().unwrap().strip_prefix("job ").unwrap().to_owned();
        bed.rest.reaches(&id, "running").await;
        let mut errors = BufReader::new(child.stderr.take().unwrap()).lines();
        within(async { while !errors.next_line().await.unwrap().expect("it follows").contains("running") {} }).await;
        assert!(signal(name, child.id().unwrap()));
        assert_eq!(within(child.wait()).await.unwrap().code(), Some(code));
        assert_eq!(bed.rest.state(&id).await, "running");
        bed.ok(&["jobs", "cancel", &id]).await;
        bed.rest.reaches(&id, "cancelled").await;
    }
    bed.write("endless.json", &endless());
    let id = bed.ok(&["jobs", "submit", "--file", "endless.json"]).await;
    let watching = bed.command(&["jobs", "watch", &id]).spawn().unwrap();
    within(async {
        while !workers(&id).into_iter().any(|worker| signal("KILL", worker)) {
            tokio::time::sleep(POLL).await;
        }
    })
    .await;
    let watched = within(watching.wait_with_output()).await.unwrap();
    assert_eq!(watched.status.code(), Some(3), "{}", String::from_utf8_lossy(&watched.stderr));
}

/// The fields of a job that decide what it does, and those of the jobs that it has made.
async fn what_it_does(bed: &Bed, id: &str) -> Value {
    let fields = |job: &Value| {
        let fields = [
            "kind",
            "labels",
            "notes",
            "threads",
            "priority",
            "max_attempts",
            "timeout",
            "backoff",
            "memory",
            "stop",
            "init",
            "publish",
            "algorithm",
            "preset",
            "environment",
            "training",
            "evaluation",
            "experiment",
            "seed",
            "point",
        ];
        fields.map(|field| job[field].clone())
    };
    let mut all = vec![fields(&bed.json(&["jobs", "show", id]).await)];
    let made = bed.rest.get(&format!("/v1/jobs?parent={id}&sort=created")).await["jobs"].clone();
    for job in made.as_array().unwrap() {
        all.push(fields(&bed.json(&["jobs", "show", job["id"].as_str().unwrap()]).await));
    }
    json!(all)
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_exported_of_every_kind_runs_the_same_jobs_again() {
    let bed = Bed::start().await;
    let start = json!({"name": "weights", "stop": {"metric": "eval/mean_aoi", "at_most": 1e9}});
    bed.write("job.json", &super::harness::with(&start));
    bed.ok(&["jobs", "submit", "--file", "job.json", "--watch"]).await;
    let swept =
        |sweep: Value| super::harness::with(&json!({"kind": "sweep", "seed": 7, "init": {"policy": "weights"}, "sweep": sweep}));
    let lost = json!({"policies": ["sweep"], "episodes": 2, "lose": {"uav": 1, "slot": 20}, "position_noise": 0.02});
    let planned = json!({"policies": ["sweep"], "episodes": 2, "plan": {"target_p95": 70, "max_uavs": 2, "failures": true}});
    let runs = json!({
        "title": "t", "figure": "parameter", "seeds": [1, 2], "episodes": 2, "layouts": "valid-v1", "baselines": ["sweep"],
        "run": {"environment": {"uavs": 2, "slots": 8}, "training": {"steps": 200, "eval_every": 200, "eval_episodes": 2}},
        "series": [{"name": "VDN", "algorithm": "vdn"}], "points": [{"name": "2 users", "x": 2, "environment": {"users": 2}}],
    });
    for (name, request) in [
        ("train", super::harness::with(&json!({"seed": 3, "init": {"policy": "weights"}, "priority": 2, "labels": {"a": "b"}}))),
        ("evaluate", json!({"kind": "evaluate", "environment": {"users": 3}, "evaluation": lost})),
        ("mixed", json!({"kind": "evaluate", "evaluation": {"policies": ["sweep"], "episodes": 1, "layouts": "eval-mixed-v2"}})),
        ("plan", json!({"kind": "evaluate", "environment": {"users": 12}, "evaluation": planned})),
        ("grid", swept(json!({"grid": {"training.gamma": [0.5, 0.9], "training.buffer": [20, 30]}, "seeds": 2}))),
        ("random", swept(json!({"random": {"samples": 2, "fields": {"training.gamma": {"low": 0.5, "high": 0.9}}}}))),
        ("experiment", json!({"kind": "experiment", "experiment": runs})),
    ] {
        bed.write("job.json", &request);
        let id = bed.ok(&["jobs", "submit", "--file", "job.json"]).await;
        bed.ok(&["jobs", "export", &id, "--out", name]).await;
        let again = bed.ok(&["jobs", "submit", "--file", &format!("{name}/config.json")]).await;
        assert_eq!(what_it_does(&bed, &again).await, what_it_does(&bed, &id).await, "{name}");
    }
}
