//! Baselines (docs/model.md, "Baselines"): quality, determinism, and independence of batching.

use std::sync::Arc;

use qedgix::env::{EnvConfig, EpisodeMetrics, Point};
use qedgix::learner::{difference, evaluate, layout_list};
use qedgix::policy::EnvParams;
use qedgix::policy::baselines::{self, LIST};
use qedgix::policy::{FleetGraph, FleetStep, Policy, RequiredInput};

fn policy(name: &str) -> Arc<dyn Policy> {
    baselines::by_name(name, EnvParams::default()).unwrap()
}

fn flown(name: &str, env: &EnvConfig, episodes: usize) -> Vec<EpisodeMetrics> {
    let policy = baselines::by_name(name, EnvParams::from(env)).unwrap();
    evaluate(&*policy, env, &layout_list("eval-v1").unwrap().seeds(episodes), 1).unwrap()
}

fn mean(episodes: &[EpisodeMetrics]) -> f64 {
    EpisodeMetrics::mean(episodes).mean_aoi
}

#[test]
fn better_informed_baselines_have_lower_aoi() {
    for (uavs, users) in [(2, 4), (3, 5), (4, 8)] {
        let env = EnvConfig { uavs, users, ..EnvConfig::default() };
        let all: Vec<_> = LIST.iter().map(|b| (b.name, flown(b.name, &env, 64))).collect();
        for (i, (worse, before)) in all.iter().enumerate() {
            for (better, after) in &all[i + 1..] {
                // These two have the same information. Which is better depends on the size.
                if (*worse, *better) != ("max-aoi", "nearest") {
                    let d = difference(after, before).unwrap().mean_aoi;
                    assert!(d.high < 0.0, "({uavs}, {users}): {better} against {worse}: {d:?}");
                }
            }
        }
    }
}

#[test]
fn mean_aoi_for_the_sizes_of_the_paper() {
    let env = EnvConfig::default();
    // The limits of docs/model.md, "Baselines".
    let random = mean(&flown("random", &env, 256));
    assert!((28.0..31.0).contains(&random), "random: {random}");
    let greedy = mean(&flown("greedy-global", &env, 256));
    assert!(greedy < 5.2, "greedy-global: {greedy}");
    let sweep = flown("sweep", &env, 256);
    assert!(mean(&sweep) < 7.5, "sweep: {}", mean(&sweep));
    assert!(EpisodeMetrics::mean(&sweep).coverage > 0.95);
    for greedy in ["nearest", "max-aoi"] {
        let aoi = mean(&flown(greedy, &env, 256));
        assert!(aoi < 15.0, "{greedy}: {aoi}");
    }
    for (uavs, users, limit) in [(3, 5, 1.6), (2, 4, 3.8), (4, 8, 1.3)] {
        let tour = mean(&flown("tour", &EnvConfig { uavs, users, ..EnvConfig::default() }, 256));
        assert!(tour < limit, "tour with ({uavs}, {users}): {tour}");
    }
}

#[test]
fn sweep_serves_better_the_more_it_detects_and_uavs_that_start_together_part() {
    for name in ["sweep", "sweep-shared"] {
        let with_range = |detection_range: f64| mean(&flown(name, &EnvConfig { detection_range, ..EnvConfig::default() }, 64));
        let (near, wide, all) = (with_range(0.28), with_range(0.5), with_range(1.5));
        assert!(wide < 0.6 * near && all < 0.6 * near, "{name}: {near}, {wide}, {all}");
    }
}

