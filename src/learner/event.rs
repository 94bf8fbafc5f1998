//! What a training run tells as it goes. No clock here: whoever listens adds the time.

use crate::env::EpisodeMetrics;

/// One thing that happened in training. `step` counts environment slots since the beginning.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// Episodes were collected and the networks updated.
    Iteration(Iteration),
    /// The greedy policy flew the evaluation layouts.
    Evaluation {
        /// Environment steps at which it was taken.
        step: u64,
        /// Mean over the layouts.
        metrics: EpisodeMetrics,
    },
    /// A weight left the range of sensible numbers: the run ends here, and its best weights are all that is left of it.
    Diverged {
        /// Environment steps until then.
        step: u64,
    },
    /// All steps are done.
    Finished {
        /// Environment steps in the end.
        step: u64,
    },
}

/// Figures of one iteration: `envs` episodes and `updates_per_iteration` updates.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Iteration {
    /// Environment steps after it.
    pub step: u64,
    /// Episodes collected after it.
    pub episodes: u64,
    /// Updates made after it.
    pub updates: u64,
    /// Exploration while collecting.
    pub epsilon: f64,
    /// Mean AoI of the episodes collected.
    pub mean_aoi: f64,
    /// Mean of the updates' losses; absent while the buffer holds less than a batch.
    pub loss: Option<f64>,
    /// Mean of the updates' gradient norms before clipping.
    pub grad_norm: Option<f64>,
    /// Mean chosen Q_tot over the updates.
    pub q_tot: Option<f64>,
}

impl Event {
    /// The event as rows of a curve: (step, name, value). Names are those that servers and CSV files show.
    pub fn rows(&self) -> Vec<(u64, &'static str, f64)> {
        match self {
            Self::Iteration(i) => {
                let mut rows = vec![(i.step, "epsilon", i.epsilon), (i.step, "train/mean_aoi", i.mean_aoi)];
                let optional = [("loss", i.loss), ("grad_norm", i.grad_norm), ("q_tot", i.q_tot)];
                rows.extend(optional.into_iter().filter_map(|(name, value)| Some((i.step, name, value?))));
                rows
            }
            Self::Evaluation { step, metrics: m } => vec![
                (*step, "eval/mean_aoi", m.mean_aoi),
                (*step, "eval/p95_aoi", m.p95_aoi),
                (*step, "eval/peak_aoi", m.peak_aoi),
                (*step, "eval/coverage", m.coverage),
                (*step, "eval/fairness", m.fairness),
            ],
            Self::Diverged { .. } | Self::Finished { .. } => Vec::new(),
        }
    }
}
