//! Tests of products against the formula.

use rand::RngExt;

use super::*;

/// Row i, column j of start + A B by the formula, in f64.
fn naive<T: Real>(k: usize, a: impl Fn(usize) -> T, b: impl Fn(usize) -> T, start: T) -> f64 {
    (0..k).map(|k| a(k).to_f64() * b(k).to_f64()).sum::<f64>() + start.to_f64()
}

fn check<T: Real>(tolerance: f64) {
    for width in VectorWidth::available() {
        check_width::<T>(width, tolerance);
    }
}

fn check_width<T: Real>(width: VectorWidth, tolerance: f64) {
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
                        matmul_with(width, (m, k, n), (lhs, rhs), out, start);
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
                            assert!(
                                (c.to_f64() - exact).abs() <= tolerance * (1.0 + k as f64),
                                "{width:?} {m} {k} {n}: {c} {exact}"
                            );
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

/// Rows `rows` of a product of 50 rows.
fn product(width: VectorWidth, rows: std::ops::Range<usize>, k: usize, n: usize) -> Vec<f32> {
    let data: Vec<f32> = (0..50 * k.max(n)).map(|i| ((i * 37 % 101) as f32 - 50.0) / 7.0).collect();
    let b: Vec<f32> = (0..k * n).map(|i| ((i * 53 % 103) as f32 - 51.0) / 9.0).collect();
    let mut c = vec![0.0; rows.len() * n];
    let a = Lhs::rows(&data[rows.start * k..], k);
    let out = Out { data: &mut c, stride: n };
    matmul_with(width, (rows.len(), k, n), (a, Rhs { data: &b, stride: n }), out, InitialValue::Zero);
    c
}

#[test]
fn a_row_has_the_same_bits_in_any_batch() {
    for width in VectorWidth::available() {
        let whole = product(width, 0..50, 64, 33);
        for rows in [0..1, 3..5, 4..7, 7..20, 49..50] {
            assert_eq!(product(width, rows.clone(), 64, 33), whole[rows.start * 33..rows.end * 33], "{width:?} {rows:?}");
        }
    }
}

#[test]
fn all_widths_that_fuse_have_the_same_bits() {
    let mut widths = VectorWidth::available();
    widths.retain(|&width| width != VectorWidth::Portable);
    for (k, n) in [(1, 5), (21, 64), (64, 96), (2 * DEPTH + 1, 23)] {
        let results: Vec<_> = widths.iter().map(|&width| product(width, 0..50, k, n)).collect();
        assert!(results.windows(2).all(|pair| pair[0] == pair[1]), "{widths:?} {k} {n}");
    }
}
