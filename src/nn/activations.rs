//! Activation functions and their derivatives, over whole batches.

use super::real::Real;
use super::simd::simd;

/// Slope of the leaky ReLU below 0.
const LEAK: f64 = 0.01;

/// x = max(x, 0).
pub fn relu<T: Real>(x: &mut [T]) {
    simd(
        #[inline(always)]
        || x.iter_mut().for_each(|x| *x = x.relu()),
    );
}

/// Derivative of the ReLU from its output y: sets dy to 0 where y <= 0.
pub fn relu_back<T: Real>(y: &[T], dy: &mut [T]) {
    simd(
        #[inline(always)]
        || dy.iter_mut().zip(y).for_each(|(d, &y)| *d = if y > T::ZERO { *d } else { T::ZERO }),
    );
}

/// x = x if x > 0, else 0.01 x.
pub fn leaky_relu<T: Real>(x: &mut [T]) {
    let leak = T::from_f64(LEAK);
    simd(
        #[inline(always)]
        || x.iter_mut().for_each(|x| *x = if *x > T::ZERO { *x } else { leak * *x }),
    );
}

/// Derivative of the leaky ReLU from its output y: multiplies dy by 0.01 where y <= 0.
pub fn leaky_relu_back<T: Real>(y: &[T], dy: &mut [T]) {
    let leak = T::from_f64(LEAK);
    simd(
        #[inline(always)]
        || dy.iter_mut().zip(y).for_each(|(d, &y)| *d = if y > T::ZERO { *d } else { leak * *d }),
    );
}

/// ELU: x if x > 0, else e^x - 1.
#[inline(always)]
pub fn elu<T: Real>(x: T) -> T {
    let below = x.exp() - T::ONE;
    if x > T::ZERO { x } else { below }
}

/// Derivative of the ELU, from its output.
#[inline(always)]
pub fn elu_slope<T: Real>(y: T) -> T {
    if y > T::ZERO { T::ONE } else { y + T::ONE }
}

/// Index of the largest value; of equal values the first; 0 for an empty slice.
pub fn argmax<T: PartialOrd>(x: &[T]) -> usize {
    (1..x.len()).fold(0, |best, i| if x[i] > x[best] { i } else { best })
}
