//! A trained agent as a [`Policy`]. One forward pass computes a batch of fleets of different sizes.
//!
//! Memory: per UAV its hidden state (64), last heading (-1 in slot 0), and the token with identity `token`; then, for agents with a
//! memory, what each UAV remembers (`policy::memory`).

use std::sync::{Mutex, PoisonError};

use rand::RngExt;

use super::agent::{Agent, AgentCache, Dims};
use super::config::{AgentConfig, Identity, TOKEN};
use super::features::{Inputs, NO_ACTION};
use super::geometry::Geometry;
use super::goals::{self, Goals};
use super::memory::{self, Exchange, MAX_REMEMBERED, uav_memory_len};
use super::{Carry, EnvParams, FleetStep, Policy, Reach, RequiredInput};
use crate::invalid::{Invalid, in_range};
use crate::nn::{HIDDEN, Weights, argmax};
use crate::rng;

/// Maximum entries of users in the memories of a fleet, which are vectors of fixed length.
const MAX_ENTRIES: usize = 1 << 24;
/// Buffers of a batch that costs more (see [`Policy::work`]) are not kept: they are large, and to allocate them costs little by
/// comparison.
const MAX_KEPT_WORK: usize = 1 << 16;

/// A trained agent with prepared weights. Shared by threads.
#[derive(Debug)]
pub struct LearnedPolicy {
    agent: Agent,
    params: Vec<f32>,
    prepared: Vec<f32>,
    advice_margin: f32,
    trained: Trained,
    /// Buffers of finished calls, for the next calls.
    buffers: Mutex<Vec<Buffers>>,
}

/// The fleets and ranges of the training, as far as advised policies need them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Trained {
    /// The largest M.
    pub most_uavs: usize,
    /// The smallest d.
    pub least_detection_range: f64,
}

impl Trained {
    /// Any fleet and any range.
    pub const ANY: Self = Self { most_uavs: usize::MAX, least_detection_range: 0.0 };

    /// Ranges that a caller gave in metres are rounded.
    fn contains(&self, uavs: usize, env: &EnvParams) -> bool {
        uavs <= self.most_uavs && env.detection_range >= 0.99 * self.least_detection_range
    }
}

#[derive(Debug, Default)]
struct Buffers {
    geometry: Geometry,
    goals: Goals,
    exchange: Exchange,
    cache: AgentCache<f32>,
    last: Vec<u8>,
    identity_token: Vec<f32>,
    position: Vec<f32>,
}

impl LearnedPolicy {
    /// The policy with parameters `params`, in the order of the agent's layout.
    ///
    /// # Errors
    /// [`Invalid`] if the number of parameters does not fit the architecture, or one is not finite.
    pub fn new(config: AgentConfig, dims: Dims, params: Vec<f32>) -> Result<Self, Invalid> {
        let agent = Agent::new(config, dims);
        let len = agent.layout().len();
        if params.len() != len {
            return Err(Invalid::new("parameters", format!("{} numbers", params.len()), format!("{len} numbers")));
        }
        if let Some(bad) = params.iter().find(|x| !x.is_finite()) {
            return Err(Invalid::new("parameters", bad, "only finite numbers"));
        }
        let mut prepared = vec![0.0; len];
        agent.prepare(&params, &mut prepared);
        Ok(Self { agent, params, prepared, advice_margin: 0.0, trained: Trained::ANY, buffers: Mutex::default() })
    }

    /// The policy that leaves the advised heading only for one whose Q-value is higher by `margin` times the users per UAV that it
    /// remembers, at least by `margin` (docs/model.md, "Advice"). Without advice it stays as it is.
    #[must_use]
    pub fn with_advice_margin(self, margin: f32) -> Self {
        Self { advice_margin: margin, ..self }
    }

    /// The policy that always flies the advised heading where it was not trained (docs/model.md, "Advice"). Without advice it stays as
    /// it is.
    #[must_use]
    pub fn with_trained(self, trained: Trained) -> Self {
        Self { trained, ..self }
    }

    /// The architecture.
    pub fn agent(&self) -> &Agent {
        &self.agent
    }

    /// The margin of [`LearnedPolicy::with_advice_margin`].
    pub fn advice_margin(&self) -> f32 {
        self.advice_margin
    }

    /// The fleets and ranges of [`LearnedPolicy::with_trained`].
    pub fn trained(&self) -> Trained {
        self.trained
    }

    /// The parameters, in the order of the agent's layout.
    pub fn parameters(&self) -> &[f32] {
        &self.params
    }

