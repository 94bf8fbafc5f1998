//! The agent (docs/model.md, "Agents"). Its parameters are shared by all UAVs; only the GRU carries state from slot to slot.
//!
//! ```text
//! x = relu(fc(input))        h_k = GRU(x, h_{k-1})
//! no graph:    Q = head(h)
//! with graph:  y = leaky(w1 h) for UAVs, leaky(w2 obs) for users; graph layers with ReLU between; Q = head(h || y)
//! ```
//!
//! Each layer computes all slots of all fleets at once. UAV rows are time-major: slot, fleet, UAV.

use super::EnvParams;
use super::config::{AgentConfig, Aggregation, Gnn, Identity, ObservationKind};
use super::features::{Inputs, SetEncoder, flat_observation, identity_width, write_action_identity_position};
use super::fleet_profile::FleetProfile;
use super::geometry::{Geometry, GeometryConfig};
use super::goal_head::{GoalCache, GoalHead};
use super::goals::Goals;
use super::hop_search::HopSearch;
use super::memory::{Exchange, memories, remember, uav_memory_len};
use super::sight::Sight;
use crate::invalid::Invalid;
use crate::nn::matmul::InitialValue;
use crate::nn::{
    Batch, GraphLayer, Gru, HIDDEN, Init, LayerCache, LayerScratch, Linear, Mlp, MlpCache, ParameterLayout, Real, Rows, Weights,
    leaky_relu, leaky_relu_back, relu, relu_back,
};
use crate::threads;

/// Sizes of the fleet and parameters of the environment that an agent is made for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Dims {
    /// M.
    pub uavs: usize,
    /// N.
    pub users: usize,
    /// The environment. AoI is divided by its K.
    pub env: EnvParams,
}

/// What is added to the Q-value of the advised heading before training, and the factor of the initial weights of the last layers. The
/// other differences of untrained Q-values are then smaller, so an untrained policy follows the advice.
const TRUST: f64 = 0.1;
const QUIET: f64 = 0.02;

/// An agent's architecture and the layout of its parameters.
#[derive(Clone, Debug)]
pub struct Agent {
    config: AgentConfig,
    dims: Dims,
    layout: ParameterLayout,
    sets: Option<SetEncoder>,
    fc: Linear,
    rnn: Gru,
    body: Body,
    goals: Option<GoalHead>,
    /// What is added to the Q-value of the advised heading.
    advice: Option<usize>,
    /// Width of an observation.
    observation_width: usize,
}

#[derive(Clone, Debug)]
enum Body {
    Plain { head: Linear },
    Graph { w1: Linear, w2: Linear, layers: Vec<GraphLayer>, head: Mlp<HIDDEN> },
}

/// Activations of one forward pass, and buffers of its backward pass.
#[derive(Debug, Default)]
pub struct AgentCache<T: Real> {
    /// (slots + 1) blocks of hidden states: before the first slot, then after each slot.
    pub h: Batch<T>,
    /// Q-values, A per UAV row.
    pub q: Batch<T>,
    input: Batch<T>,
    user_obs: Batch<T>,
    x: Batch<T>,
    gates: Batch<T>,
    /// Input of each graph layer, then the output of the last one.
    y: Vec<Batch<T>>,
    layers: Vec<LayerCache<T>>,
    head: MlpCache<T>,
    goals: GoalCache<T>,
    search: HopSearch,
    scratch: Scratch<T>,
}

#[derive(Debug, Default)]
struct Scratch<T: Real> {
    dh: Batch<T>,
    dx: Batch<T>,
    dy: Batch<T>,
    next: Batch<T>,
    observation: Batch<T>,
    layer: LayerScratch<T>,
}

impl<T: Real> AgentCache<T> {
    /// Allocates for `slots` slots of `rows` UAVs, and returns the hidden states before the first slot for the caller to fill in.
    pub fn begin(&mut self, rows: usize, slots: usize) -> &mut [T] {
        self.h.resize(HIDDEN, rows * (slots + 1));
        &mut self.h.as_mut_slice()[..rows * HIDDEN]
    }

