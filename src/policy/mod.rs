//! What a UAV knows and decides: observations, agents, mixers, baselines, and the trait that all policies share.

mod actor;
mod agent;
pub mod baselines;
mod config;
mod features;
mod geometry;
mod hop_search;
mod learned;
pub mod mixer;
mod neighbor_search;
mod slot;

pub use actor::{Actor, StepInput};
pub use agent::{Agent, AgentCache, Dims};
pub use config::{AgentConfig, Aggregation, Gnn, HIDDEN, Identity, ObservationKind, TOKEN};
pub use features::{Inputs, NO_ACTION, SetEncoder, flat_observation, flat_state};
pub use geometry::{FleetSpan, Geometry, GeometryConfig, NodeView};
pub use hop_search::HopSearch;
pub use learned::LearnedPolicy;
pub use neighbor_search::Detection;
pub use slot::Slot;

use crate::invalid::Invalid;

/// How much of a slot a policy must be told.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum RequiredInput {
    /// Only what nodes detect.
    Detections,
    /// Detections, and each UAV's own position.
    OwnPositions,
    /// The positions of all UAVs and users.
    FullScene,
}

/// One fleet's turn in a batch: what it sees, its memory, and where its answer goes.
pub struct FleetStep<'a> {
    /// The slot as all nodes see it.
    pub slot: &'a Slot,
    /// Slots since the episode began.
    pub step: u64,
    /// The fleet's memory, `Policy::memory_len` long; advanced in place.
    pub memory: &'a mut [f32],
    /// Out: heading index of each UAV.
    pub headings: &'a mut [u8],
    /// Out, when wanted: Q-values, A per UAV, UAV by UAV. Policies without values write NaN.
    pub q_values: Option<&'a mut [f32]>,
}

/// A policy: learned or not, served and evaluated alike. Shared by threads behind an `Arc`.
pub trait Policy: Send + Sync {
    /// A, the number of actions.
    fn actions(&self) -> usize;

    /// What it must be told.
    fn needs(&self) -> RequiredInput;

    /// d, the detection range that it works with; scenes are transposed into detections with it.
    fn detection_range(&self) -> f64;

    /// Whether it can fly this many UAVs among this many users.
    ///
    /// # Errors
    /// The count that does not fit, and what would.
    fn check_fleet(&self, uavs: usize, users: usize) -> Result<(), Invalid>;

    /// Length of the memory of a fleet.
    fn memory_len(&self, uavs: usize, users: usize) -> usize;

    /// Writes the memory of a fleet at slot 0. `seed` fixes everything random about the episode.
    fn start(&self, uavs: usize, users: usize, seed: u64, memory: &mut [f32]);

    /// Whether a slot costs little more than a constant per node and detection, so that a small one need not be computed away
    /// from where it arrives.
    fn is_cheap(&self) -> bool {
        false
    }

    /// Advances every fleet by one slot. Fleets may differ in size. Each answer is the same as if its fleet came alone.
    /// The caller has checked sizes with `check_fleet` and the slots with `needs`.
    fn act(&self, turns: &mut [FleetStep<'_>]);
}
