//! Matrix products: C = A B, C = bias + A B, C += A B.
//!
//! One kernel serves all three products of a layer, because in each the rows of the right-hand side are contiguous:
//! Y = X Wt (weights are transposed once per update), dX = dY W, dW += dYt X. A tile of C stays in vector registers while the
//! kernel runs over k.
//!
//! Every element of C is summed over k in the same order, for any batch size, row and vector width, by fused multiply-adds (by
//! multiplications and additions in the portable form). Even and odd terms are summed separately, which lowers the rounding error
//! and hides latency. So a policy's result for a fleet does not depend on the other fleets in the batch. General-purpose products
//! have special cases for few rows and do not guarantee this. The kernel allocates nothing, packs nothing (panels of B at these
//! sizes fit into the first-level cache as they are) and starts no threads: callers split the work.
//!
//! Tiles have 6 rows. With AVX-512, they are 32 columns wide, and both sets of 6 x 2 sums are in its 32 registers. AVX2 has 16
//! registers and NEON vectors of 4 numbers, so their tiles are 16 columns wide, and the even terms are summed before the odd ones.

use pulp::{Simd, WithSimd};

use super::real::Real;
use super::simd::{VectorWidth, dispatch};

/// A: element (i, k) is `data[i * row_stride + k * col_stride]`; one of the strides is 1.
#[derive(Clone, Copy, Debug)]
pub struct Lhs<'a, T> {
    data: &'a [T],
    row_stride: usize,
    col_stride: usize,
}

impl<'a, T> Lhs<'a, T> {
    /// Rows of `stride` numbers each.
    pub fn rows(data: &'a [T], stride: usize) -> Self {
        Self { data, row_stride: stride, col_stride: 1 }
    }

    /// The transpose of rows of `stride` numbers each.
    pub fn transposed(data: &'a [T], stride: usize) -> Self {
        Self { data, row_stride: 1, col_stride: stride }
    }
}

/// B: element (k, j) is `data[k * stride + j]`.
#[derive(Clone, Copy, Debug)]
pub struct Rhs<'a, T> {
    /// Rows, one after another.
    pub data: &'a [T],
    /// Distance between rows.
    pub stride: usize,
}

/// C: element (i, j) is `data[i * stride + j]`.
#[derive(Debug)]
pub struct Out<'a, T> {
    /// Rows, one after another.
    pub data: &'a mut [T],
    /// Distance between rows.
    pub stride: usize,
}

/// Initial value of the sum over k.
#[derive(Clone, Copy, Debug)]
pub enum InitialValue<'a, T> {
    /// 0.
    Zero,
    /// A bias per column.
    Bias(&'a [T]),
    /// The previous content of C.
    Previous,
}

/// Number of terms summed before a tile is stored: a panel of B of this height fits into the first-level cache.
const DEPTH: usize = 144;

/// C = start + A B for A (m, k), B (k, n), with start from `initial`.
///
/// # Panics
/// If a slice is too short for its shape.
pub fn matmul<T: Real>(shape: (usize, usize, usize), a: Lhs<'_, T>, b: Rhs<'_, T>, c: Out<'_, T>, initial: InitialValue<'_, T>) {
    if let Some(product) = Product::new(shape, (a, b), c, initial) {
        dispatch(product);
    }
}

/// Like [`matmul`], but with vectors of this width, whatever the environment says.
///
/// # Panics
/// If a slice is too short for its shape.
pub fn matmul_with<T: Real>(
    width: VectorWidth,
    shape: (usize, usize, usize),
    (a, b): (Lhs<'_, T>, Rhs<'_, T>),
    c: Out<'_, T>,
    initial: InitialValue<'_, T>,
) {
    if let Some(product) = Product::new(shape, (a, b), c, initial) {
        width.run(product);
    }
}

struct Product<'a, T> {
    m: usize,
    k: usize,
    n: usize,
    a: Lhs<'a, T>,
    b: Rhs<'a, T>,
    c: Out<'a, T>,
    initial: InitialValue<'a, T>,
}

impl<'a, T: Real> Product<'a, T> {
    /// `None` if C is empty.
    fn new(
        (m, k, n): (usize, usize, usize),
        (a, b): (Lhs<'a, T>, Rhs<'a, T>),
        c: Out<'a, T>,
        initial: InitialValue<'a, T>,
    ) -> Option<Self> {
        if m == 0 || n == 0 {
            return None;
        }
        assert!(c.data.len() >= (m - 1) * c.stride + n && c.stride >= n, "C is too short");
        assert!(k == 0 || a.data.len() > (m - 1) * a.row_stride + (k - 1) * a.col_stride, "A is too short");
        assert!(a.col_stride == 1 || a.col_stride >= m, "rows of A overlap");
        assert!(k == 0 || b.data.len() >= (k - 1) * b.stride + n && b.stride >= n, "B is too short");
        if let InitialValue::Bias(bias) = initial {
            assert!(bias.len() >= n, "the bias is too short");
        }
        Some(Self { m, k, n, a, b, c, initial })
    }
}

