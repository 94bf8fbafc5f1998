//! An agent that acts for B fleets of equal size at once, slot by slot, without allocation per step. Used by rollouts.

use super::agent::{Agent, AgentCache, Dims};
use super::config::TOKEN;
use super::features::{Inputs, NO_ACTION};
use super::geometry::Geometry;
use super::goals::Goals;
use super::memory::Exchange;
use crate::nn::{HIDDEN, Weights};

/// The scenes of B fleets in one slot.
#[derive(Clone, Copy, Debug)]
pub struct StepInput<'a> {
    /// (B, M, 2) UAV positions.
    pub uav_xy: &'a [f32],
    /// (B, N, 2) user positions.
    pub user_xy: &'a [f32],
    /// (B, N) AoI in slots.
    pub aoi: &'a [f32],
}

/// Hidden states, last actions and buffers of B fleets.
#[derive(Debug)]
pub struct BatchedAgent {
    fleets: usize,
    /// The environment, and the size of each fleet.
    dims: Dims,
    params: Vec<f32>,
    prepared: Vec<f32>,
    hidden: Vec<f32>,
    last: Vec<u8>,
    identity_token: Vec<f32>,
    geometry: Geometry,
    /// What the UAVs remember, fleet after fleet.
    memory: Vec<f32>,
    exchange: Exchange,
    goals: Goals,
    slot: u64,
    cache: AgentCache<f32>,
}

impl BatchedAgent {
    /// Allocates for `fleets` fleets of these sizes, in this environment. Call [`BatchedAgent::begin`] before the first step.
    pub fn new(agent: &Agent, dims: Dims, fleets: usize) -> Self {
        let (len, rows) = (agent.layout().len(), fleets * dims.uavs);
        Self {
            fleets,
            dims,
            params: vec![0.0; len],
            prepared: vec![0.0; len],
            hidden: vec![0.0; rows * HIDDEN],
            last: vec![NO_ACTION; rows],
            identity_token: vec![0.0; rows * TOKEN],
            geometry: Geometry::default(),
            memory: vec![0.0; agent.memory_len(dims.uavs, dims.users) * fleets],
            exchange: Exchange::default(),
            goals: Goals::default(),
            slot: 0,
            cache: AgentCache::default(),
        }
    }

    /// Starts an episode with the parameters `params`. `identity_token` is (B, M, 4) and is used only with identity `token`.
    ///
    /// # Panics
    /// If a length does not fit.
    pub fn begin(&mut self, agent: &Agent, params: &[f32], identity_token: &[f32]) {
        self.params.copy_from_slice(params);
        agent.prepare(&self.params, &mut self.prepared);
        self.identity_token.copy_from_slice(identity_token);
        self.hidden.fill(0.0);
        self.last.fill(NO_ACTION);
        self.memory.fill(0.0);
        self.slot = 0;
    }

    /// Returns the Q-values (B, M, A) of the next slot and advances the hidden states.
    ///
    /// # Panics
    /// If a length does not fit.
    pub fn step(&mut self, agent: &Agent, input: StepInput<'_>) -> &[f32] {
        let (m, n, env) = (self.dims.uavs, self.dims.users, &self.dims.env);
        let lengths = (input.uav_xy.len(), input.user_xy.len(), input.aoi.len());
        assert_eq!(lengths, (self.fleets * m * 2, self.fleets * n * 2, self.fleets * n), "B fleets of M and N");
        let config = agent.geometry_config(env);
        self.geometry.clear();
        self.goals.clear();
        for f in 0..self.fleets {
            let (uav_xy, user_xy) = (&input.uav_xy[f * 2 * m..][..2 * m], &input.user_xy[f * 2 * n..][..2 * n]);
            let aoi = &input.aoi[f * n..][..n];
            self.geometry.push_scene(&config, uav_xy, user_xy, aoi);
            if !self.memory.is_empty() {
                let len = agent.memory_len(m, n);
                let (memory, last) = (&mut self.memory[f * len..][..len], &self.last[f * m..][..m]);
                let sight = self.geometry.last_sight(aoi);
                agent.remember((env, &sight, self.slot), (last, None), memory, &mut self.exchange, &mut self.goals);
            }
        }
        self.geometry.finish(&config);
        self.slot += 1;
        let rows = self.fleets * m;
        self.cache.begin(rows, 1).copy_from_slice(&self.hidden);
        let weights = Weights { params: &self.params, prepared: &self.prepared };
        let inputs = Inputs {
            geometry: &self.geometry,
            goals: &self.goals,
            needed: None,
            last: &self.last,
            identity_token: &self.identity_token,
            position: input.uav_xy,
        };
        agent.forward(weights, &inputs, 1, &mut self.cache);
        self.hidden.copy_from_slice(self.cache.last_hidden(rows));
        self.cache.q.as_slice()
    }

    /// Records the actions taken (B, M), which are inputs of the next slot.
    ///
    /// # Panics
    /// If the number of actions is not B M.
    pub fn record_actions(&mut self, actions: &[u8]) {
        self.last.copy_from_slice(actions);
    }
}
