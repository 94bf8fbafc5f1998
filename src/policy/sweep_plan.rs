//! Where the rules `sweep` and `sweep-shared` fly, and what they advise a learned policy (docs/model.md, "Advice").
//!
//! A UAV flies to where it expects to remove most AoI per slot of flight: to a known user, or to a part of the square that it has not
//! searched and that may hold the users it does not know. Each UAV searches its own sector of the square first. The heading follows from
//! the UAV's memory and what it detects in this slot; the rule has no state of its own.

use std::sync::LazyLock;

use super::fleet_profile::direction;
use super::flight::{Headings, distance, travel_slots};
use super::memory::{GRID, RememberedUser, UavMemory};
use super::{EnvParams, FleetProfile, Sector, Sight, UserCount};
use crate::env::Point;
use crate::nn::simd;
use crate::threads;

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
    /// Weight of a user to whom a detected UAV is nearer, or as near while the user is not in the UAV's own sector: UAVs in one place
    /// part.
    pub(crate) contested: f64,
    /// AoI is divided by the flight time to this power. Above 1, near users are preferred.
    pub(crate) time_power: f64,
}

pub(crate) const WEIGHTS: Weights = Weights { foreign_sector: 0.02, search: 2.0, contested: 0.3, time_power: 1.25 };

/// Writes the heading that each UAV of a fleet would fly in slot `slot`. `memories` are those of this slot.
pub(super) fn sweep_headings<'a>(
    (env, sight, slot): (&EnvParams, &Sight<'_>, u64),
    memories: impl Iterator<Item = UavMemory<'a>> + Clone + Sync,
    profile: Option<&FleetProfile>,
    headings: &mut [u8],
) {
    let part = threads::part(headings.len());
    threads::for_each(headings.chunks_mut(part).enumerate(), |(k, headings)| {
        let first = k * part;
        for ((i, heading), memory) in (first..).zip(headings).zip(memories.clone().skip(first)) {
            let sector = FleetProfile::sector(profile, i, sight.uavs());
            let own = FleetProfile::env(profile, env, i);
            let uav = Uav { env: &own, sector, at: sight.positions[i], now: slot as f64 };
            let serving = uav.best_user(memory.users().flatten(), sight.detected_uavs(i).map(|(_, at)| at));
            let searching = uav.best_block(memory, FleetProfile::users(profile));
            let best = if serving.score >= searching.score { serving } else { searching };
            *heading = Headings::new(&own, uav.at).toward(best.position);
        }
    });
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
    sector: Sector,
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
            let (own, nearest) = (distance(self.at, to), uavs.clone().map(|r| distance(r, to)).fold(f64::INFINITY, f64::min));
            let contested = nearest < own || nearest == own && !self.sector.owns(to);
            let score = age / time_weight(slots) * if contested { WEIGHTS.contested } else { 1.0 };
            if score > best.score {
                best = Candidate { score, position: to };
            }
        }
        best
    }

    /// The block with the best score among those that are not searched.
    fn best_block(&self, memory: UavMemory<'_>, count: UserCount) -> Candidate {
        let (unknown, now) = (memory.unknown_users(count), self.now - memory.unknown_since(count));
        let ground = Ground::new(memory, &self.sector);
        let range = self.env.detection_range;
        let users_per_block = unknown as f64 / ground.unsearched.max(1.0);
        let mut best = NOTHING;
        for (row, &unsearched) in ground.cells.iter().enumerate().filter(|(_, cells)| **cells != [0; _]) {
            let y = CENTERS[row];
            let scores = simd(
                #[inline(always)]
                || {
                    let weights = ground.weights_within(row, range);
                    let mut scores = [0.0; LANES];
                    for ((score, weight), &x) in scores.iter_mut().zip(weights).zip(&CENTERS) {
                        let slots = travel_slots(self.env, self.at, [x, y], range);
                        *score = WEIGHTS.search * weight * users_per_block * (now + slots) / (slots + 1.0);
                    }
                    scores
                },
            );
            for (column, (&score, unsearched)) in scores.iter().zip(unsearched).enumerate() {
                if unsearched > 0 && score > best.score {
                    best = Candidate { score, position: [CENTERS[column], y] };
                }
            }
        }
        best
    }
}