impl<T: Real> WithSimd for Product<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let mut k0 = 0;
        loop {
            let depth = DEPTH.min(self.k - k0);
            if S::F32_LANES >= 8 {
                self.terms::<S, 2>(simd, k0, depth);
            } else {
                self.terms::<S, 4>(simd, k0, depth);
            }
            k0 += depth;
            if k0 >= self.k {
                return;
            }
            self.initial = InitialValue::Previous;
        }
    }
}

impl<T: Real> Product<'_, T> {
    /// Terms k0..k0 + depth of all sums, for V vectors of columns at a time.
    #[inline(always)]
    fn terms<S: Simd, const V: usize>(&mut self, simd: S, k0: usize, depth: usize) {
        let lanes = T::lanes::<S>();
        let mut j = 0;
        while j < self.n {
            let left = self.n - j;
            // For whole vectors the width is known to the compiler, so that only the last columns use masks.
            if left >= V * lanes {
                self.columns::<S, V>(simd, (j, k0), depth, V * lanes);
            } else if left > 2 * lanes {
                self.columns::<S, V>(simd, (j, k0), depth, left);
            } else if left > lanes {
                self.columns::<S, 2>(simd, (j, k0), depth, left);
            } else if left == lanes {
                self.columns::<S, 1>(simd, (j, k0), depth, lanes);
            } else {
                self.columns::<S, 1>(simd, (j, k0), depth, left);
            }
            j += V * lanes;
        }
    }

    /// Columns j..j + width of C.
    #[inline(always)]
    fn columns<S: Simd, const V: usize>(&mut self, simd: S, (j, k0): (usize, usize), depth: usize, width: usize) {
        let mut i = 0;
        while i + 6 <= self.m {
            self.tile::<S, 6, V>(simd, (i, j, k0), depth, width);
            i += 6;
        }
        if i + 3 <= self.m {
            self.tile::<S, 3, V>(simd, (i, j, k0), depth, width);
            i += 3;
        }
        while i + 2 <= self.m {
            self.tile::<S, 2, V>(simd, (i, j, k0), depth, width);
            i += 2;
        }
        if i < self.m {
            self.tile::<S, 1, V>(simd, (i, j, k0), depth, width);
        }
    }

    /// Rows i..i + R and columns j..j + width of C.
    #[inline(always)]
    fn tile<S: Simd, const R: usize, const V: usize>(
        &mut self,
        simd: S,
        (i, j, k0): (usize, usize, usize),
        depth: usize,
        width: usize,
    ) {
        let lanes = T::lanes::<S>();
        let mut sums = [[T::splat(simd, T::ZERO); V]; R];
        match self.initial {
            InitialValue::Zero => {}
            InitialValue::Bias(bias) => sums = [load_row::<T, S, V>(simd, &bias[j..][..width]); R],
            InitialValue::Previous => {
                for (r, row) in sums.iter_mut().enumerate() {
                    *row = load_row::<T, S, V>(simd, &self.c.data[(i + r) * self.c.stride + j..][..width]);
                }
            }
        }
        if depth > 0 {
            let b = Strided { data: &self.b.data[k0 * self.b.stride + j..], stride: self.b.stride };
            if self.a.col_stride == 1 {
                let mut rows: [&[T]; R] = [&[]; R];
                for (r, row) in rows.iter_mut().enumerate() {
                    *row = &self.a.data[(i + r) * self.a.row_stride + k0..][..depth];
                }
                b.add_products::<S, R, V>(simd, (depth, width), RowMajor(rows), &mut sums);
            } else {
                let a = Strided { data: &self.a.data[i + k0 * self.a.col_stride..], stride: self.a.col_stride };
                b.add_products::<S, R, V>(simd, (depth, width), a, &mut sums);
            }
        }
        for (r, row) in sums.iter().enumerate() {
            let c = &mut self.c.data[(i + r) * self.c.stride + j..][..width];
            for (v, x) in row.iter().enumerate() {
                T::store(simd, &mut c[v * lanes..if v + 1 < V { (v + 1) * lanes } else { width }], *x);
            }
        }
    }
}

/// Columns of R rows of A, in pairs.
trait Columns<T, const R: usize>: Copy {
    /// A pair of columns.
    type Pair: Copy;

    /// The first `count` pairs.
    fn pairs(self, count: usize) -> impl Iterator<Item = Self::Pair> + Clone;

    /// Row r of a column of a pair.
    fn of_pair(self, pair: Self::Pair, odd: bool, r: usize) -> T;

    /// Row r of column k.
    fn at(self, k: usize, r: usize) -> T;
}

/// R rows of equal length.
#[derive(Clone, Copy)]
struct RowMajor<'a, T, const R: usize>([&'a [T]; R]);

