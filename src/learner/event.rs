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
