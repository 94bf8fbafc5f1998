//! The environment (docs/model.md, "Environment"): order of a step, every option, recorded dynamics, invariants.

#![allow(clippy::float_cmp, reason = "the expected numbers are exact in binary")]

use proptest::prelude::*;
use qedgix::env::{BatchEnv, Boundary, EnvConfig, Episode, Layout, Point, Start, StepError};
use safetensors::SafeTensors;

/// One UAV at `uav`, one user at `user`.
fn pair(uav: Point, user: Point) -> EnvConfig {
    EnvConfig {
        uavs: 1,
        users: 1,
        start: Start::Given(vec![uav]),
        layout: Layout::Given(vec![user]),
        speed: 0.125,
        transmission_range: 0.125,
        ..EnvConfig::default()
    }
}

fn episode(config: &EnvConfig) -> Episode {
    Episode::new(config, 0).unwrap()
}

#[test]
fn reset_puts_uavs_at_the_centre_and_aoi_to_0() {
    let env = BatchEnv::new(&EnvConfig::default(), 4).unwrap();
    assert!(env.uav_xy().iter().all(|&x| x == 0.5));
    assert!(env.aoi().iter().all(|&a| a == 0.0));
    assert!(env.user_xy().iter().all(|x| (0.0..=1.0).contains(x)));
    assert_ne!(env.user_xy()[..10], env.user_xy()[10..20], "layouts differ with their seeds");
}

#[test]
fn layout_depends_on_seed_and_number_of_users_only() {
    let mut a = BatchEnv::new(&EnvConfig::default(), 1).unwrap();
    let other = EnvConfig { uavs: 7, slots: 9, speed: 0.1, hover: true, start: Start::Random, ..EnvConfig::default() };
    let mut b = BatchEnv::new(&other, 2).unwrap();
    a.reset(&[42]);
    b.reset(&[1, 42]);
    assert_eq!(a.user_xy(), &b.user_xy()[10..]);
}

#[test]
fn headings_are_45_degrees_apart_counter_clockwise() {
    for h in 0..8_u8 {
        let mut e = episode(&pair([0.5, 0.5], [0.0, 0.0]));
        e.step(&[h]).unwrap();
        let angle = f64::from(h) * std::f64::consts::FRAC_PI_4;
        let [x, y] = e.uavs()[0];
        assert!((x - 0.5 - 0.125 * angle.cos()).abs() < 1e-7, "heading {h}: x = {x}");
        assert!((y - 0.5 - 0.125 * angle.sin()).abs() < 1e-7, "heading {h}: y = {y}");
    }
}

#[test]
fn data_is_collected_at_the_end_of_the_move() {
    // Out of range before the move, in range after it: AoI 0, and the reward is computed from it.
    let mut e = episode(&pair([0.25, 0.5], [0.5, 0.5]));
    assert_eq!(e.step(&[0]), Ok(0.0));
    assert_eq!(e.aoi(), [0.0]);
    // The UAV flies away, and AoI rises by 1 per slot.
    e.step(&[4]).unwrap();
    e.step(&[4]).unwrap();
    assert_eq!(e.aoi(), [2.0]);
}

#[test]
fn a_user_exactly_at_the_transmission_range_is_collected() {
    // After flying up, dx = 0.125 exactly and dy = 0; all numbers are powers of two, so distance^2 == t^2.
    let mut e = episode(&pair([0.5, 0.375], [0.625, 0.5]));
    e.step(&[2]).unwrap();
    assert_eq!(e.aoi(), [0.0]);
    let mut e = episode(&pair([0.5, 0.375], [0.625 + 1e-6, 0.5]));
    e.step(&[2]).unwrap();
    assert_eq!(e.aoi(), [1.0]);
}

