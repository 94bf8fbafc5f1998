//! The work of the engine: one fleet in one slot, and the decision that results.

use std::sync::Arc;
use std::time::Duration;

use crate::invalid::Invalid;
use crate::policy::{FleetGraph, FleetStep};
use crate::serving::{FleetMemory, LoadedPolicy, SceneOrGraph, TaskInput};

/// One fleet in one slot, with buffers for the output.
#[derive(Debug)]
pub struct Task {
    policy: Arc<LoadedPolicy>,
    graph: FleetGraph,
    /// A large scene or graph, of which [`Task::prepare`] makes `graph`.
    unconverted: Option<Box<SceneOrGraph>>,
    /// M and N.
    size: (usize, usize),
    /// The memory before the slot, until [`Task::prepare`] moves it to `numbers`.
    memory: FleetMemory,
    /// The memory that the policy works on.
    numbers: Vec<f32>,
    decision: Decision,
    work: usize,
}

/// Result of a task.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TaskOutput {
    /// The fleet's memory after the slot.
    pub memory: FleetMemory,
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
    pub fn new(policy: Arc<LoadedPolicy>, input: TaskInput, step: u64, memory: FleetMemory, buffers: OutputBuffers) -> Self {
        let (uavs, users) = input.size();
        let OutputBuffers { mut headings, mut q_values } = buffers;
        headings.clear();
        headings.resize(uavs, 0);
        q_values.clear();
        q_values.resize(uavs * policy.implementation.actions(), f32::NAN);
        let decision = Decision { step, headings, q_values, timings: Timings::default() };
        let work = policy.implementation.work(uavs, users, input.detection_count());
        let (graph, unconverted) = match input {
            TaskInput::Graph(graph) => (graph, None),
            TaskInput::Large { content, .. } => (FleetGraph::default(), Some(content)),
        };
        Self { policy, graph, unconverted, size: (uavs, users), memory, numbers: Vec::new(), decision, work }
    }

    /// The policy version to run.
    pub fn policy(&self) -> &Arc<LoadedPolicy> {
        &self.policy
    }

    /// Converts a large input and unpacks a large memory. Until now they were small, so that waiting tasks take little memory.
    ///
    /// # Errors
    /// [`Invalid`] for an input or a memory that the policy does not accept.
    pub(super) fn prepare(&mut self) -> Result<(), Invalid> {
        let policy = &*self.policy.implementation;
        if let Some(content) = self.unconverted.take() {
            self.graph = content.into_fleet_graph(self.size, policy)?;
        }
        self.numbers = std::mem::take(&mut self.memory).unpack(policy, self.size)?;
        Ok(())
    }

    /// The arguments of the policy for this task. [`Task::prepare`] has succeeded.
    pub(super) fn as_fleet_step(&mut self) -> FleetStep<'_> {
        let Self { policy, graph, numbers, decision, .. } = self;
        let Decision { step, headings, q_values, .. } = decision;
        FleetStep { env: policy.implementation.env(), graph, step: *step, memory: numbers, headings, q_values: Some(q_values) }
    }

    pub(super) fn finish(self, timings: Timings) -> TaskOutput {
        let memory = FleetMemory::pack(self.numbers, &*self.policy.implementation, self.size);
        TaskOutput { memory, decision: Decision { timings, ..self.decision } }
    }

    /// Estimated cost in the unit of [`Policy::work`](crate::policy::Policy::work).
    pub(super) fn work(&self) -> usize {
        self.work
    }

    /// Whether the input is converted and the memory unpacked.
    pub(super) fn is_prepared(&self) -> bool {
        self.unconverted.is_none() && self.memory.is_plain()
    }
}
