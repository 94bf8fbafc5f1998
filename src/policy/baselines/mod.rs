//! Policies that are not learned (spec 6), served and evaluated exactly like checkpoints.
//!
//! All state lives in the memory that the caller holds. Randomness is counter-based, from (seed, slot). A rule decides for
//! one fleet; [`Baseline`] makes a [`Policy`] of it. Headings that stay in place are used by none but `random`.

mod geometry;
mod greedy_global;
mod max_aoi;
mod nearest;
mod persistent;
mod random;
mod search;
mod sweep;
mod tour;

use std::sync::Arc;

use rand_chacha::ChaCha8Rng;

use self::search::Search;
use super::{FleetStep, Policy, RequiredInput, Slot};
use crate::env::{EnvConfig, Point};
use crate::invalid::{Invalid, in_range};
use crate::rng;

/// What a baseline knows of the world it flies in.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EnvParams {
    /// v, distance per slot.
    pub speed: f64,
    /// t, range within which data is collected.
    pub transmission_range: f64,
    /// d, range within which nodes see each other.
    pub detection_range: f64,
    /// A, the number of actions.
    pub headings: usize,
    /// K, slots per episode: how far those that plan look ahead.
    pub slots: usize,
}

impl From<&EnvConfig> for EnvParams {
    fn from(env: &EnvConfig) -> Self {
        Self {
            speed: env.speed,
            transmission_range: env.transmission_range,
            detection_range: env.detection_range,
            headings: env.headings(),
            slots: env.slots,
        }
    }
}

impl Default for EnvParams {
    fn default() -> Self {
        Self::from(&EnvConfig::default())
    }
}

/// A baseline as a list of policies shows it.
#[derive(Clone, Copy, Debug)]
pub struct BaselineInfo {
    /// The name it is asked for by.
    pub name: &'static str,
    /// One sentence on what it does.
    pub text: &'static str,
    /// What it must be told.
    pub needs: RequiredInput,
    open: fn(EnvParams) -> Arc<dyn Policy>,
}

/// All baselines, from the least to the best informed.
pub const LIST: [BaselineInfo; 7] = [
    describe::<random::Random>(),
    describe::<Search<persistent::Persistent>>(),
    describe::<Search<max_aoi::MaxAoi>>(),
    describe::<Search<nearest::Nearest>>(),
    describe::<sweep::Sweep>(),
    describe::<greedy_global::GreedyGlobal>(),
    describe::<tour::Tour>(),
];

/// The baseline called `name`, if there is one.
pub fn by_name(name: &str, world: EnvParams) -> Option<Arc<dyn Policy>> {
    LIST.iter().find(|baseline| baseline.name == name).map(|baseline| (baseline.open)(world))
}

const fn describe<R: Rule + 'static>() -> BaselineInfo {
    BaselineInfo { name: R::NAME, text: R::TEXT, needs: R::NEEDS, open: |world| Arc::new(Baseline { rule: R::default(), world }) }
}

/// How one fleet decides one slot.
trait Rule: Default + Send + Sync {
    const NAME: &'static str;
    const TEXT: &'static str;
    const NEEDS: RequiredInput;

    /// Length of a fleet's memory.
    fn memory_len(&self, uavs: usize, users: usize) -> usize;

    /// Writes the memory of slot 0, which comes filled with zeros.
    fn start(&self, seed: u64, memory: &mut [f32]);

    /// Writes a heading per UAV and advances the memory.
    fn fly(&self, world: &EnvParams, slot: &Slot, step: u64, memory: &mut [f32], headings: &mut [u8]);
}

/// A rule in a world: a policy.
struct Baseline<R> {
    rule: R,
    world: EnvParams,
}

/// Largest M * N that baselines fly: their work and memory grow with it.
const MAX_PAIRS: usize = 1 << 20;

impl<R: Rule> Policy for Baseline<R> {
    fn actions(&self) -> usize {
        self.world.headings
    }

    fn needs(&self) -> RequiredInput {
        R::NEEDS
    }

    fn detection_range(&self) -> f64 {
        self.world.detection_range
    }

    fn check_fleet(&self, uavs: usize, users: usize) -> Result<(), Invalid> {
        in_range("uavs", uavs, 1..=4096)?;
        in_range("users", users, 1..=MAX_PAIRS / uavs)
    }

    fn memory_len(&self, uavs: usize, users: usize) -> usize {
        self.rule.memory_len(uavs, users)
    }

    fn start(&self, _uavs: usize, _users: usize, seed: u64, memory: &mut [f32]) {
        memory.fill(0.0);
        self.rule.start(seed, memory);
    }

    fn act(&self, turns: &mut [FleetStep<'_>]) {
        for turn in turns {
            self.rule.fly(&self.world, turn.slot, turn.step, turn.memory, turn.headings);
            if let Some(q) = &mut turn.q_values {
                q.fill(f32::NAN);
            }
        }
    }
}

/// f32s that a seed takes in a memory: 16 bits each, which f32 holds exactly.
const SEED_LEN: usize = 4;

fn store_seed(seed: u64, memory: &mut [f32]) {
    for (i, m) in memory[..SEED_LEN].iter_mut().enumerate() {
        *m = f32::from((seed >> (16 * i)) as u16);
    }
}

/// The random numbers of one slot of the episode whose seed is in `memory`.
fn slot_rng(memory: &[f32], name: &str, step: u64) -> ChaCha8Rng {
    let seed = memory[..SEED_LEN].iter().rev().fold(0, |seed, &m| seed << 16 | u64::from(m as u16));
    rng::stream(seed, name, step)
}

/// The positions of the UAVs.
fn own_positions(slot: &Slot) -> &[Point] {
    slot.uav_positions().expect("the caller gives what `needs` asks for")
}
