//! The world: users whose data ages, UAVs that fly (spec 1). Pure and synchronous: no clock, no I/O, no global randomness.

mod config;
mod metrics;

pub use config::{Boundary, EnvConfig, Layout, Point, Start};
pub use metrics::EpisodeMetrics;
