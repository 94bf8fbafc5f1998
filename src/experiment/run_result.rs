//! What a finished run leaves: `result.json` in its folder.

use serde::{Deserialize, Serialize};

use crate::env::EpisodeMetrics;

/// An evaluation of weights on the layouts of an experiment.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EvaluatedWeights {
    /// Environment steps that the weights were trained for.
    pub step: u64,
    /// Metrics on each layout, in the order of the list.
    pub episodes: Vec<EpisodeMetrics>,
}

/// The result of a finished run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunResult {
    /// Name of the list of layouts.
    pub layouts: String,
    /// Environment steps of the run.
    pub steps: u64,
    /// Whether training ended early because it diverged.
    pub diverged: bool,
    /// The weights with the lowest mean AoI on the validation layouts.
    pub best: EvaluatedWeights,
    /// The last weights; absent if the run diverged.
    pub last: Option<EvaluatedWeights>,
    /// Training time in seconds, over all attempts.
    pub seconds: f64,
}
