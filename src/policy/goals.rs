//! The places that a UAV with a memory may fly to: users that it remembers, and ground that it has not searched (docs/model.md,
//! "Goals"). Each goal lies in the direction of one heading, and has features that do not depend on the size of the fleet, the ranges
//! or the horizon, except through the quantities that matter: flight times, ages, and numbers of users.

use super::env_params::EnvParams;
use super::fleet_profile::{FleetProfile, Place};
use super::flight::{distance, heading_toward, travel_slots};
use super::memory::{GRID, RememberedUser, UavMemory};
use super::sight::Sight;
use super::sweep_plan::sweep_headings;
use crate::env::Point;

/// Number of features of a goal.
pub const FEATURES: usize = 16;
/// A UAV that remembers more users considers these many as goals: those that promise the highest AoI per slot of flight.
pub const MAX_USERS: usize = 64;
/// Blocks of ground along each side of the square. Each block that is not searched is a goal.
const BLOCKS: usize = 5;
/// Maximum number of goals in the ground.
pub const MAX_BLOCKS: usize = BLOCKS * BLOCKS;
/// Cells along each side of a block.
const SIDE: usize = GRID / BLOCKS;

/// The goals of a batch of UAVs, in the order of the rows of a [`super::Geometry`].
#[derive(Clone, Debug, Default)]
pub struct Goals {
    /// The goals of row r are `offsets[r]..offsets[r + 1]`.
    offsets: Vec<u32>,
    headings: Vec<u8>,
    /// (goals, [`FEATURES`]).
    features: Vec<f32>,
    /// How many users the UAV of each row remembers, divided by M.
    load: Vec<f32>,
    /// The advised heading of each row; empty without advice.
    advice: Vec<u8>,
    users: Vec<RememberedUser>,
}

impl Goals {
    /// Number of features of a goal.
    pub const FEATURES: usize = FEATURES;
    /// Blocks of ground along each side of the square.
    pub const BLOCKS: usize = BLOCKS;

    /// Removes all rows.
    pub fn clear(&mut self) {
        self.offsets.clear();
        self.offsets.push(0);
        self.headings.clear();
        self.features.clear();
        self.load.clear();
        self.advice.clear();
    }

    /// Number of rows.
    pub fn rows(&self) -> usize {
        self.offsets.len().saturating_sub(1)
    }

    /// Number of goals.
    pub fn len(&self) -> usize {
        self.headings.len()
    }

    /// Whether there are no goals.
    pub fn is_empty(&self) -> bool {
        self.headings.is_empty()
    }

    /// Indices of the goals of row `r`.
    pub fn of_row(&self, r: usize) -> std::ops::Range<usize> {
        self.offsets[r] as usize..self.offsets[r + 1] as usize
    }

    /// The heading of each goal.
    pub fn headings(&self) -> &[u8] {
        &self.headings
    }

    /// The features of all goals, (goals, [`FEATURES`]).
    pub fn features(&self) -> &[f32] {
        &self.features
    }

    /// How many users the UAV of each row remembers, divided by M.
    pub fn load(&self) -> &[f32] {
        &self.load
    }

    /// The advised heading of each row; empty without advice.
    pub fn advice(&self) -> &[u8] {
        &self.advice
    }

    /// Adds the advice of `sweep` to the UAVs of a fleet in slot `slot`.
    pub(super) fn push_advice<'a>(
        &mut self,
        slot: (&EnvParams, &Sight<'_>, u64),
        memories: impl Iterator<Item = UavMemory<'a>>,
        profile: Option<&FleetProfile>,
    ) {
        sweep_headings(slot, memories, profile, |_, heading| self.advice.push(heading));
    }

    /// Adds one row per UAV of a fleet in slot `slot`. `memories` holds their memories, `last` their last
    /// headings.
    pub(super) fn push_fleet<'a>(
        &mut self,
        (env, sight, slot): (&EnvParams, &Sight<'_>, u64),
        memories: impl Iterator<Item = UavMemory<'a>>,
        (last, profile): (&[u8], Option<&FleetProfile>),
    ) {
        for ((i, memory), &last) in memories.enumerate().zip(last) {
            let at = sight.positions[i];
            let place = FleetProfile::place(profile, i, sight.uavs());
            let open = FleetProfile::is_open(profile);
            let own = FleetProfile::env(profile, env, i);
            let view = View { env: &own, place, open, uavs: sight.uavs(), at, slot: slot as f64, last };
            self.push_row(&view, memory, sight.detected_uavs(i).map(|(_, at)| at));
        }
    }