    fn has_token(&self) -> bool {
        self.agent.config().identity == Identity::Token
    }

    /// Length of the hidden state, last heading and token of one UAV.
    fn stride(&self) -> usize {
        HIDDEN + 1 + if self.has_token() { TOKEN } else { 0 }
    }
}

impl Policy for LearnedPolicy {
    fn actions(&self) -> usize {
        self.agent.dims().env.actions
    }

    fn needs(&self) -> RequiredInput {
        if self.agent.config().self_position || !self.agent.config().memory.is_none() {
            RequiredInput::OwnPositions
        } else {
            RequiredInput::Detections
        }
    }

    fn env(&self) -> EnvParams {
        self.agent.dims().env
    }

    fn check_fleet(&self, uavs: usize, users: usize) -> Result<(), Invalid> {
        self.agent.check_fleet(uavs, users)?;
        let fits = !self.remembers_users() || uavs * users.min(MAX_REMEMBERED) <= MAX_ENTRIES;
        if fits { Ok(()) } else { in_range("users", users, 0..=MAX_ENTRIES / uavs) }
    }

    fn work(&self, uavs: usize, users: usize, detections: usize) -> usize {
        let alone = 32 * uavs + users + detections;
        if !self.remembers_users() {
            return alone;
        }
        // Each UAV looks at every user that it remembers and scores its goals; then it may receive as many memories as it detects UAVs.
        let remembered = users.min(MAX_REMEMBERED);
        let goals = goals::MAX_USERS.min(users) + goals::MAX_BLOCKS;
        // As many of all detections as are among UAVs when nodes of both kinds are spread alike.
        let received = (detections as f64 * (uavs as f64 / (uavs + users) as f64).powi(2)) as usize;
        alone + uavs * (goals + remembered / 4) + received * (remembered / 8 + goals / 32)
    }

    fn observers(&self, uavs: usize, users: usize) -> usize {
        self.agent.geometry_config(&self.env()).observers(uavs, users)
    }

    fn memory_period(&self, _uavs: usize, users: usize) -> usize {
        if self.agent.config().memory.is_none() { self.stride() } else { uav_memory_len(users) }
    }

    fn memory_len(&self, uavs: usize, users: usize) -> usize {
        let remembered = if self.agent.config().memory.is_none() { 0 } else { uav_memory_len(users) };
        uavs * (self.stride() + remembered)
    }

    fn start(&self, uavs: usize, _users: usize, seed: u64, memory: &mut [f32]) {
        let (memory, remembered) = memory.split_at_mut(uavs * self.stride());
        remembered.fill(0.0);
        let mut stream = rng::stream(seed, "token", 0);
        for uav in memory.chunks_exact_mut(self.stride()) {
            uav.fill(0.0);
            uav[HIDDEN] = -1.0;
            uav[HIDDEN + 1..].fill_with(|| 2.0 * stream.random::<f32>() - 1.0);
        }
    }

    fn carry(&self, from: &[f32], to: &mut [f32], carry: &Carry<'_>) {
        let stride = self.stride();
        let (hidden, remembered) = from.split_at(carry.from.0 * stride);
        let (to_hidden, to_remembered) = to.split_at_mut(carry.to.0 * stride);
        carry.uav_rows(stride, hidden, to_hidden);
        if self.remembers_users() {
            memory::carry(remembered, to_remembered, carry);
        }
    }

    fn overrule(&self, memory: &mut [f32], uav: usize, heading: u8) {
        let known = usize::from(heading) < self.actions();
        memory[uav * self.stride() + HIDDEN] = if known { f32::from(heading) } else { -1.0 };
    }

    fn remembers_users(&self) -> bool {
        !self.agent.config().memory.is_none()
    }

    fn reach(&self) -> Reach {
        let config = self.agent.config();
        let layers = self.agent.geometry_config(&self.env()).layers;
        // What a user detects, the UAVs know that detect the user: one link more than to the user.
        let graph = if layers > 0 { layers + 1 } else { 0 };
        let hops = if config.hops > 1 { config.hops } else { 0 };
        let shared = usize::from(config.memory.sharing() == Some(memory::Sharing::Shared));
        Reach::Links(graph.max(hops).max(shared))
    }

