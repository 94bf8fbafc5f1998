//! Adam over a flat vector, with clipping of the gradient to a global norm, both as in `PyTorch` (docs/model.md, "Optimiser").

use super::real::Real;
use super::simd::simd;

const BETA1: f64 = 0.9;
const BETA2: f64 = 0.999;
const EPS: f64 = 1e-8;

/// State of the optimiser.
#[derive(Clone, Debug, PartialEq)]
pub struct Adam<T> {
    /// First moments.
    pub m: Vec<T>,
    /// Second moments.
    pub v: Vec<T>,
    /// Number of steps taken.
    pub steps: u64,
}

impl<T: Real> Adam<T> {
    /// The state before the first step.
    pub fn new(len: usize) -> Self {
        Self { m: vec![T::ZERO; len], v: vec![T::ZERO; len], steps: 0 }
    }

    /// Takes one step. `norm` is the norm of `grads`; gradients of a larger norm than `clip` are scaled down to it.
    ///
    /// # Panics
    /// If the lengths differ.
    pub fn step(&mut self, params: &mut [T], grads: &[T], rate: f64, (norm, clip): (f64, f64)) {
        assert!(params.len() == grads.len() && grads.len() == self.m.len(), "one moment per parameter");
        self.steps += 1;
        let power = i32::try_from(self.steps).unwrap_or(i32::MAX);
        let scale = T::from_f64((clip / (norm + 1e-6)).min(1.0));
        let rate = T::from_f64(rate / (1.0 - BETA1.powi(power)));
        let root = T::from_f64(1.0 / (1.0 - BETA2.powi(power)).sqrt());
        let (rest1, beta2, rest2, eps) =
            (T::from_f64(1.0 - BETA1), T::from_f64(BETA2), T::from_f64(1.0 - BETA2), T::from_f64(EPS));
        let (m, v) = (&mut self.m[..], &mut self.v[..]);
        simd(
            #[inline(always)]
            || {
                for (((p, &g), m), v) in params.iter_mut().zip(grads).zip(m).zip(v) {
                    let g = g * scale;
                    *m += rest1 * (g - *m);
                    *v = *v * beta2 + rest2 * g * g;
                    *p -= rate * *m / (v.sqrt() * root + eps);
                }
            },
        );
    }
}

/// Sum of squares, in f64.
pub fn norm_squared<T: Real>(x: &[T]) -> f64 {
    x.iter().map(|x| x.to_f64() * x.to_f64()).sum()
}