/// Blocks of a row, filled up to a whole number of vectors.
const LANES: usize = 16;

/// The coordinates of the centres of the blocks; far away beyond the last block.
const CENTERS: [f64; LANES] = {
    let mut centers = [1e9; LANES];
    let mut k = 0;
    while k < BLOCKS {
        centers[k] = (k as f64 + 0.5) / BLOCKS as f64;
        k += 1;
    }
    centers
};

/// Squares of the distances between the centres of blocks k and l.
const SQUARES: [[f64; LANES]; BLOCKS] = {
    let mut squares = [[f64::INFINITY; LANES]; BLOCKS];
    let mut k = 0;
    while k < BLOCKS * BLOCKS {
        let difference = CENTERS[k / BLOCKS] - CENTERS[k % BLOCKS];
        squares[k / BLOCKS][k % BLOCKS] = difference * difference;
        k += 1;
    }
    squares
};

/// The [`direction`] of the centre of each block.
static DIRECTIONS: LazyLock<[[f64; BLOCKS]; BLOCKS]> =
    LazyLock::new(|| std::array::from_fn(|row| std::array::from_fn(|column| direction([CENTERS[column], CENTERS[row]]))));

/// The flight time to the power of the rule. Most flights take few slots.
fn time_weight(slots: f64) -> f64 {
    static OF_INTEGERS: LazyLock<[f64; 64]> = LazyLock::new(|| std::array::from_fn(|k| (k as f64).powf(WEIGHTS.time_power)));
    // Numbers of slots are whole, and at least 1.
    OF_INTEGERS.get(slots as usize).copied().unwrap_or_else(|| slots.powf(WEIGHTS.time_power))
}

/// The blocks of ground, row by row.
struct Ground {
    /// Cells of each block that were not searched.
    cells: [[u8; BLOCKS]; BLOCKS],
    /// The share of each block that was not searched, times the weight of its sector.
    weights: [[f64; BLOCKS]; BLOCKS],
    /// The shares of all blocks together.
    unsearched: f64,
}

impl Ground {
    fn new(memory: UavMemory<'_>, sector: &Sector) -> Self {
        let mut ground = Self { cells: [[0; _]; _], weights: [[0.0; _]; _], unsearched: 0.0 };
        let directions = &*DIRECTIONS;
        for row in 0..BLOCKS {
            let cells: [u32; SIDE] = std::array::from_fn(|r| !memory.searched(SIDE * row + r));
            for column in 0..BLOCKS {
                let left = cells.map(|cells| ((cells >> (SIDE * column)) & ((1 << SIDE) - 1)).count_ones() as u8);
                let left = left.iter().sum::<u8>();
                if left > 0 {
                    let share = f64::from(left) / (SIDE * SIDE) as f64;
                    let own = sector.owns_direction(directions[row][column]);
                    ground.cells[row][column] = left;
                    ground.weights[row][column] = share * if own { 1.0 } else { WEIGHTS.foreign_sector };
                    ground.unsearched += share;
                }
            }
        }
        ground
    }

    /// For each block of row `row`, the sum of the weights of the blocks whose centre is within `range` of its centre.
    #[inline(always)]
    fn weights_within(&self, row: usize, range: f64) -> [f64; LANES] {
        let square = range * range;
        let mut sums = [0.0; LANES];
        for (weights, &dy) in self.weights.iter().zip(&SQUARES[row]).filter(|(_, dy)| **dy <= square) {
            for (&weight, squares) in weights.iter().zip(&SQUARES) {
                for (sum, dx) in sums.iter_mut().zip(squares) {
                    *sum += if dx + dy <= square { weight } else { 0.0 };
                }
            }
        }
        sums
    }
}
