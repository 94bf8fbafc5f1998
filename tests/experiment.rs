//! `qedgix experiment`: an interrupted and resumed experiment gives the same results; errors are reported before the first run.

use std::fs;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;

const TINY: &str = r#"
title = "Tiny"
figure = "parameter"
x = "users"
seeds = [1, 2]
layouts = "valid-v1"
episodes = 6
baselines = ["sweep", "random"]

[run]
preset = "practical"
environment = { uavs = 2, slots = 8 }
training = { steps = 600, eval_every = 200, eval_episodes = 4, batch = 8, buffer = 32, layers = 1 }

[[series]]
name = "Qedgix"
algorithm = "qedgix"

[[series]]
name = "QMIX"
algorithm = "qmix"
training = { learning_rate = 2e-3 }

[[points]]
name = "2 users"
x = 2
environment = { users = 2 }

[[points]]
name = "3 users"
x = 3
environment = { users = 3 }
"#;

fn qedgix(dir: &Path, words: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_qedgix"));
    command.current_dir(dir).arg("experiment").args(words).stdin(Stdio::null());
    command
}

fn run(dir: &Path, words: &[&str]) -> Output {
    qedgix(dir, words).output().unwrap()
}

fn run_successfully(dir: &Path, words: &[&str]) -> String {
    let output = run(dir, words);
    let (out, err) = (String::from_utf8(output.stdout).unwrap(), String::from_utf8(output.stderr).unwrap());
    assert!(output.status.success(), "{words:?}: {out}\n{err}");
    out + &err
}

fn directory_with(toml: &str) -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    fs::write(dir.path().join("tiny.toml"), toml).unwrap();
    dir
}

fn read(dir: &Path, name: &str) -> String {
    fs::read_to_string(dir.join(name)).unwrap_or_else(|e| panic!("{name}: {e}"))
}

/// All files below `dir` by path, except those that contain times and those that a killed process left.
fn files(dir: &Path) -> Vec<(String, Vec<u8>)> {
    let mut found = Vec::new();
    let mut left = vec![dir.to_path_buf()];
    while let Some(path) = left.pop() {
        if path.is_dir() {
            left.extend(fs::read_dir(path).unwrap().map(|entry| entry.unwrap().path()));
            continue;
        }
        let name = path.strip_prefix(dir).unwrap().display().to_string();
        if !["timing.json", "result.json", "progress.json", ".partial"].iter().any(|timed| name.ends_with(timed)) {
            found.push((name, fs::read(path).unwrap()));
        }
    }
    found.sort();
    found
}

#[test]
fn an_interrupted_experiment_gives_the_same_results() {
    let dir = directory_with(TINY);
    let whole = run_successfully(dir.path(), &["tiny.toml", "--threads", "3"]);
    assert!(whole.contains("Qedgix, 2 users, seed 2: step"), "{whole}");
    let out = dir.path().join("results/tiny");
    let results: Value = serde_json::from_str(&read(&out, "results.json")).unwrap();
    assert_eq!(results["runs"].as_array().unwrap().len(), 8);
    assert_eq!(results["rows"].as_array().unwrap().len(), 4);
    assert_eq!(results["baselines"].as_array().unwrap().len(), 4);
    // Per point: one pair of series, and each with two baselines.
    assert_eq!(results["differences"].as_array().unwrap().len(), 10);
    let first = &results["rows"][0];
    let mean = |path: &Value| path["mean"].as_f64().unwrap();
    assert!(first["mean_aoi"]["low"].as_f64().unwrap() <= mean(&first["mean_aoi"]));
    let per_seed = first["per_seed"].as_array().unwrap();
    let average = per_seed.iter().map(|seed| seed.as_f64().unwrap()).sum::<f64>() / 2.0;
    assert!((average - mean(&first["mean_aoi"])).abs() < 1e-9);
    let page = read(&out, "README.md");
    for part in ["qedgix experiment tiny.toml", "Qedgix", "sweep", "seed 2", "![parameter.svg]"] {
        assert!(page.contains(part), "{part}: {page}");
    }
    assert!(read(&out, "parameter.svg").starts_with("<svg"));

    // Killed several times at arbitrary points, then run to the end.
    for wait in [20, 60, 120, 200] {
        let mut child = qedgix(dir.path(), &["tiny.toml", "--out", "again", "--threads", "2"])
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let deadline = Instant::now() + Duration::from_millis(wait);
        while Instant::now() < deadline && child.try_wait().unwrap().is_none() {
            std::thread::sleep(Duration::from_millis(5));
        }
        let _ = child.kill();
        child.wait().unwrap();
    }
    run_successfully(dir.path(), &["tiny.toml", "--out", "again", "--threads", "1"]);
    let (whole, again) = (files(&out), files(&dir.path().join("again")));
    assert!(!names(&whole).iter().any(|name| name.contains("snapshot")));
    assert_eq!(names(&whole), names(&again));
    for ((name, a), (_, b)) in whole.iter().zip(&again) {
        assert!(a == b, "{name} differs");
    }

    // Finished runs are not trained again. With more layouts, their weights are evaluated again.
    let second = run_successfully(dir.path(), &["tiny.toml"]);
    assert!(!second.contains("step 0"), "{second}");
    fs::write(dir.path().join("tiny.toml"), TINY.replace("episodes = 6", "episodes = 9")).unwrap();
    let more = run_successfully(dir.path(), &["tiny.toml"]);
    assert!(!more.contains("step 0"), "{more}");
    let results: Value = serde_json::from_str(&read(&out, "results.json")).unwrap();
    assert_eq!(results["runs"][0]["per_layout"].as_array().unwrap().len(), 9);
}

