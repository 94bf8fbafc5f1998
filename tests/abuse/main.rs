//! Hostile clients beside a well-behaved one with an API key: it gets every answer, the server lives, and its memory stays
//! bounded. A quarter of a minute by default. The full form also asserts what depends on time: the latencies of the well-behaved
//! client, and that the server gives memory back:
//!
//!     QEDGIX_ABUSE_SECONDS=600 cargo test --release --test abuse -- --nocapture
//!
//! `QEDGIX_ABUSE_ONLY=RapidReset,Garbage` runs some of the clients only.

mod good;
mod hostile;
#[path = "../process/mod.rs"]
mod process;
mod wire;

use std::process::{Command, Stdio};
use std::time::Duration;

use qedgix::wire::v1;
use rand::RngExt;

use self::good::Good;
use self::hostile::Target;
use self::process::Process;

/// Most memory that the server may take, in MiB.
const PEAK: f64 = 1024.0;
/// Memory that the server may keep a minute after the abuse, in MiB.
const KEPT: f64 = 150.0;
/// The 99th percentile of latencies may grow by this factor.
const SLOWER: f64 = 4.0;

/// A random scene.
fn scene(uavs: usize, users: usize, seed: u64) -> v1::Scene {
    let mut rng = qedgix::rng::stream(seed, "abuse-scene", 0);
    v1::Scene {
        uavs: (0..uavs)
            .map(|i| v1::SceneUav { id: format!("a{i}"), x: rng.random(), y: rng.random(), ..Default::default() })
            .collect(),
        users: (0..users)
            .map(|j| v1::SceneUser { id: format!("u{j}"), x: rng.random(), y: rng.random(), aoi: 1.0, z: None })
            .collect(),
    }
}

/// Lengths of the phases in seconds.
struct Phases {
    idle: u64,
    abuse: u64,
    after: u64,
}

#[tokio::test]
async fn the_good_client_gets_every_answer() {
    let seconds: Option<u64> = std::env::var("QEDGIX_ABUSE_SECONDS").ok().map(|text| text.parse().expect("a number of seconds"));
    let phases = seconds.map_or(Phases { idle: 3, abuse: 9, after: 2 }, |abuse| Phases { idle: 30, abuse, after: 60 });
    let dir = tempfile::tempdir().unwrap();
    let (ours, theirs) = (process::create_key(dir.path(), "act"), process::create_key(dir.path(), "read,act"));
    let mut command = process::serve(dir.path());
    let log = dir.path().join("log");
    command.stderr(std::fs::File::create(&log).unwrap());
    let mut server = Process::start(command).await;
    let good = Good::start(&server.grpc, &ours);
    // The first answers wait for pages of memory and for branches of code.
    wait(1).await;
    let early = good.experience();
    wait(phases.idle).await;
    let (mut idle, begin) = (good.experience(), server.memory());

    let target = Target { grpc: server.grpc.parse().unwrap(), http: server.http.parse().unwrap(), key: theirs };
    let mut hostile = hostile_process(&target, phases.abuse);
    wait(phases.abuse).await;
    let mut abused = good.experience();
    let ended = hostile.wait().unwrap();
    wait(phases.after).await;
    let (mut after, end, peak) = (good.experience(), server.memory(), server.peak_memory());

    let errors: Vec<String> = [&early, &idle, &abused, &after].into_iter().flat_map(|phase| phase.errors.clone()).collect();
    let [before, during] = [&mut idle, &mut abused].map(|phase| phase.quantile(0.99));
    let ratio = during.as_secs_f64() / before.as_secs_f64();
    for (name, phase) in [("idle", &mut idle), ("abused", &mut abused), ("after", &mut after)] {
        let [half, most, worst] = [0.5, 0.99, 1.0].map(|fraction| phase.quantile(fraction));
        let slots = phase.latencies.len();
        println!("{name:>7}: {slots} slots, p50 {half:.1?}, p99 {most:.1?}, slowest {worst:.1?}, {} errors", phase.errors.len());
    }
    let log = std::fs::read_to_string(&log).unwrap();
    println!(
        "{} lines in the log, {} of them errors",
        log.lines().count(),
        log.lines().filter(|line| line.contains("ERROR")).count()
    );
    println!("p99 times {ratio:.1}; memory in MiB: {begin:.0} at first, {peak:.0} at most, {end:.0} at the end");
    assert!(ended.success(), "the hostile clients: {ended}");
    assert_eq!(server.ended(), None, "the server lives");
    assert!(errors.is_empty(), "{} errors of the good client: {:#?}", errors.len(), &errors[..errors.len().min(10)]);
    assert!(peak < PEAK, "{peak:.0} MiB at most");
    if seconds.is_some() {
        assert!(end - begin < KEPT, "{:.0} MiB more at the end", end - begin);
        assert!(ratio < SLOWER, "p99 times {ratio:.1}");
    }
}

async fn wait(seconds: u64) {
    tokio::time::sleep(Duration::from_secs(seconds)).await;
}

/// Runs the hostile clients in a process of their own, which runs only when no other process wants the processor: they stand for other
/// machines, which would not take processor time away from the server.
fn hostile_process(target: &Target, seconds: u64) -> std::process::Child {
    let mut command = Command::new("chrt");
    command.args(["--idle", "0"]).arg(std::env::current_exe().unwrap());
    command.args(["--exact", "hostile_clients", "--ignored", "--nocapture"]);
    command.env(TARGET, serde_json::to_string(target).unwrap()).env(SECONDS, seconds.to_string());
    command.stdin(Stdio::null()).spawn().unwrap()
}

/// Environment variables of the hostile process.
const TARGET: &str = "QEDGIX_ABUSE_TARGET";
const SECONDS: &str = "QEDGIX_ABUSE_FOR";

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "runs as a process of the_good_client_gets_every_answer"]
async fn hostile_clients() {
    let Ok(target) = std::env::var(TARGET) else { return };
    let target: Target = serde_json::from_str(&target).unwrap();
    let seconds = std::env::var(SECONDS).unwrap().parse().unwrap();
    hostile::run(target, Duration::from_secs(seconds)).await;
}
