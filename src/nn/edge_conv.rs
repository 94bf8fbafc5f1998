//! Edge networks: f = Linear(2H, 96), LayerNorm, ReLU, Linear(96, H) on each pair of neighbours, aggregated over the neighbours
//! (docs/model.md, "EdgeConv" and "AggGNN"). Computed in factored form, exact up to rounding:
//!
//! ```text
//! EdgeConv    x'_i = agg_j f(x_i || x_j - x_i)      u_i = (Wa - Wb) x_i + b
//! AggGNN      m_i  = agg_j f(x_i || x_j)            u_i = Wa x_i + b
//! v_j = Wb x_j                                per node: f's first Linear is linear in x_i and x_j
//! a_i = agg_j relu(LayerNorm(u_i + v_j))      per edge: not stored, backward recomputes it
//! x'_i = W' a_i + b'                          per node: f's last Linear commutes with the sum
//! ```
//!
//! A node without neighbours gets 0. The nodes computed are a prefix of the nodes read (see [`Graph`]).

use pulp::Simd;

use super::HIDDEN as H;
use super::batch::{Batch, Rows, RowsMut};
use super::edge_norm::{self, W, WithRows, with_rows};
use super::graph::Graph;
use super::layer_norm::{Affine, LayerNorm, Stats};
use super::linear::Linear;
use super::matmul::{InitialValue, Lhs, Out, Rhs, matmul};
use super::params::{ParameterLayout, Weights};
use super::real::Real;
use super::simd::simd;
use crate::threads;

/// Second half of f's input.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pairing {
    /// x_j - x_i.
    Difference,
    /// x_j.
    Plain,
}

/// The network f, its input and its aggregation.
#[derive(Clone, Copy, Debug)]
pub struct EdgeNet {
    first: Linear,
    norm: LayerNorm<W>,
    last: Linear,
    pairing: Pairing,
    mean: bool,
}

/// Values that backward needs: u, v, a, and (mean, rstd) per edge.
#[derive(Debug, Default)]
pub struct EdgeCache<T: Real> {
    u: Batch<T>,
    v: Batch<T>,
    a: Batch<T>,
    stats: Vec<[T; 2]>,
}

/// Buffers of backward, shared by all layers.
#[derive(Debug, Default)]
pub struct EdgeScratch<T: Real> {
    da: Batch<T>,
    du: Batch<T>,
    dv: Batch<T>,
}

impl EdgeNet {
    /// Adds the parameters `name.0`, `name.1` and `name.3`. The aggregation is the mean over neighbours or, without `mean`, the sum.
    pub fn new(layout: &mut ParameterLayout, name: &str, pairing: Pairing, mean: bool) -> Self {
        Self {
            first: Linear::new(layout, &format!("{name}.0"), 2 * H, W),
            norm: LayerNorm::new(layout, &format!("{name}.1")),
            last: Linear::new(layout, &format!("{name}.3"), W, H),
            pairing,
            mean,
        }
    }

    /// Writes Wa - Wb (or Wa) and Wb transposed, (H, W) each, and the last layer's transposed weight.
    pub fn prepare<T: Real>(&self, params: &[T], prepared: &mut [T]) {
        self.last.prepare(params, prepared);
        let (own, neighbour) = self.first.weight_mut(prepared).split_at_mut(H * W);
        for (o, row) in self.first.weight(params).as_chunks::<{ 2 * H }>().0.iter().enumerate() {
            for i in 0..H {
                own[i * W + o] = if self.pairing == Pairing::Difference { row[i] - row[H + i] } else { row[i] };
                neighbour[i * W + o] = row[H + i];
            }
        }
    }

    /// The matrix products of a forward pass that reads `inputs` nodes and computes `outputs`, each as (rows, k, columns).
    pub fn products(&self, (inputs, outputs): (usize, usize)) -> [[usize; 3]; 3] {
        [[outputs, H, W], [inputs, H, W], self.last.product(outputs)]
    }