#[test]
fn tour_plans_once_and_again_after_users_have_moved() {
    let policy = policy("tour");
    let users: Vec<Point> = (0..5).map(|j| [0.1 + 0.2 * j as f64, 0.3]).collect();
    let scene = |users: &[Point]| FleetGraph::from_scene(&[[0.5, 0.5]; 3], users, &[0.0; 5], policy.env().detection_range);
    let mut memory = vec![0.0; policy.memory_len(3, 5)];
    let fly = |graph: &FleetGraph, step, memory: &mut Vec<f32>| {
        let mut headings = [99; 3];
        policy.act(&mut [FleetStep {
            env: policy.env(),
            graph,
            profile: None,
            step,
            memory,
            headings: &mut headings,
            q_values: None,
        }]);
        headings
    };
    fly(&scene(&users), 0, &mut memory);
    let plan = memory.clone();
    let near: Vec<Point> = users.iter().map(|u| [u[0], u[1] + 0.05]).collect();
    fly(&scene(&near), 1, &mut memory);
    assert_eq!(memory, plan, "no user has moved too far from the plan");
    let far: Vec<Point> = users.iter().map(|u| [u[0], 1.0 - u[1]]).collect();
    let headings = fly(&scene(&far), 2, &mut memory);
    assert_ne!(memory, plan);
    // A malformed memory, which a client could send, also leads to a new plan.
    for junk in [f32::NAN, f32::INFINITY, -1.0, 1e9, 2.0] {
        let mut memory = vec![junk; memory.len()];
        assert_eq!(fly(&scene(&far), 2, &mut memory), headings, "{junk}");
    }
}

#[test]
fn tours_of_large_fleets_are_planned() {
    for (uavs, users) in [(64, 1024), (1, 3000), (200, 3), (5, 5), (9, 40)] {
        let env = EnvConfig { uavs, users, slots: 12, ..EnvConfig::default() };
        let aoi = mean(&flown("tour", &env, 1));
        assert!(aoi > 0.0 && aoi <= 12.0, "({uavs}, {users}): {aoi}");
    }
    let env = EnvConfig { uavs: 64, users: 1024, ..EnvConfig::default() };
    let better = difference(&flown("tour", &env, 4), &flown("sweep", &env, 4)).unwrap().mean_aoi;
    assert!(better.high < 0.0, "{better:?}");
}

#[test]
fn episodes_depend_on_seeds_only() {
    let env = EnvConfig { user_speed: 0.01, ..EnvConfig::default() };
    let seeds = layout_list("valid-v1").unwrap().seeds(20);
    for b in LIST {
        let one = evaluate(&*policy(b.name), &env, &seeds, 1).unwrap();
        assert_eq!(one, evaluate(&*policy(b.name), &env, &seeds, 3).unwrap(), "{}", b.name);
        let backwards: Vec<u64> = seeds.iter().rev().copied().collect();
        let mut reversed = evaluate(&*policy(b.name), &env, &backwards, 1).unwrap();
        reversed.reverse();
        assert_eq!(one, reversed, "{}: order of fleets", b.name);
    }
}

/// A fleet in one slot, with its memory.
struct Fleet {
    graph: FleetGraph,
    memory: Vec<f32>,
    headings: Vec<u8>,
}

impl Fleet {
    fn new(policy: &dyn Policy, uavs: usize, users: usize, seed: u64) -> Self {
        let at = |i: usize, s: u64| -> Point { [(i as f64 * 0.37 + s as f64 * 0.11) % 1.0, (i as f64 * 0.61 + 0.2) % 1.0] };
        let own: Vec<Point> = (0..uavs).map(|i| at(i, seed)).collect();
        let all: Vec<Point> = (0..users).map(|i| at(i + 9, seed)).collect();
        let aoi: Vec<f32> = (0..users).map(|i| (i * 7 % 11) as f32).collect();
        let mut memory = vec![7.0; policy.memory_len(uavs, users)];
        policy.start(uavs, users, seed, &mut memory);
        Self { graph: FleetGraph::from_scene(&own, &all, &aoi, policy.env().detection_range), memory, headings: vec![99; uavs] }
    }