    /// Hidden states after the last slot.
    pub fn last_hidden(&self, rows: usize) -> &[T] {
        &self.h.as_slice()[self.h.as_slice().len() - rows * HIDDEN..]
    }
}

impl Agent {
    /// The agent with its own layout, `agent.*`.
    pub fn new(config: AgentConfig, dims: Dims) -> Self {
        let mut layout = ParameterLayout::default();
        let m = dims.uavs;
        let sets = (config.observation == ObservationKind::Set).then(|| SetEncoder::new(&mut layout, "agent.sets"));
        let observation = if sets.is_some() { SetEncoder::WIDTH } else { 2 * m + 3 * dims.users };
        let position = if config.self_position { 2 } else { 0 };
        let advice = if config.advice.is_none() { 0 } else { dims.env.actions };
        let input = observation + dims.env.actions + identity_width(config.identity, m) + position + advice;
        let fc = Linear::new(&mut layout, "agent.fc", input, HIDDEN);
        let rnn = Gru::new(&mut layout, "agent.rnn");
        let mean = config.aggregation == Aggregation::Mean;
        let layer: &dyn Fn(&mut ParameterLayout, &str) -> GraphLayer = match config.gnn {
            Gnn::None | Gnn::EdgeConv => &|layout, name| GraphLayer::edge_conv(layout, name, mean),
            Gnn::AggGnn => &|layout, name| GraphLayer::agg_gnn(layout, name),
            Gnn::Rgcn => &|layout, name| GraphLayer::rgcn(layout, name),
        };
        let body = if config.gnn == Gnn::None {
            Body::Plain { head: Linear::new(&mut layout, "agent.head", HIDDEN, dims.env.actions) }
        } else {
            let w1 = Linear::new(&mut layout, "agent.w1", HIDDEN, HIDDEN);
            let w2 = Linear::new(&mut layout, "agent.w2", observation, HIDDEN);
            let layers = (0..config.layers).map(|l| layer(&mut layout, &format!("agent.layers.{l}"))).collect();
            Body::Graph { w1, w2, layers, head: Mlp::new(&mut layout, "agent.head", 2 * HIDDEN, dims.env.actions) }
        };
        let context = if config.gnn == Gnn::None { HIDDEN } else { 2 * HIDDEN };
        let goals = (!config.memory.is_none()).then(|| GoalHead::new(&mut layout, "agent.goals", context, advice > 0));
        let advice = (advice > 0).then(|| {
            let last_layers = ["agent.head.weight", "agent.head.bias", "agent.head.3.", "agent.goals.2."];
            last_layers.iter().for_each(|name| layout.scale_init(name, QUIET));
            layout.add("agent.advice", &[1], Init::Constant(TRUST))
        });
        Self { config, dims, layout, sets, fc, rnn, body, goals, advice, observation_width: observation }
    }

    /// The architecture.
    pub fn config(&self) -> &AgentConfig {
        &self.config
    }

    /// The sizes that the agent was made for.
    pub fn dims(&self) -> &Dims {
        &self.dims
    }

    /// The layout of the parameters.
    pub fn layout(&self) -> &ParameterLayout {
        &self.layout
    }

    /// Configuration of geometries for this agent, in this environment. AoI is divided by the K that the agent was made for.
    pub fn geometry_config(&self, env: &EnvParams) -> GeometryConfig {
        let layers = if self.config.gnn == Gnn::None { 0 } else { self.config.layers };
        GeometryConfig {
            ranges: env.ranges(),
            episode_slots: self.dims.env.slots,
            layers,
            self_loops: self.config.self_loops,
            hops: self.config.hops,
        }
    }

    /// Length of what the UAVs of a fleet remember; 0 without memory.
    pub fn memory_len(&self, uavs: usize, users: usize) -> usize {
        if self.config.memory.is_none() { 0 } else { uavs * uav_memory_len(users) }
    }