    /// Writes x' of the first `y.len` nodes, from x of all nodes.
    pub fn forward<T: Real>(
        &self,
        w: Weights<'_, T>,
        graph: &Graph,
        x: Rows<'_, T>,
        cache: &mut EdgeCache<T>,
        y: RowsMut<'_, T>,
    ) {
        let nodes = y.len;
        cache.u.resize(W, nodes);
        cache.v.resize(W, x.len);
        cache.a.resize(W, nodes);
        cache.stats.resize(graph.offsets[nodes] as usize, [T::ZERO; 2]);
        let (own, neighbour) = self.first.weight_transposed(w).split_at(H * W);
        let (own, neighbour) = (Rhs { data: own, stride: W }, Rhs { data: neighbour, stride: W });
        let EdgeCache { u, v, a, stats } = cache;
        let part = threads::part(x.len);
        threads::for_each(x.parts(part).zip(v.rows_mut().parts(part)), |(x, v)| {
            let out = Out { data: v.data, stride: W };
            matmul((x.len, H, W), Lhs::rows(x.data, x.stride), neighbour, out, InitialValue::Zero);
        });
        let (affine, bias) = (self.norm.affine(w.params), self.first.bias(w));
        let v = v.as_slice().as_chunks().0;
        let part = threads::part(nodes);
        let rows = Rows { len: nodes, ..x }.parts(part).zip(u.rows_mut().parts(part)).zip(a.rows_mut().parts(part));
        let rows = rows.zip(y.parts(part)).zip(graph.edge_parts(stats, part));
        threads::for_each(rows.enumerate(), |(k, ((((x, u), a), mut y), stats))| {
            let first = k * part;
            let out = Out { data: &mut *u.data, stride: W };
            matmul((x.len, H, W), Lhs::rows(x.data, x.stride), own, out, InitialValue::Bias(bias));
            let (u, sums) = (u.data.as_chunks().0, a.data.as_chunks_mut().0);
            with_rows(Aggregate { graph, first, mean: self.mean, affine: &affine, u, v, stats, a: sums });
            let sums = Rows { data: a.data, stride: W, len: a.len };
            self.last.forward(w, sums, RowsMut { data: &mut *y.data, ..y });
            self.correct_bias(w, (graph, first), &mut y);
        });
    }

    /// Corrects the last product, which added one bias per node. A sum has one bias per neighbour, and a node without neighbours has
    /// none. `y` are the rows of the nodes from `first` on.
    fn correct_bias<T: Real>(&self, w: Weights<'_, T>, (graph, first): (&Graph, usize), y: &mut RowsMut<'_, T>) {
        let bias = self.last.bias(w);
        for (i, y) in y.data.chunks_mut(y.stride).take(y.len).enumerate() {
            let degree = graph.degree(first + i);
            if degree == 0 {
                y[..H].fill(T::ZERO);
            } else if !self.mean {
                let more = T::from_f64((degree - 1) as f64);
                y[..H].iter_mut().zip(bias).for_each(|(y, &b)| *y += more * b);
            }
        }
    }

    /// Adds the gradients of the parameters and writes dx of all nodes read. Overwrites `dy`.
    pub fn backward<T: Real>(
        &self,
        params: &[T],
        (graph, x, cache): (&Graph, Rows<'_, T>, &EdgeCache<T>),
        dy: &mut Batch<T>,
        scratch: &mut EdgeScratch<T>,
        (grads, dx): (&mut [T], &mut Batch<T>),
    ) {
        let nodes = dy.len();
        let EdgeScratch { da, du, dv } = scratch;
        da.resize(W, nodes);
        du.resize(W, nodes);
        dv.resize_zero(W, x.len);
        let bias: &mut [T; H] = self.last.bias_mut(grads).try_into().expect("H numbers");
        simd(
            #[inline(always)]
            || last_bias_back(graph, self.mean, dy.as_mut_slice().as_chunks_mut().0, bias),
        );
        self.last.backward_part((0, W), cache.a.rows(), dy.rows(), grads);
        self.last.backward_input(params, (0, W), dy.rows(), da.rows_mut(), InitialValue::Zero);

        let affine = self.norm.affine(params);
        let mut sums = Affine::zero();
        let (u, v) = (cache.u.as_slice().as_chunks().0, cache.v.as_slice().as_chunks().0);
        let (du_rows, dv_rows) = (du.as_mut_slice().as_chunks_mut().0, dv.as_mut_slice().as_chunks_mut().0);
        let da = da.as_slice().as_chunks().0;
        let (mean, stats) = (self.mean, &cache.stats[..]);
        with_rows(AggregateBack { graph, mean, affine: &affine, u, v, stats, da, du: du_rows, dv: dv_rows, sums: &mut sums });
        self.norm.add_grads(&sums, grads);

        self.first.backward_bias(du.rows(), grads);
        self.first.backward_part((0, H), x, du.rows(), grads);
        if self.pairing == Pairing::Difference {
            // u uses Wa - Wb and v uses Wb, so the gradient of Wb comes from dv - du.
            let (dv, du) = (dv.as_mut_slice(), du.as_slice());
            simd(
                #[inline(always)]
                || dv.iter_mut().zip(du).for_each(|(v, &u)| *v -= u),
            );
        }
        self.first.backward_part((H, H), x, dv.rows(), grads);
        dx.resize(H, x.len);
        self.first.backward_input(params, (H, H), dv.rows(), dx.rows_mut(), InitialValue::Zero);
        self.first.backward_input(params, (0, H), du.rows(), dx.range_mut(0..nodes), InitialValue::Previous);
    }
}

/// Adds the gradient of the last layer's bias. Sets the gradient of nodes without neighbours, whose output is constant, to 0.
#[inline(always)]
fn last_bias_back<T: Real>(graph: &Graph, mean: bool, dy: &mut [[T; H]], bias: &mut [T; H]) {
    for (i, dy) in dy.iter_mut().enumerate() {
        let degree = graph.degree(i);
        if degree == 0 {
            *dy = [T::ZERO; H];
            continue;
        }
        let times = if mean { T::ONE } else { T::from_f64(degree as f64) };
        for c in 0..H {
            bias[c] = times.mul_add(dy[c], bias[c]);
        }
    }
}

/// a_i = agg_j relu(LayerNorm(u_i + v_j)) for the nodes from `first` on.
struct Aggregate<'a, T> {
    graph: &'a Graph,
    first: usize,
    mean: bool,
    affine: &'a Affine<T, W>,
    u: &'a [[T; W]],
    v: &'a [[T; W]],
    stats: &'a mut [[T; 2]],
    a: &'a mut [[T; W]],
}

