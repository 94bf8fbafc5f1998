//! Scores the goals of each UAV with one shared network, and adds the best score per heading to the heading's Q-value (docs/model.md,
//! "Goals").
//!
//! ```text
//! s_g = v relu(W [features_g || context_i] + b) + c        Q_i(h) += max over goals g of UAV i in the direction h of s_g
//! ```
//!
//! A heading without a goal gets a learned constant instead. The context is the UAV's hidden state, in a graph network also the output of
//! its last layer.

use std::ops::Range;

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

/// What a forward pass leaves to its backward pass, and buffers. The hidden units of goals are not kept: the backward pass computes those
/// of the few goals that were chosen again.
#[derive(Debug, Default)]
pub(super) struct GoalCache<T: Real> {
    context: Batch<T>,
    /// (rows, A) the best goal of each heading, or [`NONE`].
    best: Vec<u32>,
    /// The goals of a tile, and for each of its rows the end of its goals among them.
    tile: Vec<u32>,
    ends: Vec<usize>,
    features: Batch<T>,
    hidden: Batch<T>,
    lanes: Vec<[T; LANES]>,
    /// Row, goal and value of each derivative that is not zero.
    chosen: Vec<(u32, u32, T)>,
    d_hidden: Batch<T>,
    d_context: Batch<T>,
}