#[test]
fn boundary_rule_is_applied_before_data_is_collected() {
    // Unclamped the UAV would end at x = 1.06, out of range of the user; clamped it ends at 1.
    let mut clamped = pair([0.9375, 0.5], [0.9, 0.5]);
    clamped.transmission_range = 0.11;
    let free = EnvConfig { boundary: Boundary::Free, ..clamped.clone() };
    let mut e = episode(&clamped);
    e.step(&[0]).unwrap();
    assert_eq!((e.uavs()[0], e.aoi()), ([1.0, 0.5], &[0.0][..]));
    let mut e = episode(&free);
    e.step(&[0]).unwrap();
    assert_eq!((e.uavs()[0], e.aoi()), ([1.0625, 0.5], &[1.0][..]));
}

#[test]
fn coordinates_are_clamped_independently() {
    let mut e = episode(&pair([1.0, 0.5], [0.0, 0.0]));
    e.step(&[1]).unwrap();
    let [x, y] = e.uavs()[0];
    assert!(x == 1.0 && y > 0.58, "slides along the border: ({x}, {y})");
}

#[test]
fn hovering_needs_the_option_and_stays_in_place() {
    let still = pair([0.5, 0.5], [0.5, 0.5]);
    let mut e = episode(&EnvConfig { hover: true, ..still.clone() });
    e.step(&[8]).unwrap();
    assert_eq!(e.uavs(), [[0.5, 0.5]]);
    let error = episode(&still).step(&[8]).unwrap_err();
    assert!(matches!(error, StepError::Invalid(e) if e.field == "actions[0]"));
}

#[test]
fn reward_is_scaled_mean_aoi() {
    let config = EnvConfig {
        users: 2,
        layout: Layout::Given(vec![[0.5, 0.5], [0.0, 0.0]]),
        start: Start::Given(vec![[0.5, 0.5]]),
        uavs: 1,
        ..EnvConfig::default()
    };
    let mut e = episode(&config);
    e.step(&[0]).unwrap();
    assert_eq!(e.step(&[4]), Ok(-(1.0 / 80.0) as f32), "AoI (0, 2), mean 1, scale 1/K");
    let mut e = episode(&EnvConfig { reward_scale: Some(5.0), ..config.clone() });
    assert_eq!(e.step(&[0]), Ok(-2.5));
    // Weights (1, 3) are scaled to (0.5, 1.5).
    let mut e = episode(&EnvConfig { reward_scale: Some(1.0), weights: Some(vec![1.0, 3.0]), ..config });
    assert_eq!(e.step(&[0]), Ok(-0.75));
    assert_eq!(e.metrics().mean_aoi, 0.75);
}

#[test]
fn start_positions_are_given_or_drawn_from_the_seed() {
    let given = EnvConfig { start: Start::Given(vec![[0.25, 0.75], [1.0, 0.0], [0.5, 0.5]]), ..EnvConfig::default() };
    assert_eq!(episode(&given).uavs(), [[0.25, 0.75], [1.0, 0.0], [0.5, 0.5]]);
    let random = EnvConfig { start: Start::Random, ..EnvConfig::default() };
    let (a, b) = (Episode::new(&random, 1).unwrap(), Episode::new(&random, 2).unwrap());
    assert_ne!(a.uavs(), b.uavs());
    assert_ne!(a.uavs()[0], a.uavs()[1]);
    assert_eq!(a.uavs(), Episode::new(&random, 1).unwrap().uavs());
}

#[test]
fn moving_users_keep_their_speed_and_stay_in_the_square() {
    let config = EnvConfig { user_speed: 0.02, slots: 500, ..EnvConfig::default() };
    let mut e = Episode::new(&config, 7).unwrap();
    let mut reflected = false;
    while !e.done() {
        let before = e.users();
        e.step(&[0, 3, 5]).unwrap();
        for (a, b) in before.iter().zip(e.users()) {
            assert!(b.iter().all(|x| (0.0..=1.0).contains(x)));
            let walked = (a[0] - b[0]).hypot(a[1] - b[1]);
            let inner = b.iter().all(|x| (0.02..=0.98).contains(x));
            assert!(walked <= 0.02 + 1e-6 && (!inner || walked >= 0.02 - 1e-6), "walked {walked}");
            reflected |= walked < 0.019;
        }
    }
    assert!(reflected, "a user was reflected in 500 slots");
    let mut still = Episode::new(&EnvConfig::default(), 7).unwrap();
    let users = still.users();
    still.step(&[0, 1, 2]).unwrap();
    assert_eq!(still.users(), users, "users do not move by default");
}