impl<T: Real> WithRows<T> for Aggregate<'_, T> {
    #[inline(always)]
    fn with_rows<S: Simd, const N: usize>(self, simd: S) {
        let mut stats = self.stats.iter_mut();
        for (i, (u, a)) in self.u.iter().zip(self.a).enumerate() {
            let u = edge_norm::load::<T, S, N>(simd, u);
            let mut sum = [T::splat(simd, T::ZERO); N];
            let neighbours = self.graph.neighbours(self.first + i);
            for (&j, stats) in neighbours.iter().zip(&mut stats) {
                let x = edge_norm::add::<T, S, N>(simd, u, &edge_norm::load(simd, &self.v[j as usize]));
                let s = edge_norm::stats::<T, S, N>(simd, &x);
                *stats = [s.mean, s.rstd];
                sum = edge_norm::add::<T, S, N>(simd, sum, &edge_norm::norm_relu::<T, S, N>(simd, &x, s, self.affine));
            }
            let sum = edge_norm::times::<T, S, N>(simd, sum, edge_weight(neighbours, self.mean));
            edge_norm::store::<T, S, N>(simd, &sum, a);
        }
    }
}

/// The gradients of u and v from that of a, and those of the LayerNorm.
struct AggregateBack<'a, T> {
    graph: &'a Graph,
    mean: bool,
    affine: &'a Affine<T, W>,
    u: &'a [[T; W]],
    v: &'a [[T; W]],
    stats: &'a [[T; 2]],
    da: &'a [[T; W]],
    du: &'a mut [[T; W]],
    dv: &'a mut [[T; W]],
    sums: &'a mut Affine<T, W>,
}

impl<T: Real> WithRows<T> for AggregateBack<'_, T> {
    #[inline(always)]
    fn with_rows<S: Simd, const N: usize>(self, simd: S) {
        let mut stats = self.stats.iter();
        for (i, ((u, da), du)) in self.u.iter().zip(self.da).zip(self.du).enumerate() {
            let neighbours = self.graph.neighbours(i);
            let da = edge_norm::load::<T, S, N>(simd, da);
            let da = edge_norm::times::<T, S, N>(simd, da, edge_weight(neighbours, self.mean));
            let u = edge_norm::load::<T, S, N>(simd, u);
            let mut sum = [T::splat(simd, T::ZERO); N];
            for (&j, stats) in neighbours.iter().zip(&mut stats) {
                let x = edge_norm::add::<T, S, N>(simd, u, &edge_norm::load(simd, &self.v[j as usize]));
                let s = Stats { mean: stats[0], rstd: stats[1] };
                let d = edge_norm::norm_relu_back::<T, S, N>(simd, (&x, s), self.affine, &da, self.sums);
                sum = edge_norm::add::<T, S, N>(simd, sum, &d);
                let dv = &mut self.dv[j as usize];
                let total = edge_norm::add::<T, S, N>(simd, edge_norm::load(simd, dv), &d);
                edge_norm::store::<T, S, N>(simd, &total, dv);
            }
            edge_norm::store::<T, S, N>(simd, &sum, du);
        }
    }
}

/// Weight of one neighbour in the aggregation.
#[inline(always)]
fn edge_weight<T: Real>(neighbours: &[u32], mean: bool) -> T {
    if mean { T::ONE / T::from_f64(neighbours.len().max(1) as f64) } else { T::ONE }
}