/// Goals that are scored at a time: few enough for the CPU's cache. One UAV may have more.
const TILE: usize = 192;

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

    /// Adds the best score per heading to the Q-values `q`. `needed`: see [`super::Inputs::needed`]. `context` are the parts of the context,
    /// each [`HIDDEN`] wide.
    pub(super) fn forward<T: Real>(
        &self,
        w: Weights<'_, T>,
        (goals, needed): (&Goals, Option<&[u8]>),
        context: &[Rows<'_, T>],
        c: &mut GoalCache<T>,
        q: &mut Batch<T>,
    ) {
        c.context.resize(HIDDEN, goals.rows());
        for (part, &rows) in context.iter().enumerate() {
            let initial = if part == 0 { InitialValue::Zero } else { InitialValue::Previous };
            self.first.forward_part(w, (self.features + part * HIDDEN, HIDDEN), rows, c.context.rows_mut(), initial);
        }
        c.best.clear();
        c.best.resize(goals.rows() * q.width(), NONE);
        let mut row = 0;
        while row < goals.rows() {
            let first = row;
            c.tile.clear();
            c.ends.clear();
            while row < goals.rows() && (row == first || c.tile.len() + goals.of_row(row).len() <= TILE) {
                let of_row = goals.of_row(row);
                match needed.map(|needed| needed[row]) {
                    None => c.tile.extend(of_row.map(|g| g as u32)),
                    Some(heading) => c.tile.extend(of_row.filter(|&g| goals.headings()[g] == heading).map(|g| g as u32)),
                }
                c.ends.push(c.tile.len());
                row += 1;
            }
            self.score(w, (goals, first..row), c, q);
        }
    }

    /// Adds the best score per heading of the goals in the tile to the Q-values of its rows.
    fn score<T: Real>(&self, w: Weights<'_, T>, (goals, rows): (&Goals, Range<usize>), c: &mut GoalCache<T>, q: &mut Batch<T>) {
        c.features.resize(self.features, c.tile.len());
        let mut features = c.features.as_mut_slice().chunks_exact_mut(self.features);
        let mut begin = 0;
        for (r, &end) in rows.clone().zip(&c.ends) {
            for (&g, features) in c.tile[begin..end].iter().zip(&mut features) {
                write_features(goals, (r, g as usize), features);
            }
            begin = end;
        }
        c.hidden.resize(HIDDEN, c.tile.len());
        self.hidden_of_features(w, c.features.rows(), c.hidden.rows_mut());
        let (actions, none) = (q.width(), w.params[self.none]);
        let (value, bias) = (self.value(w.params), self.value.bias(w)[0]);
        simd(
            #[inline(always)]
            || {
                let hidden = c.hidden.as_mut_slice().as_chunks_mut::<HIDDEN>().0;
                let contexts = c.context.as_slice().as_chunks::<HIDDEN>().0;
                let rows_of = |all: Range<usize>| all.start * actions..all.end * actions;
                let best = c.best[rows_of(rows.clone())].chunks_exact_mut(actions);
                let q = q.as_mut_slice()[rows_of(rows.clone())].chunks_exact_mut(actions);
                let mut begin = 0;
                for (((r, &end), q), best) in rows.clone().zip(&c.ends).zip(q).zip(best) {
                    let hidden = &mut hidden[begin..end];
                    c.lanes.resize(hidden.len(), [T::ZERO; LANES]);
                    for (lanes, hidden) in c.lanes.iter_mut().zip(hidden) {
                        *lanes = product(activate(hidden, &contexts[r]), value);
                    }
                    let mut scores = [T::ZERO; 16];
                    for (&g, lanes) in c.tile[begin..end].iter().zip(&c.lanes) {
                        let score = lanes.iter().fold(T::ZERO, |sum, &lane| sum + lane) + bias;
                        let h = usize::from(goals.headings()[g as usize]);
                        if best[h] == NONE || score > scores[h] {
                            (best[h], scores[h]) = (g, score);
                        }
                    }
                    begin = end;
                    for (h, q) in q.iter_mut().enumerate() {
                        *q += if best[h] == NONE { none } else { scores[h] };
                    }
                }
            },
        );
    }

    /// What the features contribute to the first layer.
    fn hidden_of_features<T: Real>(&self, w: Weights<'_, T>, features: Rows<'_, T>, hidden: RowsMut<'_, T>) {
        self.first.forward_part(w, (0, self.features), features, hidden, InitialValue::Bias(self.first.bias(w)));
    }

    /// v.
    fn value<'a, T: Real>(&self, params: &'a [T]) -> &'a [T; HIDDEN] {
        self.value.weight(params).try_into().expect("one value per hidden unit")
    }

    /// Adds the gradients of the parameters, given those of the Q-values. [`GoalHead::backward_context`] then gives those of the context.
    pub(super) fn backward<T: Real>(
        &self,
        w: Weights<'_, T>,
        (goals, context): (&Goals, &[Rows<'_, T>]),
        dq: Rows<'_, T>,
        c: &mut GoalCache<T>,
        grads: &mut [T],
    ) {
        let actions = c.best.len() / dq.len.max(1);
        let value = self.value(w.params);
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
        c.features.resize(self.features, c.chosen.len());
        for (&(r, g, _), features) in c.chosen.iter().zip(c.features.as_mut_slice().chunks_exact_mut(self.features)) {
            write_features(goals, (r as usize, g as usize), features);
        }
        c.hidden.resize(HIDDEN, c.chosen.len());
        self.hidden_of_features(w, c.features.rows(), c.hidden.rows_mut());
        c.d_hidden.resize(HIDDEN, c.chosen.len());
        let mut d_value = [T::ZERO; HIDDEN];
        let mut d_bias = T::ZERO;
        let (hidden, contexts) = (c.hidden.as_slice().as_chunks::<HIDDEN>().0, c.context.as_slice().as_chunks::<HIDDEN>().0);
        let d_hidden = c.d_hidden.as_mut_slice().as_chunks_mut::<HIDDEN>().0;
        let d_contexts = c.d_context.as_mut_slice().as_chunks_mut::<HIDDEN>().0;
        simd(
            #[inline(always)]
            || {
                for ((&(r, _, d), hidden), out) in c.chosen.iter().zip(hidden).zip(d_hidden) {
                    let (context, d_context) = (&contexts[r as usize], &mut d_contexts[r as usize]);
                    for k in 0..HIDDEN {
                        let hidden = relu_of_sum(hidden[k], context[k]);
                        d_value[k] += d * hidden;
                        out[k] = if hidden > T::ZERO { d * value[k] } else { T::ZERO };
                        d_context[k] += out[k];
                    }
                    d_bias += d;
                }
            },
        );
        self.value.weight_mut(grads).iter_mut().zip(d_value).for_each(|(g, d)| *g += d);
        self.value.bias_mut(grads)[0] += d_bias;
        self.first.backward_bias(c.d_hidden.rows(), grads);
        self.first.backward_part((0, self.features), c.features.rows(), c.d_hidden.rows(), grads);
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

/// Writes the inputs of the first layer, without the context, for goal `g` of row `r`.
fn write_features<T: Real>(goals: &Goals, (r, g): (usize, usize), out: &mut [T]) {
    let (own, advised) = out.split_at_mut(FEATURES);
    let features = goals.features().as_chunks::<FEATURES>().0[g];
    own.copy_from_slice(&features.map(|f| T::from_f64(f.into())));
    if let ([advised], Some(heading)) = (advised, goals.advice().get(r)) {
        *advised = if goals.headings()[g] == *heading { T::ONE } else { T::ZERO };
    }
}

/// Adds the context to a hidden row, and applies ReLU.
#[inline(always)]
fn activate<'a, T: Real>(hidden: &'a mut [T; HIDDEN], context: &[T; HIDDEN]) -> &'a [T; HIDDEN] {
    hidden.iter_mut().zip(context).for_each(|(hidden, &context)| *hidden = relu_of_sum(*hidden, context));
    hidden
}

#[inline(always)]
fn relu_of_sum<T: Real>(a: T, b: T) -> T {
    let sum = a + b;
    if sum > T::ZERO { sum } else { T::ZERO }
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

#[cfg(test)]
mod tests {
    use rand::RngExt;

    use super::super::memory::{GRID, memories, uav_memory_len};
    use super::super::{EnvParams, FleetGraph};
    use super::*;
    use crate::nn::argmax;
    use crate::rng;

    const ACTIONS: usize = 8;

    /// The goals of fleets that remember more and more users, so that a tile has one row or several.
    fn goals() -> Goals {
        let mut goals = Goals::default();
        goals.clear();
        let mut rng = rng::stream(3, "goals", 0);
        for users in [0, 2, 5, 30, 90, 200] {
            let mut memory = vec![0.0; 3 * uav_memory_len(users)];
            for uav in memory.chunks_exact_mut(uav_memory_len(users)) {
                uav[..GRID].fill_with(|| rng.random_range(0..1 << GRID) as f32);
                uav[GRID..]
                    .chunks_exact_mut(5)
                    .for_each(|user| user.copy_from_slice(&[1.0, rng.random(), rng.random(), 3.0, 5.0]));
            }
            let uavs = [[0.1, 0.2], [0.6, 0.5], [0.9, 0.9]];
            let graph = FleetGraph::from_scene(&uavs, &vec![[0.5, 0.5]; users], &vec![1.0; users], 0.28);
            let slot = (&EnvParams::default(), &graph.sight().unwrap(), 7);
            goals.push_fleet(slot, memories(&memory, users), (&[0, 3, 5], None));
        }
        goals
    }

    #[test]
    fn the_best_goal_of_each_heading_counts_and_only_of_headings_that_are_needed() {
        let mut layout = ParameterLayout::default();
        let head = GoalHead::new(&mut layout, "goals", HIDDEN, false);
        let params: Vec<f64> = layout.initialise(&mut rng::stream(4, "test", 0));
        let mut prepared = vec![0.0; params.len()];
        head.prepare(&params, &mut prepared);
        let w = Weights { params: &params, prepared: &prepared };
        let goals = goals();
        let mut rng = rng::stream(5, "context", 0);
        let context: Vec<f64> = (0..goals.rows() * HIDDEN).map(|_| rng.random_range(-1.0..1.0)).collect();
        let context_rows = [Rows { data: &context, stride: HIDDEN, len: goals.rows() }];
        let forward = |needed: Option<&[u8]>| {
            let mut q = Batch::default();
            q.resize_zero(ACTIONS, goals.rows());
            head.forward(w, (&goals, needed), &context_rows, &mut GoalCache::default(), &mut q);
            q
        };
        let all = forward(None);
        let (weight, bias) = (head.first.weight(&params), head.first.bias(w));
        for r in 0..goals.rows() {
            let mut best = [f64::NEG_INFINITY; ACTIONS];
            for g in goals.of_row(r) {
                let features = goals.features()[g * FEATURES..][..FEATURES].iter().map(|&f| f64::from(f));
                let input: Vec<f64> = features.chain(context[r * HIDDEN..][..HIDDEN].iter().copied()).collect();
                let hidden = weight
                    .chunks_exact(input.len())
                    .zip(bias)
                    .map(|(row, b)| (row.iter().zip(&input).map(|(w, x)| w * x).sum::<f64>() + b).max(0.0));
                let score = hidden.zip(head.value(&params)).map(|(x, v)| x * v).sum::<f64>() + head.value.bias(w)[0];
                let h = usize::from(goals.headings()[g]);
                best[h] = best[h].max(score);
            }
            for (q, best) in all.row(r).iter().zip(best) {
                let expected = if best.is_finite() { best } else { params[head.none] };
                assert!((q - expected).abs() < 1e-12, "row {r}: {q}, {expected}");
            }
        }
        let needed: Vec<u8> = (0..goals.rows()).map(|r| argmax(all.row(r)) as u8).collect();
        let some = forward(Some(&needed));
        for (r, &h) in needed.iter().enumerate() {
            assert_eq!(some.row(r)[usize::from(h)].to_bits(), all.row(r)[usize::from(h)].to_bits(), "row {r}");
        }
        assert_ne!(some.as_slice(), all.as_slice());
    }
}
