//! The data of plots.

use crate::env::Point;

/// One curve.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Series {
    /// Name in the legend.
    pub name: String,
    /// (x, y) in drawing order; a point that is not finite interrupts the curve.
    pub points: Vec<[f64; 2]>,
    /// Interval (low, high) of each point.
    pub band: Option<Vec<[f64; 2]>>,
}

/// Curves over common axes.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Chart {
    /// Title of the plot.
    pub title: String,
    /// Label of the x axis, with the unit.
    pub x: String,
    /// Label of the y axis, with the unit.
    pub y: String,
    /// The curves. Names of algorithms and baselines fix their colours.
    pub series: Vec<Series>,
    /// Values that do not depend on x, drawn as horizontal lines.
    pub levels: Vec<(String, f64)>,
    /// What bands, bars and levels are, as a sentence below the legend.
    pub note: String,
    /// Draws a marker at every point, and bands as error bars: for few x values.
    pub markers: bool,
    /// Whether the x axis is logarithmic. Points whose x is not above 0 are left out.
    pub log_x: bool,
}

/// A bar with its interval.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Bar {
    /// Its label.
    pub name: String,
    /// Its length.
    pub mean: f64,
    /// Low end of the interval.
    pub low: f64,
    /// High end of the interval.
    pub high: f64,
}

/// What speaks for or against the heading of a UAV, drawn from the UAV to it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Pull {
    /// Position of the UAV.
    pub from: Point,
    /// Position of the node.
    pub to: Point,
    /// From -1, against the heading, to 1, for it.
    pub strength: f64,
}

/// The paths of a fleet in one episode. Lengths are in units of the square's side.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Trajectories {
    /// Per UAV its positions in slots 0..=K.
    pub uavs: Vec<Vec<Point>>,
    /// Position of each user.
    pub users: Vec<Point>,
    /// Range within which a user's data is collected.
    pub transmission_range: f64,
    /// Which episode it is, as a sentence below the legend.
    pub note: String,
}
