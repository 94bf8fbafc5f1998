//! What an episode is judged by (spec 1).

use serde::{Deserialize, Serialize};

/// Figures of one episode over slots 1..K, or the mean of them over episodes. AoI is in slots.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct EpisodeMetrics {
    /// Mean AoI over users (weighted, where users have weights) and slots.
    pub mean_aoi: f64,
    /// Largest AoI of any user in any slot.
    pub peak_aoi: f64,
    /// 95th percentile of AoI over users and slots.
    pub p95_aoi: f64,
    /// Share of users ever visited.
    pub coverage: f64,
    /// Jain's fairness index of the users' mean AoI, (sum x)^2 / (N sum x^2); 1 when all are 0.
    pub fairness: f64,
}
