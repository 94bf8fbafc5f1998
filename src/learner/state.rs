//! How far a training run has come: counters, the next phase, evaluations. The trainer changes it, a snapshot holds it.

use serde::{Deserialize, Serialize};

use super::{Evaluation, TrainConfig};
use crate::env::EpisodeMetrics;

/// What the next call of [`super::Trainer::next`] does.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Phase {
    Evaluate,
    /// Evaluates for a report.
    Report,
    Iterate,
    /// Yields [`super::Event::Finished`].
    #[serde(rename = "finish")]
    YieldFinished,
    /// Yields no more events.
    #[serde(rename = "finished")]
    Done,
}

/// Counters of a run, and the phase that comes next.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Counters {
    pub phase: Phase,
    /// Environment steps made.
    #[serde(rename = "step")]
    pub env_steps: u64,
    /// Episodes collected.
    pub episodes: u64,
    /// Updates made.
    pub updates: u64,
    /// `episodes` when the target networks were last copied.
    #[serde(rename = "copied")]
    pub targets_copied_at_episode: u64,
    /// Environment step of the next evaluation.
    pub next_evaluation: u64,
}

/// Everything about a run that is neither configuration nor networks nor replay.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct RunState {
    pub counters: Counters,
    /// The last evaluation.
    pub latest: Option<Evaluation>,
    /// The evaluation with the lowest mean AoI, and the parameters that reached it.
    pub best: Option<(Evaluation, Vec<f32>)>,
    /// Metrics of the layouts done in the evaluation in progress.
    pub layouts: Vec<EpisodeMetrics>,
    /// Whether reports are evaluated.
    pub reports: bool,
}

impl Counters {
    /// Whether a run of this configuration can reach these counters with `held` episodes in replay.
    pub(super) fn is_consistent(&self, config: &TrainConfig, held: usize) -> bool {
        let t = &config.training;
        let [fewest, most] = t.vary.slots.unwrap_or([config.environment.slots; 2]).map(|slots| slots as u64);
        let possible = self.episodes.checked_mul(fewest).zip(self.episodes.checked_mul(most));
        possible.is_some_and(|(fewest, most)| (fewest..=most).contains(&self.env_steps))
            && self.env_steps < t.steps + t.envs as u64 * most
            && self.targets_copied_at_episode <= self.episodes
            && self.updates <= self.episodes.saturating_mul(t.updates_per_iteration as u64)
            && self.next_evaluation <= (self.env_steps / t.eval_every + 1) * t.eval_every
            && held as u64 == self.episodes.min(t.buffer as u64)
    }
}

impl RunState {
    /// A run that has not begun.
    pub(super) fn new() -> Self {
        let counters = Counters {
            phase: Phase::Evaluate,
            env_steps: 0,
            episodes: 0,
            updates: 0,
            targets_copied_at_episode: 0,
            next_evaluation: 0,
        };
        Self { counters, latest: None, best: None, layouts: Vec::new(), reports: false }
    }
}
