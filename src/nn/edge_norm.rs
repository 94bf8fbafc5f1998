//! LayerNorm and ReLU of edges: the formulas and sums of [`layer_norm`](super::layer_norm), to the bit, on rows that are held in
//! vector registers. There are more edges than rows of all other layers, and the compiler keeps arrays in memory.

use pulp::{Simd, WithSimd};

use super::layer_norm::{Affine, PARTS, Stats};
use super::real::Real;
use super::simd::dispatch;

/// Width of a sample.
pub(super) const W: usize = 96;

/// A sample in N vectors.
pub(super) type Row<T, S, const N: usize> = [<T as Real>::Vector<S>; N];

/// Work on samples, compiled for each width of vectors.
pub(super) trait WithRows<T: Real> {
    fn with_rows<S: Simd, const N: usize>(self, simd: S);
}

struct ByLanes<T, Op>(Op, std::marker::PhantomData<T>);

impl<T: Real, Op: WithRows<T>> WithSimd for ByLanes<T, Op> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        match T::lanes::<S>() {
            16 => self.0.with_rows::<S, { W / 16 }>(simd),
            8 => self.0.with_rows::<S, { W / 8 }>(simd),
            4 => self.0.with_rows::<S, { W / 4 }>(simd),
            2 => self.0.with_rows::<S, { W / 2 }>(simd),
            _ => self.0.with_rows::<S, W>(simd),
        }
    }
}

/// Does `work` with the processor's vectors.
pub(super) fn with_rows<T: Real>(work: impl WithRows<T>) {
    dispatch(ByLanes(work, std::marker::PhantomData));
}

/// The numbers of vector c.
#[inline(always)]
fn vector<T, const N: usize>(row: &[T; W], c: usize) -> &[T] {
    &row[c * (W / N)..][..W / N]
}

/// The numbers of vector c.
#[inline(always)]
fn vector_mut<T, const N: usize>(row: &mut [T; W], c: usize) -> &mut [T] {
    &mut row[c * (W / N)..][..W / N]
}

#[inline(always)]
pub(super) fn load<T: Real, S: Simd, const N: usize>(simd: S, from: &[T; W]) -> Row<T, S, N> {
    let mut row = [T::splat(simd, T::ZERO); N];
    for c in 0..N {
        row[c] = T::load(simd, vector::<T, N>(from, c));
    }
    row
}

#[inline(always)]
pub(super) fn store<T: Real, S: Simd, const N: usize>(simd: S, row: &Row<T, S, N>, to: &mut [T; W]) {
    for c in 0..N {
        T::store(simd, vector_mut::<T, N>(to, c), row[c]);
    }
}

/// a + b.
#[inline(always)]
pub(super) fn add<T: Real, S: Simd, const N: usize>(simd: S, mut a: Row<T, S, N>, b: &Row<T, S, N>) -> Row<T, S, N> {
    for c in 0..N {
        a[c] = T::add_vectors(simd, a[c], b[c]);
    }
    a
}

/// x times a number.
#[inline(always)]
pub(super) fn times<T: Real, S: Simd, const N: usize>(simd: S, mut x: Row<T, S, N>, factor: T) -> Row<T, S, N> {
    let factor = T::splat(simd, factor);
    for c in 0..N {
        x[c] = T::mul_vectors(simd, x[c], factor);
    }
    x
}

/// The partial sum that vector c belongs to.
#[inline(always)]
fn part<const N: usize>(c: usize) -> usize {
    c % (PARTS * N / W)
}

/// Mean over the width from the partial sums, which are added by repeated halving.
#[inline(always)]
fn mean<T: Real, S: Simd, const N: usize>(simd: S, mut sums: Row<T, S, N>) -> T {
    let mut vectors = PARTS * N / W;
    while vectors > 1 {
        vectors /= 2;
        for c in 0..vectors {
            sums[c] = T::add_vectors(simd, sums[c], sums[c + vectors]);
        }
    }
    T::sum_lanes(simd, sums[0]) * T::from_f64(1.0 / W as f64)
}