    fn push_row(&mut self, view: &View<'_>, memory: UavMemory<'_>, others: impl Iterator<Item = Point> + Clone) {
        let mut users = std::mem::take(&mut self.users);
        users.clear();
        users.extend(memory.users().flatten());
        let unknown = memory.unknown_users(view.open);
        let all = users.len() + unknown;
        let ground = Ground::new(memory);
        let common = [
            ln1(ground.unsearched as f64 * CELL_SHARE * unknown as f64),
            unknown as f64 / all.max(1) as f64,
            ground.unsearched as f64 * CELL_SHARE,
            ln1(users.len() as f64 / view.uavs as f64),
        ];
        self.load.push(users.len() as f32 / view.uavs as f32);
        view.keep_best(&mut users);
        for (j, user) in users.iter().enumerate() {
            let goal = view.user(user, &users, j);
            self.push(view, user.position, goal, common, others.clone());
        }
        for block in 0..BLOCKS * BLOCKS {
            if ground.blocks[block] > 0 {
                let to = ground.centers[block];
                let goal = view.ground(to, &ground, unknown);
                self.push(view, to, goal, common, others.clone());
            }
        }
        self.users = users;
        self.offsets.push(self.headings.len() as u32);
    }

    /// Adds a goal at `to`.
    fn push(&mut self, view: &View<'_>, to: Point, own: [f64; 7], common: [f64; 4], others: impl Iterator<Item = Point>) {
        let heading = heading_toward(view.env, view.at, to);
        let mine = distance(view.at, to);
        let nearest = others.map(|other| distance(other, to)).fold(f64::INFINITY, f64::min);
        // How much nearer this UAV is than the nearest other one that it detects, in units of d.
        let lead = ((nearest - mine) / view.env.detection_range).clamp(-1.0, 1.0);
        let contested = f64::from(u8::from(nearest < mine));
        let onward = f64::from(u8::from(heading == view.last));
        let shared = [lead, contested, onward, ((mine / view.env.detection_range) - 1.0).clamp(-1.0, 1.0), 1.0];
        self.headings.push(heading);
        self.features.extend(own.iter().chain(&common).chain(&shared).map(|&x| x as f32));
    }
}

/// Share of a cell of the ground.
const CELL_SHARE: f64 = 1.0 / (GRID * GRID) as f64;

/// A coordinate that is out of range of everything.
const FAR: f64 = 1e9;

/// ln(1 + x).
fn ln1(x: f64) -> f64 {
    x.max(0.0).ln_1p()
}

/// One UAV in one slot.
struct View<'a> {
    env: &'a EnvParams,
    place: Place,
    open: bool,
    uavs: usize,
    at: Point,
    slot: f64,
    last: u8,
}

impl View<'_> {
    /// Keeps the [`MAX_USERS`] users that promise most, in their order.
    fn keep_best(&self, users: &mut Vec<RememberedUser>) {
        if users.len() <= MAX_USERS {
            return;
        }
        let mut rates: Vec<(f64, usize)> = users.iter().enumerate().map(|(j, user)| (self.rate(user), j)).collect();
        rates.select_nth_unstable_by(MAX_USERS, |a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        let mut best: Vec<usize> = rates[..MAX_USERS].iter().map(|&(_, j)| j).collect();
        best.sort_unstable();
        for (place, &j) in best.iter().enumerate() {
            users[place] = users[j];
        }
        users.truncate(MAX_USERS);
    }

    /// AoI of a user when the UAV can be there, per slot of that flight.
    fn rate(&self, user: &RememberedUser) -> f64 {
        let slots = travel_slots(self.env, self.at, user.position, self.env.transmission_range);
        (self.slot - f64::from(user.collected) + slots) / slots
    }

    /// Features of user `j` of the remembered users.
    fn user(&self, user: &RememberedUser, users: &[RememberedUser], j: usize) -> [f64; 7] {
        let range = self.env.transmission_range;
        let age_after = |user: &RememberedUser, slots: f64| self.slot - f64::from(user.collected) + slots;
        let slots = travel_slots(self.env, self.at, user.position, range);
        let age = age_after(user, slots);
        // The best AoI per slot that the next flight, from there, promises.
        let next = users.iter().enumerate().filter(|(k, _)| *k != j).fold(0.0, |best: f64, (_, next)| {
            let onward = travel_slots(self.env, user.position, next.position, range);
            best.max(age_after(next, slots + onward) / onward)
        });
        let rate = age / slots;
        [1.0, ln1(slots), 1.0 / slots, ln1(age), ln1(rate), ln1(next), ln1(self.slot - f64::from(user.observed))]
    }

    /// Features of unsearched ground around `to`.
    fn ground(&self, to: Point, ground: &Ground, unknown: usize) -> [f64; 7] {
        let range = self.env.detection_range;
        let slots = travel_slots(self.env, self.at, to, range);
        let expected = unknown as f64 * ground.within(to, range) / f64::from(ground.unsearched.max(1));
        let rate = expected * (self.slot + slots) / slots;
        let own = f64::from(u8::from(self.place.owns(to)));
        [0.0, ln1(slots), 1.0 / slots, ln1(self.slot + slots), ln1(rate), ln1(expected), own]
    }
}

