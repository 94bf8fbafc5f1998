//! Guard rails: in random slots, no UAV breaks a constraint that it could have kept, and nothing is changed without need.
//!
//! Long form: `QEDGIX_GUARD_SLOTS=1000000 cargo test --release --test serving -- guard --nocapture`

use std::sync::Arc;

use bytes::Bytes;
use qedgix::env::{Boundary, DIRECTIONS, Point};
use qedgix::policy::EnvParams;
use qedgix::serving::{Constraint, Guard, Overruled, Situation, Zone};
use qedgix::wire::v1;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use tonic::Code;

use super::harness::*;

const HEADINGS: usize = 9;
/// Violations below this are rounding.
const ROUNDING: f64 = 1e-6;
/// Constraints are checked at points along a flight, a thousandth apart. What is kept by more than that at all points is kept between
/// them, too.
const SAMPLING: f64 = 1e-3;

fn distance(a: Point, b: Point) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// Points along a flight, the last one its end.
fn along(from: Point, to: Point) -> impl Iterator<Item = Point> {
    (1..=40).map(move |k| {
        let t = f64::from(k) / 40.0;
        [from[0] + t * (to[0] - from[0]), from[1] + t * (to[1] - from[1])]
    })
}

/// Whether `p` is in the zone, by at least `by` (negative: or as near to it).
fn inside(zone: &Zone, p: Point, by: f64) -> bool {
    match zone {
        Zone::Circle(center, radius) => distance(p, *center) < radius - by,
        Zone::Polygon(corners) => {
            // Corners are those of an axis-parallel box here.
            let bounds = |axis: usize| {
                let values = corners.iter().map(|corner| corner[axis]);
                (values.clone().fold(f64::INFINITY, f64::min), values.fold(f64::NEG_INFINITY, f64::max))
            };
            (0..2).all(|axis| (bounds(axis).0 + by..=bounds(axis).1 - by).contains(&p[axis]))
        }
    }
}

struct Slot {
    guard: Guard,
    env: EnvParams,
    positions: Vec<Point>,
    endurance: Vec<f64>,
    q: Vec<f32>,
    headings: Vec<u8>,
}

impl Slot {
    fn random(rng: &mut ChaCha8Rng) -> Self {
        let uavs = rng.random_range(1..=3);
        let mut point = |around: f64| [0, 1].map(|_| 0.5 + around * (rng.random::<f64>() - 0.5));
        let positions = (0..uavs).map(|_| point(0.3)).collect();
        let circle = Zone::Circle(point(0.5), 0.06);
        let [x, y] = point(0.4);
        let corners = Zone::Polygon(vec![[x, y], [x + 0.1, y], [x + 0.1, y + 0.05], [x, y + 0.05]]);
        let home = point(0.2);
        let mut choose = |value: f64| if rng.random_bool(0.5) { Some(value) } else { None };
        let guard = Guard {
            no_fly: choose(0.0).map_or_else(Vec::new, |_| vec![circle, corners]),
            min_separation: choose(0.05).unwrap_or(0.0),
            home: Some(home),
            max_distance: choose(0.15),
            return_in_time: choose(0.0).is_some(),
            boundary: Boundary::Clamp,
        };
        let endurance = (0..uavs).map(|_| rng.random_range(1.0..6.0_f64).floor()).collect();
        let q: Vec<f32> = (0..8 * uavs).map(|_| rng.random()).collect();
        let best = |q: &[f32]| (0..8).max_by(|&a, &b| q[a].total_cmp(&q[b])).unwrap() as u8;
        let headings = q.chunks_exact(8).map(best).collect();
        Self { guard, env: EnvParams::default(), positions, endurance, q, headings }
    }

    fn end(&self, i: usize, heading: u8) -> Point {
        let direction = DIRECTIONS[usize::from(heading)];
        [0, 1].map(|axis| (self.positions[i][axis] + self.env.speed * direction[axis]).clamp(0.0, 1.0))
    }