#[test]
fn steps_after_the_time_limit_are_rejected_until_a_reset() {
    let mut e = episode(&EnvConfig { slots: 2, ..EnvConfig::default() });
    e.step(&[0, 0, 0]).unwrap();
    e.step(&[0, 0, 0]).unwrap();
    assert!(e.done());
    assert_eq!(e.step(&[0, 0, 0]), Err(StepError::Finished { slots: 2 }));
    e.reset(3);
    assert!(e.step(&[0, 0, 0]).is_ok());
    assert!(matches!(e.step(&[0]), Err(StepError::Invalid(_))), "one heading per UAV");
}

#[test]
fn metrics_of_a_small_episode() {
    // User 0 is always in range, user 1 never: ages 1, 2, 3, 4.
    let config = EnvConfig {
        uavs: 1,
        users: 2,
        slots: 4,
        hover: true,
        layout: Layout::Given(vec![[0.5, 0.5], [0.0, 0.0]]),
        ..EnvConfig::default()
    };
    let mut e = episode(&config);
    for _ in 0..4 {
        e.step(&[8]).unwrap();
    }
    let m = e.metrics();
    assert_eq!(m.mean_aoi, 10.0 / 8.0);
    assert_eq!(m.peak_aoi, 4.0);
    assert_eq!(m.p95_aoi, 4.0, "nearest rank of 8 values");
    assert_eq!(m.coverage, 0.5);
    assert_eq!(m.fairness, 0.5, "only one of two users is served");
}

#[test]
fn configurations_out_of_range_are_rejected() {
    let bad = EnvConfig { speed: f64::NAN, ..EnvConfig::default() };
    assert_eq!(BatchEnv::new(&bad, 1).unwrap_err().field, "speed");
    let bad = EnvConfig { detection_range: 0.1, ..EnvConfig::default() };
    assert!(Episode::new(&bad, 0).is_err(), "d >= t");
    assert!(BatchEnv::new(&EnvConfig::default(), 0).is_err());
}

/// The actions recorded in every golden file reproduce the recorded positions, AoI and rewards.
#[test]
fn recorded_dynamics() {
    let directory = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden");
    let mut files = 0;
    for entry in std::fs::read_dir(directory).unwrap() {
        let path = entry.unwrap().path();
        let bytes = std::fs::read(&path).unwrap();
        replay(&path.display().to_string(), &bytes);
        files += 1;
    }
    assert!(files >= 9, "{files} golden files");
}