    fn turn(&mut self, step: u64) -> FleetStep<'_> {
        FleetStep {
            env: EnvParams::default(),
            graph: &self.graph,
            profile: None,
            step,
            memory: &mut self.memory,
            headings: &mut self.headings,
            q_values: None,
        }
    }
}

#[test]
fn fleets_of_different_sizes_in_one_batch_do_not_affect_each_other() {
    for b in LIST {
        let policy = policy(b.name);
        let fleets = || [(1, 1, 5), (3, 5, 6), (6, 2, 7)].map(|(m, n, seed)| Fleet::new(&*policy, m, n, seed));
        let (mut together, mut alone) = (fleets(), fleets());
        for step in 0..5 {
            let mut turns: Vec<FleetStep<'_>> = together.iter_mut().map(|f| f.turn(step)).collect();
            policy.act(&mut turns);
            for fleet in alone.iter_mut().rev() {
                policy.act(&mut [fleet.turn(step)]);
            }
            for (a, b) in together.iter().zip(&alone) {
                assert_eq!(a.headings, b.headings);
                assert_eq!(a.memory, b.memory);
                assert!(a.headings.iter().all(|&h| h < 8));
            }
        }
    }
}

#[test]
fn detections_suffice_for_baselines_that_do_not_need_the_scene() {
    for b in LIST.iter().filter(|b| b.needs < RequiredInput::FullScene) {
        let policy = policy(b.name);
        let mut scene = Fleet::new(&*policy, 3, 5, 11);
        let mut graph = Fleet::new(&*policy, 3, 5, 11);
        let lists: Vec<_> = (0..8).map(|i| scene.graph.detections(i).to_vec()).collect();
        let own = (b.needs == RequiredInput::OwnPositions).then(|| scene.graph.uav_positions().unwrap().to_vec());
        graph.graph = FleetGraph::from_detections(own, 3, scene.graph.aoi().to_vec(), &lists);
        for step in 0..5 {
            policy.act(&mut [scene.turn(step)]);
            policy.act(&mut [graph.turn(step)]);
            assert_eq!(scene.headings, graph.headings, "{}", b.name);
        }
    }
}

#[test]
fn only_random_baselines_depend_on_seeds_and_memories_are_finite() {
    for b in LIST {
        let policy = policy(b.name);
        let fly = |seed: u64| {
            let mut fleet = Fleet::new(&*policy, 4, 3, 1);
            policy.start(4, 3, seed, &mut fleet.memory);
            let mut flown = Vec::new();
            for step in 0..12 {
                policy.act(&mut [fleet.turn(step)]);
                flown.extend_from_slice(&fleet.headings);
            }
            assert!(fleet.memory.iter().all(|m| m.is_finite()), "{}", b.name);
            flown
        };
        let draws = ["random", "persistent", "nearest", "max-aoi"].contains(&b.name);
        assert_eq!(fly(u64::MAX) != fly(u64::MAX - (1 << 48)), draws, "{}", b.name);
        assert_eq!(fly(3), fly(3));
    }
}

#[test]
fn q_values_are_nan_and_fleets_are_checked() {
    let policy = policy("sweep");
    let mut fleet = Fleet::new(&*policy, 2, 2, 0);
    let mut q = vec![0.0; 16];
    policy.act(&mut [FleetStep { q_values: Some(&mut q), ..fleet.turn(0) }]);
    assert!(q.iter().all(|q| q.is_nan()));
    // Nobody may be in sight.
    assert!(policy.check_fleet(3, 5).is_ok() && policy.check_fleet(3, 0).is_ok());
    assert!(policy.check_fleet(0, 5).is_err() && policy.check_fleet(1000, 10_000).is_ok());
    // Rules with the full scene look at all pairs.
    for (m, n) in [(0, 5), (5000, 1), (1000, 10_000)] {
        assert!(self::policy("tour").check_fleet(m, n).is_err(), "({m}, {n})");
    }
    assert!(baselines::by_name("no-such", EnvParams::default()).is_none());
}