#[inline(always)]
pub(super) fn stats<T: Real, S: Simd, const N: usize>(simd: S, x: &Row<T, S, N>) -> Stats<T> {
    let (mut sum, mut square) = ([T::splat(simd, T::ZERO); N], [T::splat(simd, T::ZERO); N]);
    for c in 0..N {
        sum[part::<N>(c)] = T::add_vectors(simd, sum[part::<N>(c)], x[c]);
    }
    let middle = mean::<T, S, N>(simd, sum);
    for c in 0..N {
        let d = T::sub_vectors(simd, x[c], T::splat(simd, middle));
        square[part::<N>(c)] = T::fma(simd, d, d, square[part::<N>(c)]);
    }
    Stats::new(middle, mean::<T, S, N>(simd, square))
}

/// n = (x - mean) rstd.
#[inline(always)]
fn norm<T: Real, S: Simd>(simd: S, x: T::Vector<S>, s: Stats<T>) -> T::Vector<S> {
    T::mul_vectors(simd, T::sub_vectors(simd, x, T::splat(simd, s.mean)), T::splat(simd, s.rstd))
}

/// LayerNorm and ReLU: relu(g n + b).
#[inline(always)]
pub(super) fn norm_relu<T: Real, S: Simd, const N: usize>(
    simd: S,
    x: &Row<T, S, N>,
    s: Stats<T>,
    p: &Affine<T, W>,
) -> Row<T, S, N> {
    let mut y = *x;
    for c in 0..N {
        let (scale, shift) = (T::load(simd, vector::<T, N>(&p.scale, c)), T::load(simd, vector::<T, N>(&p.shift, c)));
        let open = T::fma(simd, norm(simd, x[c], s), scale, shift);
        y[c] = T::where_positive(simd, open, open);
    }
    y
}

/// Returns dx from x and dy, and adds the gradients of scale and shift.
#[inline(always)]
pub(super) fn norm_relu_back<T: Real, S: Simd, const N: usize>(
    simd: S,
    (x, s): (&Row<T, S, N>, Stats<T>),
    p: &Affine<T, W>,
    dy: &Row<T, S, N>,
    grads: &mut Affine<T, W>,
) -> Row<T, S, N> {
    let zero = [T::splat(simd, T::ZERO); N];
    let (mut n, mut e, mut sum, mut product) = (zero, zero, zero, zero);
    for c in 0..N {
        let (scale, shift) = (T::load(simd, vector::<T, N>(&p.scale, c)), T::load(simd, vector::<T, N>(&p.shift, c)));
        n[c] = norm(simd, x[c], s);
        let d = T::where_positive(simd, T::fma(simd, n[c], scale, shift), dy[c]);
        let to = vector_mut::<T, N>(&mut grads.scale, c);
        let scale_grad = T::fma(simd, d, n[c], T::load(simd, to));
        T::store(simd, to, scale_grad);
        let to = vector_mut::<T, N>(&mut grads.shift, c);
        let shift_grad = T::add_vectors(simd, T::load(simd, to), d);
        T::store(simd, to, shift_grad);
        e[c] = T::mul_vectors(simd, d, scale);
        sum[part::<N>(c)] = T::add_vectors(simd, sum[part::<N>(c)], e[c]);
        product[part::<N>(c)] = T::fma(simd, e[c], n[c], product[part::<N>(c)]);
    }
    let (middle, slope) = (T::splat(simd, mean::<T, S, N>(simd, sum)), T::splat(simd, mean::<T, S, N>(simd, product)));
    let rstd = T::splat(simd, s.rstd);
    for c in 0..N {
        let centred = T::sub_vectors(simd, e[c], middle);
        e[c] = T::mul_vectors(simd, rstd, T::sub_vectors(simd, centred, T::mul_vectors(simd, n[c], slope)));
    }
    e
}
