//! Traced evaluations: they agree with plain evaluations, and disturbances have their documented effect only.

use std::process::{Command, Output};
use std::sync::Mutex;

use qedgix::env::{EnvConfig, EpisodeMetrics, LostUav};
use qedgix::invalid::Invalid;
use qedgix::learner::{Disturbance, TracedEvaluation, evaluate, evaluate_traced, layout_list};
use qedgix::policy::EnvParams;
use qedgix::policy::baselines;
use qedgix::policy::{FleetStep, Policy, RequiredInput};

fn evaluated(name: &str, env: &EnvConfig, disturbance: &Disturbance, threads: usize) -> TracedEvaluation {
    let policy = baselines::by_name(name, EnvParams::from(env)).unwrap();
    evaluate_traced(&*policy, env, &layout_list("valid-v1").unwrap().seeds(11), 7, disturbance, threads).unwrap()
}

fn losing(uav: usize, slot: usize) -> Disturbance {
    Disturbance { lose: Some(LostUav { uav, slot }), ..Disturbance::default() }
}

#[test]
fn a_traced_evaluation_has_the_metrics_of_a_plain_one() {
    let env = EnvConfig { user_speed: 0.01, ..EnvConfig::default() };
    let seeds = layout_list("valid-v1").unwrap().seeds(11);
    for name in ["sweep", "random", "greedy-global"] {
        let plain = evaluate(&*baselines::by_name(name, EnvParams::default()).unwrap(), &env, &seeds, 1).unwrap();
        let evaluation = evaluated(name, &env, &Disturbance::default(), 1);
        assert_eq!(plain, evaluation.episodes, "{name}");
        assert_eq!(evaluation.aoi.len(), env.slots + 1);
        assert_eq!(evaluation.aoi[0], 0.0);
        let over_slots = evaluation.aoi[1..].iter().sum::<f64>() / env.slots as f64;
        assert!((over_slots - EpisodeMetrics::mean(&plain).mean_aoi).abs() < 1e-9, "{name}: {over_slots}");
    }
}

#[test]
fn the_trajectory_is_of_the_traced_episode() {
    let env = EnvConfig::default();
    let TracedEvaluation { episodes, trajectory, .. } = evaluated("sweep", &env, &Disturbance::default(), 3);
    assert_eq!(trajectory.seed, layout_list("valid-v1").unwrap().first + 7);
    assert_eq!((trajectory.uavs.len(), trajectory.users.len(), trajectory.aoi.len()), (env.uavs, env.users, env.users));
    assert!(trajectory.uavs.iter().chain(&trajectory.users).all(|path| path.len() == env.slots + 1));
    let sum: f32 = trajectory.aoi.iter().flat_map(|ages| &ages[1..]).sum();
    assert!((f64::from(sum) / (env.users * env.slots) as f64 - episodes[7].mean_aoi).abs() < 1e-9);
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    let env = EnvConfig { user_speed: 0.01, ..EnvConfig::default() };
    let disturbance = Disturbance { position_noise: 0.02, ..losing(1, 20) };
    for name in ["sweep", "nearest"] {
        let one = evaluated(name, &env, &disturbance, 1);
        for threads in [2, 3, 50] {
            assert_eq!(one, evaluated(name, &env, &disturbance, threads), "{name}, {threads} threads");
        }
    }
}

#[test]
fn a_lost_uav_does_not_move_or_collect() {
    // One UAV, one user in its range: collected in every slot until the UAV is lost.
    let middle = vec![[0.5, 0.5]];
    let env = EnvConfig {
        uavs: 1,
        users: 1,
        layout: qedgix::env::Layout::Given(middle),
        transmission_range: 0.2,
        speed: 0.0,
        ..EnvConfig::default()
    };
    let trajectory = evaluated("random", &env, &losing(0, 30), 1).trajectory;
    assert!(trajectory.aoi[0][..=30].iter().all(|&a| a == 0.0));
    assert!(trajectory.aoi[0][31..].iter().enumerate().all(|(i, &a)| a == i as f32 + 1.0));

    let env = EnvConfig::default();
    let trajectory = evaluated("sweep", &env, &losing(2, 10), 1).trajectory;
    let before = evaluated("sweep", &env, &Disturbance::default(), 1).trajectory;
    assert!(trajectory.uavs[2][10..].iter().all(|at| *at == trajectory.uavs[2][10]));
    assert_eq!(trajectory.uavs[2][..=10], before.uavs[2][..=10]);
    assert_ne!(trajectory.uavs[0][10], trajectory.uavs[0][11], "the other UAVs move");
}

