//! What a hosted environment is made of: checked, bounded, and what fixes its episodes.

use rand::RngExt;

use crate::env::EnvConfig;
use crate::invalid::{Invalid, in_range};
use crate::rng;
use crate::train_config::EXACT;

/// Most copies of one environment.
const MAX_COPIES: usize = 1024;
/// Most UAVs and users in all copies of one environment: an answer without graphs stays below 4 MiB.
const MAX_NODES: usize = 32_768;
/// Most detections of an answer, if in every copy all nodes detect each other: some 20 MiB.
const MAX_DETECTIONS: usize = 1 << 19;

/// Everything that, together with the actions, fixes what an environment answers.
#[derive(Clone, Debug, PartialEq)]
pub struct Blueprint {
    /// The environment, checked.
    pub config: EnvConfig,
    /// B.
    pub copies: usize,
    /// Copy b's first episode has the seed `seed` + b.
    pub seed: u64,
    /// Whether the last step of an episode begins the next.
    pub auto_reset: bool,
}

impl Blueprint {
    /// Checks everything but the name.
    ///
    /// # Errors
    /// The first field that is out of range, or copies and nodes that are too many together.
    pub fn new(config: EnvConfig, copies: usize, seed: u64, auto_reset: bool) -> Result<Self, Invalid> {
        config.validate().map_err(|e| e.within("environment"))?;
        in_range("count", copies, 1..=MAX_COPIES)?;
        check_seed(seed)?;
        if copies * config.nodes() > MAX_NODES {
            let value = format!("{copies} copies of {} UAVs and users", config.nodes());
            return Err(Invalid::new("count", value, format!("at most {MAX_NODES} UAVs and users in all copies")));
        }
        Ok(Self { config, copies, seed, auto_reset })
    }

    /// Refuses graphs whose size would be out of bounds, whatever the positions.
    ///
    /// # Errors
    /// There are too many nodes that might detect each other.
    pub(super) fn check_graph(&self) -> Result<(), Invalid> {
        let (copies, nodes) = (self.copies, self.config.nodes());
        if copies * nodes * (nodes - 1) <= MAX_DETECTIONS {
            return Ok(());
        }
        let value = format!("true with {copies} copies of {nodes} UAVs and users");
        let expected = format!("false, because more than {MAX_DETECTIONS} detections are possible");
        Err(Invalid::new("return_graph", value, expected))
    }

    /// `actions` of all copies in a row.
    ///
    /// # Errors
    /// The number of copies or headings is wrong, or a heading index does not exist.
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
                if heading as usize >= self.config.headings() {
                    let expected = format!("a heading index from 0 to {}", self.config.headings() - 1);
                    return Err(Invalid::new(format!("actions[{b}].headings[{i}]"), heading, expected));
                }
                flat.push(heading as u8);
            }
        }
        Ok(flat)
    }

    /// Distances that a step looks at, and numbers that it writes: what decides where it is computed.
    pub(super) fn work(&self) -> usize {
        self.copies * (self.config.uavs * self.config.users + self.config.nodes())
    }

    /// Memory that the environment takes while it is held, in bytes; a little more than it really is.
    pub(super) fn bytes(&self) -> usize {
        let env = &self.config;
        // Position, last move and final position of a UAV; position, walk, AoI, tally and final state of a user; counts of
        // each AoI; what is kept of a copy besides.
        let copy = env.uavs * 24 + env.users * 48 + (env.slots + 1) * 4 + 1024;
        self.copies * copy + env.nodes() * 64 + 4096
    }
}

/// Checks a seed.
pub(super) fn check_seed(seed: u64) -> Result<(), Invalid> {
    in_range("seed", seed, 0..=EXACT)
}

/// The seed of episode `episode` of the copy whose episode 0 has `first`: at most [`EXACT`], and the top bit below it set,
/// so that episodes after the first do not meet those that policies are evaluated on.
pub(super) fn episode_seed(first: u64, episode: u64) -> u64 {
    if episode == 0 {
        return first;
    }
    let drawn = rng::stream(first, "hosted-episode", episode).random::<u64>();
    (drawn & EXACT) | (1 << 52)
}
