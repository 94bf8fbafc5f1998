//! The work of the engine: one fleet in one slot, and the decision that results.

use std::sync::Arc;
use std::time::Duration;

use crate::invalid::Invalid;
use crate::policy::{DecidedSlot, EnvParams, FleetGraph, FleetProfile, FleetStep};
use crate::serving::{
    FleetChange, FleetIds, FleetMemory, Guard, LoadedPolicy, Overruled, SceneOrGraph, Sensing, Situation, TaskInput,
};

/// One fleet in one slot, with buffers for the output.
#[derive(Debug)]
pub struct Task {
    policy: Arc<LoadedPolicy>,
    graph: FleetGraph,
    /// A large scene or graph, of which [`Task::prepare`] makes `graph`.
    unconverted: Option<(Box<SceneOrGraph>, Sensing)>,
    /// M and N of the input.
    size: (usize, usize),
    /// How the memory changes before the slot, if the fleet has changed.
    change: Option<Box<FleetChange>>,
    /// What the policy is told about the fleet.
    profile: Option<Box<FleetProfile>>,
    /// The world that the fleet flies in.
    env: EnvParams,
    /// Constraints, and the slots that each UAV can still fly.
    guard: Option<(Arc<Guard>, Vec<f64>)>,
    /// The ids of the fleet if the decision is to be explained, and the memory before the slot.
    explain: Option<Box<(FleetIds, Vec<f32>)>>,
    /// The memory of a fleet of which some UAVs are missing.
    all: Option<Vec<f32>>,
    /// The memory before the slot, until [`Task::prepare`] moves it to `numbers`.
    memory: FleetMemory,
    /// The memory that the policy works on.
    numbers: Vec<f32>,
    decision: Decision,
    /// Number of detections, or its estimate.
    detections: usize,
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
    /// What constraints changed.
    pub overruled: Vec<Overruled>,
    /// Why, if that was asked for.
    pub influences: Vec<NamedInfluence>,
}

/// What a detection or a message means for the heading of a UAV, see [`Influence`](crate::policy::Influence).
#[derive(Clone, Debug, PartialEq)]
pub struct NamedInfluence {
    /// Canonical index of the UAV.
    pub uav: u32,
    /// Id of the node.
    pub node: String,
    /// Whether it is the message of the node.
    pub message: bool,
    /// Change of the Q-value of the policy's heading.
    pub change: f32,
}

