//! What all baselines share: the trait of a rule, and seeds in a fleet's memory.

use rand_chacha::ChaCha8Rng;

use crate::env::Point;
use crate::policy::{Carry, EnvParams, FleetGraph, FleetProfile, Reach, RequiredInput};
use crate::rng;

/// One fleet in one slot.
#[derive(Clone, Copy)]
pub(super) struct Slot<'a> {
    pub(super) env: &'a EnvParams,
    pub(super) graph: &'a FleetGraph,
    pub(super) step: u64,
    pub(super) profile: Option<&'a FleetProfile>,
}

/// How one fleet acts in one slot. No rule but `random` hovers.
pub(super) trait Rule: Default + Send + Sync {
    const NAME: &'static str;
    /// One sentence on what the rule does.
    const DESCRIPTION: &'static str;
    const NEEDS: RequiredInput;
    /// As [`Policy::reach`](crate::policy::Policy::reach).
    const REACH: Reach = Reach::Fleet;

    /// Length of a fleet's memory.
    fn memory_len(&self, uavs: usize, users: usize) -> usize;

    /// As [`Policy::work`](crate::policy::Policy::work).
    fn work(&self, uavs: usize, users: usize, detections: usize) -> usize {
        32 * uavs + users + detections
    }

    /// Initialises the memory for slot 0. All numbers are 0 before.
    fn start(&self, seed: u64, memory: &mut [f32]);

    /// As [`Policy::carry`](crate::policy::Policy::carry). Without it, a fleet that changes begins afresh.
    fn carry(&self, _from: &[f32], _to: &mut [f32], _carry: &Carry<'_>) {}

    /// As [`Policy::remembers_users`](crate::policy::Policy::remembers_users).
    fn remembers_users(&self) -> bool {
        false
    }

    /// Writes one heading per UAV and advances the memory.
    fn decide(&self, slot: &Slot<'_>, memory: &mut [f32], headings: &mut [u8]);
}

/// Length of a seed in a memory: 16 bits per f32, which f32 holds exactly.
pub(super) const SEED_LEN: usize = 4;

pub(super) fn store_seed(seed: u64, memory: &mut [f32]) {
    for (i, m) in memory[..SEED_LEN].iter_mut().enumerate() {
        *m = f32::from((seed >> (16 * i)) as u16);
    }
}

/// The random stream `name` of slot `step` of the episode whose seed is in `memory`.
pub(super) fn slot_rng(memory: &[f32], name: &str, step: u64) -> ChaCha8Rng {
    let seed = memory[..SEED_LEN].iter().rev().fold(0, |seed, &m| seed << 16 | u64::from(m as u16));
    rng::stream(seed, name, step)
}

/// The positions of the UAVs.
pub(super) fn uav_positions(graph: &FleetGraph) -> &[Point] {
    graph.uav_positions().expect("the caller provides what `needs` requires")
}

/// The positions of the users.
pub(super) fn user_positions(graph: &FleetGraph) -> &[Point] {
    graph.user_positions().expect("the caller provides what `needs` requires")
}
