//! LayerNorm (eps 1e-5, scale g, shift b) followed by ReLU, per sample, for widths that are a multiple of 16.
//!
//! Forward: y = relu(g n + b), n = (x - mean) rstd, rstd = 1 / sqrt(variance + eps).
//! Backward, with e = dy g if y > 0, else 0, and means over the width: dx = rstd (e - mean(e) - n mean(e n)).

use super::params::{Init, ParameterLayout};
use super::real::Real;

/// Number of partial sums of a reduction. It is fixed, so that sums have the same order on every processor.
pub(super) const PARTS: usize = 16;
const EPS: f64 = 1e-5;

/// Offsets of scale and shift.
#[derive(Clone, Copy, Debug)]
pub(super) struct LayerNorm<const W: usize> {
    scale: usize,
    shift: usize,
}

/// Mean and reciprocal standard deviation of a sample.
#[derive(Clone, Copy, Debug)]
pub(super) struct Stats<T> {
    pub(super) mean: T,
    pub(super) rstd: T,
}

impl<T: Real> Stats<T> {
    #[inline(always)]
    pub(super) fn new(mean: T, variance: T) -> Self {
        Self { mean, rstd: T::ONE / (variance + T::from_f64(EPS)).sqrt() }
    }
}

/// Scale and shift, or their gradients.
#[derive(Clone, Copy)]
pub(super) struct Affine<T, const W: usize> {
    pub(super) scale: [T; W],
    pub(super) shift: [T; W],
}

impl<const W: usize> LayerNorm<W> {
    pub(super) fn new(layout: &mut ParameterLayout, name: &str) -> Self {
        let scale = layout.add(format!("{name}.weight"), &[W], Init::Constant(1.0));
        let shift = layout.add(format!("{name}.bias"), &[W], Init::Constant(0.0));
        Self { scale, shift }
    }

    pub(super) fn affine<T: Real>(&self, params: &[T]) -> Affine<T, W> {
        let at = |from: usize| params[from..from + W].try_into().expect("W numbers");
        Affine { scale: at(self.scale), shift: at(self.shift) }
    }

    /// Adds the gradients in `sums` to `grads`.
    pub(super) fn add_grads<T: Real>(&self, sums: &Affine<T, W>, grads: &mut [T]) {
        grads[self.scale..][..W].iter_mut().zip(&sums.scale).for_each(|(g, &s)| *g += s);
        grads[self.shift..][..W].iter_mut().zip(&sums.shift).for_each(|(g, &s)| *g += s);
    }
}

impl<T: Real, const W: usize> Affine<T, W> {
    pub(super) fn zero() -> Self {
        Self { scale: [T::ZERO; W], shift: [T::ZERO; W] }
    }
}

/// Sum of all lanes, by repeated halving.
#[inline(always)]
fn fold<T: Real>(mut lanes: [T; PARTS]) -> T {
    let mut width = PARTS / 2;
    while width > 0 {
        for l in 0..width {
            lanes[l] += lanes[l + width];
        }
        width /= 2;
    }
    lanes[0]
}

#[inline(always)]
pub(super) fn stats<T: Real, const W: usize>(x: &[T; W]) -> Stats<T> {
    let inverse_width = T::from_f64(1.0 / W as f64);
    let mut sum = [T::ZERO; PARTS];
    for c in x.chunks_exact(PARTS) {
        for l in 0..PARTS {
            sum[l] += c[l];
        }
    }
    let mean = fold(sum) * inverse_width;
    let mut square = [T::ZERO; PARTS];
    for c in x.chunks_exact(PARTS) {
        for l in 0..PARTS {
            let d = c[l] - mean;
            square[l] = d.mul_add(d, square[l]);
        }
    }
    Stats::new(mean, fold(square) * inverse_width)
}

/// LayerNorm and ReLU: y = relu(g n + b).
#[inline(always)]
pub(super) fn norm_relu<T: Real, const W: usize>(x: &[T; W], s: Stats<T>, p: &Affine<T, W>, y: &mut [T; W]) {
    for c in 0..W {
        let n = (x[c] - s.mean) * s.rstd;
        y[c] = n.mul_add(p.scale[c], p.shift[c]).relu();
    }
}

/// Returns dx from x and dy, and adds the gradients of scale and shift.
#[inline(always)]
pub(super) fn norm_relu_back<T: Real, const W: usize>(
    x: &[T; W],
    s: Stats<T>,
    p: &Affine<T, W>,
    dy: &[T; W],
    grads: &mut Affine<T, W>,
) -> [T; W] {
    let inverse_width = T::from_f64(1.0 / W as f64);
    let mut n = [T::ZERO; W];
    let mut e = [T::ZERO; W];
    for c in 0..W {
        n[c] = (x[c] - s.mean) * s.rstd;
        let open = n[c].mul_add(p.scale[c], p.shift[c]) > T::ZERO;
        let d = if open { dy[c] } else { T::ZERO };
        grads.scale[c] = d.mul_add(n[c], grads.scale[c]);
        grads.shift[c] += d;
        e[c] = d * p.scale[c];
    }
    let (mut sum, mut product) = ([T::ZERO; PARTS], [T::ZERO; PARTS]);
    for (e, n) in e.chunks_exact(PARTS).zip(n.chunks_exact(PARTS)) {
        for l in 0..PARTS {
            sum[l] += e[l];
            product[l] = e[l].mul_add(n[l], product[l]);
        }
    }
    let (mean, slope) = (fold(sum) * inverse_width, fold(product) * inverse_width);
    let mut dx = [T::ZERO; W];
    for c in 0..W {
        dx[c] = s.rstd * ((e[c] - mean) - n[c] * slope);
    }
    dx
}
