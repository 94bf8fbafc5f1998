//! The loss of an update and its gradient (docs/model.md, "Targets"): double Q-learning with a target network and TD(lambda).
//!
//! ```text
//! m_k = target_mixer(Q_target(argmax_a Q(o_k, a)), s_k)
//! G_K = m_K,  G_k = r_k + gamma (lambda G_{k+1} + (1 - lambda) m_{k+1})
//! loss = mean over episodes, slots and joint values of (Q_tot - G)^2 / 2
//! ```
//!
//! A batch is one group of episodes or several, which may differ in size. Groups are split into chunks of episodes;
//! their number depends on sizes only. Each chunk has its own gradient, and the gradients are summed in a fixed order. The number of
//! threads therefore changes no bit.

use std::sync::{Mutex, PoisonError};

use rayon::prelude::*;

use super::episodes::Episodes;
use crate::nn::{Batch, ParameterLayout, Real, Weights, argmax, norm_squared};
use crate::policy::memory::Exchange;
use crate::policy::mixer::{Mixer, MixerCache, MixerKind};
use crate::policy::{Agent, AgentCache, AgentConfig, Dims, Geometry, Goals, Inputs, NO_ACTION, TOKEN, flat_state};

/// Rows (UAVs of all episodes) per slot of a chunk: enough for efficient matrix products, few enough for the CPU caches.
const ROWS: usize = 24;
/// Parameters per task when gradients are summed.
const BLOCK: usize = 4096;

/// Episodes per chunk for fleets of this size.
pub fn episodes_per_chunk(uavs: usize) -> usize {
    (ROWS / uavs).max(1)
}

/// The parameters of TD(lambda).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TdLambda {
    /// Discount factor gamma.
    pub gamma: f64,
    /// Weight lambda of longer returns.
    pub lambda: f64,
}

/// Metrics of an update.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LossMetrics {
    /// The loss.
    pub loss: f64,
    /// L2 norm of the gradient.
    pub grad_norm: f64,
    /// Mean Q_tot of the actions taken.
    pub q_tot: f64,
}

/// Intermediate values of an update in the order (episode, slot, ...), for tests.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Trace<T> {
    /// (B, K+1, M, A) Q-values of the online network.
    pub q: Vec<T>,
    /// (B, K, W) joint values of the actions taken; W is 1, or M without a mixer.
    pub q_tot: Vec<T>,
    /// (B, K, W) targets.
    pub target: Vec<T>,
}

/// The networks and buffers of the loss. The caller owns the parameters.
#[derive(Debug)]
pub struct Loss<T: Real> {
    agent: Agent,
    mixer: Mixer,
    layout: ParameterLayout,
    td_lambda: TdLambda,
    /// Prepared forms of the parameters of the online and the target networks, see [`Weights`].
    prepared: [Vec<T>; 2],
    chunks: Vec<Chunk<T>>,
    workspaces: Vec<Mutex<Workspace<T>>>,
    gradient: Vec<T>,
    norms: Vec<f64>,
}

/// The contribution of a chunk.
#[derive(Debug)]
struct Chunk<T> {
    grads: Vec<T>,
    loss: f64,
    q_tot: f64,
    trace: Trace<T>,
}

/// Buffers of one thread.
#[derive(Debug, Default)]
struct Workspace<T: Real> {
    geometry: Geometry,
    goals: Goals,
    /// What the UAVs of each episode remember.
    memory: Vec<f32>,
    exchange: Exchange,
    last: Vec<u8>,
    identity_token: Vec<f32>,
    position: Vec<f32>,
    /// The heading with the highest Q-value of the online network, per UAV row; [`NO_ACTION`] in slot 0.
    greedy: Vec<u8>,
    states: Batch<T>,
    online: AgentCache<T>,
    target: AgentCache<T>,
    online_mixer: MixerCache<T>,
    target_mixer: MixerCache<T>,
    chosen: Batch<T>,
    best: Batch<T>,
    total: Batch<T>,
    target_total: Batch<T>,
    td_target: Batch<T>,
    d_total: Batch<T>,
    d_chosen: Batch<T>,
    dq: Batch<T>,
}

