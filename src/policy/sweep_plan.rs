//! Where the rules `sweep` and `sweep-shared` fly, and what they advise a learned policy (docs/model.md, "Advice").
//!
//! A UAV flies to where it expects to remove most AoI per slot of flight: to a known user, or to a part of the square that it has not
//! searched and that may hold the users it does not know. Each UAV searches its own sector of the square first. The heading follows from
//! the UAV's memory and what it detects in this slot; the rule has no state of its own.

use super::flight::{distance, heading_toward, travel_slots};
use super::memory::{GRID, RememberedUser, UavMemory};
use super::{EnvParams, FleetProfile, Place, Sight};
use crate::env::Point;

/// Blocks of cells along each side of the square.
pub(crate) const BLOCKS: usize = 10;
/// Cells along each side of a block.
const SIDE: usize = GRID / BLOCKS;

/// Weights of the rule, chosen on `valid-v1`.
pub(crate) struct Weights {
    /// Weight of cells in the sectors of other UAVs; in the UAV's own sector it is 1.
    pub(crate) foreign_sector: f64,
    /// Weight of the AoI expected in cells that were not searched relative to known AoI: a user that is found can be served many
    /// times.
    pub(crate) search: f64,
    /// Weight of a user to whom a detected UAV is nearer.
    pub(crate) contested: f64,
    /// AoI is divided by the flight time to this power. Above 1, near users are preferred.
    pub(crate) time_power: f64,
}

pub(crate) const WEIGHTS: Weights = Weights { foreign_sector: 0.02, search: 2.0, contested: 0.3, time_power: 1.25 };

/// Calls `advise` with the index of each UAV of a fleet and the heading that it would fly in slot `slot`. `memories` are those of this
/// slot.
pub(super) fn sweep_headings<'a>(
    (env, sight, slot): (&EnvParams, &Sight<'_>, u64),
    memories: impl Iterator<Item = UavMemory<'a>>,
    profile: Option<&FleetProfile>,
    mut advise: impl FnMut(usize, u8),
) {
    for (i, memory) in memories.enumerate() {
        let place = FleetProfile::place(profile, i, sight.uavs());
        let own = FleetProfile::env(profile, env, i);
        let uav = Uav { env: &own, place, at: sight.positions[i], now: slot as f64 };
        let serving = uav.best_user(memory.users().flatten(), sight.detected_uavs(i).map(|(_, at)| at));
        let searching = uav.best_block(memory, memory.unknown_users(FleetProfile::is_open(profile)));
        let best = if serving.score >= searching.score { serving } else { searching };
        advise(i, heading_toward(env, uav.at, best.position));
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
    fn best_user(&self, users: impl Iterator<Item = RememberedUser>, uavs: impl Iterator<Item = Point> + Clone) -> Candidate {
        let mut best = NOTHING;
        for user in users.filter(|user| f64::from(user.collected) < self.now) {
            let to = user.position;
            let slots = travel_slots(self.env, self.at, to, self.env.transmission_range);
            let age = self.now - f64::from(user.collected) + slots;
            let contested = uavs.clone().any(|r| distance(r, to) < distance(self.at, to));
            let score = age / slots.powf(WEIGHTS.time_power) * if contested { WEIGHTS.contested } else { 1.0 };
            if score > best.score {
                best = Candidate { score, position: to };
            }
        }
        best
    }

    /// The block with the best score among those that are not searched.
    fn best_block(&self, memory: UavMemory<'_>, unknown: usize) -> Candidate {
        let ground = Ground::new(memory, |center| self.sector_weight(center));
        let range = self.env.detection_range;
        let users_per_block = unknown as f64 / ground.unsearched.max(1.0);
        let mut best = NOTHING;
        for &(to, _) in &ground.blocks[..ground.len()] {
            let slots = travel_slots(self.env, self.at, to, range);
            let weight = ground.weight_within(to, range);
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

/// The blocks with ground that was not searched, row by row.
struct Ground {
    /// Centre and weight of each block: the share of it that was not searched, times the weight of its sector.
    blocks: [(Point, f64); BLOCKS * BLOCKS],
    /// The blocks of row r are `rows[r]..rows[r + 1]`.
    rows: [usize; BLOCKS + 1],
    /// The shares of all blocks together.
    unsearched: f64,
}

impl Ground {
    fn new(memory: UavMemory<'_>, sector_weight: impl Fn(Point) -> f64) -> Self {
        let mut ground = Self { blocks: [([0.0; 2], 0.0); _], rows: [0; _], unsearched: 0.0 };
        let mut len = 0;
        for row in 0..BLOCKS {
            let cells: [u32; SIDE] = std::array::from_fn(|r| !memory.searched(SIDE * row + r));
            for column in 0..BLOCKS {
                let left = cells.map(|cells| ((cells >> (SIDE * column)) & ((1 << SIDE) - 1)).count_ones());
                let share = f64::from(left.iter().sum::<u32>()) / (SIDE * SIDE) as f64;
                if share > 0.0 {
                    let center = [column, row].map(|k| (k as f64 + 0.5) / BLOCKS as f64);
                    ground.unsearched += share;
                    ground.blocks[len] = (center, share * sector_weight(center));
                    len += 1;
                }
            }
            ground.rows[row + 1] = len;
        }
        ground
    }

    /// Number of blocks.
    fn len(&self) -> usize {
        self.rows[BLOCKS]
    }

    /// Sum of the weights of the blocks whose centre is within `range` of `to`.
    fn weight_within(&self, to: Point, range: f64) -> f64 {
        let square = range * range;
        let mut sum = 0.0;
        for row in self.rows.windows(2).map(|ends| &self.blocks[ends[0]..ends[1]]) {
            // All blocks of a row have the same y.
            let Some(dy) = row.first().map(|(p, _)| (p[1] - to[1]).powi(2)).filter(|dy| *dy <= square) else { continue };
            for &(p, weight) in row {
                sum += if (p[0] - to[0]).powi(2) + dy <= square { weight } else { 0.0 };
            }
        }
        sum
    }
}
