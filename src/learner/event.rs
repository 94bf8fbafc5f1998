//! The events that a training run yields. They carry no time; the consumer adds it.

use serde::{Deserialize, Serialize};

use crate::env::EpisodeMetrics;

/// An event of a training run.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// Episodes were collected and the networks updated.
    Iteration(Iteration),
    /// A part of the layouts of an evaluation in progress is done.
    Evaluating {
        /// Environment steps made.
        env_steps: u64,
        /// Layouts done.
        layouts: usize,
    },
    /// The greedy policy was evaluated on the validation layouts.
    Evaluation(Evaluation),
    /// The policy that a report compares was evaluated on the layouts of reports, see [`super::Trainer::add_reports`].
    Report(Evaluation),
    /// A parameter is not finite or too large. The run has ended; the best parameters so far remain available.
    Diverged {
        /// Environment steps made.
        env_steps: u64,
    },
    /// All steps are made. The run has ended.
    Finished {
        /// Environment steps made.
        env_steps: u64,
    },
}

/// Metrics of a greedy policy on layouts.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Evaluation {
    /// Environment steps made when it was taken.
    #[serde(rename = "step")]
    pub env_steps: u64,
    /// Mean over the layouts.
    pub metrics: EpisodeMetrics,
}

/// Metrics of one iteration: `envs` episodes and `updates_per_iteration` updates.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Iteration {
    /// Environment steps after it.
    pub env_steps: u64,
    /// Episodes collected after it.
    pub episodes: u64,
    /// Updates made after it.
    pub updates: u64,
    /// Epsilon during collection.
    pub epsilon: f64,
    /// Mean AoI of the collected episodes, in slots.
    pub mean_aoi: f64,
    /// Mean of the updates' losses; absent while replay holds less than a batch.
    pub loss: Option<f64>,
    /// Mean of the updates' gradient norms before clipping.
    pub grad_norm: Option<f64>,
    /// Mean Q_tot of the actions taken, over the updates.
    pub q_tot: Option<f64>,
}

impl Event {
    /// The names of the metrics of [`Event::rows`].
    pub const METRICS: [&str; 11] = [
        "epsilon",
        "train/mean_aoi",
        "loss",
        "grad_norm",
        "q_tot",
        "eval/mean_aoi",
        "eval/p95_aoi",
        "eval/peak_aoi",
        "eval/coverage",
        "eval/fairness",
        "eval-v1/mean_aoi",
    ];

    /// The event as metrics: (environment step, name, value), with the names used by servers and CSV files.
    pub fn rows(&self) -> Vec<(u64, &'static str, f64)> {
        match self {
            Self::Iteration(i) => {
                let mut rows = vec![(i.env_steps, "epsilon", i.epsilon), (i.env_steps, "train/mean_aoi", i.mean_aoi)];
                let optional = [("loss", i.loss), ("grad_norm", i.grad_norm), ("q_tot", i.q_tot)];
                rows.extend(optional.into_iter().filter_map(|(name, value)| Some((i.env_steps, name, value?))));
                rows
            }
            Self::Evaluation(Evaluation { env_steps, metrics: m }) => vec![
                (*env_steps, "eval/mean_aoi", m.mean_aoi),
                (*env_steps, "eval/p95_aoi", m.p95_aoi),
                (*env_steps, "eval/peak_aoi", m.peak_aoi),
                (*env_steps, "eval/coverage", m.coverage),
                (*env_steps, "eval/fairness", m.fairness),
            ],
            Self::Report(Evaluation { env_steps, metrics }) => vec![(*env_steps, "eval-v1/mean_aoi", metrics.mean_aoi)],
            Self::Evaluating { .. } | Self::Diverged { .. } | Self::Finished { .. } => Vec::new(),
        }
    }
}
