//! Policies by rule, served and evaluated exactly like checkpoints (docs/model.md, "Baselines").
//!
//! All state is in the memory that the caller holds. Random numbers depend on (seed, slot) only. A rule decides for one fleet;
//! [`Baseline`] makes a [`Policy`] of it.

mod greedy_global;
mod max_aoi;
mod nearest;
mod persistent;
mod random;
mod rule;
mod search;
mod sweep;
mod tour;

use std::sync::Arc;

use self::rule::{Rule, Slot};
use self::search::Search;
use super::{Carry, EnvParams, FleetStep, Policy, Reach, RequiredInput};
use crate::invalid::{Invalid, in_range};

/// A baseline in the list of policies.
#[derive(Clone, Copy, Debug)]
pub struct BaselineInfo {
    /// Name of the policy.
    pub name: &'static str,
    /// One sentence on what the baseline does.
    pub description: &'static str,
    /// The input that the baseline requires.
    pub needs: RequiredInput,
    create: fn(EnvParams) -> Arc<dyn Policy>,
}

/// All baselines, from the least to the best informed.
pub const LIST: [BaselineInfo; 8] = [
    info::<random::Random>(),
    info::<Search<persistent::Persistent>>(),
    info::<Search<max_aoi::MaxAoi>>(),
    info::<Search<nearest::Nearest>>(),
    info::<sweep::Sweep<false>>(),
    info::<sweep::Sweep<true>>(),
    info::<greedy_global::GreedyGlobal>(),
    info::<tour::Tour>(),
];

/// Whether a baseline has this name.
pub fn is_name(name: &str) -> bool {
    LIST.iter().any(|baseline| baseline.name == name)
}

/// The baseline `name` in the environment `env`, or `None` for an unknown name.
pub fn by_name(name: &str, env: EnvParams) -> Option<Arc<dyn Policy>> {
    LIST.iter().find(|baseline| baseline.name == name).map(|baseline| (baseline.create)(env))
}

const fn info<R: Rule + 'static>() -> BaselineInfo {
    BaselineInfo {
        name: R::NAME,
        description: R::DESCRIPTION,
        needs: R::NEEDS,
        create: |env| Arc::new(Baseline { rule: R::default(), env }),
    }
}

/// The policy that follows a rule in an environment.
struct Baseline<R> {
    rule: R,
    env: EnvParams,
}

/// Limits of rules that plan with the full scene: their work grows with M * N and with the square of M.
const MAX_UAVS: usize = 4096;
const MAX_PAIRS: usize = 1 << 20;

impl<R: Rule> Policy for Baseline<R> {
    fn actions(&self) -> usize {
        self.env.actions
    }

    fn needs(&self) -> RequiredInput {
        R::NEEDS
    }

    fn env(&self) -> EnvParams {
        self.env
    }

    fn check_fleet(&self, uavs: usize, users: usize) -> Result<(), Invalid> {
        if uavs == 0 {
            return Err(Invalid::new("uavs", uavs, "at least 1"));
        }
        if R::NEEDS != RequiredInput::FullScene {
            return Ok(());
        }
        in_range("uavs", uavs, 1..=MAX_UAVS)?;
        in_range("users", users, 0..=MAX_PAIRS / uavs)
    }

    fn observers(&self, uavs: usize, _users: usize) -> usize {
        match R::NEEDS {
            // A UAV decides by what it detects itself.
            RequiredInput::OwnPositions => uavs,
            // `random` looks at nothing; rules with the full scene compute what they need.
            RequiredInput::Detections | RequiredInput::FullScene => 0,
        }
    }

    fn reach(&self) -> Reach {
        R::REACH
    }

    fn work(&self, uavs: usize, users: usize, detections: usize) -> usize {
        self.rule.work(uavs, users, detections)
    }

    fn is_cheap(&self) -> bool {
        // With the full scene, a rule plans whole flights.
        R::NEEDS != RequiredInput::FullScene
    }

    fn memory_len(&self, uavs: usize, users: usize) -> usize {
        self.rule.memory_len(uavs, users)
    }

    fn start(&self, _uavs: usize, _users: usize, seed: u64, memory: &mut [f32]) {
        memory.fill(0.0);
        self.rule.start(seed, memory);
    }

    fn carry(&self, from: &[f32], to: &mut [f32], carry: &Carry<'_>) {
        self.rule.carry(from, to, carry);
    }

    fn remembers_users(&self) -> bool {
        self.rule.remembers_users()
    }

    fn act(&self, fleets: &mut [FleetStep<'_>]) {
        for fleet in fleets {
            let slot = Slot { env: &fleet.env, graph: fleet.graph, step: fleet.step, profile: fleet.profile };
            self.rule.decide(&slot, fleet.memory, fleet.headings);
            if let Some(q) = &mut fleet.q_values {
                q.fill(f32::NAN);
            }
        }
    }
}