/// The ground that was not searched, by block.
struct Ground {
    /// Cells per block.
    blocks: [u32; BLOCKS * BLOCKS],
    /// Mean position of these cells; far away without any.
    centers: [Point; BLOCKS * BLOCKS],
    /// Cells of all blocks.
    unsearched: u32,
}

impl Ground {
    fn new(memory: UavMemory<'_>) -> Self {
        let mut ground = Self { blocks: [0; _], centers: [[FAR; 2]; _], unsearched: 0 };
        let mut sums = [[0; 2]; BLOCKS * BLOCKS];
        for row in 0..GRID {
            let mut cells = !memory.searched(row) & ((1 << GRID) - 1);
            while cells != 0 {
                let column = cells.trailing_zeros();
                cells &= cells - 1;
                let block = row / SIDE * BLOCKS + column as usize / SIDE;
                ground.blocks[block] += 1;
                sums[block][0] += column;
                sums[block][1] += row as u32;
                ground.unsearched += 1;
            }
        }
        for ((center, sums), &cells) in ground.centers.iter_mut().zip(sums).zip(&ground.blocks).filter(|(_, cells)| **cells > 0) {
            *center = sums.map(|sum: u32| (f64::from(sum) / f64::from(cells) + 0.5) / GRID as f64);
        }
        ground
    }

    /// Cells of the blocks whose centre is within `range` of `to`.
    fn within(&self, to: Point, range: f64) -> f64 {
        let near = |p: &Point| (p[0] - to[0]).powi(2) + (p[1] - to[1]).powi(2) <= range * range;
        let cells: u32 = self.centers.iter().zip(&self.blocks).map(|(center, cells)| if near(center) { *cells } else { 0 }).sum();
        f64::from(cells)
    }
}

#[cfg(test)]
mod tests {
    use super::super::FleetGraph;
    use super::super::memory::{memories, uav_memory_len};
    use super::*;

    #[test]
    fn of_many_users_the_most_promising_are_goals() {
        let (env, users) = (EnvParams::default(), 3 * MAX_USERS);
        // All at one place, with ages that only the last ones exceed.
        let mut memory = vec![0.0; uav_memory_len(users)];
        for (j, user) in memory[GRID..].chunks_exact_mut(5).enumerate() {
            user.copy_from_slice(&[1.0, 0.9, 0.9, if j < 2 * MAX_USERS { 50.0 } else { 10.0 }, 60.0]);
        }
        let graph = FleetGraph::from_scene(&[[0.1, 0.1]], &vec![[0.9, 0.9]; users], &vec![1.0; users], 0.28);
        let mut goals = Goals::default();
        goals.clear();
        goals.push_fleet((&env, &graph.sight().unwrap(), 60), memories(&memory, users), (&[0], None));
        assert_eq!(goals.len(), MAX_USERS + MAX_BLOCKS);
        let (oldest, user_goals) = (ln1(50.0), goals.features().chunks_exact(FEATURES).take(MAX_USERS));
        assert!(user_goals.into_iter().all(|features| f64::from(features[3]) > oldest), "AoI on arrival");
    }
}
