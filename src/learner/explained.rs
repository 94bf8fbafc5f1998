//! One episode of a policy, with what speaks for and against each heading in every slot.

use crate::env::{BatchEnv, EnvConfig, Point, points};
use crate::invalid::Invalid;
use crate::policy::{DecidedSlot, EnvParams, FleetGraph, FleetStep, Influence, Policy};

/// A slot of an explained episode. Positions are in units of the square's side.
#[derive(Clone, Debug, PartialEq)]
pub struct ExplainedSlot {
    /// Position of each UAV before its move.
    pub uavs: Vec<Point>,
    /// Position of each user.
    pub users: Vec<Point>,
    /// Heading index of each UAV.
    pub headings: Vec<u8>,
    /// What speaks for and against them; empty if the policy has no Q-values.
    pub influences: Vec<Influence>,
}

/// Flies the episode with this seed.
///
/// # Errors
/// The environment is invalid, or the policy does not fit it.
pub fn explained_flight(policy: &dyn Policy, config: &EnvConfig, seed: u64) -> Result<Vec<ExplainedSlot>, Invalid> {
    config.validate()?;
    policy.check_fleet(config.uavs, config.users)?;
    let (m, n, params) = (config.uavs, config.users, EnvParams::from(config));
    let mut env = BatchEnv::new(config, 1)?;
    env.reset(&[seed]);
    let mut memory = vec![0.0; policy.memory_len(m, n)];
    policy.start(m, n, seed, &mut memory);
    let mut slots = Vec::with_capacity(config.slots);
    while !env.done() {
        let (uavs, users): (Vec<Point>, Vec<Point>) = (points(env.uav_xy()).collect(), points(env.user_xy()).collect());
        let graph = FleetGraph::from_scene(&uavs, &users, env.aoi(), params.ranges());
        let (mut headings, mut q_values) = (vec![0; m], vec![f32::NAN; m * policy.actions()]);
        let (before, step) = (memory.clone(), env.slot() as u64);
        policy.act(&mut [FleetStep {
            env: params,
            graph: &graph,
            step,
            profile: None,
            memory: &mut memory,
            headings: &mut headings,
            q_values: Some(&mut q_values),
        }]);
        let decided = DecidedSlot {
            env: params,
            graph: &graph,
            step,
            profile: None,
            memory: &before,
            headings: &headings,
            q_values: &q_values,
        };
        let influences = decided.explain(policy);
        env.step(&headings);
        slots.push(ExplainedSlot { uavs, users, headings, influences });
    }
    Ok(slots)
}
