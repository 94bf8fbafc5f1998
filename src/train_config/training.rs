//! The fields of learning: their ranges, and the schedules of learning rate and epsilon.

use serde::{Deserialize, Serialize};

use super::vary::{self, Vary};
use crate::invalid::{Invalid, in_range};
use crate::policy::mixer::MixerKind;
use crate::policy::{Advice, Aggregation, Identity, Memory, ObservationKind, baselines};

/// Most environment steps of a run.
pub(super) const MAX_STEPS: u64 = 1_000_000_000_000;

/// The fields of learning. Environment steps are slots, counted over all episodes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(clippy::struct_excessive_bools, reason = "independent switches of a document")]
pub struct Training {
    /// Observation of each node.
    pub observation: ObservationKind,
    /// Identity of a UAV.
    pub identity: Identity,
    /// Aggregation of `edgeconv`.
    pub aggregation: Aggregation,
    /// Graph layers.
    pub layers: usize,
    /// Whether a UAV knows its own position.
    pub self_position: bool,
    /// Whether a node is its own neighbour.
    pub self_loops: bool,
    /// Without a graph network: number of links over which a UAV observes. 1: its own detections; L + 1: what L graph layers
    /// bring.
    #[serde(default = "default_hops")]
    pub hops: usize,
    /// Whether relative positions are divided by the detection range in flat observations, and own positions scaled to [-1, 1].
    #[serde(default)]
    pub normalise: bool,
    /// What a UAV remembers: `none`, as in the paper; `own`, what it detected itself; `shared`, also what UAVs in communication range
    /// remember.
    #[serde(default)]
    pub memory: Memory,
    /// What a rule advises a UAV from its memory: `none`, as in the paper; `sweep`, the heading that `sweep` would fly, with a shared memory
    /// that of `sweep-shared`.
    #[serde(default)]
    pub advice: Advice,
    /// With advice: how much higher the Q-value of another heading must be before the policy leaves the advised one, per remembered user
    /// and UAV of the fleet, at least once. Exploration and updates do not know it.
    #[serde(default)]
    pub advice_margin: f64,
    /// Mixer.
    pub mixer: MixerKind,
    /// Factor of the initial weights of the hypernetworks' last layers.
    #[serde(default = "default_factor")]
    pub hyper_init: f64,
    /// Environment steps to train for.
    pub steps: u64,
    /// Learning rate of Adam at the start.
    pub learning_rate: f64,
    /// The learning rate at the end of training, as a fraction of `learning_rate`; it falls linearly over `steps`. 1.0: no decay.
    #[serde(default = "default_factor")]
    pub learning_rate_decay: f64,
    /// Discount factor.
    pub gamma: f64,
    /// lambda of TD(lambda).
    pub lambda: f64,
    /// Global L2 norm that gradients are clipped to.
    pub clip: f64,
    /// Final epsilon.
    pub epsilon_end: f64,
    /// Environment steps over which epsilon falls linearly from 1 to `epsilon_end`.
    pub epsilon_anneal: u64,
    /// Episodes per update.
    pub batch: usize,
    /// Updates per iteration; an iteration collects `envs` episodes.
    pub updates_per_iteration: usize,
    /// Episodes collected per iteration.
    pub envs: usize,
    /// Capacity of replay, in episodes.
    pub buffer: usize,
    /// Episodes between copies of the online networks to the target networks.
    pub target_every: u64,
    /// Fraction of the distance to the online networks by which the target networks move after each update. 0: they are copied every
    /// `target_every` episodes.
    #[serde(default)]
    pub target_tau: f64,
    /// The weights that are evaluated and published are an exponential moving average over about this many updates. 0 or 1: the
    /// online weights.
    #[serde(default)]
    pub average: u64,
    /// Whether the reward of a slot is the AoI collected in it instead of minus the AoI of all users. The optimal policies are the
    /// same (potential-based shaping).
    #[serde(default)]
    pub shaping: bool,
    /// Whether replayed episodes are rotated and mirrored at random, by the eight symmetries of the square.
    #[serde(default)]
    pub augment: bool,
    /// Baseline that flies some of the UAVs while episodes are collected, so that they show the policy what the rule does. Absent, or `none`
    /// where a preset has a teacher: the policy explores by random headings only, as in the paper.
    #[serde(default)]
    pub teacher: Option<String>,
    /// With a teacher: smallest probability that it flies a UAV for an episode. The probability is epsilon while that is larger.
    #[serde(default = "default_teacher_share")]
    pub teacher_share: f64,
    /// Ranges from which environments are drawn, one per iteration. The policy then flies fleets of many sizes.
    #[serde(default, deserialize_with = "vary::from_object")]
    pub vary: Vary,
    /// Environment steps between evaluations.
    pub eval_every: u64,
    /// Layouts per evaluation.
    pub eval_episodes: usize,
}

