//! The environment: UAVs that fly, users whose data ages (docs/model.md, "Environment"). Pure: no clock, no I/O, no global
//! randomness.

mod batch;
mod config;
mod episode;
mod metrics;
mod point;
mod walk;

pub use batch::{BatchEnv, StepError};
pub use config::{Boundary, EnvConfig, Layout, LostUav, Ranges, Start, UserSlots};
pub use episode::Episode;
pub use metrics::EpisodeMetrics;
pub use point::{Point, points};

/// Direction of each action: unit vectors of the headings 45 h degrees, counter-clockwise from +x, then (0, 0) for hovering.
pub const DIRECTIONS: [Point; EnvConfig::COMPASS + 1] = {
    const D: f64 = std::f64::consts::FRAC_1_SQRT_2;
    [[1.0, 0.0], [D, D], [0.0, 1.0], [-D, D], [-1.0, 0.0], [-D, -D], [0.0, -1.0], [D, -D], [0.0, 0.0]]
};
