//! A rule that flies some of the UAVs while episodes are collected (docs/model.md, "Teacher"). Q-learning is off-policy: it learns the
//! values of what the rule does, and improves on them.
//!
//! For each episode, every UAV is led with probability max(epsilon, `teacher_share`). A led UAV follows the rule in nine of ten slots,
//! and the policy in the others, so that the policy also sees what follows from its own headings.

use std::sync::Arc;

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::TrainConfig;
use crate::env::{BatchEnv, EnvConfig, Point, points};
use crate::invalid::Invalid;
use crate::policy::{EnvParams, FleetGraph, FleetStep, Policy, baselines};

/// Probability that the rule decides for a led UAV in a slot.
const FOLLOW: f64 = 0.9;

/// The rule, and the fleets that it may lead.
pub(super) struct Teacher {
    rule: Arc<dyn Policy>,
    env: EnvParams,
    /// N.
    users: usize,
    share: f64,
    /// Probability of a random heading of a UAV that is not led.
    pub(super) epsilon: f64,
    graphs: Vec<FleetGraph>,
    memories: Vec<Vec<f32>>,
    /// (B, M) whether the UAV is led.
    led: Vec<bool>,
    /// (B, M) the rule's headings.
    headings: Vec<u8>,
    points: [Vec<Point>; 2],
}

impl std::fmt::Debug for Teacher {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Teacher").field("share", &self.share).finish_non_exhaustive()
    }
}

impl Teacher {
    /// The teacher of a configuration, if it has one, for `fleets` fleets in `environment`.
    pub(super) fn new(config: &TrainConfig, environment: &EnvConfig, fleets: usize) -> Result<Option<Self>, Invalid> {
        let Some(name) = &config.training.teacher else { return Ok(None) };
        let env = EnvParams::from(environment);
        let (m, n) = (environment.uavs, environment.users);
        let rule =
            baselines::by_name(name, env).ok_or_else(|| Invalid::new("training.teacher", name, "the name of a baseline"))?;
        rule.check_fleet(m, n)?;
        Ok(Some(Self {
            env,
            users: n,
            share: config.training.teacher_share,
            epsilon: config.training.epsilon_end,
            graphs: vec![FleetGraph::default(); fleets],
            memories: vec![vec![0.0; rule.memory_len(m, n)]; fleets],
            led: vec![false; fleets * m],
            headings: vec![0; fleets * m],
            points: Default::default(),
            rule,
        }))
    }

    /// Chooses the led UAVs of new episodes with these seeds.
    pub(super) fn begin(&mut self, epsilon: f64, seeds: &[u64], rngs: &mut [ChaCha8Rng]) {
        let uavs = self.led.len() / seeds.len();
        let share = epsilon.max(self.share);
        for (led, rng) in self.led.chunks_exact_mut(uavs).zip(rngs) {
            led.fill_with(|| rng.random::<f64>() < share);
        }
        for (memory, &seed) in self.memories.iter_mut().zip(seeds) {
            self.rule.start(uavs, self.users, seed, memory);
        }
    }

    /// Computes the rule's headings in the current slot, for the fleets with a led UAV.
    pub(super) fn decide(&mut self, env: &BatchEnv) {
        let (m, n) = (env.config().uavs, env.config().users);
        let [uavs, users] = &mut self.points;
        for (b, graph) in self.graphs.iter_mut().enumerate().filter(|(b, _)| self.led[b * m..][..m].contains(&true)) {
            uavs.clear();
            uavs.extend(points(&env.uav_xy()[b * m * 2..][..m * 2]));
            users.clear();
            users.extend(points(&env.user_xy()[b * n * 2..][..n * 2]));
            graph.set_scene(uavs, users, &env.aoi()[b * n..][..n], self.env.ranges());
            let (memory, headings) = (&mut self.memories[b], &mut self.headings[b * m..][..m]);
            let step =
                FleetStep { env: self.env, graph, profile: None, step: env.slot() as u64, memory, headings, q_values: None };
            self.rule.act(&mut [step]);
        }
    }

    /// The heading of UAV `i` of all fleets, if the rule decides for it in this slot.
    pub(super) fn leads(&self, i: usize, rng: &mut ChaCha8Rng) -> Option<u8> {
        (self.led[i] && rng.random::<f64>() < FOLLOW).then_some(self.headings[i])
    }
}