fn names(files: &[(String, Vec<u8>)]) -> Vec<&str> {
    files.iter().map(|(name, _)| name.as_str()).collect()
}

#[test]
fn convergence_and_trajectories_are_plotted() {
    let convergence = TINY.replace("\"parameter\"", "\"convergence\"");
    let dir = directory_with(&convergence);
    run_successfully(dir.path(), &["tiny.toml", "--out", "c", "--steps", "200"]);
    for name in ["convergence-2-users.svg", "reached-2-users.svg", "convergence-3-users.svg"] {
        assert!(read(&dir.path().join("c"), name).contains("Qedgix"), "{name}");
    }
    fs::write(dir.path().join("tiny.toml"), TINY.replace("\"parameter\"", "\"trajectories\"")).unwrap();
    // The same runs with another plot: nothing is trained.
    let out = run_successfully(dir.path(), &["tiny.toml", "--out", "c", "--steps", "200"]);
    assert!(!out.contains("step 0"), "{out}");
    for name in ["trajectories-qedgix-2-users.svg", "trajectories-qmix-3-users.svg"] {
        assert!(read(&dir.path().join("c"), name).starts_with("<svg"), "{name}");
    }
}

#[test]
fn a_dry_run_lists_the_runs_without_running_them() {
    let dir = directory_with(TINY);
    let listed = run_successfully(dir.path(), &["tiny.toml", "--dry-run", "--seeds", "7,8,9"]);
    assert_eq!(listed.lines().filter(|line| line.contains("to do")).count(), 12, "{listed}");
    assert!(listed.contains("QMIX, 3 users, seed 9"), "{listed}");
    assert!(!dir.path().join("results").exists());
    for (number, seeds) in [("1", "1"), ("4", "1,2,3,4")] {
        let first = run_successfully(dir.path(), &["tiny.toml", "--dry-run", "--num-seeds", number]);
        assert_eq!(first, run_successfully(dir.path(), &["tiny.toml", "--dry-run", "--seeds", seeds]));
    }
    let other = run_successfully(dir.path(), &["tiny.toml", "--dry-run", "--seeds", "7", "--set", "training.gamma=0.9"]);
    let folder = |text: &str| text.lines().nth(1).unwrap().rsplit(' ').next().unwrap().to_owned();
    assert_ne!(folder(&listed), folder(&other), "another configuration has another folder");
}

