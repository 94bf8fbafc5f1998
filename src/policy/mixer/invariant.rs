//! The permutation-invariant mixer (docs/model.md, "Invariant"), E = 32:
//!
//! ```text
//! g    = mean_i relu(Linear(2, 64)(P_i)) + mean_j relu(Linear(3, 64)(P_j, AoI_j / K))
//! w1_i = |Linear(64, E)(relu(Linear(66, 64)(P_i || g)))|      hid = ELU(sum_i q_i w1_i + Linear(64, E)(g))
//! Q_tot = |Linear(64, E)(relu(Linear(64, 64)(g)))| . hid + Linear(E, 1)(relu(Linear(64, E)(g)))
//! ```
//!
//! The part of w1's first layer that depends on g is the same for all UAVs of a slot and computed once.

use super::hyper_net::{HyperNet, HyperNetCache};
use super::mixing::{E, mix, mix_back};
use crate::nn::matmul::InitialValue;
use crate::nn::{Batch, Embedding, EmbeddingParams, HIDDEN, Linear, ParameterLayout, Real, Rows, Weights, simd};

#[derive(Clone, Copy, Debug)]
pub(super) struct Invariant {
    uav: Embedding<2>,
    user: Embedding<3>,
    w1: HyperNet,
    b1: Linear,
    w2: HyperNet,
    b2: HyperNet,
}

#[derive(Debug, Default)]
pub(super) struct InvariantCache<T: Real> {
    g: Batch<T>,
    /// P_i, one sample per slot and UAV.
    positions: Batch<T>,
    /// The part of w1's first layer that depends on g; backward replaces it by its gradient.
    g_part_or_grad: Batch<T>,
    w1: HyperNetCache<T>,
    w2: HyperNetCache<T>,
    b2: HyperNetCache<T>,
    mixed: Batch<T>,
    dg: Batch<T>,
}

impl Invariant {
    pub(super) fn new(layout: &mut ParameterLayout) -> Self {
        Self {
            uav: Embedding::new(layout, "mixer.uav"),
            user: Embedding::new(layout, "mixer.user"),
            w1: HyperNet::new(layout, "mixer.w1", [2 + HIDDEN, HIDDEN, E]),
            b1: Linear::new(layout, "mixer.b1", HIDDEN, E),
            w2: HyperNet::new(layout, "mixer.w2", [HIDDEN, HIDDEN, E]),
            b2: HyperNet::new(layout, "mixer.b2", [HIDDEN, E, 1]),
        }
    }

    pub(super) fn prepare<T: Real>(&self, params: &[T], prepared: &mut [T]) {
        self.uav.prepare(params, prepared);
        self.user.prepare(params, prepared);
        [&self.w1, &self.w2, &self.b2].iter().for_each(|net| net.prepare(params, prepared));
        self.b1.prepare(params, prepared);
    }

    pub(super) fn forward<T: Real>(
        &self,
        w: Weights<'_, T>,
        states: Rows<'_, T>,
        q: Rows<'_, T>,
        c: &mut InvariantCache<T>,
        total: &mut [T],
    ) {
        let (m, slots) = (q.stride, states.len);
        c.g.resize(HIDDEN, slots);
        c.positions.resize(2, slots * m);
        c.g_part_or_grad.resize(HIDDEN, slots);
        c.w1.hidden.resize(HIDDEN, slots * m);
        c.mixed.resize(E, slots);
        let (uav, user) = (self.uav.params(w), self.user.params(w));
        simd(
            #[inline(always)]
            || summarise(states, m, (&uav, &user), c.g.as_mut_slice()),
        );
        for (state, p) in states.data.chunks(states.stride).take(slots).zip(c.positions.as_mut_slice().chunks_exact_mut(2 * m)) {
            p.copy_from_slice(&state[..2 * m]);
        }
        let first = &self.w1.first;
        first.forward_part(w, (2, HIDDEN), c.g.rows(), c.g_part_or_grad.rows_mut(), InitialValue::Bias(first.bias(w)));
        for (rows, g_part) in
            c.w1.hidden.as_mut_slice().chunks_exact_mut(m * HIDDEN).zip(c.g_part_or_grad.as_slice().chunks_exact(HIDDEN))
        {
            rows.chunks_exact_mut(HIDDEN).for_each(|row| row.copy_from_slice(g_part));
        }
        first.forward_part(w, (0, 2), c.positions.rows(), c.w1.hidden.rows_mut(), InitialValue::Previous);
        self.w1.finish(w, &mut c.w1);
        self.w2.forward(w, c.g.rows(), &mut c.w2);
        self.b2.forward(w, c.g.rows(), &mut c.b2);
        self.b1.forward(w, c.g.rows(), c.mixed.rows_mut());
        let parts = (c.w1.output_or_grad.as_slice(), c.w2.output_or_grad.as_slice(), c.b2.output_or_grad.as_slice());
        simd(
            #[inline(always)]
            || mix(parts, (q.data, m), c.mixed.as_mut_slice(), total),
        );
    }