    /// Advances what the UAVs of a fleet remember to slot `slot`, and adds their goals, and the advice from it, to `goals`. Does nothing
    /// without memory. `last` holds the last headings of the UAVs. `exchange` keeps buffers between calls.
    pub fn remember(
        &self,
        slot: (&EnvParams, &Sight<'_>, u64),
        (last, profile): (&[u8], Option<&FleetProfile>),
        memory: &mut [f32],
        exchange: &mut Exchange,
        goals: &mut Goals,
    ) {
        let Some(sharing) = self.config.memory.sharing() else { return };
        remember(slot, (sharing, FleetProfile::users(profile)), memory, exchange);
        let (_, sight, _) = slot;
        goals.push_fleet(slot, memories(memory, sight.users()), (last, profile));
        if self.advice.is_some() {
            goals.push_advice(slot, memories(memory, sight.users()), profile);
        }
    }

    /// Checks whether the agent fits a fleet. With flat observations, M and N must be those that the agent was made for; with one-hot
    /// identities, M must be. Otherwise any fleet fits.
    ///
    /// # Errors
    /// [`Invalid`] for the count that does not fit.
    pub fn check_fleet(&self, uavs: usize, users: usize) -> Result<(), Invalid> {
        let flat = self.sets.is_none();
        let exact = |field: &str, count: usize, fits: usize| {
            if count == fits {
                Ok(())
            } else {
                Err(Invalid::new(field, count, format!("{fits}, the number that this policy was trained with")))
            }
        };
        if flat || self.config.identity == Identity::Onehot {
            exact("uavs", uavs, self.dims.uavs)?;
        }
        if flat {
            exact("users", users, self.dims.users)?;
        }
        if uavs == 0 {
            return Err(Invalid::new("uavs", uavs, "at least 1"));
        }
        Ok(())
    }

    /// Fills `prepared` (see [`Weights`]). Both vectors have at least the length of the layout.
    pub fn prepare<T: Real>(&self, params: &[T], prepared: &mut [T]) {
        if let Some(sets) = &self.sets {
            sets.prepare(params, prepared);
        }
        self.fc.prepare(params, prepared);
        self.rnn.prepare(params, prepared);
        if let Some(goals) = &self.goals {
            goals.prepare(params, prepared);
        }
        match &self.body {
            Body::Plain { head } => head.prepare(params, prepared),
            Body::Graph { w1, w2, layers, head } => {
                w1.prepare(params, prepared);
                w2.prepare(params, prepared);
                layers.iter().for_each(|layer| layer.prepare(params, prepared));
                head.prepare(params, prepared);
            }
        }
    }

    /// Writes the observations of rows `first` and following, `stride` apart.
    fn observe<T: Real>(
        &self,
        w: Weights<'_, T>,
        (geometry, first): (&Geometry, usize),
        search: &mut HopSearch,
        (out, stride): (&mut [T], usize),
    ) {
        match &self.sets {
            Some(sets) => sets.forward(w, (geometry, first), search, (out, stride)),
            None => {
                for (r, out) in out.chunks_exact_mut(stride).enumerate() {
                    let view = geometry.view_of_row(first + r, search);
                    let scale = if self.config.normalise { view.fleet.scale } else { 1.0 };
                    flat_observation(&view, scale, &mut out[..self.observation_width]);
                }
            }
        }
    }

    /// The matrix products of a forward pass over `slots` slots, each as (rows, k, columns). Benchmarks measure them alone.
    pub fn products(&self, geometry: &Geometry, slots: usize) -> Vec<[usize; 3]> {
        let (uavs, graph) = (geometry.uav_rows(), geometry.graph());
        let mut products = vec![self.fc.product(uavs), [uavs, HIDDEN, 3 * HIDDEN]];
        products.resize(products.len() + slots, [uavs / slots, HIDDEN, 3 * HIDDEN]);
        match &self.body {
            Body::Plain { head } => products.push(head.product(uavs)),
            Body::Graph { w1, w2, layers, head } => {
                products.extend([w1.product(uavs), w2.product(geometry.rows() - uavs)]);
                products.extend(layers.iter().enumerate().flat_map(|(l, layer)| layer.products(graph.span(l, layers.len()))));
                products.extend(head.products(uavs));
            }
        }
        products
    }

    /// Computes Q-values and hidden states of `slots` slots. [`AgentCache::begin`] must have been called.
    pub fn forward<T: Real>(&self, w: Weights<'_, T>, inputs: &Inputs<'_>, slots: usize, c: &mut AgentCache<T>) {
        let uavs = inputs.geometry.uav_rows();
        let rows = inputs.geometry.rows();
        c.input.resize(self.fc.inputs, uavs);
        self.observe(w, (inputs.geometry, 0), &mut c.search, (c.input.as_mut_slice(), self.fc.inputs));
        for (r, input) in c.input.as_mut_slice().chunks_exact_mut(self.fc.inputs).enumerate() {
            write_action_identity_position(&self.config, self.dims.env.actions, inputs, r, &mut input[self.observation_width..]);
        }
        c.x.resize(HIDDEN, uavs);
        self.fc.forward(w, c.input.rows(), c.x.rows_mut());
        relu(c.x.as_mut_slice());
        self.rnn.forward(w, c.x.rows(), slots, &mut c.gates, &mut c.h);
        let h = hidden(&c.h, uavs);
        c.q.resize(self.dims.env.actions, uavs);
        match &self.body {
            Body::Plain { head } => {
                head.forward(w, h, c.q.rows_mut());
                if let Some(goals) = &self.goals {
                    goals.forward(w, (inputs.goals, inputs.needed), &[h], &mut c.goals, &mut c.q);
                }
            }
            Body::Graph { w1, w2, layers, head } => {
                let graph = inputs.geometry.graph();
                c.user_obs.resize(self.observation_width, rows - uavs);
                c.y.resize_with(layers.len() + 1, Batch::default);
                c.layers.resize_with(layers.len(), LayerCache::default);
                c.y[0].resize(HIDDEN, rows);
                w1.forward(w, h, c.y[0].range_mut(0..uavs));
                let part = threads::part(rows - uavs);
                let parts = c.user_obs.rows_mut().parts(part).zip(c.y[0].range_mut(uavs..rows).parts(part));
                threads::for_each(parts.enumerate(), |(k, (observations, y))| {
                    let out = (&mut *observations.data, self.observation_width);
                    // Agents with a graph observe over one link, without a search.
                    self.observe(w, (inputs.geometry, uavs + k * part), &mut HopSearch::default(), out);
                    w2.forward(w, Rows { data: observations.data, stride: self.observation_width, len: y.len }, y);
                });
                leaky_relu(c.y[0].as_mut_slice());
                for (l, layer) in layers.iter().enumerate() {
                    let [x, y] = &mut c.y[l..l + 2] else { unreachable!("one batch more than layers") };
                    y.resize(HIDDEN, graph.span(l, layers.len()).1);
                    layer.forward(w, graph, x.rows(), &mut c.layers[l], y.rows_mut());
                    if l + 1 < layers.len() {
                        relu(y.as_mut_slice());
                    }
                }
                let y = c.y[layers.len()].rows();
                head.forward(w, (h, y, HIDDEN), &mut c.head, c.q.rows_mut());
                if let Some(goals) = &self.goals {
                    goals.forward(w, (inputs.goals, inputs.needed), &[h, y], &mut c.goals, &mut c.q);
                }
            }
        }
        if let Some(trust) = self.advice {
            for (q, &heading) in c.q.as_mut_slice().chunks_exact_mut(self.dims.env.actions).zip(inputs.goals.advice()) {
                q[usize::from(heading)] += w.params[trust];
            }
        }
    }

    /// Adds the gradients of all parameters, given those of the Q-values of the last forward pass. Overwrites the cache.
    pub fn backward<T: Real>(
        &self,
        w: Weights<'_, T>,
        (inputs, slots): (&Inputs<'_>, usize),
        dq: Rows<'_, T>,
        c: &mut AgentCache<T>,
        grads: &mut [T],
    ) {
        let uavs = inputs.geometry.uav_rows();
        let h = hidden(&c.h, uavs);
        let s = &mut c.scratch;
        if let Some(trust) = self.advice {
            for (dq, &heading) in dq.data.chunks(dq.stride).zip(inputs.goals.advice()) {
                grads[trust] += dq[usize::from(heading)];
            }
        }
        s.dh.resize(HIDDEN, uavs);
        match &self.body {
            Body::Plain { head } => {
                head.backward(w.params, h, dq, grads, Some(s.dh.rows_mut()));
                if let Some(goals) = &self.goals {
                    goals.backward(w, (inputs.goals, &[h]), dq, &mut c.goals, grads);
                    goals.backward_context(w.params, 0, &c.goals, s.dh.rows_mut());
                }
            }
            Body::Graph { w1, w2, layers, head } => {
                let graph = inputs.geometry.graph();
                head.backward(w.params, (h, c.y[layers.len()].rows(), HIDDEN), dq, &mut c.head, grads);
                let d = head.d_first(&c.head);
                head.first.backward_input(w.params, (0, HIDDEN), d, s.dh.rows_mut(), InitialValue::Zero);
                s.dy.resize(HIDDEN, uavs);
                head.first.backward_input(w.params, (HIDDEN, HIDDEN), d, s.dy.rows_mut(), InitialValue::Zero);
                if let Some(goals) = &self.goals {
                    goals.backward(w, (inputs.goals, &[h, c.y[layers.len()].rows()]), dq, &mut c.goals, grads);
                    goals.backward_context(w.params, 0, &c.goals, s.dh.rows_mut());
                    goals.backward_context(w.params, 1, &c.goals, s.dy.rows_mut());
                }
                for (l, layer) in layers.iter().enumerate().rev() {
                    if l + 1 < layers.len() {
                        relu_back(c.y[l + 1].as_slice(), s.dy.as_mut_slice());
                    }
                    let forward = (graph, c.y[l].rows(), &mut c.layers[l]);
                    layer.backward(w, forward, &mut s.dy, &mut s.layer, (grads, &mut s.next));
                    std::mem::swap(&mut s.dy, &mut s.next);
                }
                leaky_relu_back(c.y[0].as_slice(), s.dy.as_mut_slice());
                let (own, users) = (s.dy.range(0..uavs), s.dy.range(uavs..s.dy.len()));
                w1.backward_bias(own, grads);
                w1.backward_part((0, HIDDEN), h, own, grads);
                w1.backward_input(w.params, (0, HIDDEN), own, s.dh.rows_mut(), InitialValue::Previous);
                w2.backward_bias(users, grads);
                w2.backward_part((0, self.observation_width), c.user_obs.rows(), users, grads);
                if let Some(sets) = &self.sets {
                    s.observation.resize(SetEncoder::WIDTH, users.len);
                    w2.backward_input(w.params, (0, SetEncoder::WIDTH), users, s.observation.rows_mut(), InitialValue::Zero);
                    sets.backward(w, (inputs.geometry, uavs), &mut c.search, s.observation.rows(), grads);
                }
            }
        }
        self.rnn.backward(w.params, (c.x.rows(), slots), &c.h, (&mut c.gates, &mut s.dh), grads);
        self.rnn.backward_input(w.params, &c.gates, &mut s.dx);
        relu_back(c.x.as_slice(), s.dx.as_mut_slice());
        self.fc.backward(w.params, c.input.rows(), s.dx.rows(), grads, None);
        if let Some(sets) = &self.sets {
            s.observation.resize(SetEncoder::WIDTH, uavs);
            self.fc.backward_input(w.params, (0, SetEncoder::WIDTH), s.dx.rows(), s.observation.rows_mut(), InitialValue::Zero);
            sets.backward(w, (inputs.geometry, 0), &mut c.search, s.observation.rows(), grads);
        }
    }
}

/// The hidden states after each slot.
fn hidden<T: Real>(h: &Batch<T>, uavs: usize) -> Rows<'_, T> {
    h.range(h.len() - uavs..h.len())
}
