//! A single environment with points and checked actions, instead of a batch.

use super::{BatchEnv, EnvConfig, EpisodeMetrics, Point, StepError, points};
use crate::invalid::Invalid;

/// A single running episode.
#[derive(Clone, Debug)]
pub struct Episode {
    env: BatchEnv,
    seed: u64,
}

impl Episode {
    /// The episode with seed `seed`, at slot 0.
    ///
    /// # Errors
    /// [`Invalid`] for the first field of `config` that is out of range.
    pub fn new(config: &EnvConfig, seed: u64) -> Result<Self, Invalid> {
        let mut episode = Self { env: BatchEnv::new(config, 1)?, seed };
        episode.reset(seed);
        Ok(episode)
    }

    /// Starts the episode with seed `seed`.
    pub fn reset(&mut self, seed: u64) {
        self.seed = seed;
        self.env.reset(&[seed]);
    }

    /// Advances one slot, with one heading index per UAV, and returns the reward.
    ///
    /// # Errors
    /// As [`BatchEnv::try_step`].
    pub fn step(&mut self, headings: &[u8]) -> Result<f32, StepError> {
        self.env.try_step(headings).map(|reward| reward[0])
    }

    /// The configuration.
    pub fn config(&self) -> &EnvConfig {
        self.env.config()
    }

    /// The episode's seed.
    pub fn seed(&self) -> u64 {
        self.seed
    }

    /// Slots since the reset.
    pub fn slot(&self) -> usize {
        self.env.slot()
    }

    /// Whether the episode has reached the time limit K.
    pub fn done(&self) -> bool {
        self.env.done()
    }

    /// Position of each UAV.
    pub fn uavs(&self) -> Vec<Point> {
        points(self.env.uav_xy()).collect()
    }

    /// Position of each user.
    pub fn users(&self) -> Vec<Point> {
        points(self.env.user_xy()).collect()
    }

    /// AoI of each user in slots.
    pub fn aoi(&self) -> &[f32] {
        self.env.aoi()
    }

    /// Metrics over the slots so far.
    pub fn metrics(&self) -> EpisodeMetrics {
        self.env.metrics(0)
    }
}
