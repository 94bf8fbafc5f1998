//! `sweep`: no prior knowledge. UAVs fan out over the square, search it, and serve the users they have found.
//!
//! A UAV knows the square, its own index among M, and what it has detected itself. It flies to where it expects to remove most
//! AoI per slot of flight: to a known user, or to a part of the square that it has not seen and that may hold the users it does
//! not know. Each UAV searches its own sector of the square first.

use std::f64::consts::{PI, TAU};

use super::geometry::{distance, heading_toward, travel_slots};
use super::rule::{EnvParams, Rule, uav_positions};
use crate::env::Point;
use crate::policy::{FleetGraph, RequiredInput};

/// Memory of each UAV: a grid of cells, 1 if the cell was seen; then for each user: 1 if it is known, its position (x, y), and
/// the slot in which its data was last collected.
#[derive(Default)]
pub(super) struct Sweep;

/// Cells along each side of the square.
const GRID: usize = 10;
const CELLS: usize = GRID * GRID;
/// Numbers per user in the memory.
const USER: usize = 4;
// The following four weights were chosen on `valid-v1`.
/// Weight of unseen cells in the sectors of other UAVs; in the UAV's own sector it is 1.
const FOREIGN_SECTOR: f64 = 0.02;
/// Weight of the AoI expected in unseen cells relative to known AoI: a user that is found can be served many times.
const SEARCH: f64 = 2.0;
/// Weight of a user to whom a detected UAV is nearer.
const CONTESTED: f64 = 0.3;
/// AoI is divided by the flight time to this power. Above 1, near users are preferred.
const TIME_POWER: f64 = 1.25;

impl Rule for Sweep {
    const NAME: &'static str = "sweep";
    const DESCRIPTION: &'static str = "No prior knowledge: UAVs fan out, search, and serve the users that each found itself.";
    const NEEDS: RequiredInput = RequiredInput::OwnPositions;

    fn memory_len(&self, uavs: usize, users: usize) -> usize {
        uavs * (CELLS + USER * users)
    }

    fn start(&self, _seed: u64, _memory: &mut [f32]) {}

    fn decide(&self, env: &EnvParams, graph: &FleetGraph, step: u64, memory: &mut [f32], headings: &mut [u8]) {
        let memories = memory.chunks_exact_mut(CELLS + USER * graph.users());
        for ((i, memory), heading) in memories.enumerate().zip(headings) {
            let (seen, users) = memory.split_at_mut(CELLS);
            let uav = Uav { env, index: i, uavs: graph.uavs(), at: uav_positions(graph)[i], now: step as f64 };
            let nearby = uav.observe(graph, seen, users);
            let serving = uav.best_user(users, &nearby);
            let searching = uav.best_cell(seen, users);
            let best = if serving.score >= searching.score { serving } else { searching };
            *heading = heading_toward(env, uav.at, best.position);
        }
    }
}

/// A place to fly to.
#[derive(Clone, Copy)]
struct Candidate {
    /// AoI removed per slot of flight, as weighted above.
    score: f64,
    position: Point,
}

/// A UAV with nothing to do flies to the centre.
const NOTHING: Candidate = Candidate { score: 0.0, position: [0.5, 0.5] };

/// One UAV in one slot.
struct Uav<'a> {
    env: &'a EnvParams,
    index: usize,
    uavs: usize,
    at: Point,
    now: f64,
}

impl Uav<'_> {
    /// Writes what the UAV detects into its memory. Returns the positions of the other UAVs that it detects.
    fn observe(&self, graph: &FleetGraph, seen: &mut [f32], users: &mut [f32]) -> Vec<Point> {
        let range = self.env.detection_range;
        for (_, seen) in seen.iter_mut().enumerate().filter(|(c, _)| distance(self.at, center(*c)) <= range) {
            *seen = 1.0;
        }
        // A user that should be detected and is not has moved away. The margin allows for rounding.
        for user in users.chunks_exact_mut(USER).filter(|u| distance(self.at, position(u)) < 0.99 * range) {
            user[0] = 0.0;
        }
        let mut uavs = Vec::new();
        for detection in graph.detections(self.index) {
            let [x, y] = [0, 1].map(|k| self.at[k] + f64::from(detection.rel[k]));
            match (detection.target as usize).checked_sub(graph.uavs()) {
                Some(j) => {
                    let collected = self.now as f32 - graph.aoi()[j];
                    users[j * USER..][..USER].copy_from_slice(&[1.0, x as f32, y as f32, collected]);
                }
                None => uavs.push([x, y]),
            }
        }
        uavs
    }

    /// The known user with the best score.
    fn best_user(&self, users: &[f32], uavs: &[Point]) -> Candidate {
        let mut best = NOTHING;
        for user in users.chunks_exact(USER).filter(|u| u[0] > 0.0 && f64::from(u[3]) < self.now) {
            let to = position(user);
            let slots = travel_slots(self.env, self.at, to, self.env.transmission_range);
            let age = self.now - f64::from(user[3]) + slots;
            let contested = uavs.iter().any(|&r| distance(r, to) < distance(self.at, to));
            let score = age / slots.powf(TIME_POWER) * if contested { CONTESTED } else { 1.0 };
            if score > best.score {
                best = Candidate { score, position: to };
            }
        }
        best
    }

    /// The unseen cell with the best score.
    fn best_cell(&self, seen: &[f32], users: &[f32]) -> Candidate {
        let unknown = users.chunks_exact(USER).filter(|u| u[0] == 0.0).count();
        let unseen: Vec<(Point, f64)> =
            (0..CELLS).filter(|&c| seen[c] == 0.0).map(|c| (center(c), self.cell_weight(center(c)))).collect();
        let range = self.env.detection_range;
        let users_per_cell = unknown as f64 / unseen.len().max(1) as f64;
        let mut best = NOTHING;
        for &(to, _) in &unseen {
            let in_range = |p: Point| (p[0] - to[0]).powi(2) + (p[1] - to[1]).powi(2) <= range * range;
            let cells: f64 = unseen.iter().filter(|(p, _)| in_range(*p)).map(|(_, weight)| weight).sum();
            let slots = travel_slots(self.env, self.at, to, range);
            let score = SEARCH * cells * users_per_cell * (self.now + slots) / (slots + 1.0);
            if score > best.score {
                best = Candidate { score, position: to };
            }
        }
        best
    }

    /// Weight of an unseen cell at `p`: 1 in the UAV's own sector around the centre of the square.
    fn cell_weight(&self, p: Point) -> f64 {
        let own = TAU * self.index as f64 / self.uavs as f64;
        let off = ((p[1] - 0.5).atan2(p[0] - 0.5) - own).rem_euclid(TAU);
        if off.min(TAU - off) <= PI / self.uavs as f64 { 1.0 } else { FOREIGN_SECTOR }
    }
}

/// Centre of cell `c`.
fn center(c: usize) -> Point {
    [c % GRID, c / GRID].map(|k| (k as f64 + 0.5) / GRID as f64)
}

/// Remembered position of a user.
fn position(user: &[f32]) -> Point {
    [user[1].into(), user[2].into()]
}
