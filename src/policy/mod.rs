//! Policies: observations, agents, mixers, baselines, and the trait that all policies implement.

mod agent;
pub mod baselines;
mod batched_agent;
mod config;
mod env_params;
mod explain;
mod features;
mod fleet_graph;
mod fleet_profile;
mod flight;
mod geometry;
mod goal_head;
mod goals;
mod hop_search;
mod learned;
pub mod memory;
pub mod mixer;
mod neighbor_search;
mod sight;
pub(crate) mod sweep_plan;

pub use agent::{Agent, AgentCache, Dims};
pub use batched_agent::{BatchedAgent, StepInput};
pub use config::{Advice, AgentConfig, Aggregation, Gnn, Identity, Memory, ObservationKind, TOKEN};
pub use env_params::EnvParams;
pub use explain::{DecidedSlot, Influence};
pub use features::{Inputs, NO_ACTION, SetEncoder, flat_observation, flat_state};
pub use fleet_graph::FleetGraph;
pub use fleet_profile::{Carry, FleetProfile, Sector, UserCount};
pub use geometry::{FleetSpan, Geometry, GeometryConfig, NodeView};
pub use goals::Goals;
pub use hop_search::HopSearch;
pub use learned::{LearnedPolicy, Trained};
pub use neighbor_search::{Detection, DetectionEstimate, estimate_detections};
pub use sight::Sight;

use serde::{Deserialize, Serialize};

use crate::env::Ranges;
use crate::invalid::Invalid;

/// The input that a policy requires.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub enum RequiredInput {
    /// The detections of all nodes.
    Detections,
    /// The detections and each UAV's own position.
    OwnPositions,
    /// The positions of all UAVs and users.
    FullScene,
}

/// Whose messages a UAV needs to decide alone as it would be told by [`Policy::act`] (docs/model.md, "Deciding alone"). A message has what
/// its UAV observes in the slot and remembers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reach {
    /// Those of the UAVs within so many links. 0: none, its own sensors are enough.
    Links(usize),
    /// Those of all UAVs, wherever they are.
    Fleet,
}

impl Reach {
    /// Distance within which all these UAVs are, in units of the square's side; `None`: any distance.
    pub fn range(self, env: &EnvParams) -> Option<f64> {
        // The last link of several is one between a user and a UAV.
        let (first, last) = (env.communication_range, env.detection_range);
        match self {
            Self::Links(0) => Some(0.0),
            Self::Links(1) => Some(first),
            Self::Links(links) => Some((links - 1) as f64 * first.max(last) + last),
            Self::Fleet => None,
        }
    }
}

/// One fleet in one slot, as an item of a batch: input, memory and output.
pub struct FleetStep<'a> {
    /// The environment that the fleet flies in.
    pub env: EnvParams,
    /// What all nodes detect.
    pub graph: &'a FleetGraph,
    /// Index of the slot in the episode.
    pub step: u64,
    /// How the fleet differs from one of equal UAVs that has not changed since slot 0; `None` if it does not.
    pub profile: Option<&'a FleetProfile>,
    /// The fleet's memory, of length [`Policy::memory_len`]; updated in place.
    pub memory: &'a mut [f32],
    /// Output: heading index of each UAV.
    pub headings: &'a mut [u8],
    /// Output, optional: A Q-values per UAV. Policies without Q-values write NaN.
    pub q_values: Option<&'a mut [f32]>,
}

/// A policy, learned or by rule. Threads share it behind an `Arc`.
pub trait Policy: Send + Sync {
    /// A, the number of actions.
    fn actions(&self) -> usize;

    /// The input that the policy requires.
    fn needs(&self) -> RequiredInput;

    /// The environment that the policy is made for.
    fn env(&self) -> EnvParams;

    /// The ranges that decide the detections in a scene.
    fn ranges(&self) -> Ranges {
        self.env().ranges()
    }

    /// Checks whether the policy accepts this number of UAVs and of users.
    ///
    /// # Errors
    /// [`Invalid`] for the count that does not fit.
    fn check_fleet(&self, uavs: usize, users: usize) -> Result<(), Invalid>;

    /// Length of a fleet's memory.
    fn memory_len(&self, uavs: usize, users: usize) -> usize;

    /// Distance at which numbers of the memory resemble each other, as those of two UAVs about the same user do. Packing uses it.
    fn memory_period(&self, uavs: usize, users: usize) -> usize {
        self.memory_len(uavs, users) / uavs.max(1)
    }

    /// Initialises a fleet's memory for slot 0. `seed` determines all random numbers of the episode.
    fn start(&self, uavs: usize, users: usize, seed: u64, memory: &mut [f32]);

    /// Copies what the memory `from` holds about UAVs and users to the memory `to` of another fleet, and what it holds about the whole
    /// fleet. The rest of `to` remains: it was initialised by [`Policy::start`].
    fn carry(&self, _from: &[f32], _to: &mut [f32], _carry: &Carry<'_>) {}

    /// Writes to the memory after a slot that UAV `uav` of `uavs` does not fly the heading that the policy chose, but `heading`.
    fn overrule(&self, _memory: &mut [f32], _uav: usize, _heading: u8) {}

    /// Whether the memory holds something about each user, that is carried when users come and go.
    fn remembers_users(&self) -> bool {
        false
    }

    /// Whose messages a UAV needs to decide alone.
    fn reach(&self) -> Reach {
        Reach::Fleet
    }

    /// Number of nodes, of the first ones (UAVs, then users), whose detections the policy reads. Others need not be computed.
    fn observers(&self, uavs: usize, users: usize) -> usize {
        uavs + users
    }

    /// Estimated time of a slot. The unit is the time that a learned policy takes for a detection: about 0.1 microseconds.
    fn work(&self, uavs: usize, users: usize, detections: usize) -> usize {
        32 * uavs + users + detections
    }

    /// The rule that decides instead of the policy in a world outside of its training, if it has one.
    fn rule_in(&self, _env: &EnvParams) -> Option<&'static str> {
        None
    }

    /// Whether the time for a slot is about proportional to its nodes and detections. Small fleets of such policies can be computed
    /// on the thread that received the request.
    fn is_cheap(&self) -> bool {
        false
    }

    /// Advances every fleet by one slot. Fleets may differ in size. The result for a fleet does not depend on the other fleets.
    /// The caller has checked the sizes with `check_fleet` and provides what `needs` requires.
    fn act(&self, fleets: &mut [FleetStep<'_>]);
}
