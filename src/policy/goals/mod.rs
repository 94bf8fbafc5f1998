//! The places that a UAV with a memory may fly to: users that it remembers, and ground that it has not searched (docs/model.md,
//! "Goals"). Each goal lies in the direction of one heading, and has features that do not depend on the size of the fleet, the ranges
//! or the horizon, except through the quantities that matter: flight times, ages, and numbers of users.

mod columns;
mod ground;

use std::sync::LazyLock;

use columns::Columns;
use ground::RecentGround;

use super::env_params::EnvParams;
use super::fleet_profile::{FleetProfile, Sector, UserCount};
use super::flight::{Headings, travel_slots};
use super::memory::{GRID, RememberedUser, UavMemory};
use super::sight::Sight;
use super::sweep_plan::sweep_headings;
use crate::env::Point;
use crate::nn::simd;
use crate::threads;

/// Number of features of a goal.
pub const FEATURES: usize = 16;
/// A UAV that remembers more users considers these many as goals: those that promise the highest AoI per slot of flight.
pub const MAX_USERS: usize = 64;
/// Blocks of ground along each side of the square. Each block that is not searched is a goal.
const BLOCKS: usize = 5;
/// Maximum number of goals in the ground.
pub const MAX_BLOCKS: usize = BLOCKS * BLOCKS;

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
    others: Vec<Point>,
    columns: Columns,
    recent: RecentGround,
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
        memories: impl Iterator<Item = UavMemory<'a>> + Clone + Sync,
        profile: Option<&FleetProfile>,
    ) {
        let first = self.advice.len();
        self.advice.resize(first + slot.1.uavs(), 0);
        sweep_headings(slot, memories, profile, &mut self.advice[first..]);
    }

    /// Adds one row per UAV of a fleet in slot `slot`. `memories` holds their memories, `last` their last
    /// headings.
    pub(super) fn push_fleet<'a>(
        &mut self,
        slot: (&EnvParams, &Sight<'_>, u64),
        memories: impl Iterator<Item = UavMemory<'a>> + Clone + Sync,
        (last, profile): (&[u8], Option<&FleetProfile>),
    ) {
        let part = threads::part(last.len());
        if part >= last.len() {
            self.push_uavs(slot, (0, memories), (last, profile));
            return;
        }
        let mut parts = vec![Self::default(); last.len().div_ceil(part)];
        threads::for_each(parts.iter_mut().zip(last.chunks(part)).enumerate(), |(k, (goals, last))| {
            goals.clear();
            goals.push_uavs(slot, (k * part, memories.clone().skip(k * part)), (last, profile));
        });
        parts.iter().for_each(|part| self.append(part));
    }

    /// Adds the rows of other goals, without their advice.
    fn append(&mut self, other: &Self) {
        let first = self.headings.len() as u32;
        self.offsets.extend(other.offsets[1..].iter().map(|end| first + end));
        self.headings.extend_from_slice(&other.headings);
        self.features.extend_from_slice(&other.features);
        self.load.extend_from_slice(&other.load);
    }

    /// Adds one row for each UAV from `first` on, as many as `last` has headings.
    fn push_uavs<'a>(
        &mut self,
        (env, sight, slot): (&EnvParams, &Sight<'_>, u64),
        (first, memories): (usize, impl Iterator<Item = UavMemory<'a>>),
        (last, profile): (&[u8], Option<&FleetProfile>),
    ) {
        for ((i, &last), memory) in (first..).zip(last).zip(memories) {
            let at = sight.positions[i];
            let sector = FleetProfile::sector(profile, i, sight.uavs());
            let count = FleetProfile::users(profile);
            let own = FleetProfile::env(profile, env, i);
            let headings = Headings::new(&own, at);
            let view = View { env: &own, sector, count, uavs: sight.uavs(), at, headings, slot: slot as f64, last };
            self.others.clear();
            self.others.extend(sight.detected_uavs(i).map(|(_, at)| at));
            self.push_row(&view, memory);
        }
    }

    fn push_row(&mut self, view: &View<'_>, memory: UavMemory<'_>) {
        let Self { users, others, columns, recent, .. } = self;
        users.clear();
        users.extend(memory.users().flatten());
        let (known, unknown) = (users.len() + memory.users_left_out(), memory.unknown_users(view.count));
        let since = memory.unknown_since(view.count);
        let ground = recent.of(memory);
        let common = [
            ln1(ground.unsearched as f64 * CELL_SHARE * unknown as f64),
            unknown as f64 / (known + unknown).max(1) as f64,
            ground.unsearched as f64 * CELL_SHARE,
            ln1(known as f64 / view.uavs as f64),
        ];
        self.load.push(known as f32 / view.uavs as f32);
        view.keep_best(users);
        columns.begin(view, users, ground);
        simd(
            #[inline(always)]
            || columns.compute(view, (ground, unknown, since), others),
        );
        self.headings.extend_from_slice(columns.headings());
        self.features.reserve(FEATURES * columns.headings().len());
        columns.features(view, common).for_each(|features| self.features.extend_from_slice(&features));
        self.offsets.push(self.headings.len() as u32);
    }
}

/// Share of a cell of the ground.
const CELL_SHARE: f64 = 1.0 / (GRID * GRID) as f64;

/// ln(1 + x). Most arguments are small numbers of slots.
fn ln1(x: f64) -> f64 {
    static OF_INTEGERS: LazyLock<[f64; 256]> = LazyLock::new(|| std::array::from_fn(|k| (k as f64).ln_1p()));
    let x = x.max(0.0);
    let integer = x as usize;
    match OF_INTEGERS.get(integer) {
        Some(&ln) if integer as f64 == x => ln,
        _ => x.ln_1p(),
    }
}

/// One UAV in one slot.
struct View<'a> {
    env: &'a EnvParams,
    sector: Sector,
    count: UserCount,
    uavs: usize,
    at: Point,
    headings: Headings,
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
