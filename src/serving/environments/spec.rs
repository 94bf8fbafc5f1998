//! The specification of a hosted environment: validation, limits, and the seeds of its episodes.

use rand::RngExt;

use crate::env::EnvConfig;
use crate::invalid::{Invalid, in_range};
use crate::rng;
use crate::train_config::MAX_EXACT_INTEGER;

/// Maximum number of copies of one environment.
const MAX_COPIES: usize = 1024;
/// Maximum number of UAVs and users in all copies of one environment: a response without graphs stays below 4 MiB.
const MAX_NODES: usize = 32_768;
/// Maximum number of detections of a response, if in every copy all nodes detect each other: about 20 MiB.
const MAX_DETECTIONS: usize = 1 << 19;

/// Everything that, together with the actions, determines the states of an environment.
#[derive(Clone, Debug, PartialEq)]
pub struct EnvironmentSpec {
    /// The validated configuration.
    pub config: EnvConfig,
    /// B, the number of copies.
    pub copies: usize,
    /// Copy b's first episode has the seed `seed` + b.
    pub seed: u64,
    /// Whether the last step of an episode begins the next.
    pub auto_reset: bool,
}

impl EnvironmentSpec {
    /// A valid specification.
    ///
    /// # Errors
    /// Names the first field that is out of range, or `count` if all copies together have too many nodes.
    pub fn new(config: EnvConfig, copies: usize, seed: u64, auto_reset: bool) -> Result<Self, Invalid> {
        config.validate().map_err(|e| e.with_prefix("environment"))?;
        in_range("count", copies, 1..=MAX_COPIES)?;
        check_seed(seed)?;
        if copies * config.nodes() > MAX_NODES {
            let value = format!("{copies} copies of {} UAVs and users", config.nodes());
            return Err(Invalid::new("count", value, format!("at most {MAX_NODES} UAVs and users in all copies")));
        }
        Ok(Self { config, copies, seed, auto_reset })
    }

    /// Checks that graphs may be returned: their size has to be bounded for all positions.
    ///
    /// # Errors
    /// Names `return_graph` if too many pairs of nodes could detect each other.
    pub(super) fn check_graph(&self) -> Result<(), Invalid> {
        let (copies, nodes) = (self.copies, self.config.nodes());
        if copies * nodes * (nodes - 1) <= MAX_DETECTIONS {
            return Ok(());
        }
        let value = format!("true with {copies} copies of {nodes} UAVs and users");
        let expected = format!("false, because more than {MAX_DETECTIONS} detections are possible");
        Err(Invalid::new("return_graph", value, expected))
    }

    /// The headings of all copies, (B, M) flattened.
    ///
    /// # Errors
    /// Names the part of `actions` that has a wrong length or an unknown heading index.
    pub(super) fn headings(&self, actions: &[Vec<u32>]) -> Result<Vec<u8>, Invalid> {
        if actions.len() != self.copies {
            return Err(Invalid::new("actions", format!("{} entries", actions.len()), format!("{}, one per copy", self.copies)));
        }
        let mut flat = Vec::with_capacity(self.copies * self.config.uavs);
        for (b, headings) in actions.iter().enumerate() {
            if headings.len() != self.config.uavs {
                let value = format!("{} heading indices", headings.len());
                let expected = format!("{}, one per UAV", self.config.uavs);
                return Err(Invalid::new(format!("actions[{b}].headings"), value, expected));
            }
            for (i, &heading) in headings.iter().enumerate() {
                if heading as usize >= self.config.actions() {
                    let expected = format!("a heading index from 0 to {}", self.config.actions() - 1);
                    return Err(Invalid::new(format!("actions[{b}].headings[{i}]"), heading, expected));
                }
                flat.push(heading as u8);
            }
        }
        Ok(flat)
    }

    /// Work of a step: distances that it computes plus numbers that it writes.
    pub(super) fn work(&self) -> usize {
        self.copies * (self.config.uavs * self.config.users + self.config.nodes())
    }

    /// Upper estimate of the environment's memory, in bytes.
    pub(super) fn bytes(&self) -> usize {
        let env = &self.config;
        // Per UAV: position, last move, final position. Per user: position, walk, AoI, AoI statistics, final state. Per copy:
        // a histogram of AoI, and a constant.
        let copy = env.uavs * 24 + env.users * 48 + (env.slots + 1) * 4 + 1024;
        self.copies * copy + env.nodes() * 64 + 4096
    }
}

/// Checks that a seed is in range.
pub(super) fn check_seed(seed: u64) -> Result<(), Invalid> {
    in_range("seed", seed, 0..=MAX_EXACT_INTEGER)
}

/// The seed of episode `episode` of the copy whose episode 0 has seed `first`. Seeds of later episodes have bit 52 set and are
/// at most [`MAX_EXACT_INTEGER`], so they are disjoint from the seeds of evaluation episodes.
pub(super) fn episode_seed(first: u64, episode: u64) -> u64 {
    if episode == 0 {
        return first;
    }
    let drawn = rng::stream(first, "hosted-episode", episode).random::<u64>();
    (drawn & MAX_EXACT_INTEGER) | (1 << 52)
}