impl<T: Real> Loss<T> {
    /// The loss for these networks; `threads` is the maximum number of threads that compute it.
    pub fn new(config: AgentConfig, dims: Dims, mixer: MixerKind, td_lambda: TdLambda, threads: usize) -> Self {
        let agent = Agent::new(config, dims);
        let mut layout = agent.layout().clone();
        let mixer = Mixer::new(mixer, &dims, &mut layout);
        let len = layout.len();
        Self {
            agent,
            mixer,
            layout,
            td_lambda,
            prepared: [vec![T::ZERO; len], vec![T::ZERO; len]],
            chunks: Vec::new(),
            workspaces: (0..threads.max(1)).map(|_| Mutex::default()).collect(),
            gradient: vec![T::ZERO; len],
            norms: vec![0.0; len.div_ceil(BLOCK)],
        }
    }

    /// The parameters: `agent.*`, then `mixer.*`.
    pub fn layout(&self) -> &ParameterLayout {
        &self.layout
    }

    /// The agents.
    pub fn agent(&self) -> &Agent {
        &self.agent
    }

    /// The gradient of the last batch, before clipping.
    pub fn gradient(&self) -> &[T] {
        &self.gradient
    }

    /// Computes the loss of a batch and its gradient with respect to `online`. Runs on the current rayon pool.
    ///
    /// # Panics
    /// If the networks do not fit the sizes of the episodes, or there are no episodes.
    pub fn compute_gradient(
        &mut self,
        online: &[T],
        target: &[T],
        groups: &[Episodes],
        trace: Option<&mut Trace<T>>,
    ) -> LossMetrics {
        assert!(groups.iter().any(|group| group.len > 0), "a batch of at least one episode");
        for group in groups {
            self.agent.check_fleet(group.uavs, group.users).expect("the agents fit the fleet");
            let Dims { uavs, users, .. } = *self.agent.dims();
            assert!(self.mixer.fits_any_fleet() || (group.uavs, group.users) == (uavs, users), "the mixer fits the fleet");
        }
        let [prepared_online, prepared_target] = &mut self.prepared;
        for (params, prepared) in [(online, &mut *prepared_online), (target, &mut *prepared_target)] {
            self.agent.prepare(params, prepared);
            self.mixer.prepare(params, prepared);
        }
        let parts: Vec<(&Episodes, std::ops::Range<usize>)> = groups
            .iter()
            .flat_map(|group| {
                let per_chunk = episodes_per_chunk(group.uavs);
                (0..group.len).step_by(per_chunk).map(move |first| (group, first..(first + per_chunk).min(group.len)))
            })
            .collect();
        let values = |group: &Episodes| group.len * group.slots * self.mixer.joint_values_per_slot(group.uavs);
        let (count, total) = (parts.len(), groups.iter().map(values).sum::<usize>() as f64);
        let len = self.layout.len();
        let empty = || Chunk { grads: vec![T::ZERO; len], loss: 0.0, q_tot: 0.0, trace: Trace::default() };
        if self.chunks.len() < count {
            self.chunks.resize_with(count, empty);
        }
        let pass = Pass {
            agent: &self.agent,
            mixer: &self.mixer,
            online: Weights { params: online, prepared: prepared_online },
            target: Weights { params: target, prepared: prepared_target },
            td_lambda: self.td_lambda,
            total,
            traced: trace.is_some(),
        };
        let workspaces = &self.workspaces;
        self.chunks[..count].par_iter_mut().zip(parts).with_max_len(1).for_each(|(chunk, part)| {
            let thread = rayon::current_thread_index().unwrap_or(0) % workspaces.len();
            // A poisoned workspace is usable: every buffer is written before it is read.
            let mut workspace = workspaces[thread].lock().unwrap_or_else(PoisonError::into_inner);
            pass.run(part, &mut workspace, chunk);
        });
        let chunks = &self.chunks[..count];
        self.gradient.par_chunks_mut(BLOCK).zip(&mut self.norms).enumerate().for_each(|(i, (sum, norm))| {
            sum.fill(T::ZERO);
            for chunk in chunks {
                sum.iter_mut().zip(&chunk.grads[i * BLOCK..]).for_each(|(s, &g)| *s += g);
            }
            *norm = norm_squared(sum);
        });
        if let Some(trace) = trace {
            let join = |part: fn(&Trace<T>) -> &[T]| chunks.iter().flat_map(|c| part(&c.trace)).copied().collect();
            *trace = Trace { q: join(|t| &t.q), q_tot: join(|t| &t.q_tot), target: join(|t| &t.target) };
        }
        LossMetrics {
            loss: 0.5 * chunks.iter().map(|c| c.loss).sum::<f64>() / total,
            grad_norm: self.norms.iter().sum::<f64>().sqrt(),
            q_tot: chunks.iter().map(|c| c.q_tot).sum::<f64>() / total,
        }
    }
}

