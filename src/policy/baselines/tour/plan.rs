//! From shared-out users to the plan of the fleet: changes at random, kept where all UAVs flying together keep data fresher.
//!
//! Here UAVs may share a user, a user may come twice in a tour, and what one UAV collects in passing counts.

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::flight::{Pilot, Scene};
use super::partition;
use crate::rng;

/// Most users for which the fleet as a whole is simulated: one bit each.
const TOGETHER: usize = 64;
/// Changes that are tried; ten times as many keep data fresher by one part in a hundred.
const TRIES: usize = 400;

/// A tour per UAV, `capacity` entries in all.
pub fn tours(scene: &Scene, capacity: usize) -> Vec<Vec<u32>> {
    let mut plan = partition::tours(scene);
    if scene.users.len() > TOGETHER {
        return plan;
    }
    // The same numbers for every scene: the plan is a function of the scene.
    let mut rng = rng::stream(0, "tour", 0);
    let mut tracks: Vec<Track> = plan.iter().enumerate().map(|(uav, tour)| track(scene, uav, tour)).collect();
    let mut best = age(scene, &tracks);
    for _ in 0..TRIES {
        let Some((changed, tours)) = change(&plan, capacity, &mut rng) else { continue };
        let before: Vec<Track> =
            tours.iter().map(|&uav| std::mem::replace(&mut tracks[uav], track(scene, uav, &changed[uav]))).collect();
        let age = age(scene, &tracks);
        if age <= best {
            best = age;
            plan = changed;
        } else {
            for (&uav, before) in tours.iter().zip(before) {
                tracks[uav] = before;
            }
        }
    }
    plan
}

/// A bit per user, for each slot: whose data one UAV collects.
type Track = Vec<u64>;

fn track(scene: &Scene, uav: usize, tour: &[u32]) -> Track {
    let pilot = Pilot::new(scene.world);
    let collected = |at| {
        let bits = scene.users.iter().enumerate().map(|(i, &user)| u64::from(pilot.collects(at, user)) << i);
        bits.fold(0, |all, bit| all | bit)
    };
    pilot.path(scene, uav, tour.to_vec()).map(collected).collect()
}

/// Sum of ages over users and slots.
fn age(scene: &Scene, tracks: &[Track]) -> f64 {
    let collected: Vec<u64> = (0..scene.slots).map(|k| tracks.iter().fold(0, |all, track| all | track[k])).collect();
    let mut sum = 0.0;
    for (i, &first) in scene.aoi.iter().enumerate() {
        let mut age = f64::from(first);
        for set in &collected {
            age = if set >> i & 1 == 1 { 0.0 } else { age + 1.0 };
            sum += age;
        }
    }
    sum
}

/// A plan with one change, and the UAVs whose tours it changes; none where the draw leads to no plan.
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
        // Moved, also within a tour.
        0 | 1 => {
            changed[from].remove(i);
            let end = changed[to].len();
            changed[to].insert(j.min(end), user);
        }
        // Shared.
        2 if plan.iter().map(Vec::len).sum::<usize>() < capacity => changed[to].insert(j, user),
        // No longer shared.
        3 if plan.iter().flatten().filter(|&&u| u == user).count() > 1 => {
            changed[from].remove(i);
            return Some((changed, vec![from]));
        }
        // Exchanged.
        4 if j < plan[to].len() => {
            changed[from][i] = plan[to][j];
            changed[to][j] = user;
        }
        // Turned round, or begun elsewhere.
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
