//! ReLU(Linear(F, 64)) of single points, summed over sets of points (docs/model.md, "Set observation" and "Invariant").
//!
//! F is 2 or 3, too small for a matrix product: F multiply-adds on rows of 64. Backward recomputes them.

use super::HIDDEN as H;
use super::linear::Linear;
use super::params::{ParameterLayout, Weights};
use super::real::Real;

/// The embedding of points of F coordinates.
#[derive(Clone, Copy, Debug)]
pub struct Embedding<const F: usize>(Linear);

/// The parameters of an embedding as rows of 64, or the sums of their gradients.
#[derive(Clone, Copy, Debug)]
pub struct EmbeddingParams<T, const F: usize> {
    weight: [[T; H]; F],
    bias: [T; H],
}

impl<const F: usize> Embedding<F> {
    /// Adds `name.weight` (64, F) and `name.bias`.
    pub fn new(layout: &mut ParameterLayout, name: &str) -> Self {
        Self(Linear::new(layout, name, F, H))
    }

    /// See [`Linear::prepare`].
    pub fn prepare<T: Real>(&self, params: &[T], prepared: &mut [T]) {
        self.0.prepare(params, prepared);
    }

    /// The parameters, for [`EmbeddingParams::add`] and [`EmbeddingParams::backward`].
    pub fn params<T: Real>(&self, w: Weights<'_, T>) -> EmbeddingParams<T, F> {
        let rows = self.0.weight_transposed(w).as_chunks::<H>().0;
        EmbeddingParams { weight: rows.try_into().expect("F rows"), bias: self.0.bias(w).try_into().expect("64 numbers") }
    }

    /// Adds the gradients in `sums` to `grads`.
    pub fn add_grads<T: Real>(&self, sums: &EmbeddingParams<T, F>, grads: &mut [T]) {
        for (o, row) in self.0.weight_mut(grads).chunks_exact_mut(F).enumerate() {
            row.iter_mut().zip(&sums.weight).for_each(|(g, s)| *g += s[o]);
        }
        self.0.bias_mut(grads).iter_mut().zip(&sums.bias).for_each(|(g, &s)| *g += s);
    }
}

impl<T: Real, const F: usize> EmbeddingParams<T, F> {
    /// All zeros.
    pub fn zero() -> Self {
        Self { weight: [[T::ZERO; H]; F], bias: [T::ZERO; H] }
    }

    /// The linear part.
    #[inline(always)]
    fn linear(&self, point: [T; F]) -> [T; H] {
        let mut x = self.bias;
        for f in 0..F {
            for c in 0..H {
                x[c] = self.weight[f][c].mul_add(point[f], x[c]);
            }
        }
        x
    }

    /// Adds the embedding of `point` to `sum`.
    #[inline(always)]
    pub fn add(&self, point: [T; F], sum: &mut [T; H]) {
        let x = self.linear(point);
        for c in 0..H {
            sum[c] += x[c].relu();
        }
    }

    /// Adds the gradients of the weights, given the gradient `d` of the embedding of `point`.
    #[inline(always)]
    pub fn backward(&self, point: [T; F], d: &[T; H], grads: &mut Self) {
        let x = self.linear(point);
        for c in 0..H {
            let open = if x[c] > T::ZERO { d[c] } else { T::ZERO };
            grads.bias[c] += open;
            for f in 0..F {
                grads.weight[f][c] = open.mul_add(point[f], grads.weight[f][c]);
            }
        }
    }
}
