//! An experiment: which runs a file asks for, and what their results say together. Runs and files are the command line's.
//!
//! [`Experiment::resolve`] turns a document into runs, [`Outcome`] is what a finished run leaves, and [`report`] turns all
//! outcomes into numbers, tables and figures. The same outcomes give the same bytes: no clock, no files, no threads here.

mod charts;
mod curve;
mod document;
mod plan;
mod statistics;
mod summary;
mod tables;

use serde::{Deserialize, Serialize};

use crate::env::EpisodeMetrics;

pub use charts::figures;
pub use curve::Curve;
pub use document::Overrides;
pub use plan::{Experiment, Figure, Point, Run};
pub use summary::{Compared, Reference, Report, Row, report};
pub use tables::readme;

/// Weights flown on the frozen layouts of an experiment.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Flown {
    /// Environment steps that the weights were trained for.
    pub step: u64,
    /// Figures on each layout, in the order of the list.
    pub episodes: Vec<EpisodeMetrics>,
}

/// What a finished run leaves.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Outcome {
    /// The list of layouts that was flown.
    pub layouts: String,
    /// Environment steps of the run.
    pub steps: u64,
    /// Whether it ended early because a weight left the range of sensible numbers.
    pub diverged: bool,
    /// The weights that were best on the validation layouts.
    pub best: Flown,
    /// The last weights; none of a run that diverged.
    pub last: Option<Flown>,
    /// Seconds that training took, all attempts together.
    pub seconds: f64,
}