/// The inputs that all chunks of a batch share.
struct Pass<'a, T> {
    agent: &'a Agent,
    mixer: &'a Mixer,
    online: Weights<'a, T>,
    target: Weights<'a, T>,
    td_lambda: TdLambda,
    /// Joint values of all slots of the batch.
    total: f64,
    traced: bool,
}

impl<T: Real> Pass<'_, T> {
    fn run(&self, (ep, range): (&Episodes, std::ops::Range<usize>), ws: &mut Workspace<T>, out: &mut Chunk<T>) {
        let (m, k, b) = (ep.uavs, ep.slots, range.len());
        let (slots, per_slot) = (k + 1, b * m);
        ws.load(self.agent, ep, range.clone());
        let inputs = Inputs {
            geometry: &ws.geometry,
            goals: &ws.goals,
            needed: None,
            last: &ws.last,
            identity_token: &ws.identity_token,
            position: &ws.position,
        };
        ws.online.begin(per_slot, slots).fill(T::ZERO);
        self.agent.forward(self.online, &inputs, slots, &mut ws.online);
        // Double Q-learning: the online network chooses the action, the target network gives its value. Slot 0 is not needed.
        ws.greedy.clear();
        ws.greedy
            .extend((0..slots * per_slot).map(|row| if row < per_slot { NO_ACTION } else { argmax(ws.online.q.row(row)) as u8 }));
        ws.target.begin(per_slot, slots).fill(T::ZERO);
        self.agent.forward(self.target, &Inputs { needed: Some(&ws.greedy), ..inputs }, slots, &mut ws.target);

        let actions = self.agent.dims().env.actions;
        // Row (slot, episode, UAV) of the batch, and the action in the order (episode, slot, UAV).
        let action = |row: usize| {
            let (slot, episode, uav) = (row / per_slot, range.start + row / m % b, row % m);
            usize::from(ep.actions[(episode * k + slot) * m + uav])
        };
        ws.best.resize(m, k * b);
        for (best, row) in ws.best.as_mut_slice().iter_mut().zip(per_slot..) {
            *best = ws.target.q.row(row)[usize::from(ws.greedy[row])];
        }
        ws.chosen.resize(m, k * b);
        for (chosen, row) in ws.chosen.as_mut_slice().iter_mut().zip(0..) {
            *chosen = ws.online.q.row(row)[action(row)];
        }
        let values = self.mixer.joint_values_per_slot(m);
        ws.target_total.resize(values, k * b);
        ws.total.resize(values, k * b);
        let next_inputs = (ws.states.range(b..slots * b), ws.best.rows());
        self.mixer.forward(self.target, next_inputs, &mut ws.target_mixer, ws.target_total.rows_mut());
        let mixer_inputs = (ws.states.range(0..k * b), ws.chosen.rows());
        self.mixer.forward(self.online, mixer_inputs, &mut ws.online_mixer, ws.total.rows_mut());

        ws.td_target.resize(values, k * b);
        self.td_targets((ep, range.clone()), ws.target_total.as_slice(), ws.td_target.as_mut_slice());
        if self.traced {
            record_trace(ws, (b, slots, m), &mut out.trace);
        }
        let scale = T::from_f64(1.0 / self.total);
        (out.loss, out.q_tot) = (0.0, 0.0);
        ws.d_total.resize(values, k * b);
        let errors = ws.total.as_slice().iter().zip(ws.td_target.as_slice());
        for (d_total, (&total, &td_target)) in ws.d_total.as_mut_slice().iter_mut().zip(errors) {
            out.q_tot += total.to_f64();
            let error = total - td_target;
            out.loss += error.to_f64() * error.to_f64();
            *d_total = error * scale;
        }

        out.grads.fill(T::ZERO);
        let gradients = (&mut out.grads[..], &mut ws.d_chosen);
        self.mixer.backward(self.online, mixer_inputs, &mut ws.online_mixer, ws.d_total.as_slice(), gradients);
        ws.dq.resize_zero(actions, slots * per_slot);
        for (row, &d) in ws.d_chosen.as_slice().iter().enumerate() {
            ws.dq.row_mut(row)[action(row)] = d;
        }
        self.agent.backward(self.online, (&inputs, slots), ws.dq.rows(), &mut ws.online, &mut out.grads);
    }

    /// Computes TD(lambda) targets from the last slot backwards; `next_values` starts at slot 1.
    fn td_targets(&self, (ep, range): (&Episodes, std::ops::Range<usize>), next_values: &[T], td_target: &mut [T]) {
        let (k, values) = (ep.slots, self.mixer.joint_values_per_slot(ep.uavs));
        let stride = range.len() * values;
        let gamma = T::from_f64(self.td_lambda.gamma);
        let (lambda, one_minus_lambda) = (T::from_f64(self.td_lambda.lambda), T::from_f64(1.0 - self.td_lambda.lambda));
        for t in (0..k).rev() {
            for i in 0..stride {
                let reward = T::from_f64(ep.reward[(range.start + i / values) * k + t].into());
                let value = next_values[t * stride + i];
                let next = if t + 1 == k { value } else { td_target[(t + 1) * stride + i] };
                td_target[t * stride + i] = reward + gamma * (lambda * next + one_minus_lambda * value);
            }
        }
    }
}