fn replay(name: &str, bytes: &[u8]) {
    let (_, header) = SafeTensors::read_metadata(bytes).unwrap();
    let tensors = SafeTensors::deserialize(bytes).unwrap();
    let given = |key: &str| -> f64 { header.metadata().as_ref().unwrap()[key].parse().unwrap() };
    let floats = |key: &str| -> Vec<f32> {
        let data = tensors.tensor(key).unwrap().data();
        data.chunks_exact(4).map(|c| f32::from_le_bytes(c.try_into().unwrap())).collect()
    };
    let (uavs, users, aoi, reward) = (floats("in.uavs"), floats("in.users"), floats("in.aoi"), floats("in.reward"));
    let actions: Vec<u8> = tensors.tensor("in.actions").unwrap().data().chunks_exact(8).map(|c| c[0]).collect();
    let (m, n, k) = (given("M") as usize, given("N") as usize, given("K") as usize);
    for b in 0..given("batch") as usize {
        let points = |xy: &[f32]| -> Vec<Point> { xy.chunks_exact(2).map(|p| [p[0].into(), p[1].into()]).collect() };
        let config = EnvConfig {
            uavs: m,
            users: n,
            slots: k,
            speed: given("v"),
            transmission_range: given("t"),
            detection_range: given("d"),
            hover: given("A") == 9.0,
            reward_scale: Some(given("reward_scale")),
            start: Start::Given(points(&uavs[b * (k + 1) * m * 2..][..m * 2])),
            layout: Layout::Given(points(&users[b * n * 2..][..n * 2])),
            ..EnvConfig::default()
        };
        let mut e = episode(&config);
        for slot in 1..=k {
            let got = e.step(&actions[(b * k + slot - 1) * m..][..m]).unwrap();
            let recorded = points(&uavs[(b * (k + 1) + slot) * m * 2..][..m * 2]);
            for (p, q) in e.uavs().iter().zip(&recorded) {
                assert!((p[0] - q[0]).abs() < 1e-5 && (p[1] - q[1]).abs() < 1e-5, "{name}: slot {slot}: {p:?}, not {q:?}");
            }
            // A user within rounding of the transmission range may or may not be collected, and the episodes diverge.
            let edge = recorded
                .iter()
                .any(|p| e.users().iter().any(|u| ((p[0] - u[0]).hypot(p[1] - u[1]) - config.transmission_range).abs() < 1e-6));
            if edge {
                break;
            }
            assert_eq!(e.aoi(), &aoi[(b * (k + 1) + slot) * n..][..n], "{name}: slot {slot}");
            let expected = reward[b * k + slot - 1];
            assert!(
                (got - expected).abs() <= 1e-6 * expected.abs().max(1.0),
                "{name}: slot {slot}: reward {got}, not {expected}"
            );
        }
    }
}

proptest! {
    #[test]
    fn invariants_hold_for_any_actions(
        seed: u64, uavs in 1..5_usize, users in 1..7_usize, hover: bool, free: bool, walk: bool,
        actions in prop::collection::vec(0..9_u8, 200),
    ) {
        let config = EnvConfig {
            uavs, users, hover, slots: 40,
            boundary: if free { Boundary::Free } else { Boundary::Clamp },
            user_speed: if walk { 0.03 } else { 0.0 },
            ..EnvConfig::default()
        };
        let mut one = Episode::new(&config, seed).unwrap();
        let mut batch = BatchEnv::new(&config, 3).unwrap();
        batch.reset(&[seed ^ 1, seed, seed ^ 2]);
        for slot in 0..40_usize {
            let moves: Vec<u8> = (0..uavs).map(|i| actions[(slot * uavs + i) % 200] % config.actions() as u8).collect();
            let before: Vec<f32> = one.aoi().to_vec();
            let reward = one.step(&moves).unwrap();
            // The second copy of the batch equals the single episode, bit for bit.
            batch.try_step(&moves.repeat(3)).unwrap();
            prop_assert_eq!(&batch.aoi()[users..2 * users], one.aoi());
            prop_assert_eq!(batch.reward()[1], reward);
            for (a, b) in before.iter().zip(one.aoi()) {
                prop_assert!(*b == 0.0 || *b == a + 1.0);
            }
            if !free {
                prop_assert!(one.uavs().iter().flatten().all(|x| (0.0..=1.0).contains(x)));
            }
            prop_assert!(one.users().iter().flatten().all(|x| (0.0..=1.0).contains(x)));
            prop_assert!(reward <= 0.0);
        }
        let m = one.metrics();
        prop_assert_eq!(m, batch.metrics(1));
        prop_assert!(m.mean_aoi <= m.peak_aoi && m.p95_aoi <= m.peak_aoi && m.peak_aoi <= 40.0);
        prop_assert!((0.0..=1.0).contains(&m.coverage));
        prop_assert!(m.fairness > 0.0 && m.fairness <= 1.0 + 1e-12);
    }
}
