//! Relational graph convolution (docs/model.md, "RGCN"): x'_i = W_0 x_i + b + sum_r mean_{j in N_r(i)} x_j W_r.
//!
//! The relation of an edge is given by the kinds of its two nodes: first-first, mixed, second-second. A node has two means,
//! over its neighbours of the first kind and of the second kind, so that products run once per node.

use super::HIDDEN as H;
use super::batch::{Batch, Rows, RowsMut};
use super::graph::Graph;
use super::linear::{Linear, transpose};
use super::matmul::{InitialValue, Lhs, Out, Rhs, matmul};
use super::params::{Init, ParameterLayout, Weights};
use super::real::Real;
use super::simd::simd;

/// One layer.
#[derive(Clone, Copy, Debug)]
pub struct Rgcn {
    root: Linear,
    /// Offset of the weights of the relations, (3, H, H).
    relations: usize,
}

/// Means over the neighbours of the first and of the second kind; in backward their gradients.
#[derive(Debug, Default)]
pub struct RgcnCache<T: Real> {
    means: Batch<T>,
}

impl Rgcn {
    /// Adds the parameters `name.root` and `name.rel` (3, H, H). `rel` multiplies from the right.
    pub fn new(layout: &mut ParameterLayout, name: &str) -> Self {
        let root = Linear::new(layout, &format!("{name}.root"), H, H);
        Self { root, relations: layout.add(format!("{name}.rel"), &[3, H, H], Init::Normal(1.0 / (H as f64).sqrt())) }
    }

    /// Transposes all weights. Those of the relations are needed in backward only.
    pub fn prepare<T: Real>(&self, params: &[T], prepared: &mut [T]) {
        self.root.prepare(params, prepared);
        for at in (self.relations..).step_by(H * H).take(3) {
            transpose(&params[at..][..H * H], H, &mut prepared[at..][..H * H]);
        }
    }

    /// The range of nodes of each kind, with its relations to nodes of the first and of the second kind.
    fn kind_ranges(graph: &Graph, nodes: usize) -> [(std::ops::Range<usize>, [usize; 2]); 2] {
        let first = graph.first_kind_count().min(nodes);
        [(0..first, [0, 1]), (first..nodes, [1, 2])]
    }

    /// Writes x' of the first `y.len` nodes, from x of all nodes.
    pub fn forward<T: Real>(
        &self,
        w: Weights<'_, T>,
        graph: &Graph,
        x: Rows<'_, T>,
        cache: &mut RgcnCache<T>,
        y: RowsMut<'_, T>,
    ) {
        let nodes = y.len;
        cache.means.resize_zero(2 * H, nodes);
        let means = cache.means.as_mut_slice().as_chunks_mut::<H>().0;
        simd(
            #[inline(always)]
            || {
                for (i, means) in means.chunks_exact_mut(2).enumerate() {
                    for (kind, j, weight) in neighbours(graph, i) {
                        add_scaled(&x.data[j * x.stride..][..H], weight, &mut means[kind]);
                    }
                }
            },
        );
        let stride = y.stride;
        self.root.forward(w, Rows { len: nodes, ..x }, RowsMut { data: &mut *y.data, ..y });
        for (range, relations) in Self::kind_ranges(graph, nodes) {
            for (kind, r) in relations.into_iter().enumerate() {
                let means = Lhs::rows(cache.means.range(range.clone()).from_column(kind * H).data, 2 * H);
                let weight = Rhs { data: &w.params[self.relations + r * H * H..][..H * H], stride: H };
                matmul(
                    (range.len(), H, H),
                    means,
                    weight,
                    Out { data: &mut y.data[range.start * stride..], stride },
                    InitialValue::Previous,
                );
            }
        }
    }

    /// Adds the gradients of the parameters and writes dx of all nodes read. Overwrites the cache.
    pub fn backward<T: Real>(
        &self,
        w: Weights<'_, T>,
        (graph, x, cache): (&Graph, Rows<'_, T>, &mut RgcnCache<T>),
        dy: Rows<'_, T>,
        (grads, dx): (&mut [T], &mut Batch<T>),
    ) {
        dx.resize_zero(H, x.len);
        self.root.backward(w.params, Rows { len: dy.len, ..x }, dy, grads, Some(dx.range_mut(0..dy.len)));
        for (range, relations) in Self::kind_ranges(graph, dy.len) {
            for (kind, r) in relations.into_iter().enumerate() {
                let at = self.relations + r * H * H;
                let d = &dy.data[range.start * dy.stride..];
                let means = cache.means.range_mut(range.clone());
                let column = (kind * H).min(means.data.len());
                let out = Out { data: &mut grads[at..][..H * H], stride: H };
                let rhs = Rhs { data: d, stride: dy.stride };
                matmul((H, range.len(), H), Lhs::transposed(&means.data[column..], 2 * H), rhs, out, InitialValue::Previous);
                let out = Out { data: &mut means.data[column..], stride: 2 * H };
                let transposed = Rhs { data: &w.prepared[at..][..H * H], stride: H };
                matmul((range.len(), H, H), Lhs::rows(d, dy.stride), transposed, out, InitialValue::Zero);
            }
        }
        let means = cache.means.as_slice().as_chunks::<H>().0;
        simd(
            #[inline(always)]
            || {
                for (i, means) in means.chunks_exact(2).enumerate() {
                    for (kind, j, weight) in neighbours(graph, i) {
                        add_scaled(&means[kind], weight, dx.row_mut(j));
                    }
                }
            },
        );
    }
}

/// Adds `weight` times `from` to `to`, both of width H.
#[inline(always)]
fn add_scaled<T: Real>(from: &[T], weight: T, to: &mut [T]) {
    for (to, &from) in to[..H].iter_mut().zip(&from[..H]) {
        *to = from.mul_add(weight, *to);
    }
}

/// Neighbours of node `i`: kind, index, and weight in the mean over that kind.
#[inline(always)]
fn neighbours<T: Real>(graph: &Graph, i: usize) -> impl Iterator<Item = (usize, usize, T)> {
    let all = graph.neighbours(i);
    let kind = |&&j: &&u32| usize::from(j as usize >= graph.first_kind_count());
    let second = all.iter().filter(|j| kind(j) == 1).count();
    let weights = [all.len() - second, second].map(|n| T::from_f64(1.0 / n.max(1) as f64));
    all.iter().map(move |j| {
        let kind = usize::from(*j as usize >= graph.first_kind_count());
        (kind, *j as usize, weights[kind])
    })
}