impl<T: Real, const R: usize> Columns<T, R> for RowMajor<'_, T, R> {
    type Pair = usize;

    #[inline(always)]
    fn pairs(self, count: usize) -> impl Iterator<Item = usize> + Clone {
        0..count
    }

    #[inline(always)]
    fn of_pair(self, pair: usize, odd: bool, r: usize) -> T {
        self.0[r][2 * pair + usize::from(odd)]
    }

    #[inline(always)]
    fn at(self, k: usize, r: usize) -> T {
        self.0[r][k]
    }
}

/// Rows of numbers, `stride` apart. The last one may end early.
#[derive(Clone, Copy)]
struct Strided<'a, T> {
    data: &'a [T],
    stride: usize,
}

impl<'a, T: Real, const R: usize> Columns<T, R> for Strided<'a, T> {
    type Pair = &'a [T];

    #[inline(always)]
    fn pairs(self, count: usize) -> impl Iterator<Item = &'a [T]> + Clone {
        self.data.chunks_exact(2 * self.stride).take(count)
    }

    #[inline(always)]
    fn of_pair(self, pair: &'a [T], odd: bool, r: usize) -> T {
        pair[usize::from(odd) * self.stride..][..R][r]
    }

    #[inline(always)]
    fn at(self, k: usize, r: usize) -> T {
        self.data[k * self.stride..][..R][r]
    }
}

impl<T: Real> Strided<'_, T> {
    /// Adds `depth` products of a column of A and a row of B, which is `self`, to `sums`.
    #[inline(always)]
    fn add_products<S: Simd, const R: usize, const V: usize>(
        self,
        simd: S,
        (depth, width): (usize, usize),
        a: impl Columns<T, R>,
        sums: &mut [[T::Vector<S>; V]; R],
    ) {
        let mut odd = [[T::splat(simd, T::ZERO); V]; R];
        // The last pair is apart, because the last row of B may be shorter than the stride.
        let stride = self.stride;
        let pairs = (depth - 1) / 2;
        let b = self.data.chunks_exact(2 * stride);
        // Both sets of sums, a row of B and a number of A.
        if 2 * R * V + V < S::REGISTER_COUNT {
            for (a_pair, b) in a.pairs(pairs).zip(b) {
                accumulate(
                    simd,
                    #[inline(always)]
                    |r| a.of_pair(a_pair, false, r),
                    &b[..width],
                    sums,
                );
                accumulate(
                    simd,
                    #[inline(always)]
                    |r| a.of_pair(a_pair, true, r),
                    &b[stride..][..width],
                    &mut odd,
                );
            }
        } else {
            for (a_pair, b) in a.pairs(pairs).zip(b.clone()) {
                accumulate(
                    simd,
                    #[inline(always)]
                    |r| a.of_pair(a_pair, false, r),
                    &b[..width],
                    sums,
                );
            }
            // The compiler must keep these sums in memory now, or there are not enough registers for the odd ones.
            *sums = std::hint::black_box(*sums);
            for (a_pair, b) in a.pairs(pairs).zip(b) {
                accumulate(
                    simd,
                    #[inline(always)]
                    |r| a.of_pair(a_pair, true, r),
                    &b[stride..][..width],
                    &mut odd,
                );
            }
        }
        accumulate(
            simd,
            #[inline(always)]
            |r| a.at(2 * pairs, r),
            &self.data[2 * pairs * stride..][..width],
            sums,
        );
        if depth % 2 == 0 {
            accumulate(
                simd,
                #[inline(always)]
                |r| a.at(depth - 1, r),
                &self.data[(depth - 1) * stride..][..width],
                &mut odd,
            );
        }
        for (row, odd) in sums.iter_mut().zip(&odd) {
            for (x, &y) in row.iter_mut().zip(odd) {
                *x = T::add_vectors(simd, *x, y);
            }
        }
    }
}

/// Loads V vectors; the last one may be shorter.
#[inline(always)]
fn load_row<T: Real, S: Simd, const V: usize>(simd: S, from: &[T]) -> [T::Vector<S>; V] {
    let lanes = T::lanes::<S>();
    let mut row = [T::splat(simd, T::ZERO); V];
    for (v, x) in row.iter_mut().enumerate() {
        *x = T::load(simd, &from[v * lanes..if v + 1 < V { (v + 1) * lanes } else { from.len() }]);
    }
    row
}

/// `sums[r]` += a(r) * b.
#[inline(always)]
fn accumulate<T: Real, S: Simd, const R: usize, const V: usize>(
    simd: S,
    a: impl Fn(usize) -> T,
    b: &[T],
    sums: &mut [[T::Vector<S>; V]; R],
) {
    let row = load_row::<T, S, V>(simd, b);
    for r in 0..R {
        let x = T::splat(simd, a(r));
        for v in 0..V {
            sums[r][v] = T::fma(simd, x, row[v], sums[r][v]);
        }
    }
}

#[cfg(test)]
mod tests;