#[test]
fn errors_name_the_file_the_table_and_the_field() {
    for (from, to, hint) in [
        ("seeds = [1, 2]", "seeds = [1, 1]", "seeds"),
        ("seeds = [1, 2]", "sedes = [1, 2]", "sedes"),
        ("\"parameter\"", "\"pie\"", "figure"),
        ("\"valid-v1\"", "\"valid-v0\"", "layouts"),
        ("episodes = 6", "episodes = 0", "episodes"),
        ("\"random\"", "\"rundom\"", "baselines[1]"),
        ("algorithm = \"qmix\"", "algorithm = \"ppo\"", "series[1].algorithm"),
        ("name = \"QMIX\"", "name = \"Qedgix\"", "series[1].name: got \"Qedgix\", expected another name than series[0] has"),
        (
            "algorithm = \"qmix\"\ntraining = { learning_rate = 2e-3 }",
            "algorithm = \"qedgix\"",
            "series: got \"QMIX\", with the settings of \"Qedgix\"",
        ),
        ("users = 3", "users = 2", "points: got \"3 users\", with the settings of \"2 users\""),
        ("x = \"users\"", "x = \"users\"\nx_scale = \"sqrt\"", "x_scale"),
        ("x = 3", "x = nan", "points[1].x: got NaN, expected a finite number"),
        ("learning_rate = 2e-3", "learning_rate = nan", "series[1].training.learning_rate: got NaN, expected a finite number"),
        ("learning_rate = 2e-3", "learning_rate = 2026-01-01", "learning_rate: got 2026-01-01, expected a number"),
        ("steps = 600", "steps = 600.5", "run.training.steps: got 600.5"),
        ("learning_rate = 2e-3", "learning_rate = 2", "series[1].training.learning_rate"),
        ("learning_rate = 2e-3", "learningrate = 2", "series[1].training.learningrate"),
        ("users = 3", "users = \"three\"", "points[1].environment.users"),
        ("slots = 8", "slots = 0", "run.environment.slots"),
        ("x = 3", "", "points[1].x"),
        ("x = 3", "y = 3", "points[1].y"),
        ("[run]", "[run", "line"),
    ] {
        assert!(TINY.contains(from), "{from}");
        let dir = directory_with(&TINY.replacen(from, to, 1));
        let output = run(dir.path(), &["tiny.toml"]);
        let message = String::from_utf8(output.stderr).unwrap();
        assert!(!output.status.success() && message.contains("tiny.toml") && message.contains(hint), "{to}: {message}");
        assert!(!dir.path().join("results").exists(), "{to}: no run is started");
    }
    let logarithmic = TINY.replacen("x = \"users\"", "x = \"users\"\nx_scale = \"log\"", 1);
    for (from, to, hint) in [
        ("x = 3", "x = 0", "points[1].x: got 0, expected a number above 0"),
        ("\"parameter\"", "\"convergence\"", "x_scale: got"),
    ] {
        let dir = directory_with(&logarithmic.replacen(from, to, 1));
        let message = String::from_utf8(run(dir.path(), &["tiny.toml"]).stderr).unwrap();
        assert!(message.contains(hint), "{to}: {message}");
    }
    let dir = directory_with(&TINY.replace("algorithm = \"qmix\"", "algorithm = \"qedgix\""));
    let message =
        String::from_utf8(run(dir.path(), &["tiny.toml", "--set", "training.learning_rate=1e-3", "--dry-run"]).stderr).unwrap();
    let expected = "training.learning_rate: got 0.001, expected a field that no series set";
    assert!(message.contains(expected) && message.contains("\"Qedgix\" and \"QMIX\""), "{message}");
    let dir = directory_with(TINY);
    for (words, hint) in [
        (vec!["tiny.toml", "--set", "training.bach=3"], "training.bach"),
        (vec!["tiny.toml", "--set", "bach=3"], "environment.FIELD"),
        (vec!["tiny.toml", "--steps", "0"], "training.steps"),
        (vec!["tiny.toml", "--set", "environment.users=3"], "points[0] sets it"),
        (vec!["tiny.toml", "--set", "environment.N=3", "--point", "3 users"], "on the command line, environment.N: got 3"),
        (vec!["tiny.toml", "--num-seeds", "0"], "--num-seeds"),
        (vec!["tiny.toml", "--num-seeds", "1", "--seeds", "1"], "--num-seeds"),
        (vec!["tiny.toml", "--series", "nobody"], "\"nobody\""),
        (vec!["tiny.toml", "--point", "nowhere"], "\"nowhere\""),
        (vec!["absent.toml"], "absent.toml"),
    ] {
        let message = String::from_utf8(run(dir.path(), &words).stderr).unwrap();
        assert!(message.contains(hint), "{words:?}: {message}");
    }
}

