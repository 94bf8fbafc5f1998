//! How much memory a training run needs, estimated from its configuration before anything is allocated.
//!
//! The estimate counts the large arrays only: replay, the parameters and their gradients, and what an update keeps of a part of a
//! batch for its backward pass. A run needs somewhat more, never less.

use super::loss::episodes_per_chunk;
use super::replay::EpisodeShape;
use crate::checkpoint;
use crate::env::EnvConfig;
use crate::nn::HIDDEN;
use crate::policy::{Gnn, ObservationKind};
use crate::train_config::TrainConfig;

/// Width of a pair of observation, action and identity besides the terms that grow with the fleet.
const SET_WIDTH: usize = 2 * HIDDEN;
/// Width of the hidden layer of an edge network.
const EDGE_WIDTH: usize = 96;

/// Memory of a training run in bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MemoryEstimate {
    /// Replay when it is full, or at the end of a short run.
    pub replay: u64,
    /// Parameters, optimiser and gradients.
    pub parameters: u64,
    /// Activations of an update on all threads.
    pub activations: u64,
}

impl MemoryEstimate {
    /// The estimate for a run of `config` on `threads` threads.
    pub fn of(config: &TrainConfig, threads: usize) -> Self {
        let t = &config.training;
        let env = &t.vary.largest(&config.environment);
        let episodes_of_run = t.steps.div_ceil(env.slots as u64).saturating_add(t.envs as u64);
        let episodes = episodes_of_run.min(t.buffer as u64);
        let replay = episodes.saturating_mul(EpisodeShape::of_environment(env).bytes() as u64);

        let chunks = t.batch.div_ceil(episodes_per_chunk(env.uavs));
        // Online, target, average, the best, both moments, both prepared forms, the sum of the gradients; and one gradient per chunk.
        let copies = 9 + chunks;
        let parameters = 4 * (checkpoint::parameter_layout(config).len() as u64).saturating_mul(copies as u64);

        let workspaces = threads.min(chunks).max(1) as u64;
        let activations = activations_of_chunk(config, env).saturating_mul(workspaces);
        Self { replay, parameters, activations }
    }

    /// The sum.
    pub fn total(&self) -> u64 {
        self.replay.saturating_add(self.parameters).saturating_add(self.activations)
    }

    /// The field of the configuration that determines the largest part.
    pub fn largest_field(&self, config: &TrainConfig) -> &'static str {
        let env = &config.environment;
        match self.replay.max(self.parameters).max(self.activations) {
            largest if largest == self.replay => "training.buffer",
            largest if largest == self.parameters => "training.batch",
            _ if env.uavs >= env.users => "environment.uavs",
            _ => "environment.users",
        }
    }
}

/// Bytes that one thread keeps of a chunk of a batch.
fn activations_of_chunk(config: &TrainConfig, env: &EnvConfig) -> u64 {
    let t = &config.training;
    let (m, n) = (env.uavs as u64, env.users as u64);
    let slots = (episodes_per_chunk(env.uavs) * (env.slots + 1)) as u64;
    let graph = config.algorithm.gnn() != Gnn::None;
    let hidden = HIDDEN as u64;
    let observation = match t.observation {
        ObservationKind::Set => SET_WIDTH as u64,
        ObservationKind::Flat => 2 * m + 3 * n,
    };
    let layers = if graph { t.layers as u64 } else { 0 };
    // Per row and network: the input of each layer, and u, v, a of each edge network.
    let layered = if graph { hidden * (layers + 1) + 3 * EDGE_WIDTH as u64 * layers } else { 0 };
    // Per UAV and network also: input, x, four gates, h.
    let uav_row = observation + 6 * hidden + layered;
    let user_row = if graph { observation + layered } else { 0 };
    let rows = (m * uav_row).saturating_add(n * user_row);
    // A node in a corner detects a quarter of the disc of its detection range; all others detect more.
    let detected = (std::f64::consts::FRAC_PI_4 * env.detection_range * env.detection_range).min(1.0);
    let observers = if graph || t.hops > 1 { m + n } else { m };
    let edges = (observers as f64 * (m + n) as f64 * detected) as u64;
    // Per edge its detection and, per layer and network, mean and deviation.
    let edge = 12 + 16 * layers;
    let state = 4 * (2 * m + 3 * n);
    let per_slot = rows.saturating_mul(8).saturating_add(edges.saturating_mul(edge)).saturating_add(state);
    slots.saturating_mul(per_slot)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train_config::{Algorithm, Preset};

    #[test]
    fn estimates_name_the_field_of_their_largest_part() {
        let base = TrainConfig::preset(Algorithm::Qedgix, Preset::Practical);
        assert!(MemoryEstimate::of(&base, 2).total() < 512 << 20, "{:?}", MemoryEstimate::of(&base, 2));
        let field = |change: &dyn Fn(&mut TrainConfig)| {
            let mut config = base.clone();
            change(&mut config);
            let estimate = MemoryEstimate::of(&config, 2);
            assert!(estimate.total() > 1 << 30, "{estimate:?}");
            estimate.largest_field(&config)
        };
        assert_eq!(field(&|c| (c.training.buffer, c.training.steps) = (1_000_000, 1_000_000_000)), "training.buffer");
        assert_eq!(
            field(&|c| (c.environment.uavs, c.environment.users, c.training.buffer) = (200, 2000, 100)),
            "environment.users"
        );
        assert_eq!(
            field(&|c| (c.environment.uavs, c.environment.users, c.training.buffer) = (2000, 200, 100)),
            "environment.uavs"
        );
        // A short run does not fill its replay.
        let mut short = base.clone();
        (short.training.buffer, short.training.steps) = (1_000_000, 1000);
        assert!(MemoryEstimate::of(&short, 1).replay < 1 << 20);
    }
}