impl Training {
    /// The learning rate after `env_steps` environment steps. It falls linearly to `learning_rate_decay` of its start value.
    pub fn learning_rate_at(&self, env_steps: u64) -> f64 {
        let done = (env_steps as f64 / self.steps as f64).min(1.0);
        self.learning_rate * (1.0 - (1.0 - self.learning_rate_decay) * done)
    }

    /// Epsilon after `env_steps` environment steps. It falls linearly from 1 to `epsilon_end`, then is constant.
    pub fn epsilon_at(&self, env_steps: u64) -> f64 {
        if env_steps >= self.epsilon_anneal {
            return self.epsilon_end;
        }
        1.0 - (1.0 - self.epsilon_end) * env_steps as f64 / self.epsilon_anneal as f64
    }

    /// The training of `steps` more environment steps from weights that were trained for `env_steps`: the learning rate stays where
    /// it was, and epsilon does not rise again once it has fallen.
    pub fn continued(&self, env_steps: u64, steps: u64) -> Self {
        Self {
            steps,
            learning_rate: self.learning_rate_at(env_steps),
            learning_rate_decay: 1.0,
            epsilon_anneal: self.epsilon_anneal.saturating_sub(env_steps).max(1),
            ..self.clone()
        }
    }

    pub(super) fn validate(&self) -> Result<(), Invalid> {
        in_range("layers", self.layers, 1..=8)?;
        in_range("hops", self.hops, 1..=9)?;
        in_range("advice_margin", self.advice_margin, 0.0..=1e3)?;
        in_range("hyper_init", self.hyper_init, 0.0..=10.0)?;
        in_range("steps", self.steps, 1..=MAX_STEPS)?;
        in_range("learning_rate", self.learning_rate, 1e-12..=1.0)?;
        in_range("learning_rate_decay", self.learning_rate_decay, 0.0..=1.0)?;
        in_range("gamma", self.gamma, 0.0..=1.0)?;
        in_range("lambda", self.lambda, 0.0..=1.0)?;
        in_range("clip", self.clip, 1e-9..=1e9)?;
        in_range("epsilon_end", self.epsilon_end, 0.0..=1.0)?;
        in_range("epsilon_anneal", self.epsilon_anneal, 1..=1_000_000_000_000)?;
        in_range("batch", self.batch, 1..=4096)?;
        in_range("updates_per_iteration", self.updates_per_iteration, 1..=1024)?;
        in_range("envs", self.envs, 1..=4096)?;
        in_range("buffer", self.buffer, 1..=1_000_000)?;
        in_range("target_every", self.target_every, 1..=1_000_000_000)?;
        in_range("target_tau", self.target_tau, 0.0..=1.0)?;
        in_range("average", self.average, 0..=1_000_000_000)?;
        in_range("teacher_share", self.teacher_share, 0.0..=1.0)?;
        if let Some(teacher) = &self.teacher
            && !baselines::LIST.iter().any(|baseline| baseline.name == teacher)
        {
            let names: Vec<_> = baselines::LIST.iter().map(|baseline| baseline.name).collect();
            return Err(Invalid::new("teacher", format!("{teacher:?}"), format!("one of {}", names.join(", "))));
        }
        in_range("eval_every", self.eval_every, 1..=1_000_000_000_000)?;
        in_range("eval_episodes", self.eval_episodes, 1..=4096)?;
        if self.shaping && self.gamma > 0.9999 {
            return Err(Invalid::new("gamma", self.gamma, "at most 0.9999 with shaping"));
        }
        if self.buffer < self.batch {
            return Err(Invalid::new("buffer", self.buffer, format!("at least batch ({})", self.batch)));
        }
        Ok(())
    }
}

fn default_hops() -> usize {
    1
}

pub(super) fn default_teacher_share() -> f64 {
    0.2
}

fn default_factor() -> f64 {
    1.0
}