#[test]
fn names_that_differ_are_accepted_and_whole_numbers_are_written_as_people_write_them() {
    let plain = directory_with(TINY);
    let listed = run_successfully(plain.path(), &["tiny.toml", "--dry-run"]);
    let floats = TINY.replace("steps = 600", "steps = 6e2").replace("users = 3", "users = 3.0").replace("[1, 2]", "[1.0, 2]");
    let dir = directory_with(&floats.replace("episodes = 6", "episodes = 6.0"));
    assert_eq!(run_successfully(dir.path(), &["tiny.toml", "--dry-run"]), listed, "the same runs in the same folders");
    for (from, to) in [("QMIX", "Qedgix+"), ("QMIX", "qedgix"), ("2 users", "学习率"), ("3 users", "> 2 users")] {
        let dir = directory_with(&TINY.replace(&format!("name = \"{from}\""), &format!("name = \"{to}\"")));
        let renamed = run_successfully(dir.path(), &["tiny.toml", "--dry-run"]);
        let folders: std::collections::BTreeSet<&str> = renamed.lines().skip(1).filter_map(|l| l.rsplit(' ').next()).collect();
        assert_eq!(folders.len(), 8, "{renamed}");
    }
}

#[test]
fn the_experiments_of_the_repository_are_valid() {
    let dir = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/experiments"));
    let mut found = Vec::new();
    for entry in fs::read_dir(dir).unwrap() {
        let name = entry.unwrap().file_name().into_string().unwrap();
        run_successfully(dir, &[&name, "--dry-run"]);
        found.push(name);
    }
    found.sort();
    let expected = [
        "communication",
        "convergence",
        "information",
        "memory",
        "practical",
        "range-memory",
        "range",
        "scale-memory",
        "scale",
        "trajectories",
    ];
    assert_eq!(found, expected.map(|name| format!("{name}.toml")));
    let part = run_successfully(dir, &["range.toml", "--dry-run", "--series", "QMIX", "--point", "9 xi", "--point", "4 xi"]);
    assert!(part.contains(": 6 runs") && !part.contains("Qedgix") && !part.contains("5 xi"), "{part}");
}

#[cfg(unix)]
#[test]
fn ctrl_c_and_sigterm_save_the_runs_in_progress() {
    let dir = directory_with(TINY);
    // A run that does not end during the test, with one evaluation at the start.
    let long = ["tiny.toml", "--steps", "100000000", "--set", "training.eval_every=100000000", "--threads", "2"];
    let begin = || qedgix(dir.path(), &long).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    let snapshots = || files(dir.path()).iter().filter(|(name, _)| name.ends_with("snapshot")).count();
    for (signal, code) in [("-INT", 130), ("-TERM", 143)] {
        let child = begin();
        let deadline = Instant::now() + Duration::from_secs(60);
        while snapshots() < 2 && Instant::now() < deadline {
            std::thread::sleep(Duration::from_millis(10));
        }
        let busy = run(dir.path(), &long);
        assert!(String::from_utf8_lossy(&busy.stderr).contains("another process"), "two processes must not write the same files");
        let signalled = Command::new("kill").args([signal, &child.id().to_string()]).status().unwrap();
        assert!(signalled.success());
        let ended = child.wait_with_output().unwrap();
        let said = String::from_utf8(ended.stderr).unwrap();
        assert_eq!(ended.status.code(), Some(code), "{said}");
        assert!(said.ends_with("stopped; the same command resumes the experiment\n"), "{said}");
        let listed = run_successfully(dir.path(), &[&long[..5], &["--dry-run"]].concat());
        assert_eq!(listed.lines().filter(|line| line.contains("at step")).count(), 2, "{listed}");
        for (name, _) in files(dir.path()).iter().filter(|(name, _)| name.ends_with("snapshot")) {
            fs::remove_file(dir.path().join(name)).unwrap();
        }
    }
}
