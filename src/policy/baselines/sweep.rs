//! `sweep`: no prior knowledge. UAVs fan out over the square, search what they have not seen, and serve the users they found.
//!
//! Local knowledge only: a UAV knows the square, its own index among M, and what it detected itself. One rule weighs
//! searching against serving: fly to where most AoI is removed per slot of flight, where unseen ground is taken to hold the
//! users that the UAV does not know. Each UAV looks first in its own sector of the square.

use std::f64::consts::{PI, TAU};

use super::geometry::{distance, heading_toward, travel_slots};
use super::{EnvParams, RequiredInput, Rule, own_positions};
use crate::env::Point;
use crate::policy::Slot;

/// Memory of each UAV: a grid of cells, 1 where seen; then per user whether it is known, where, and the slot at which its
/// data was last collected.
#[derive(Default)]
pub(super) struct Sweep;

/// Cells along each side of the square.
const GRID: usize = 10;
const CELLS: usize = GRID * GRID;
/// f32s per user.
const USER: usize = 4;
/// A UAV is this unconcerned about unseen ground in the sectors of others.
const FOREIGN: f64 = 0.02;
/// AoI hoped for in unseen ground against AoI known: what is found can be served again and again.
const CURIOSITY: f64 = 2.0;
/// What another UAV that is nearer leaves of a user's attraction.
const RIVALRY: f64 = 0.3;
/// Power of the flight time that AoI is divided by; above 1, near users come first. Chosen on `valid-v1`, like the above.
const HASTE: f64 = 1.25;

impl Rule for Sweep {
    const NAME: &'static str = "sweep";
    const TEXT: &'static str = "No prior knowledge: UAVs fan out, search, and serve the users that each found itself.";
    const NEEDS: RequiredInput = RequiredInput::OwnPositions;

    fn memory_len(&self, uavs: usize, users: usize) -> usize {
        uavs * (CELLS + USER * users)
    }

    fn start(&self, _seed: u64, _memory: &mut [f32]) {}

    fn fly(&self, world: &EnvParams, slot: &Slot, step: u64, memory: &mut [f32], headings: &mut [u8]) {
        let memories = memory.chunks_exact_mut(CELLS + USER * slot.users());
        for ((i, memory), heading) in memories.enumerate().zip(headings) {
            let (seen, users) = memory.split_at_mut(CELLS);
            let uav = Uav { world, index: i, fleet: slot.uavs(), at: own_positions(slot)[i], now: step as f64 };
            let rivals = uav.look(slot, seen, users);
            let serving = uav.best_user(users, &rivals);
            let searching = uav.best_ground(seen, users);
            let best = if serving.0 >= searching.0 { serving } else { searching };
            *heading = heading_toward(world, uav.at, best.1);
        }
    }
}

/// A promise and where it is: AoI removed per slot of flight, 0 for nothing to do.
type Goal = (f64, Point);

/// Where a UAV with nothing to do goes.
const HOME: Goal = (0.0, [0.5, 0.5]);

/// One UAV in one slot.
struct Uav<'a> {
    world: &'a EnvParams,
    index: usize,
    fleet: usize,
    at: Point,
    now: f64,
}

impl Uav<'_> {
    /// Writes what is seen into the memory; the positions of other UAVs in sight.
    fn look(&self, slot: &Slot, seen: &mut [f32], users: &mut [f32]) -> Vec<Point> {
        let range = self.world.detection_range;
        for (_, seen) in seen.iter_mut().enumerate().filter(|(c, _)| distance(self.at, center(*c)) <= range) {
            *seen = 1.0;
        }
        // A user that should be in sight and is not has walked away. Just inside the edge, rounding could hide it.
        for user in users.chunks_exact_mut(USER).filter(|u| distance(self.at, position(u)) < 0.99 * range) {
            user[0] = 0.0;
        }
        let mut rivals = Vec::new();
        for detection in slot.detections(self.index) {
            let [x, y] = [0, 1].map(|k| self.at[k] + f64::from(detection.rel[k]));
            match (detection.target as usize).checked_sub(slot.uavs()) {
                Some(j) => {
                    let collected = self.now as f32 - slot.aoi()[j];
                    users[j * USER..][..USER].copy_from_slice(&[1.0, x as f32, y as f32, collected]);
                }
                None => rivals.push([x, y]),
            }
        }
        rivals
    }

    /// The known user that promises most.
    fn best_user(&self, users: &[f32], rivals: &[Point]) -> Goal {
        let mut best = HOME;
        for user in users.chunks_exact(USER).filter(|u| u[0] > 0.0 && f64::from(u[3]) < self.now) {
            let to = position(user);
            let slots = travel_slots(self.world, self.at, to, self.world.transmission_range);
            let age = self.now - f64::from(user[3]) + slots;
            let contested = rivals.iter().any(|&r| distance(r, to) < distance(self.at, to));
            let promise = age / slots.powf(HASTE) * if contested { RIVALRY } else { 1.0 };
            if promise > best.0 {
                best = (promise, to);
            }
        }
        best
    }

    /// The unseen ground that promises most.
    fn best_ground(&self, seen: &[f32], users: &[f32]) -> Goal {
        let unknown = users.chunks_exact(USER).filter(|u| u[0] == 0.0).count();
        let unseen: Vec<(Point, f64)> =
            (0..CELLS).filter(|&c| seen[c] == 0.0).map(|c| (center(c), self.concern(center(c)))).collect();
        let range = self.world.detection_range;
        let users_per_cell = unknown as f64 / unseen.len().max(1) as f64;
        let mut best = HOME;
        for &(to, _) in &unseen {
            let in_sight = |p: Point| (p[0] - to[0]).powi(2) + (p[1] - to[1]).powi(2) <= range * range;
            let cells: f64 = unseen.iter().filter(|(p, _)| in_sight(*p)).map(|(_, concern)| concern).sum();
            let slots = travel_slots(self.world, self.at, to, range);
            let promise = CURIOSITY * cells * users_per_cell * (self.now + slots) / (slots + 1.0);
            if promise > best.0 {
                best = (promise, to);
            }
        }
        best
    }

    /// How much unseen ground at `p` matters to this UAV: fully within its sector around the middle of the square.
    fn concern(&self, p: Point) -> f64 {
        let own = TAU * self.index as f64 / self.fleet as f64;
        let off = ((p[1] - 0.5).atan2(p[0] - 0.5) - own).rem_euclid(TAU);
        if off.min(TAU - off) <= PI / self.fleet as f64 { 1.0 } else { FOREIGN }
    }
}

/// Middle of cell `c`.
fn center(c: usize) -> Point {
    [c % GRID, c / GRID].map(|k| (k as f64 + 0.5) / GRID as f64)
}

/// Remembered position of a user.
fn position(user: &[f32]) -> Point {
    [user[1].into(), user[2].into()]
}
