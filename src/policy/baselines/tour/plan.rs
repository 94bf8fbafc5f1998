//! The plan of the fleet: starts from an assignment of users to UAVs, and keeps random changes that lower the sum of AoI of the
//! whole fleet.
//!
//! Unlike in the assignment, several UAVs may serve one user, a user may come twice in a tour, and data collected in passing
//! counts.

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::partition;
use super::pilot::{Pilot, Problem};
use crate::rng;

/// Maximum number of users for which the fleet is simulated: one bit per user.
const MAX_SIMULATED: usize = 64;
/// Number of changes that are tried. Ten times as many lower the AoI by 1 %.
const TRIES: usize = 400;

/// A tour per UAV, `capacity` entries in all.
pub fn tours(problem: &Problem, capacity: usize) -> Vec<Vec<u32>> {
    if problem.users.is_empty() {
        return vec![Vec::new(); problem.uavs.len()];
    }
    let mut plan = partition::tours(problem);
    if problem.users.len() > MAX_SIMULATED {
        return plan;
    }
    // A constant seed: the plan is a function of the problem.
    let mut rng = rng::stream(0, "tour", 0);
    let mut collected: Vec<Collections> = plan.iter().enumerate().map(|(uav, tour)| collections(problem, uav, tour)).collect();
    let mut best = age(problem, &collected);
    for _ in 0..TRIES {
        let Some((changed, tours)) = change(&plan, capacity, &mut rng) else { continue };
        let before: Vec<Collections> =
            tours.iter().map(|&uav| std::mem::replace(&mut collected[uav], collections(problem, uav, &changed[uav]))).collect();
        let age = age(problem, &collected);
        if age <= best {
            best = age;
            plan = changed;
        } else {
            for (&uav, before) in tours.iter().zip(before) {
                collected[uav] = before;
            }
        }
    }
    plan
}

/// For each slot, one bit per user: set if one UAV collects the user's data.
type Collections = Vec<u64>;

fn collections(problem: &Problem, uav: usize, tour: &[u32]) -> Collections {
    let pilot = Pilot::new(problem.env);
    let collected = |at| {
        let bits = problem.users.iter().enumerate().map(|(i, &user)| u64::from(pilot.collects(at, user)) << i);
        bits.fold(0, |all, bit| all | bit)
    };
    pilot.path(problem, uav, tour.to_vec()).map(collected).collect()
}

/// Sum of AoI over users and slots.
fn age(problem: &Problem, per_uav: &[Collections]) -> f64 {
    let collected: Vec<u64> = (0..problem.slots).map(|k| per_uav.iter().fold(0, |all, collected| all | collected[k])).collect();
    let mut sum = 0.0;
    for (i, &first) in problem.aoi.iter().enumerate() {
        let mut age = f64::from(first);
        for set in &collected {
            age = if set >> i & 1 == 1 { 0.0 } else { age + 1.0 };
            sum += age;
        }
    }
    sum
}

/// A plan with one random change, and the UAVs whose tours it changes; `None` if the change is not possible.
fn change(plan: &[Vec<u32>], capacity: usize, rng: &mut ChaCha8Rng) -> Option<(Vec<Vec<u32>>, Vec<usize>)> {
    let mut changed = plan.to_vec();
    let from = rng.random_range(0..plan.len());
    let to = rng.random_range(0..plan.len());
    let length = plan[from].len();
    if length == 0 {
        return None;
    }
    let i = rng.random_range(0..length);
    let j = rng.random_range(0..=plan[to].len());
    let user = plan[from][i];
    match rng.random_range(0..6) {
        // A user moves, possibly within a tour.
        0 | 1 => {
            changed[from].remove(i);
            let end = changed[to].len();
            changed[to].insert(j.min(end), user);
        }
        // A user is added to a second tour.
        2 if plan.iter().map(Vec::len).sum::<usize>() < capacity => changed[to].insert(j, user),
        // A user is removed from one of its tours.
        3 if plan.iter().flatten().filter(|&&u| u == user).count() > 1 => {
            changed[from].remove(i);
            return Some((changed, vec![from]));
        }
        // Two users are exchanged.
        4 if j < plan[to].len() => {
            changed[from][i] = plan[to][j];
            changed[to][j] = user;
        }
        // A tour is partly reversed, or starts elsewhere.
        5 => {
            if j % 2 == 0 {
                changed[from][i..].reverse();
            } else {
                changed[from].rotate_left(i);
            }
            return Some((changed, vec![from]));
        }
        _ => return None,
    }
    let mut uavs = vec![from, to];
    uavs.dedup();
    (changed != plan).then_some((changed, uavs))
}
