//! One episode of one policy, kept as the positions it flew.

use crate::env::{EnvConfig, Episode};
use crate::figure::Flight;
use crate::invalid::Invalid;
use crate::policy::{Policy, Slot, Turn};

/// What `policy` flies in the episode with this seed.
///
/// # Errors
/// The environment is invalid, or the policy does not fit it.
pub fn flight(policy: &dyn Policy, env: &EnvConfig, seed: u64) -> Result<Flight, Invalid> {
    policy.check_fleet(env.uavs, env.users)?;
    let mut episode = Episode::new(env, seed)?;
    let mut memory = vec![0.0; policy.memory_len(env.uavs, env.users)];
    policy.start(env.uavs, env.users, seed, &mut memory);
    let mut headings = vec![0; env.uavs];
    let mut uavs: Vec<_> = episode.uavs().into_iter().map(|at| vec![at]).collect();
    while !episode.done() {
        let slot = Slot::from_scene(&episode.uavs(), &episode.users(), episode.aoi(), env.detection_range);
        let step = episode.slot() as u64;
        policy.act(&mut [Turn { slot: &slot, step, memory: &mut memory, headings: &mut headings, q_values: None }]);
        episode.step(&headings).map_err(|e| Invalid::new("policy.headings", e, "headings of the environment"))?;
        uavs.iter_mut().zip(episode.uavs()).for_each(|(flown, at)| flown.push(at));
    }
    Ok(Flight { uavs, users: episode.users(), transmission_range: env.transmission_range })
}