    /// What `headings` break. `by`: violations that are smaller do not count; negative: what is nearly one counts.
    fn broken(&self, headings: &[u8], by: f64) -> Vec<(usize, Constraint)> {
        let mut broken = Vec::new();
        for (i, &heading) in headings.iter().enumerate() {
            let (from, to) = (self.positions[i], self.end(i, heading));
            for zone in &self.guard.no_fly {
                let crosses = !inside(zone, from, 0.0) && along(from, to).any(|p| inside(zone, p, by));
                if inside(zone, to, by) || crosses {
                    broken.push((i, Constraint::NoFly));
                }
            }
            let home = self.guard.home.unwrap();
            if self.guard.max_distance.is_some_and(|most| distance(to, home) > most + by) {
                broken.push((i, Constraint::MaxDistance));
            }
            let (dx, dy) = ((to[0] - home[0]).abs(), (to[1] - home[1]).abs());
            let slots = (dx.max(dy) + (2_f64.sqrt() - 1.0) * dx.min(dy)) / self.env.speed - 0.5;
            if self.guard.return_in_time && slots > self.endurance[i] - 1.0 + by {
                broken.push((i, Constraint::ReturnInTime));
            }
            for j in (0..headings.len()).filter(|&j| j != i) {
                let (other, other_to) = (self.positions[j], self.end(j, headings[j]));
                let least = self.guard.min_separation - by;
                let meets = || along(from, to).zip(along(other, other_to)).any(|(a, b)| distance(a, b) < least);
                let near = distance(from, other) >= self.guard.min_separation && meets();
                if self.guard.min_separation > 0.0 && (distance(to, other_to) < least || near) {
                    broken.push((i, Constraint::Separation));
                }
            }
        }
        broken
    }
}

#[test]
fn no_constraint_is_broken_that_could_be_kept() {
    let slots = std::env::var("QEDGIX_GUARD_SLOTS").map_or(5000, |slots| slots.parse().unwrap());
    let (mut changed, mut unavoidable) = (0, 0);
    for slot in 0..slots {
        let mut rng = qedgix::rng::stream(slot, "guard", 0);
        let slot = Slot::random(&mut rng);
        let Slot { guard, env, positions, endurance, q, .. } = &slot;
        let mut headings = slot.headings.clone();
        let situation = Situation { env, speeds: &[], positions, endurance, q_values: q };
        let overruled = guard.apply(&situation, &mut headings);
        let broken = slot.broken(&headings, ROUNDING);
        for (uav, constraint) in &broken {
            let flagged = overruled.iter().find(|o| o.uav as usize == *uav).map(|o| o.violates.contains(constraint));
            assert_eq!(flagged, Some(true), "{constraint:?} of {uav} is not flagged");
        }
        if !overruled.iter().all(|o| o.violates.is_empty()) {
            // All combinations of headings, hovering included.
            let all = HEADINGS.pow(headings.len() as u32);
            let combination =
                |n: usize| (0..headings.len()).map(|i| (n / HEADINGS.pow(i as u32) % HEADINGS) as u8).collect::<Vec<_>>();
            let keeps = (0..all).map(combination).find(|headings| slot.broken(headings, -SAMPLING).is_empty());
            assert_eq!(keeps, None, "{headings:?} break {broken:?}");
            unavoidable += 1;
        }
        if slot.broken(&slot.headings, -SAMPLING).is_empty() {
            assert!(overruled.is_empty() && headings == slot.headings, "nothing is changed without need");
        } else {
            changed += 1;
        }
        for change in &overruled {
            assert_eq!(change.preferred, slot.headings[change.uav as usize]);
        }
    }
    println!("{slots} slots: {changed} changed, {unavoidable} with a violation that nothing avoids");
    assert!(changed > slots / 10 && unavoidable > 0);
}

