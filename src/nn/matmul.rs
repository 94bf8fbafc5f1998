//! Matrix products: C = A B, C = bias + A B, C += A B.
//!
//! One kernel serves all three products of a layer, because in each the rows of the right-hand side are contiguous:
//! Y = X Wt (weights are transposed once per update), dX = dY W, dW += dYt X. A tile of C stays in vector registers while the
//! kernel runs over k.
//!
//! Every element of C is summed over k in the same order, for any batch size and any row, by fused multiply-adds. Even and odd
//! terms are summed separately, which lowers the rounding error and hides latency. So a policy's result for a fleet does not
//! depend on the other fleets in the batch. General-purpose products have special cases for few rows and do not guarantee this.
//! The kernel allocates nothing, packs nothing and starts no threads: callers split the work.

use pulp::{Arch, Simd, WithSimd};

use super::real::Real;

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
pub fn matmul<T: Real>(
    (m, k, n): (usize, usize, usize),
    a: Lhs<'_, T>,
    b: Rhs<'_, T>,
    c: Out<'_, T>,
    initial: InitialValue<'_, T>,
) {
    if m == 0 || n == 0 {
        return;
    }
    assert!(c.data.len() >= (m - 1) * c.stride + n && c.stride >= n, "C is too short");
    assert!(k == 0 || a.data.len() > (m - 1) * a.row_stride + (k - 1) * a.col_stride, "A is too short");
    assert!(k == 0 || b.data.len() >= (k - 1) * b.stride + n, "B is too short");
    if let InitialValue::Bias(bias) = initial {
        assert!(bias.len() >= n, "the bias is too short");
    }
    Arch::new().dispatch(Product { m, k, n, a, b, c, initial });
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

impl<T: Real> WithSimd for Product<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let lanes = T::lanes::<S>();
        let mut k0 = 0;
        loop {
            let depth = DEPTH.min(self.k - k0);
            let mut j = 0;
            while j < self.n {
                let left = self.n - j;
                let width = left.min(2 * lanes);
                // For whole vectors the width is known to the compiler, so that only the last columns use masks.
                if left >= 2 * lanes {
                    self.columns::<S, 2>(simd, k0, depth, j, 2 * lanes);
                } else if left == lanes {
                    self.columns::<S, 1>(simd, k0, depth, j, lanes);
                } else if left > lanes {
                    self.columns::<S, 2>(simd, k0, depth, j, left);
                } else {
                    self.columns::<S, 1>(simd, k0, depth, j, left);
                }
                j += width;
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
    /// Columns j..j + width of C, terms k0..k0 + depth of the sums.
    #[inline(always)]
    fn columns<S: Simd, const V: usize>(&mut self, simd: S, k0: usize, depth: usize, j: usize, width: usize) {
        let mut i = 0;
        // Two sets of 6 x 2 sums fit into 32 registers, two sets of 2 x 2 into 16.
        if S::REGISTER_COUNT >= 32 {
            while i + 6 <= self.m {
                self.tile::<S, 6, V>(simd, (i, j, k0), depth, width);
                i += 6;
            }
        }
        while i + 2 <= self.m {
            self.tile::<S, 2, V>(simd, (i, j, k0), depth, width);
            i += 2;
        }
        if i < self.m {
            self.tile::<S, 1, V>(simd, (i, j, k0), depth, width);
        }
    }

    #[inline(always)]
    fn tile<S: Simd, const R: usize, const V: usize>(
        &mut self,
        simd: S,
        (i, j, k0): (usize, usize, usize),
        depth: usize,
        width: usize,
    ) {
        let lanes = T::lanes::<S>();
        let last = width - (V - 1) * lanes;
        let mut sums = [[T::splat(simd, T::ZERO); V]; R];
        match self.initial {
            InitialValue::Zero => {}
            InitialValue::Bias(bias) => {
                for v in 0..V {
                    let at = j + v * lanes;
                    let x = T::load(simd, &bias[at..at + if v + 1 < V { lanes } else { last }]);
                    for row in &mut sums {
                        row[v] = x;
                    }
                }
            }
            InitialValue::Previous => {
                for (r, row) in sums.iter_mut().enumerate() {
                    let c = &self.c.data[(i + r) * self.c.stride + j..][..width];
                    for (v, x) in row.iter_mut().enumerate() {
                        *x = T::load(simd, &c[v * lanes..if v + 1 < V { (v + 1) * lanes } else { width }]);
                    }
                }
            }
        }
        if depth > 0 {
            let b = &self.b.data[k0 * self.b.stride + j..];
            let b_row = |k: usize| &b[k * self.b.stride..][..width];
            let mut odd = [[T::splat(simd, T::ZERO); V]; R];
            if self.a.col_stride == 1 {
                let mut rows: [&[T]; R] = [&[]; R];
                for (r, row) in rows.iter_mut().enumerate() {
                    *row = &self.a.data[(i + r) * self.a.row_stride + k0..][..depth];
                }
                let mut k = 0;
                while k + 1 < depth {
                    accumulate(simd, |r| rows[r][k], b_row(k), &mut sums);
                    accumulate(simd, |r| rows[r][k + 1], b_row(k + 1), &mut odd);
                    k += 2;
                }
                if k < depth {
                    accumulate(simd, |r| rows[r][k], b_row(k), &mut sums);
                }
            } else {
                let a = &self.a.data[i + k0 * self.a.col_stride..];
                let a_row = |k: usize| -> &[T; R] { a[k * self.a.col_stride..][..R].try_into().expect("R numbers") };
                let mut k = 0;
                while k + 1 < depth {
                    let (a, next) = (a_row(k), a_row(k + 1));
                    accumulate(simd, |r| a[r], b_row(k), &mut sums);
                    accumulate(simd, |r| next[r], b_row(k + 1), &mut odd);
                    k += 2;
                }
                if k < depth {
                    let a = a_row(k);
                    accumulate(simd, |r| a[r], b_row(k), &mut sums);
                }
            }
            for (row, odd) in sums.iter_mut().zip(&odd) {
                for (x, &y) in row.iter_mut().zip(odd) {
                    *x = T::add_vectors(simd, *x, y);
                }
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

/// `sums[r]` += a(r) * b.
#[inline(always)]
fn accumulate<T: Real, S: Simd, const R: usize, const V: usize>(
    simd: S,
    a: impl Fn(usize) -> T,
    b: &[T],
    sums: &mut [[T::Vector<S>; V]; R],
) {
    let lanes = T::lanes::<S>();
    let mut row = [T::splat(simd, T::ZERO); V];
    for (v, x) in row.iter_mut().enumerate() {
        *x = T::load(simd, &b[v * lanes..if v + 1 < V { (v + 1) * lanes } else { b.len() }]);
    }
    for r in 0..R {
        let x = T::splat(simd, a(r));
        for v in 0..V {
            sums[r][v] = T::fma(simd, x, row[v], sums[r][v]);
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::RngExt;

    use super::*;

    /// Row i, column j of start + A B by the formula, in f64.
    fn naive<T: Real>(k: usize, a: impl Fn(usize) -> T, b: impl Fn(usize) -> T, start: T) -> f64 {
        (0..k).map(|k| a(k).to_f64() * b(k).to_f64()).sum::<f64>() + start.to_f64()
    }

    fn check<T: Real>(tolerance: f64) {
        let mut stream = crate::rng::stream(3, "matmul", 0);
        let mut draw = |len: usize| -> Vec<T> { (0..len).map(|_| T::from_f64(2.0 * stream.random::<f64>() - 1.0)).collect() };
        for m in [1, 2, 3, 5, 6, 7, 13, 24] {
            for k in [0, 1, 2, 21, 64, DEPTH - 1, DEPTH + 1, 2 * DEPTH] {
                for n in [1, 2, 8, 9, 15, 16, 17, 31, 33, 96] {
                    let (wide_a, wide_b, wide_c) = (k + 3, n + 2, n + 5);
                    let (a, b) = (draw(m.max(k) * (wide_a + m)), draw(k.max(1) * wide_b));
                    let (before, bias) = (draw(m * wide_c), draw(n));
                    for (lhs, place) in [(Lhs::rows(&a, wide_a), (wide_a, 1)), (Lhs::transposed(&a, m + 1), (1, m + 1))] {
                        for start in [InitialValue::Zero, InitialValue::Bias(&bias), InitialValue::Previous] {
                            let mut c = before.clone();
                            let (rhs, out) = (Rhs { data: &b, stride: wide_b }, Out { data: &mut c, stride: wide_c });
                            matmul((m, k, n), lhs, rhs, out, start);
                            for (at, (&c, &before)) in c.iter().zip(&before).enumerate() {
                                let (i, j) = (at / wide_c, at % wide_c);
                                if j >= n {
                                    assert_eq!(c, before, "outside of C");
                                    continue;
                                }
                                let start = match start {
                                    InitialValue::Zero => T::ZERO,
                                    InitialValue::Bias(bias) => bias[j],
                                    InitialValue::Previous => before,
                                };
                                let exact = naive(k, |k| a[i * place.0 + k * place.1], |k| b[k * wide_b + j], start);
                                assert!((c.to_f64() - exact).abs() <= tolerance * (1.0 + k as f64), "{m} {k} {n}: {c} {exact}");
                            }
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn agrees_with_the_formula_in_f32() {
        check::<f32>(1e-6);
    }

    #[test]
    fn agrees_with_the_formula_in_f64() {
        check::<f64>(1e-14);
    }

    #[test]
    fn a_row_has_the_same_bits_in_any_batch() {
        let data: Vec<f32> = (0..50 * 64).map(|i| ((i * 37 % 101) as f32 - 50.0) / 7.0).collect();
        let product = |rows: std::ops::Range<usize>| {
            let mut c = vec![0.0; rows.len() * 33];
            let a = Lhs::rows(&data[rows.start * 64..], 64);
            matmul(
                (rows.len(), 64, 33),
                a,
                Rhs { data: &data, stride: 33 },
                Out { data: &mut c, stride: 33 },
                InitialValue::Zero,
            );
            c
        };
        let whole = product(0..50);
        for rows in [0..1, 3..5, 7..20, 49..50] {
            assert_eq!(product(rows.clone()), whole[rows.start * 33..rows.end * 33]);
        }
    }
}
