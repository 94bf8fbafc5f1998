//! `sweep`: no prior knowledge. UAVs fan out over the square, search it, and serve the users they have found. `sweep-shared`: the same,
//! and UAVs in communication range exchange their memories.
//!
//! A UAV knows the square, its place among the UAVs, and what it remembers (`policy::memory`). It flies to where it expects to remove most
//! AoI per slot of flight: to a known user, or to a part of the square that it has not searched and that may hold the users it does
//! not know. Each UAV searches its own sector of the square first.

use super::rule::{Rule, Slot};
use crate::env::Point;
use crate::policy::flight::{distance, heading_toward, travel_slots};
use crate::policy::memory::{self, GRID, RememberedUser, Sharing, UavMemory, remember, uav_memory_len};
use crate::policy::{Carry, EnvParams, FleetProfile, Place, Reach, RequiredInput};

/// With or without shared memories. The memory is that of `policy::memory`.
#[derive(Default)]
pub(super) struct Sweep<const SHARED: bool>;

/// Blocks of cells along each side of the square.
const BLOCKS: usize = 10;
/// Cells along each side of a block.
const SIDE: usize = GRID / BLOCKS;

/// Weights of the rule, chosen on `valid-v1`.
struct Weights {
    /// Weight of cells in the sectors of other UAVs; in the UAV's own sector it is 1.
    foreign_sector: f64,
    /// Weight of the AoI expected in cells that were not searched relative to known AoI: a user that is found can be served many
    /// times.
    search: f64,
    /// Weight of a user to whom a detected UAV is nearer.
    contested: f64,
    /// AoI is divided by the flight time to this power. Above 1, near users are preferred.
    time_power: f64,
}

const WEIGHTS: Weights = Weights { foreign_sector: 0.02, search: 2.0, contested: 0.3, time_power: 1.25 };

impl<const SHARED: bool> Rule for Sweep<SHARED> {
    const NAME: &'static str = if SHARED { "sweep-shared" } else { "sweep" };
    const DESCRIPTION: &'static str = if SHARED {
        "No prior knowledge: as sweep, and UAVs in communication range exchange what they remember."
    } else {
        "No prior knowledge: UAVs fan out, search, and serve the users that each found itself."
    };
    const NEEDS: RequiredInput = RequiredInput::OwnPositions;
    const REACH: Reach = Reach::Links(if SHARED { 1 } else { 0 });

    fn memory_len(&self, uavs: usize, users: usize) -> usize {
        uavs * uav_memory_len(users)
    }

    fn work(&self, uavs: usize, users: usize, detections: usize) -> usize {
        // Each UAV compares its blocks of ground with each other and looks at every user; then it may receive as many memories.
        let received = if SHARED { detections * uavs / (uavs + users) } else { 0 };
        uavs * (256 + users / 4) + detections + received * users / 8
    }

    fn start(&self, _seed: u64, _memory: &mut [f32]) {}

    fn carry(&self, from: &[f32], to: &mut [f32], carry: &Carry<'_>) {
        memory::carry(from, to, carry);
    }

    fn remembers_users(&self) -> bool {
        true
    }

    fn decide(&self, slot: &Slot<'_>, memory: &mut [f32], headings: &mut [u8]) {
        let Slot { env, graph, step, profile } = *slot;
        let sight = graph.sight().expect("the caller provides what `needs` requires");
        let sharing = if SHARED { Sharing::Shared } else { Sharing::Own };
        memory::exclude_outside(env, sight.users(), memory);
        remember(&sight, env.detection_range, step, sharing, memory, &mut Vec::new());
        let memories = memory.chunks_exact(uav_memory_len(graph.users())).map(UavMemory::new);
        for ((i, memory), heading) in memories.enumerate().zip(headings) {
            let place = FleetProfile::place(profile, i, graph.uavs());
            let own = FleetProfile::env(profile, env, i);
            let uav = Uav { env: &own, place, at: sight.positions[i], now: step as f64 };
            let nearby: Vec<Point> = sight.detected_uavs(i).map(|(_, at)| at).collect();
            let serving = uav.best_user(memory.users().flatten(), &nearby);
            let searching = uav.best_block(memory, memory.unknown_users(FleetProfile::is_open(profile)));
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
    place: Place,
    at: Point,
    now: f64,
}

impl Uav<'_> {
    /// The known user with the best score.
    fn best_user(&self, users: impl Iterator<Item = RememberedUser>, uavs: &[Point]) -> Candidate {
        let mut best = NOTHING;
        for user in users.filter(|user| f64::from(user.collected) < self.now) {
            let to = user.position;
            let slots = travel_slots(self.env, self.at, to, self.env.transmission_range);
            let age = self.now - f64::from(user.collected) + slots;
            let contested = uavs.iter().any(|&r| distance(r, to) < distance(self.at, to));
            let score = age / slots.powf(WEIGHTS.time_power) * if contested { WEIGHTS.contested } else { 1.0 };
            if score > best.score {
                best = Candidate { score, position: to };
            }
        }
        best
    }

    /// The block with the best score among those that are not searched.
    fn best_block(&self, memory: UavMemory<'_>, unknown: usize) -> Candidate {
        let mut unsearched = 0.0;
        let mut blocks: Vec<(Point, f64)> = Vec::with_capacity(BLOCKS * BLOCKS);
        for row in 0..BLOCKS {
            for column in 0..BLOCKS {
                let cells = (0..SIDE).map(|r| (!memory.searched(SIDE * row + r) >> (SIDE * column)) & ((1 << SIDE) - 1));
                let share = f64::from(cells.map(u32::count_ones).sum::<u32>()) / (SIDE * SIDE) as f64;
                if share > 0.0 {
                    let center = [column, row].map(|k| (k as f64 + 0.5) / BLOCKS as f64);
                    unsearched += share;
                    blocks.push((center, share * self.sector_weight(center)));
                }
            }
        }
        let range = self.env.detection_range;
        let users_per_block = unknown as f64 / unsearched.max(1.0);
        let mut best = NOTHING;
        for &(to, _) in &blocks {
            let in_range = |p: Point| (p[0] - to[0]).powi(2) + (p[1] - to[1]).powi(2) <= range * range;
            let weight: f64 = blocks.iter().filter(|(p, _)| in_range(*p)).map(|(_, weight)| weight).sum();
            let slots = travel_slots(self.env, self.at, to, range);
            let score = WEIGHTS.search * weight * users_per_block * (self.now + slots) / (slots + 1.0);
            if score > best.score {
                best = Candidate { score, position: to };
            }
        }
        best
    }

    /// Weight of a block at `p`: 1 in the UAV's own sector around the centre of the square.
    fn sector_weight(&self, p: Point) -> f64 {
        if self.place.owns(p) { 1.0 } else { WEIGHTS.foreign_sector }
    }
}
