//! Scores the goals of each UAV with one shared network, and adds the best score per heading to the heading's Q-value (docs/model.md,
//! "Goals").
//!
//! ```text
//! s_g = v relu(W [features_g || context_i] + b) + c        Q_i(h) += max over goals g of UAV i in the direction h of s_g
//! ```
//!
//! A heading without a goal gets a learned constant instead. The context is the UAV's hidden state, in a graph network also the output of
//! its last layer.

use super::goals::{FEATURES, Goals};
use crate::nn::matmul::InitialValue;
use crate::nn::{Batch, HIDDEN, Init, Linear, ParameterLayout, Real, Rows, RowsMut, Weights, simd};

/// Marks a heading without a goal.
const NONE: u32 = u32::MAX;

/// The network that scores goals.
#[derive(Clone, Copy, Debug)]
pub(super) struct GoalHead {
    /// Input: features, hidden state, and in a graph network the output of the last layer.
    first: Linear,
    value: Linear,
    /// Width of the features: [`FEATURES`], and with advice whether the goal lies in the advised direction.
    features: usize,
    /// Score of a heading without a goal.
    none: usize,
}

/// Activations of a forward pass, and buffers of its backward pass.
#[derive(Debug, Default)]
pub(super) struct GoalCache<T: Real> {
    features: Batch<T>,
    context: Batch<T>,
    hidden: Batch<T>,
    lanes: Vec<[T; LANES]>,
    /// (rows, A) the best goal of each heading, or [`NONE`].
    best: Vec<u32>,
    /// Row, goal and value of each derivative that is not zero.
    chosen: Vec<(u32, u32, T)>,
    d_hidden: Batch<T>,
    d_context: Batch<T>,
    chosen_features: Batch<T>,
}

impl GoalHead {
    /// `context` is the width of the context; `advice`: whether UAVs get advice.
    pub(super) fn new(layout: &mut ParameterLayout, name: &str, context: usize, advice: bool) -> Self {
        let features = FEATURES + usize::from(advice);
        Self {
            features,
            first: Linear::new(layout, &format!("{name}.0"), features + context, HIDDEN),
            value: Linear::new(layout, &format!("{name}.2"), HIDDEN, 1),
            none: layout.add(format!("{name}.none"), &[1], Init::Constant(0.0)),
        }
    }

    pub(super) fn prepare<T: Real>(&self, params: &[T], prepared: &mut [T]) {
        self.first.prepare(params, prepared);
        self.value.prepare(params, prepared);
    }