/// UAVs at `positions` that keep `min_separation`, with random Q-values and headings.
fn crowd(positions: Vec<Point>, min_separation: f64) -> (Slot, Vec<u8>, Vec<Overruled>) {
    let mut rng = qedgix::rng::stream(positions.len() as u64, "crowd", 0);
    let q: Vec<f32> = (0..8 * positions.len()).map(|_| rng.random()).collect();
    let headings: Vec<u8> = (0..positions.len()).map(|_| rng.random_range(0..8)).collect();
    let guard = Guard { min_separation, home: Some([0.5; 2]), ..Guard::default() };
    let endurance = vec![f64::INFINITY; positions.len()];
    let slot = Slot { guard, env: EnvParams::default(), positions, endurance, q, headings };
    let mut headings = slot.headings.clone();
    let Slot { guard, env, positions, endurance, q, .. } = &slot;
    let overruled = guard.apply(&Situation { env, speeds: &[], positions, endurance, q_values: q }, &mut headings);
    (slot, headings, overruled)
}

#[test]
fn thousands_in_one_place_do_not_take_forever() {
    // A search over all of them would be 5000 calls deep, and there are 12 million pairs.
    let (_, _, overruled) = crowd(vec![[0.5; 2]; 5000], 10.0);
    assert_eq!(overruled.len(), 5000, "nobody can keep the distance");
    assert!(overruled.iter().all(|of| of.violates == [Constraint::Separation]));
    // Groups of six, of which none can be separated: the slot has one budget for all of them.
    let groups = (0..300).flat_map(|k| vec![[0.1 * f64::from(k % 20), 0.1 * f64::from(k / 20)]; 6]).collect();
    let (_, _, overruled) = crowd(groups, 0.085);
    assert!(overruled.iter().filter(|of| !of.violates.is_empty()).count() >= 300 * 2);
}

#[test]
fn large_groups_are_kept_apart() {
    let grid = |n: usize, apart: f64| (0..n * n).map(|k| [k % n, k / n].map(|x| 0.1 + apart * x as f64)).collect::<Vec<Point>>();
    for (n, apart) in [(5, 0.06), (12, 0.055)] {
        let (slot, headings, overruled) = crowd(grid(n, apart), 0.05);
        assert!(overruled.iter().all(|of| of.violates.is_empty()), "{n} x {n}: all could hover");
        assert_eq!(slot.broken(&headings, ROUNDING), []);
        assert!(headings.iter().filter(|&&h| usize::from(h) < 8).count() > n, "not all hover");
    }
}

#[test]
fn what_constraints_cost_is_estimated() {
    // What the thread of a caller may do, and what threads for heavy tasks do, in units of work.
    let (inline, heavy) = (1 << 13, 1 << 16);
    let apart = Guard { min_separation: 0.05, ..Guard::default() };
    let row = |uavs: usize, by: f64| (0..uavs).map(|i| [by * i as f64, 0.5]).collect::<Vec<Point>>();
    let cost = |guard: &Guard, positions: &[Point]| guard.work(Some(positions), positions.len(), 0.04);
    assert!(cost(&apart, &row(3, 0.01)) < inline);
    assert!(cost(&apart, &row(12, 0.2)) < inline, "far from each other");
    assert!(cost(&apart, &row(12, 0.01)) > heavy);
    assert!(apart.work(None, 12, 0.04) > heavy, "positions are not known yet");
    let zones = Guard { no_fly: vec![Zone::Polygon(vec![[0.0; 2]; 64]); 64], ..Guard::default() };
    assert!(cost(&zones, &row(3, 0.2)) > inline && cost(&zones, &row(12, 0.2)) > heavy);
}

#[test]
fn a_uav_outside_of_the_area_does_not_jump_back() {
    let zone = Zone::Circle([1.2, 0.5], 0.05);
    let guard = Guard { no_fly: vec![zone], ..Guard::default() };
    let (env, positions) = (EnvParams::default(), [[1.5, 0.5]]);
    let situation = Situation { env: &env, speeds: &[], positions: &positions, endurance: &[], q_values: &[] };
    let mut headings = [4];
    assert_eq!(guard.apply(&situation, &mut headings), [], "it does not reach the zone in this slot");
    assert_eq!(headings, [4]);
}

