//! `qedgix train` in its own process: it loses no work when it is stopped or killed, or when a file cannot be written.

use std::fs;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, ChildStderr, Command, Output, Stdio};

use super::process::{PROGRAM, signal};

/// A run of a few seconds with many evaluations.
const RUN: [&str; 14] = [
    "--algorithm",
    "vdn",
    "--uavs",
    "2",
    "--users",
    "3",
    "--slots",
    "20",
    "--steps",
    "1.6e4",
    "--set",
    "training.batch=16",
    "--set",
    "training.eval_every=2_000",
];

fn train(dir: &Path, words: &[&str]) -> Command {
    let mut command = Command::new(PROGRAM);
    command.current_dir(dir).args(["train", "--threads", "1"]).args(words).stdin(Stdio::null());
    command
}

fn run(dir: &Path, words: &[&str]) -> (Option<i32>, String) {
    let Output { status, stdout, stderr } = train(dir, words).output().unwrap();
    (status.code(), String::from_utf8([stdout, stderr].concat()).unwrap())
}

/// A run in progress, and its standard error.
struct Running {
    child: Child,
    lines: std::io::Lines<BufReader<ChildStderr>>,
}

impl Running {
    /// Starts a run and waits until it has evaluated at a step after the first.
    fn start(dir: &Path, words: &[&str]) -> Self {
        let mut child = train(dir, words).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
        let lines = BufReader::new(child.stderr.take().unwrap()).lines();
        let mut running = Self { child, lines };
        running.read_until("step     2080");
        running
    }

    fn read_until(&mut self, text: &str) {
        let mut read = String::new();
        for line in &mut self.lines {
            let line = line.unwrap();
            if line.contains(text) {
                return;
            }
            read = read + &line + "\n";
        }
        panic!("the run ended without {text:?}: {read}");
    }

    /// Sends a signal and returns the exit status and the rest of standard error.
    fn end(mut self, name: &str) -> (Option<i32>, String) {
        assert!(signal(name, self.child.id()));
        self.rest()
    }

    fn rest(&mut self) -> (Option<i32>, String) {
        let rest: Vec<String> = self.lines.by_ref().map(Result::unwrap).collect();
        (self.child.wait().unwrap().code(), rest.join("\n"))
    }
}

fn words<'a>(more: &[&'a str]) -> Vec<&'a str> {
    RUN.iter().chain(more).copied().collect()
}

fn file(dir: &Path, name: &str) -> Vec<u8> {
    fs::read(dir.join(name)).unwrap_or_else(|e| panic!("{name}: {e}"))
}

#[test]
fn a_run_that_is_stopped_or_killed_continues_with_the_same_bits() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let (code, output) = run(dir, &words(&["--out", "whole.safetensors", "--metrics", "whole.csv"]));
    assert_eq!(code, Some(0), "{output}");
    assert!(!dir.join("whole.safetensors.snapshot").exists(), "a run that is finished needs no snapshot");
    let part = ["--out", "part.safetensors", "--metrics", "part.csv", "--snapshot-every", "0"];
    let resume = ["--resume", "part.safetensors.snapshot", "--metrics", "part.csv", "--snapshot-every", "0"];
    for name in ["TERM", "INT", "KILL"] {
        let (code, rest) = Running::start(dir, &words(&part)).end(name);
        let expected = match name {
            "TERM" => Some(143),
            "INT" => Some(130),
            _ => None,
        };
        assert_eq!(code, expected, "{name}: {rest}");
        if expected.is_some() {
            assert!(rest.contains("--resume part.safetensors.snapshot --out part.safetensors --metrics part.csv"), "{rest}");
        }
        assert!(dir.join("part.safetensors").exists(), "{name}: the best weights so far are written");
        // The same flags may be repeated.
        let flags = if name == "INT" { words(&resume) } else { resume.to_vec() };
        let (code, output) = run(dir, &flags);
        assert_eq!(code, Some(0), "{name}: {output}");
        for (part, whole) in [("part.safetensors", "whole.safetensors"), ("part.csv", "whole.csv")] {
            assert!(file(dir, part) == file(dir, whole), "{name}: {part} differs from an uninterrupted run");
        }
        assert!(!dir.join("part.safetensors.snapshot").exists());
    }
}

#[test]
fn a_snapshot_that_cannot_be_written_does_not_end_the_run() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let mut running = Running::start(dir, &words(&["--snapshot", "run.snapshot", "--snapshot-every", "0"]));
    // The file that is written first cannot be opened any more, and later it can again.
    let partial = dir.join("run.snapshot.partial");
    while fs::create_dir(&partial).is_err() {}
    running.read_until("warning: cannot write run.snapshot");
    fs::remove_dir(&partial).unwrap();
    running.read_until("run.snapshot is written again");
    let (code, rest) = running.rest();
    assert_eq!(code, Some(0), "{rest}");
    assert!(dir.join("policy.safetensors").exists() && !dir.join("run.snapshot").exists());
}

#[test]
fn what_cannot_work_is_refused_before_the_first_step() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let (code, _) = Running::start(dir, &words(&["--out", "old.safetensors"])).end("INT");
    assert_eq!(code, Some(130));
    fs::write(dir.join("notes.csv"), "remember the milk\n").unwrap();
    fs::create_dir(dir.join("directory")).unwrap();
    let resume = |more: &[&'static str]| [&["--resume", "old.safetensors.snapshot"], more].concat();
    let before = (file(dir, "old.safetensors.snapshot"), file(dir, "old.safetensors"));
    for (flags, says) in [
        (vec!["--out", "missing/policy.safetensors"], "--out: cannot write missing/policy.safetensors"),
        (vec!["--out", "directory"], "--out"),
        (vec!["--metrics", "directory"], "--metrics"),
        (vec!["--snapshot", "missing/run.snapshot"], "--snapshot"),
        (vec!["--metrics", "policy.safetensors"], "--metrics policy.safetensors: the file of --out"),
        (vec!["--out", "old.safetensors"], "--overwrite"),
        (vec!["--resume", "notes.csv"], "--resume notes.csv"),
        (resume(&["--algorithm", "qmix"]), "algorithm: got \"qmix\""),
        (resume(&["--steps", "5e4"]), "training.steps: got 50000, expected 16000"),
        (resume(&["--set", "environment.M=3"]), "environment.uavs"),
        (resume(&["--seed", "2"]), "seed"),
        (resume(&["--set", "training.bach=2"]), "training.bach"),
        (resume(&["--metrics", "notes.csv"]), "--metrics notes.csv"),
        (resume(&["--metrics", "old.safetensors.snapshot"]), "--metrics"),
        (vec!["--steps", "1.5"], "--steps"),
    ] {
        let (code, output) = run(dir, &flags);
        assert!(matches!(code, Some(1 | 2)), "{flags:?}: {output}");
        assert!(output.contains(says) && !output.contains("mean AoI"), "{flags:?}: {output}");
    }
    assert_eq!(before, (file(dir, "old.safetensors.snapshot"), file(dir, "old.safetensors")));
    assert_eq!(file(dir, "notes.csv"), b"remember the milk\n");
    let (code, output) = run(dir, &["--out", "old.safetensors", "--overwrite", "--steps", "1_0", "--slots", "10"]);
    assert_eq!(code, Some(0), "{output}");
}
