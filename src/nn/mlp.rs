//! Linear, LayerNorm, ReLU, Linear: the head of graph agents, and the update network of `agggnn`.
//!
//! The input has two parts (x || x'), which are multiplied separately and never concatenated.

use super::batch::{Batch, Rows, RowsMut};
use super::layer_norm::{self, Affine, LayerNorm, Stats};
use super::linear::Linear;
use super::matmul::InitialValue;
use super::params::{ParameterLayout, Weights};
use super::real::Real;
use super::simd::simd;

/// A network with a hidden layer of width W.
#[derive(Clone, Copy, Debug)]
pub struct Mlp<const W: usize> {
    /// First layer.
    pub first: Linear,
    norm: LayerNorm<W>,
    last: Linear,
}

/// Values that backward needs, and its buffers.
#[derive(Debug, Default)]
pub struct MlpCache<T: Real> {
    /// Output of the first layer; backward replaces it by its gradient.
    pre_norm_or_grad: Batch<T>,
    stats: Batch<T>,
    /// Output of LayerNorm and ReLU; backward replaces it by its gradient.
    hidden_or_grad: Batch<T>,
}

impl<const W: usize> Mlp<W> {
    /// Adds the parameters `name.0`, `name.1` and `name.3`, numbered as in `PyTorch`'s `Sequential`.
    pub fn new(layout: &mut ParameterLayout, name: &str, inputs: usize, outputs: usize) -> Self {
        Self {
            first: Linear::new(layout, &format!("{name}.0"), inputs, W),
            norm: LayerNorm::new(layout, &format!("{name}.1")),
            last: Linear::new(layout, &format!("{name}.3"), W, outputs),
        }
    }

    /// See [`Linear::prepare`].
    pub fn prepare<T: Real>(&self, params: &[T], prepared: &mut [T]) {
        self.first.prepare(params, prepared);
        self.last.prepare(params, prepared);
    }

    /// The matrix products of a forward pass over `rows` samples, each as (rows, k, columns).
    pub fn products(&self, rows: usize) -> [[usize; 3]; 2] {
        [self.first.product(rows), self.last.product(rows)]
    }

    /// y = f(a || b) for `a` of width `split`.
    pub fn forward<T: Real>(
        &self,
        w: Weights<'_, T>,
        (a, b, split): (Rows<'_, T>, Rows<'_, T>, usize),
        cache: &mut MlpCache<T>,
        y: RowsMut<'_, T>,
    ) {
        let first = &self.first;
        cache.pre_norm_or_grad.resize(W, a.len);
        cache.stats.resize(2, a.len);
        cache.hidden_or_grad.resize(W, a.len);
        first.forward_part(w, (0, split), a, cache.pre_norm_or_grad.rows_mut(), InitialValue::Bias(first.bias(w)));
        first.forward_part(w, (split, first.inputs - split), b, cache.pre_norm_or_grad.rows_mut(), InitialValue::Previous);
        let affine = self.norm.affine(w.params);
        simd(
            #[inline(always)]
            || {
                norm_relu_rows(
                    cache.pre_norm_or_grad.as_slice(),
                    &affine,
                    cache.stats.as_mut_slice(),
                    cache.hidden_or_grad.as_mut_slice(),
                );
            },
        );
        self.last.forward(w, cache.hidden_or_grad.rows(), y);
    }

    /// Adds the gradients of the parameters. Afterwards [`Mlp::d_first`] is the gradient at the output of the first layer.
    pub fn backward<T: Real>(
        &self,
        params: &[T],
        (a, b, split): (Rows<'_, T>, Rows<'_, T>, usize),
        dy: Rows<'_, T>,
        cache: &mut MlpCache<T>,
        grads: &mut [T],
    ) {
        self.last.backward_bias(dy, grads);
        self.last.backward_part((0, W), cache.hidden_or_grad.rows(), dy, grads);
        self.last.backward_input(params, (0, W), dy, cache.hidden_or_grad.rows_mut(), InitialValue::Zero);
        let affine = self.norm.affine(params);
        let mut sums = Affine::zero();
        simd(
            #[inline(always)]
            || {
                norm_relu_rows_back(
                    cache.pre_norm_or_grad.as_mut_slice(),
                    &affine,
                    cache.stats.as_slice(),
                    cache.hidden_or_grad.as_slice(),
                    &mut sums,
                );
            },
        );
        self.norm.add_grads(&sums, grads);
        let d = cache.pre_norm_or_grad.rows();
        self.first.backward_bias(d, grads);
        self.first.backward_part((0, split), a, d, grads);
        self.first.backward_part((split, self.first.inputs - split), b, d, grads);
    }

    /// After [`Mlp::backward`]: the gradient at the output of the first layer.
    pub fn d_first<'a, T: Real>(&self, cache: &'a MlpCache<T>) -> Rows<'a, T> {
        cache.pre_norm_or_grad.rows()
    }
}

#[inline(always)]
fn norm_relu_rows<T: Real, const W: usize>(x: &[T], p: &Affine<T, W>, stats: &mut [T], y: &mut [T]) {
    let rows = x.as_chunks::<W>().0.iter().zip(y.as_chunks_mut::<W>().0);
    for ((x, y), stats) in rows.zip(stats.as_chunks_mut::<2>().0) {
        let s = layer_norm::stats(x);
        *stats = [s.mean, s.rstd];
        layer_norm::norm_relu(x, s, p, y);
    }
}

#[inline(always)]
fn norm_relu_rows_back<T: Real, const W: usize>(x: &mut [T], p: &Affine<T, W>, stats: &[T], dy: &[T], sums: &mut Affine<T, W>) {
    let rows = x.as_chunks_mut::<W>().0.iter_mut().zip(dy.as_chunks::<W>().0);
    for ((x, dy), stats) in rows.zip(stats.as_chunks::<2>().0) {
        *x = layer_norm::norm_relu_back(x, Stats { mean: stats[0], rstd: stats[1] }, p, dy, sums);
    }
}