/// A policy with heading 0 that records what it observes in each slot: detections and positions.
struct RecordingPolicy(Mutex<Vec<ObservedSlot>>);

#[derive(Clone, Debug, PartialEq)]
struct ObservedSlot {
    step: u64,
    detected: Vec<Vec<u32>>,
    uavs: Vec<[f64; 2]>,
    users: Vec<[f64; 2]>,
}

impl RecordingPolicy {
    fn observed(env: &EnvConfig, disturbance: &Disturbance) -> Vec<ObservedSlot> {
        let policy = Self(Mutex::default());
        evaluate_traced(&policy, env, &[5], 0, disturbance, 1).unwrap();
        policy.0.into_inner().unwrap()
    }
}

impl Policy for RecordingPolicy {
    fn actions(&self) -> usize {
        8
    }
    fn needs(&self) -> RequiredInput {
        RequiredInput::FullScene
    }
    fn env(&self) -> EnvParams {
        EnvParams::default()
    }
    fn check_fleet(&self, _uavs: usize, _users: usize) -> Result<(), Invalid> {
        Ok(())
    }
    fn memory_len(&self, _uavs: usize, _users: usize) -> usize {
        0
    }
    fn start(&self, _uavs: usize, _users: usize, _seed: u64, _memory: &mut [f32]) {}
    fn act(&self, turns: &mut [FleetStep<'_>]) {
        for turn in turns {
            let slot = turn.graph;
            let detected = (0..slot.uavs() + slot.users()).map(|i| slot.detections(i).iter().map(|d| d.target).collect());
            self.0.lock().unwrap().push(ObservedSlot {
                step: turn.step,
                detected: detected.collect(),
                uavs: slot.uav_positions().unwrap().to_vec(),
                users: slot.user_positions().unwrap().to_vec(),
            });
            turn.headings.fill(0);
        }
    }
}

#[test]
fn a_lost_uav_has_no_detections_and_is_not_detected() {
    for users in [5, 60] {
        // The largest valid range and error.
        let env = EnvConfig { users, detection_range: 2.0, boundary: qedgix::env::Boundary::Free, ..EnvConfig::default() };
        for position_noise in [0.0, 1.0] {
            let slots = RecordingPolicy::observed(&env, &Disturbance { position_noise, ..losing(1, 40) });
            for ObservedSlot { step, detected, uavs, .. } in slots {
                let alone = detected[1].is_empty() && detected.iter().all(|targets| !targets.contains(&1));
                if position_noise == 0.0 || step >= 40 {
                    assert_eq!(alone, step >= 40, "slot {step}");
                }
                assert!(uavs.iter().flatten().all(|x| x.is_finite()));
            }
        }
    }
}

#[test]
fn position_noise_has_its_standard_deviation_and_does_not_change_the_environment() {
    let env = EnvConfig { users: 40, slots: 200, ..EnvConfig::default() };
    let truth = RecordingPolicy::observed(&env, &Disturbance::default());
    let noisy = RecordingPolicy::observed(&env, &Disturbance { position_noise: 0.05, ..Disturbance::default() });
    assert_eq!(noisy, RecordingPolicy::observed(&env, &Disturbance { position_noise: 0.05, ..Disturbance::default() }));
    let positions = |slots: &[ObservedSlot]| -> Vec<f64> {
        slots.iter().flat_map(|s| s.uavs.iter().chain(&s.users).flatten().copied()).collect()
    };
    let errors: Vec<f64> = positions(&noisy).iter().zip(positions(&truth)).map(|(a, b)| a - b).collect();
    let n = errors.len() as f64;
    let mean = errors.iter().sum::<f64>() / n;
    let deviation = (errors.iter().map(|e| e * e).sum::<f64>() / n).sqrt();
    assert!(mean.abs() < 2e-3 && (deviation - 0.05).abs() < 2e-3, "mean {mean}, deviation {deviation}");
    // The policy ignores its observations, so the metrics must be the same.
    let metrics = |noise| {
        evaluate_traced(
            &RecordingPolicy(Mutex::default()),
            &env,
            &[5],
            0,
            &Disturbance { position_noise: noise, ..Disturbance::default() },
            1,
        )
    };
    assert_eq!(metrics(0.05).unwrap(), metrics(0.0).unwrap());
}

#[test]
fn errors_name_the_invalid_field() {
    let env = EnvConfig::default();
    for (disturbance, field) in [
        (losing(3, 0), "lose.uav"),
        (losing(0, 80), "lose.slot"),
        (Disturbance { position_noise: -0.1, ..Disturbance::default() }, "position_noise"),
        (Disturbance { position_noise: f64::NAN, ..Disturbance::default() }, "position_noise"),
    ] {
        let error = evaluate_traced(&RecordingPolicy(Mutex::default()), &env, &[1], 0, &disturbance, 1).unwrap_err();
        assert_eq!(error.field, field);
    }
    assert_eq!(
        evaluate_traced(&RecordingPolicy(Mutex::default()), &env, &[1], 1, &Disturbance::default(), 1).unwrap_err().field,
        "traced"
    );
}

/// Runs the command in `dir`.
fn command(dir: &tempfile::TempDir, line: &str) -> Output {
    Command::new(env!("CARGO_BIN_EXE_qedgix")).args(line.split(' ')).current_dir(dir).output().unwrap()
}

fn document(output: &Output) -> serde_json::Value {
    serde_json::from_slice(&output.stdout).unwrap()
}

#[test]
fn an_audit_says_what_uavs_need() {
    let dir = tempfile::tempdir().unwrap();
    for (policy, passes) in [("qmix", true), ("sweep-shared", true), ("nearest", false), ("tour", false)] {
        let output = command(&dir, &format!("audit --policy {policy} --episodes 3 --threads 1 --json"));
        let report = document(&output);
        assert_eq!((output.status.code(), &report["passed"]), (Some(i32::from(!passes)), &passes.into()), "{policy}");
        assert_eq!(report["why"].is_string(), !passes);
        if passes {
            assert_eq!((&report["needs"]["message_links"], &report["needs"]["message_range"]), (&1.into(), &0.28.into()));
            assert_eq!(report["trials"][1]["same_bits"], 1.0);
        }
    }
}

#[test]
fn a_plan_finds_the_smallest_fleet_that_meets_the_target() {
    let dir = tempfile::tempdir().unwrap();
    let line = "plan --policy sweep-shared --users 4 --target-p95 25 --episodes 12 --threads 1 --failures --report out --json";
    let output = command(&dir, line);
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let plan = document(&output);
    let uavs = plan["uavs"].as_u64().unwrap() as usize;
    let p95 = |size: usize, end: &str| plan["sizes"][size - 1]["p95_aoi"][end].as_f64().unwrap();
    assert!(p95(uavs, "mean") <= 25.0 && (1..uavs).all(|size| p95(size, "mean") > 25.0), "{plan}");
    let [low, high] = [0, 1].map(|end| plan["interval"][end].as_u64().unwrap() as usize);
    assert!(low <= uavs && uavs <= high && p95(high, "high") <= 25.0);
    assert_eq!(plan["failures"].as_array().unwrap().len(), 8);
    for file in ["plan.svg", "failures.svg", "plan.json"] {
        assert!(std::fs::metadata(dir.path().join("out").join(file)).unwrap().len() > 500, "{file}");
    }
    let none = command(&dir, "plan --policy random --target-p95 0.5 --max-uavs 2 --episodes 2 --threads 1 --json");
    assert_eq!((none.status.code(), &document(&none)["uavs"]), (Some(1), &serde_json::Value::Null));
}

#[test]
fn explanations_are_drawn_and_written() {
    let dir = tempfile::tempdir().unwrap();
    let output = command(&dir, "evaluate --policy qmix --policy sweep --episodes 2 --threads 1 --explain why");
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let read = |name: &str| std::fs::read_to_string(dir.path().join("why").join(name)).unwrap();
    assert!(read("explain-1-qmix.svg").contains("for the heading") && !read("explain-2-sweep.svg").contains("for the heading"));
    let slots: serde_json::Value = serde_json::from_str(&read("explain-1-qmix.json")).unwrap();
    assert_eq!(slots["slots"].as_array().unwrap().len(), 80);
    assert!(!slots["slots"][0]["influences"].as_array().unwrap().is_empty());
}