    pub(super) fn backward<T: Real>(
        &self,
        w: Weights<'_, T>,
        (states, q): (Rows<'_, T>, Rows<'_, T>),
        c: &mut InvariantCache<T>,
        d_total: &[T],
        (grads, dq): (&mut [T], &mut Batch<T>),
    ) {
        let (m, params) = (q.stride, w.params);
        let parts = (c.w1.output_or_grad.as_mut_slice(), c.w2.output_or_grad.as_mut_slice(), c.mixed.as_mut_slice());
        simd(
            #[inline(always)]
            || mix_back(parts, (q.data, m), d_total, dq.as_mut_slice()),
        );
        c.b2.output_or_grad.as_mut_slice().copy_from_slice(d_total);
        c.dg.resize(HIDDEN, states.len);
        self.b1.backward(params, c.g.rows(), c.mixed.rows(), grads, Some(c.dg.rows_mut()));
        for (net, cache) in [(&self.w2, &mut c.w2), (&self.b2, &mut c.b2)] {
            net.backward(params, c.g.rows(), cache, grads);
            net.backward_input(params, cache, &mut c.dg);
        }
        self.w1.backward_last(params, &mut c.w1, grads);
        let first = &self.w1.first;
        first.backward_part((0, 2), c.positions.rows(), c.w1.d_first.rows(), grads);
        for (rows, g_part) in
            c.w1.d_first.as_slice().chunks_exact(m * HIDDEN).zip(c.g_part_or_grad.as_mut_slice().chunks_exact_mut(HIDDEN))
        {
            g_part.fill(T::ZERO);
            rows.chunks_exact(HIDDEN).for_each(|row| g_part.iter_mut().zip(row).for_each(|(s, &d)| *s += d));
        }
        first.backward_bias(c.g_part_or_grad.rows(), grads);
        first.backward_part((2, HIDDEN), c.g.rows(), c.g_part_or_grad.rows(), grads);
        first.backward_input(params, (2, HIDDEN), c.g_part_or_grad.rows(), c.dg.rows_mut(), InitialValue::Previous);
        let (uav, user) = (self.uav.params(w), self.user.params(w));
        let (mut uav_sums, mut user_sums) = (EmbeddingParams::zero(), EmbeddingParams::zero());
        simd(
            #[inline(always)]
            || summarise_back(states, m, (&uav, &user), c.dg.as_slice(), (&mut uav_sums, &mut user_sums)),
        );
        self.uav.add_grads(&uav_sums, grads);
        self.user.add_grads(&user_sums, grads);
    }
}

#[inline(always)]
fn summarise<T: Real>(
    states: Rows<'_, T>,
    uavs: usize,
    (uav, user): (&EmbeddingParams<T, 2>, &EmbeddingParams<T, 3>),
    g: &mut [T],
) {
    let (per_uav, per_user) = mean_factors(states.stride, uavs);
    for (state, g) in states.data.chunks(states.stride).zip(g.as_chunks_mut::<HIDDEN>().0) {
        let (own, users) = state.split_at(2 * uavs);
        let (mut a, mut b) = ([T::ZERO; HIDDEN], [T::ZERO; HIDDEN]);
        own.as_chunks().0.iter().for_each(|&p| uav.add(p, &mut a));
        users.as_chunks().0.iter().for_each(|&p| user.add(p, &mut b));
        for c in 0..HIDDEN {
            g[c] = a[c] * per_uav + b[c] * per_user;
        }
    }
}

#[inline(always)]
fn summarise_back<T: Real>(
    states: Rows<'_, T>,
    uavs: usize,
    (uav, user): (&EmbeddingParams<T, 2>, &EmbeddingParams<T, 3>),
    dg: &[T],
    (uav_sums, user_sums): (&mut EmbeddingParams<T, 2>, &mut EmbeddingParams<T, 3>),
) {
    let (per_uav, per_user) = mean_factors::<T>(states.stride, uavs);
    for (state, dg) in states.data.chunks(states.stride).zip(dg.as_chunks::<HIDDEN>().0) {
        let (own, users) = state.split_at(2 * uavs);
        let (mut a, mut b) = (*dg, *dg);
        for c in 0..HIDDEN {
            a[c] *= per_uav;
            b[c] *= per_user;
        }
        own.as_chunks().0.iter().for_each(|&p| uav.backward(p, &a, uav_sums));
        users.as_chunks().0.iter().for_each(|&p| user.backward(p, &b, user_sums));
    }
}

/// 1 / M and 1 / N.
#[inline(always)]
fn mean_factors<T: Real>(states: usize, uavs: usize) -> (T, T) {
    let users = (states - 2 * uavs) / 3;
    (T::from_f64(1.0 / uavs as f64), T::from_f64(1.0 / users.max(1) as f64))
}