#[tokio::test]
async fn a_panic_while_constraints_are_applied_is_an_error() {
    let server = Server::with(|config| config.engine.threads = 1).await;
    server.add("panics", 1, Arc::new(TestPolicy::PanicOverruled));
    server.add("counts", 1, Arc::new(TestPolicy::Count));
    let mut client = server.grpc().await;
    let center = Some(v1::Position { x: 0.5, y: 0.5, z: None });
    let zone = v1::Zone { center, radius: Some(2.0), ..Default::default() };
    let constraints = Some(v1::Constraints { no_fly: vec![zone], ..Default::default() });
    for _ in 0..3 {
        let request = v1::ActRequest { constraints: constraints.clone(), ..held("panics", Bytes::new(), scene(2, 2, 0)) };
        let (code, reason, _) = refused(with_timeout(client.act(request)).await);
        assert_eq!((code, reason.as_str()), (Code::Internal, "internal"));
    }
    // The only thread of the engine still works.
    with_timeout(client.act(held("counts", Bytes::new(), scene(2, 2, 0)))).await.unwrap();
}

#[tokio::test]
async fn answers_say_what_was_overruled() {
    let server = Server::start().await;
    let mut client = server.grpc().await;
    let at = |x: f64, y: f64| v1::Position { x, y, z: None };
    let zone =
        v1::Zone { corners: vec![at(520.0, 0.0), at(900.0, 0.0), at(900.0, 1000.0), at(520.0, 1000.0)], ..Default::default() };
    let circle = v1::Zone { center: Some(at(100.0, 100.0)), radius: Some(50.0), ..Default::default() };
    let constraints = v1::Constraints { no_fly: vec![zone, circle], min_separation: Some(20.0), ..Default::default() };
    let frame = v1::Frame { side: Some(1000.0), ..Default::default() };
    let request = v1::OpenSessionRequest { frame: Some(frame), constraints: Some(constraints), ..open("nearest", "s") };
    client.open_session(request.clone()).await.unwrap();
    // Both UAVs want to fly to the user in the zone.
    let uav = |id: &str, y: f64| v1::SceneUav { id: id.into(), x: 500.0, y, ..Default::default() };
    let user = v1::SceneUser { id: "u".into(), x: 700.0, y: 500.0, aoi: 9.0, z: None };
    let scene = v1::Scene { uavs: vec![uav("a", 500.0), uav("b", 530.0)], users: vec![user] };
    let answer = client.act(in_session("s", Some(0), scene.clone())).await.unwrap().into_inner();
    for action in &answer.actions {
        let overruled = action.overruled.as_ref().unwrap();
        assert_eq!((overruled.preferred_heading_index, overruled.because.as_slice()), (0, &[v1::Constraint::NoFly as i32][..]));
        assert!(overruled.violates.is_empty() && action.heading_index != 0);
    }
    let again = client.act(in_session("s", Some(0), scene)).await.unwrap().into_inner();
    assert_eq!(again, answer, "a repetition has the same answer");
    let with = |change: fn(&mut v1::Constraints)| {
        let mut request = v1::OpenSessionRequest { session_id: String::new(), ..request.clone() };
        change(request.constraints.as_mut().unwrap());
        request
    };
    for (request, field) in [
        (with(|c| c.no_fly[0].corners.truncate(2)), "constraints.no_fly[0].corners"),
        (with(|c| c.no_fly[1].radius = None), "constraints.no_fly[1]"),
        (with(|c| c.no_fly[1].radius = Some(-1.0)), "constraints.no_fly[1].radius"),
        (with(|c| c.no_fly = vec![c.no_fly[1].clone(); 65]), "constraints.no_fly"),
        (with(|c| c.min_separation = Some(f64::NAN)), "constraints.min_separation"),
        (with(|c| c.max_distance = Some(1.0)), "constraints.home"),
        (with(|c| c.return_in_time = true), "constraints.home"),
    ] {
        let (code, _, found) = refused(client.open_session(request).await);
        assert_eq!((code, found.as_str()), (Code::InvalidArgument, field));
    }
}
