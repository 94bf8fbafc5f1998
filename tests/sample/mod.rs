//! Agents and episodes to test with.
#![allow(dead_code)] // each test binary uses its part

use qedgix::learner::Episodes;
use qedgix::policy::{Advice, AgentConfig, Aggregation, Dims, Gnn, Identity, Memory, ObservationKind, TOKEN};
use qedgix::rng;
use rand::RngExt;

/// Qedgix as in the paper, except for the aggregation by the mean.
pub const AGENT: AgentConfig = AgentConfig {
    gnn: Gnn::EdgeConv,
    layers: 2,
    aggregation: Aggregation::Mean,
    observation: ObservationKind::Flat,
    identity: Identity::Onehot,
    self_position: false,
    self_loops: false,
    hops: 1,
    normalise: false,
    memory: Memory::None,
    advice: Advice::None,
};

/// Episodes of UAVs that fly at random from the centre. Each episode has its own users.
pub fn episodes(dims: &Dims, len: usize, seed: u64) -> Episodes {
    let Dims { uavs, users, env } = *dims;
    let (actions, slots) = (env.actions, env.slots);
    let mut stream = rng::stream(seed, "episodes", 0);
    let mut ep = Episodes { env: dims.env, len, uavs, users, slots, ..Episodes::default() };
    for _ in 0..len {
        let mut at = vec![0.5_f32; 2 * uavs];
        let mut aoi = vec![0.0; users];
        ep.user_xy.extend((0..2 * users).map(|_| stream.random::<f32>()));
        ep.identity_token.extend((0..uavs * TOKEN).map(|_| 2.0 * stream.random::<f32>() - 1.0));
        for slot in 0..=slots {
            ep.uav_xy.extend(&at);
            ep.aoi.extend(&aoi);
            if slot == slots {
                break;
            }
            for p in at.chunks_exact_mut(2) {
                let heading = stream.random_range(0..actions);
                let (sin, cos) = (heading as f32 * std::f32::consts::FRAC_PI_4).sin_cos();
                let speed = if heading < 8 { 0.1 } else { 0.0 };
                p[0] = (p[0] + speed * cos).clamp(0.0, 1.0);
                p[1] = (p[1] + speed * sin).clamp(0.0, 1.0);
                ep.actions.push(heading as u8);
            }
            aoi.iter_mut().for_each(|a| *a = if stream.random_bool(0.3) { 0.0 } else { *a + 1.0 });
            ep.reward.push(-aoi.iter().sum::<f32>() / (users * slots) as f32);
        }
    }
    ep
}