impl<T: Real> Workspace<T> {
    /// Loads the episodes `range`, time-major.
    fn load(&mut self, agent: &Agent, ep: &Episodes, range: std::ops::Range<usize>) {
        let (m, n, k) = (ep.uavs, ep.users, ep.slots);
        let (env, episode_slots) = (&ep.env, agent.dims().env.slots);
        let config = agent.geometry_config(env);
        let slots = k + 1;
        let memory_len = agent.memory_len(m, n);
        self.geometry.clear();
        self.goals.clear();
        self.memory.clear();
        self.memory.resize(memory_len * range.len(), 0.0);
        self.last.clear();
        self.identity_token.clear();
        self.position.clear();
        self.states.resize(2 * m + 3 * n, slots * range.len());
        let mut states = self.states.as_mut_slice().chunks_exact_mut(2 * m + 3 * n);
        for t in 0..slots {
            for e in range.clone() {
                let at = e * slots + t;
                let uav_xy = &ep.uav_xy[at * 2 * m..][..2 * m];
                let user_xy = &ep.user_xy[if ep.users_move { at } else { e } * 2 * n..][..2 * n];
                let aoi = &ep.aoi[at * n..][..n];
                self.geometry.push_scene(&config, uav_xy, user_xy, aoi);
                match t {
                    0 => self.last.resize(self.last.len() + m, NO_ACTION),
                    t => self.last.extend_from_slice(&ep.actions[(e * k + t - 1) * m..][..m]),
                }
                if memory_len > 0 {
                    let memory = &mut self.memory[(e - range.start) * memory_len..][..memory_len];
                    let sight = self.geometry.last_sight(aoi);
                    let last = &self.last[self.last.len() - m..];
                    agent.remember((env, &sight, t as u64), (last, None), memory, &mut self.exchange, &mut self.goals);
                }
                self.identity_token.extend_from_slice(&ep.identity_token[e * m * TOKEN..][..m * TOKEN]);
                self.position.extend_from_slice(uav_xy);
                flat_state(uav_xy, user_xy, aoi, episode_slots, states.next().expect("one state per slot"));
            }
        }
        self.geometry.finish(&config);
    }
}

/// Writes the trace of a chunk, episode-major.
fn record_trace<T: Real>(ws: &Workspace<T>, (b, slots, m): (usize, usize, usize), out: &mut Trace<T>) {
    let reorder = |from: &[T], slots: usize, to: &mut Vec<T>| {
        to.clear();
        let width = from.len() / (slots * b);
        for e in 0..b {
            (0..slots).for_each(|t| to.extend_from_slice(&from[(t * b + e) * width..][..width]));
        }
    };
    debug_assert_eq!(ws.online.q.len(), slots * b * m);
    reorder(ws.online.q.as_slice(), slots, &mut out.q);
    reorder(ws.total.as_slice(), slots - 1, &mut out.q_tot);
    reorder(ws.td_target.as_slice(), slots - 1, &mut out.target);
}
