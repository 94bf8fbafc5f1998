//! Elementwise functions over whole batches, compiled for the processor's vector units and chosen at run time.

use super::real::Real;

/// Runs `f` compiled for the widest vector unit of this processor. What `f` calls must be `inline(always)` to profit.
#[inline(always)]
pub fn simd<R>(f: impl FnOnce() -> R) -> R {
    pulp::Arch::new().dispatch(f)
}

/// Slope of the leaky ReLU below 0.
const LEAK: f64 = 0.01;

/// x = max(x, 0).
pub fn relu<T: Real>(x: &mut [T]) {
    simd(
        #[inline(always)]
        || x.iter_mut().for_each(|x| *x = x.relu()),
    );
}

/// dx = dy where y > 0, else 0, in place.
pub fn relu_back<T: Real>(y: &[T], dy: &mut [T]) {
    simd(
        #[inline(always)]
        || dy.iter_mut().zip(y).for_each(|(d, &y)| *d = if y > T::ZERO { *d } else { T::ZERO }),
    );
}

/// x = x above 0, 0.01 x below.
pub fn leaky_relu<T: Real>(x: &mut [T]) {
    let leak = T::of(LEAK);
    simd(
        #[inline(always)]
        || x.iter_mut().for_each(|x| *x = if *x > T::ZERO { *x } else { leak * *x }),
    );
}

/// Gradient of the leaky ReLU from its output, in place.
pub fn leaky_relu_back<T: Real>(y: &[T], dy: &mut [T]) {
    let leak = T::of(LEAK);
    simd(
        #[inline(always)]
        || dy.iter_mut().zip(y).for_each(|(d, &y)| *d = if y > T::ZERO { *d } else { leak * *d }),
    );
}

/// ELU: x above 0, e^x - 1 below.
#[inline(always)]
pub fn elu<T: Real>(x: T) -> T {
    let below = x.exp() - T::ONE;
    if x > T::ZERO { x } else { below }
}

/// sums += the sum of `rows`, each as wide as `sums`.
pub(super) fn add_rows<T: Real>(rows: super::Rows<'_, T>, sums: &mut [T]) {
    let width = sums.len();
    simd(
        #[inline(always)]
        || {
            for row in rows.data.chunks(rows.stride.max(1)).take(rows.len) {
                sums.iter_mut().zip(&row[..width]).for_each(|(s, &x)| *s += x);
            }
        },
    );
}
