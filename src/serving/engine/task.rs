//! The work of the engine: one fleet in one slot, and the decision that results.

use std::sync::Arc;
use std::time::Duration;

use crate::policy::{FleetGraph, FleetStep};
use crate::serving::LoadedPolicy;

/// Cost of a UAV in units of work. A detection or a user costs one unit.
const UAV_WORK: usize = 32;

/// One fleet in one slot, with buffers for the output.
#[derive(Debug)]
pub struct Task {
    policy: Arc<LoadedPolicy>,
    graph: FleetGraph,
    output: TaskOutput,
}

/// Result of a task.
#[derive(Clone, Debug, PartialEq)]
pub struct TaskOutput {
    /// The fleet's memory after the slot.
    pub memory: Vec<f32>,
    /// The decision of the policy.
    pub decision: Decision,
}

/// The headings of one fleet in one slot, in canonical order of UAVs.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Decision {
    /// Index of the slot since the episode began.
    pub step: u64,
    /// Heading index of each UAV.
    pub headings: Vec<u8>,
    /// A Q-values per UAV; NaN if the policy has none.
    pub q_values: Vec<f32>,
    /// How long it took.
    pub timings: Timings,
}

/// Duration of a task.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Timings {
    /// Time in the engine's queue.
    pub queue: Duration,
    /// Time of the forward pass.
    pub compute: Duration,
    /// Number of fleets in the forward pass.
    pub batch_size: u32,
}

/// Vectors that a task may reuse; their contents are overwritten.
#[derive(Debug, Default)]
pub struct OutputBuffers {
    /// Buffer for headings.
    pub headings: Vec<u8>,
    /// Buffer for Q-values.
    pub q_values: Vec<f32>,
}

impl Task {
    /// A task for slot `step` of a fleet with this memory.
    pub fn new(policy: Arc<LoadedPolicy>, graph: FleetGraph, step: u64, memory: Vec<f32>, buffers: OutputBuffers) -> Self {
        let OutputBuffers { mut headings, mut q_values } = buffers;
        headings.clear();
        headings.resize(graph.uavs(), 0);
        q_values.clear();
        q_values.resize(graph.uavs() * policy.implementation.actions(), f32::NAN);
        let decision = Decision { step, headings, q_values, timings: Timings::default() };
        Self { policy, graph, output: TaskOutput { memory, decision } }
    }

    /// The policy version to run.
    pub fn policy(&self) -> &Arc<LoadedPolicy> {
        &self.policy
    }

    /// The arguments of the policy for this task.
    pub(super) fn as_fleet_step(&mut self) -> FleetStep<'_> {
        let TaskOutput { memory, decision } = &mut self.output;
        let Decision { step, headings, q_values, .. } = decision;
        let env = self.policy.implementation.env();
        FleetStep { env, graph: &self.graph, step: *step, memory, headings, q_values: Some(q_values) }
    }

    pub(super) fn finish(self, timings: Timings) -> TaskOutput {
        let TaskOutput { memory, decision } = self.output;
        TaskOutput { memory, decision: Decision { timings, ..decision } }
    }

    /// Estimated cost. A detection costs one unit.
    pub(super) fn work(&self) -> usize {
        UAV_WORK * self.graph.uavs() + self.graph.users() + self.graph.detection_count()
    }
}