    /// Adds the best score per heading to the Q-values `q`. `context` are the parts of the context, each [`HIDDEN`] wide.
    pub(super) fn forward<T: Real>(
        &self,
        w: Weights<'_, T>,
        goals: &Goals,
        context: &[Rows<'_, T>],
        c: &mut GoalCache<T>,
        q: &mut Batch<T>,
    ) {
        c.features.resize(self.features, goals.len());
        for (row, features) in
            c.features.as_mut_slice().chunks_exact_mut(self.features).zip(goals.features().chunks_exact(FEATURES))
        {
            row.iter_mut().zip(features).for_each(|(x, &f)| *x = T::from_f64(f.into()));
        }
        for (r, &heading) in goals.advice().iter().enumerate() {
            for g in goals.of_row(r) {
                c.features.row_mut(g)[FEATURES] = if goals.headings()[g] == heading { T::ONE } else { T::ZERO };
            }
        }
        c.hidden.resize(HIDDEN, goals.len());
        let first = &self.first;
        first.forward_part(w, (0, self.features), c.features.rows(), c.hidden.rows_mut(), InitialValue::Bias(first.bias(w)));
        c.context.resize(HIDDEN, goals.rows());
        for (part, &rows) in context.iter().enumerate() {
            let initial = if part == 0 { InitialValue::Zero } else { InitialValue::Previous };
            first.forward_part(w, (self.features + part * HIDDEN, HIDDEN), rows, c.context.rows_mut(), initial);
        }
        let (actions, none) = (q.width(), w.params[self.none]);
        let (value, bias) = (self.value.weight(w.params), self.value.bias(w)[0]);
        let value: &[T; HIDDEN] = value.try_into().expect("one value per hidden unit");
        c.best.clear();
        c.best.resize(goals.rows() * actions, NONE);
        simd(
            #[inline(always)]
            || {
                let hidden = c.hidden.as_mut_slice().as_chunks_mut::<HIDDEN>().0;
                let rows = q.as_mut_slice().chunks_exact_mut(actions).zip(c.best.chunks_exact_mut(actions));
                for ((r, (q, best)), context) in rows.enumerate().zip(c.context.as_slice().as_chunks::<HIDDEN>().0) {
                    let hidden = &mut hidden[goals.of_row(r)];
                    c.lanes.resize(hidden.len(), [T::ZERO; LANES]);
                    for (lanes, hidden) in c.lanes.iter_mut().zip(hidden) {
                        *lanes = product(activate(hidden, context), value);
                    }
                    let mut scores = [T::ZERO; 16];
                    for (g, lanes) in goals.of_row(r).zip(&c.lanes) {
                        let score = lanes.iter().fold(T::ZERO, |sum, &lane| sum + lane) + bias;
                        let h = usize::from(goals.headings()[g]);
                        if best[h] == NONE || score > scores[h] {
                            (best[h], scores[h]) = (g as u32, score);
                        }
                    }
                    for (h, q) in q.iter_mut().enumerate() {
                        *q += if best[h] == NONE { none } else { scores[h] };
                    }
                }
            },
        );
    }

    /// Adds the gradients of the parameters, given those of the Q-values. [`GoalHead::backward_context`] then gives those of the context.
    pub(super) fn backward<T: Real>(
        &self,
        params: &[T],
        context: &[Rows<'_, T>],
        dq: Rows<'_, T>,
        c: &mut GoalCache<T>,
        grads: &mut [T],
    ) {
        let actions = c.best.len() / dq.len.max(1);
        let value: &[T; HIDDEN] = self.value.weight(params).try_into().expect("one value per hidden unit");
        c.d_context.resize_zero(HIDDEN, dq.len);
        c.chosen.clear();
        for (r, dq) in dq.data.chunks(dq.stride).take(dq.len).enumerate() {
            for (h, &d) in dq[..actions].iter().enumerate().filter(|(_, d)| **d != T::ZERO) {
                match c.best[r * actions + h] {
                    NONE => grads[self.none] += d,
                    goal => c.chosen.push((r as u32, goal, d)),
                }
            }
        }
        c.d_hidden.resize(HIDDEN, c.chosen.len());
        c.chosen_features.resize(self.features, c.chosen.len());
        let mut d_value = [T::ZERO; HIDDEN];
        let mut d_bias = T::ZERO;
        for (i, &(r, g, d)) in c.chosen.iter().enumerate() {
            let hidden = c.hidden.row(g as usize);
            let (out, d_context) = (c.d_hidden.row_mut(i), c.d_context.row_mut(r as usize));
            for k in 0..HIDDEN {
                d_value[k] += d * hidden[k];
                out[k] = if hidden[k] > T::ZERO { d * value[k] } else { T::ZERO };
                d_context[k] += out[k];
            }
            d_bias += d;
            c.chosen_features.row_mut(i).copy_from_slice(c.features.row(g as usize));
        }
        self.value.weight_mut(grads).iter_mut().zip(d_value).for_each(|(g, d)| *g += d);
        self.value.bias_mut(grads)[0] += d_bias;
        self.first.backward_bias(c.d_hidden.rows(), grads);
        self.first.backward_part((0, self.features), c.chosen_features.rows(), c.d_hidden.rows(), grads);
        for (part, &rows) in context.iter().enumerate() {
            self.first.backward_part((self.features + part * HIDDEN, HIDDEN), rows, c.d_context.rows(), grads);
        }
    }

    /// Adds the gradient of part `part` of the context to `dx`.
    pub(super) fn backward_context<T: Real>(&self, params: &[T], part: usize, c: &GoalCache<T>, dx: RowsMut<'_, T>) {
        let columns = (self.features + part * HIDDEN, HIDDEN);
        self.first.backward_input(params, columns, c.d_context.rows(), dx, InitialValue::Previous);
    }
}

/// Lanes of a sum over hidden units, which have a fixed order for any vector unit.
const LANES: usize = 16;

/// Adds the context to a hidden row, and applies ReLU.
#[inline(always)]
fn activate<'a, T: Real>(hidden: &'a mut [T; HIDDEN], context: &[T; HIDDEN]) -> &'a [T; HIDDEN] {
    for (hidden, &context) in hidden.iter_mut().zip(context) {
        let x = *hidden + context;
        *hidden = if x > T::ZERO { x } else { T::ZERO };
    }
    hidden
}

/// The product of two rows, lane by lane. Its sum is left to another loop: a compiler that sees both computes the lanes one by one.
#[inline(always)]
fn product<T: Real>(hidden: &[T; HIDDEN], value: &[T; HIDDEN]) -> [T; LANES] {
    let mut lanes = [T::ZERO; LANES];
    for (hidden, value) in hidden.as_chunks::<LANES>().0.iter().zip(value.as_chunks::<LANES>().0) {
        for l in 0..LANES {
            lanes[l] += hidden[l] * value[l];
        }
    }
    lanes
}
