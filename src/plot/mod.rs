//! Plots: data in, SVG text out, from which `convert` makes PDF and PNG. No files, no clock, no fonts of the machine: the same data gives
//! the same SVG.
//!
//! Every plot has the colours of `palette`, a legend below it that explains bands and bars, a title and a description for screen readers,
//! and is dark on dark pages (docs/figures.md). Numbers that are not finite, or above 1e12, are left out. A plot without data says
//! "no data".

mod bars;
mod canvas;
mod convert;
mod data;
mod lines;
mod palette;
mod scale;
mod trajectories;

pub use bars::bars;
pub use convert::{ConversionError, pdf, png};
pub use data::{Bar, Chart, Pull, Series, Trajectories};
pub use lines::{distribution, lines};
pub use trajectories::{explained, trajectories};

#[cfg(test)]
mod tests;
