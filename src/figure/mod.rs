//! Figures: data in, SVG text out. No files, no clock, no fonts of the machine: the same data gives the same bytes.
//!
//! Every figure is drawn on white, with one colour per series from a palette that colour-blind readers can tell apart, and a
//! legend beside the plot. Numbers that are not finite, or beyond 1e12, are left out; a figure of nothing says "no data".
//! What the numbers mean is the caller's affair.

mod bars;
mod canvas;
mod lines;
mod scale;
mod trajectories;

use crate::env::Point;

pub use bars::bars;
pub use lines::{distribution, lines};
pub use trajectories::trajectories;

/// One curve.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Series {
    /// What the legend calls it.
    pub name: String,
    /// (x, y) in the order they are joined; a point that is not finite interrupts the curve.
    pub points: Vec<[f64; 2]>,
    /// (low, high) of each point, where there is an interval.
    pub band: Option<Vec<[f64; 2]>>,
}

/// Curves over common axes.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Chart {
    /// Heading of the figure.
    pub title: String,
    /// What the x axis shows, with its unit.
    pub x: String,
    /// What the y axis shows, with its unit.
    pub y: String,
    /// The curves; their order fixes their colours.
    pub series: Vec<Series>,
    /// Marks every point; bands are then drawn as error bars, for x values that are few or chosen.
    pub markers: bool,
}

/// One bar with its interval.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Bar {
    /// What stands before it.
    pub name: String,
    /// Its length.
    pub mean: f64,
    /// Low end of the interval.
    pub low: f64,
    /// High end of the interval.
    pub high: f64,
}

/// What a fleet flew. Lengths are in units of the square's side.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Flight {
    /// Per UAV its positions in slots 0..=K.
    pub uavs: Vec<Vec<Point>>,
    /// Position of each user.
    pub users: Vec<Point>,
    /// Range within which a user's data is collected.
    pub transmission_range: f64,
}

#[cfg(test)]
mod tests;