/// Limit of an explanation: runs of the policy, times numbers of its memory and detections. About 0.1 s.
const MAX_EXPLAINED: usize = 1 << 24;

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
    /// A task for slot `step` of a fleet with this memory, in the world of the policy.
    pub fn new(policy: Arc<LoadedPolicy>, input: TaskInput, step: u64, memory: FleetMemory, buffers: OutputBuffers) -> Self {
        let env = policy.implementation.env();
        let (uavs, users) = input.size();
        let OutputBuffers { mut headings, mut q_values } = buffers;
        headings.clear();
        headings.resize(uavs, 0);
        q_values.clear();
        q_values.resize(uavs * policy.implementation.actions(), f32::NAN);
        let decision =
            Decision { step, headings, q_values, timings: Timings::default(), overruled: Vec::new(), influences: Vec::new() };
        let detections = input.detection_count();
        let work = policy.implementation.work(uavs, users, detections);
        let (graph, unconverted) = match input {
            TaskInput::Graph(graph) => (graph, None),
            TaskInput::Large { content, sensing, .. } => (FleetGraph::default(), Some((content, sensing))),
        };
        let size = (uavs, users);
        Self {
            policy,
            graph,
            unconverted,
            size,
            change: None,
            profile: None,
            env,
            guard: None,
            explain: None,
            all: None,
            memory,
            numbers: Vec::new(),
            decision,
            detections,
            work,
        }
    }

    /// The same task for a fleet that has changed.
    #[must_use]
    pub fn with_change(mut self, mut change: Option<Box<FleetChange>>) -> Self {
        self.profile = change.as_mut().map(|change| Box::new(std::mem::take(&mut change.profile)));
        self.change = change;
        self
    }

    /// The same task in the world `env`, with the speed of each UAV per slot, if they differ.
    #[must_use]
    pub fn in_world(mut self, env: EnvParams, speeds: Vec<f64>) -> Self {
        self.env = env;
        if !speeds.is_empty() {
            self.profile.get_or_insert_default().speeds = speeds;
        }
        self
    }

    /// The same task with constraints, and the slots that each UAV can still fly. The input has the positions of all UAVs.
    #[must_use]
    pub fn guarded(mut self, guard: Arc<Guard>, endurance: Vec<f64>) -> Self {
        let speeds = self.profile.as_ref().map_or(&[][..], |profile| &profile.speeds);
        let fastest = speeds.iter().copied().fold(self.env.speed, f64::max);
        self.work = self.work.saturating_add(guard.work(self.graph.uav_positions(), self.size.0, fastest));
        self.guard = Some((guard, endurance));
        self
    }

    /// The same task, whose decision is explained. `ids`: those of the input.
    #[must_use]
    pub fn explained(mut self, ids: FleetIds) -> Self {
        let (uavs, users) = self.size;
        let runs = uavs * uavs + self.detections;
        let explained = runs.saturating_mul(self.policy.implementation.work(uavs, users, self.detections));
        self.work = self.work.saturating_add(explained.min(MAX_EXPLAINED));
        self.explain = Some(Box::new((ids, Vec::new())));
        self
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
        if let Some((content, sensing)) = self.unconverted.take() {
            self.graph = content.into_fleet_graph(self.size, policy, sensing)?;
        }
        let memory = std::mem::take(&mut self.memory);
        match &self.change {
            None => self.numbers = memory.unpack(policy, self.size)?,
            Some(change) => {
                (self.numbers, self.all) = change.apply(policy, memory.unpack(policy, change.before)?);
                if policy.remembers_users() {
                    self.graph.add_undetected_users(change.after.1);
                }
            }
        }
        if let Some(explain) = &mut self.explain {
            let (runs, numbers) = (DecidedSlot::runs(&self.graph), self.numbers.len());
            if runs * (numbers + self.graph.detection_count() + 1024) > MAX_EXPLAINED {
                let expected = "a smaller fleet: to explain a slot, the policy is run once per detection of a UAV";
                return Err(Invalid::new("explain", format!("{runs} runs of the policy"), expected));
            }
            explain.1.clone_from(&self.numbers);
        }
        Ok(())
    }

    /// What speaks for and against the headings of the policy.
    fn influences(&self) -> Vec<NamedInfluence> {
        let Some((ids, memory)) = self.explain.as_deref() else { return Vec::new() };
        let decided = DecidedSlot {
            env: self.env,
            graph: &self.graph,
            step: self.decision.step,
            profile: self.profile.as_deref(),
            memory,
            headings: &self.decision.headings,
            q_values: &self.decision.q_values,
        };
        let id = |node: u32| ids.uavs.iter().chain(&ids.users).nth(node as usize).cloned().unwrap_or_default();
        let influences = decided.explain(&*self.policy.implementation).into_iter();
        influences.map(|of| NamedInfluence { uav: of.uav, node: id(of.node), message: of.message, change: of.change }).collect()
    }

    /// The arguments of the policy for this task. [`Task::prepare`] has succeeded.
    pub(super) fn as_fleet_step(&mut self) -> FleetStep<'_> {
        let Self { graph, numbers, decision, profile, env, .. } = self;
        let Decision { step, headings, q_values, .. } = decision;
        let (env, profile) = (*env, profile.as_deref());
        FleetStep { env, graph, step: *step, profile, memory: numbers, headings, q_values: Some(q_values) }
    }

    pub(super) fn finish(mut self, timings: Timings) -> TaskOutput {
        self.decision.influences = self.influences();
        let policy = &*self.policy.implementation;
        if let (Some((guard, endurance)), Some(positions)) = (&self.guard, self.graph.uav_positions()) {
            let Decision { headings, q_values, overruled, .. } = &mut self.decision;
            let speeds = self.profile.as_ref().map_or(&[][..], |profile| &profile.speeds);
            *overruled = guard.apply(&Situation { env: &self.env, speeds, positions, endurance, q_values }, headings);
            for change in overruled.iter() {
                policy.overrule(&mut self.numbers, change.uav as usize, headings[change.uav as usize]);
            }
        }
        let (numbers, size) = match (self.change, self.all) {
            (Some(change), Some(mut all)) => {
                change.restore(policy, &self.numbers, &mut all);
                (all, change.after)
            }
            (Some(change), None) => (self.numbers, change.after),
            (None, _) => (self.numbers, self.size),
        };
        let memory = FleetMemory::pack(numbers, policy, size);
        TaskOutput { memory, decision: Decision { timings, ..self.decision } }
    }

    /// Estimated cost in the unit of [`Policy::work`](crate::policy::Policy::work).
    pub(super) fn work(&self) -> usize {
        self.work
    }

    /// Length of the memory that the policy works on.
    pub(super) fn memory_len(&self) -> usize {
        let (uavs, users) = self.change.as_ref().map_or(self.size, |change| change.after);
        self.policy.implementation.memory_len(uavs, users)
    }

    /// Whether the input is converted and the memory unpacked.
    pub(super) fn is_prepared(&self) -> bool {
        self.unconverted.is_none() && self.memory.is_plain()
    }
}