    fn rule_in(&self, env: &EnvParams) -> Option<&'static str> {
        let config = self.agent.config();
        let advised = !config.advice.is_none() && !self.trained.contains(1, env);
        let rule = if config.memory.sharing() == Some(memory::Sharing::Shared) { "sweep-shared" } else { "sweep" };
        advised.then_some(rule)
    }

    fn is_cheap(&self) -> bool {
        self.agent.config().hops <= 1
    }

    fn act(&self, fleets: &mut [FleetStep<'_>]) {
        let pool = || self.buffers.lock().unwrap_or_else(PoisonError::into_inner);
        let taken = pool().pop();
        let mut buffers = taken.unwrap_or_default();
        self.run(fleets, &mut buffers);
        let size = |fleet: &FleetStep<'_>| self.work(fleet.graph.uavs(), fleet.graph.users(), fleet.graph.detection_count());
        if fleets.iter().map(size).sum::<usize>() <= MAX_KEPT_WORK {
            pool().push(buffers);
        }
    }
}

impl LearnedPolicy {
    fn run(&self, fleets: &mut [FleetStep<'_>], b: &mut Buffers) {
        let stride = self.stride();
        b.geometry.clear();
        b.last.clear();
        b.identity_token.clear();
        b.position.clear();
        b.goals.clear();
        for fleet in fleets.iter_mut() {
            b.geometry.push_graph(&self.agent.geometry_config(&fleet.env), fleet.graph);
            if let Some(profile) = fleet.profile {
                b.geometry.set_sectors(&profile.sectors);
            }
            let (memory, remembered) = fleet.memory.split_at_mut(fleet.graph.uavs() * stride);
            for uav in memory.chunks_exact(stride) {
                // The memory may come from a client. A number that is not a heading counts as no heading.
                let known = (0.0..self.actions() as f32).contains(&uav[HIDDEN]);
                b.last.push(if known { uav[HIDDEN] as u8 } else { NO_ACTION });
                b.identity_token.extend_from_slice(&uav[HIDDEN + 1..]);
            }
            if !self.agent.config().memory.is_none() {
                let sight = fleet.graph.sight().expect("the caller provides what `needs` requires");
                let slot = (&fleet.env, &sight, fleet.step);
                let last = &b.last[b.last.len() - sight.uavs()..];
                self.agent.remember(slot, (last, fleet.profile), remembered, &mut b.exchange, &mut b.goals);
            }
            if let Some(own) = fleet.graph.uav_positions() {
                b.position.extend(own.iter().flatten().map(|&x| x as f32));
            }
        }
        b.geometry.finish(&self.agent.geometry_config(&self.env()));
        let rows = b.geometry.uav_rows();
        let memories = fleets.iter().flat_map(|fleet| fleet.memory[..fleet.graph.uavs() * stride].chunks_exact(stride));
        for (h, uav) in b.cache.begin(rows, 1).chunks_exact_mut(HIDDEN).zip(memories) {
            h.copy_from_slice(&uav[..HIDDEN]);
        }
        let inputs = Inputs {
            geometry: &b.geometry,
            goals: &b.goals,
            needed: None,
            last: &b.last,
            identity_token: &b.identity_token,
            position: &b.position,
        };
        let weights = Weights { params: &self.params, prepared: &self.prepared };
        self.agent.forward(weights, &inputs, 1, &mut b.cache);
        let trained = fleets.iter().flat_map(|fleet| {
            let uavs = fleet.graph.uavs();
            std::iter::repeat_n(self.trained.contains(uavs, &fleet.env), uavs)
        });
        let advice = b.goals.advice().iter().zip(b.goals.load());
        for ((q, (&heading, &load)), trained) in
            b.cache.q.as_mut_slice().chunks_exact_mut(self.actions()).zip(advice).zip(trained)
        {
            let heading = usize::from(heading);
            let base = if trained { q[heading] } else { q.iter().copied().fold(f32::MIN, f32::max) };
            q[heading] = base + self.advice_margin * load.max(1.0);
        }
        let mut after = b.cache.last_hidden(rows).chunks_exact(HIDDEN).zip(b.cache.q.as_slice().chunks_exact(self.actions()));
        for fleet in fleets {
            let hidden = &mut fleet.memory[..fleet.graph.uavs() * stride];
            for (i, uav) in hidden.chunks_exact_mut(stride).enumerate() {
                let (h, q) = after.next().expect("one row per UAV");
                let best = argmax(q);
                uav[..HIDDEN].copy_from_slice(h);
                uav[HIDDEN] = best as f32;
                fleet.headings[i] = best as u8;
                if let Some(values) = &mut fleet.q_values {
                    values[i * q.len()..][..q.len()].copy_from_slice(q);
                }
            }
        }
    }
}
