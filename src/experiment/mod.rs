//! An experiment: many training runs described by a TOML document, and the summary of their results.
//!
//! [`Experiment::resolve`] turns a document into runs, [`RunResult`] is the result of one run, and [`ExperimentSummary::new`]
//! summarizes all results as numbers; [`readme`] and [`plots`] present them. The same results give the same bytes. Running and
//! writing files is done in `cli`.

mod curve;
mod plan;
mod plots;
mod run_result;
mod settings;
mod slugs;
mod statistics;
mod summary;
mod tables;

pub use curve::TrainingCurve;
pub use plan::{Experiment, ExperimentPoint, PlotKind, Run, XScale};
pub use plots::plots;
pub use run_result::{EvaluatedWeights, RunResult};
pub use settings::Overrides;
pub use summary::{BaselineSummary, ExperimentSummary, PairedDifference, ParameterCounts, SeriesSummary};
pub use tables::{difference_cells, figure_link, metric_cells, readme};
