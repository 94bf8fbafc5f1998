//! One environment for one caller: points and checked actions instead of batches. Whoever hosts environments builds on this.

use super::{BatchEnv, EnvConfig, EpisodeMetrics, Point, StepError, points};
use crate::invalid::Invalid;

/// A single running episode.
#[derive(Clone, Debug)]
pub struct Episode {
    env: BatchEnv,
    seed: u64,
}

impl Episode {
    /// The episode with this seed, at slot 0.
    ///
    /// # Errors
    /// The first field of `config` that is out of range.
    pub fn new(config: &EnvConfig, seed: u64) -> Result<Self, Invalid> {
        let mut episode = Self { env: BatchEnv::new(config, 1)?, seed };
        episode.reset(seed);
        Ok(episode)
    }

    /// Begins the episode with another seed, or the same one again.
    pub fn reset(&mut self, seed: u64) {
        self.seed = seed;
        self.env.reset(&[seed]);
    }

    /// Flies one slot, one heading index per UAV; the reward.
    ///
    /// # Errors
    /// The episode is over, the number of headings is wrong, or one does not exist.
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

    /// Slots flown.
    pub fn slot(&self) -> usize {
        self.env.slot()
    }

    /// Whether the time limit K is reached.
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

    /// Figures over the slots flown so far.
    pub fn metrics(&self) -> EpisodeMetrics {
        self.env.metrics(0)
    }
}
