//! Speed of matrix products at the shapes of an update, with every vector width of the processor: `cargo bench --bench products`.
//!
//! One thread. Prints billions of operations per second and their share of the peak, which a loop of independent multiply-adds in
//! registers reaches. Widths and shapes alternate over many rounds; the best round counts, so other load on the machine matters
//! less. Words on the command line select shapes that contain them.

use std::hint::black_box;
use std::time::Instant;

use pulp::{Simd, WithSimd};
use qedgix::nn::VectorWidth;
use qedgix::nn::matmul::{InitialValue, Lhs, Out, Rhs, matmul_with};

/// A product C (m, n) = A (m, k) B (k, n).
struct Shape {
    name: &'static str,
    /// A is stored by columns: the product is the gradient of a weight, added to C.
    transposed: bool,
    size: (usize, usize, usize),
}

const fn shape(name: &'static str, size: (usize, usize, usize)) -> Shape {
    Shape { name, transposed: false, size }
}

const fn gradient(name: &'static str, size: (usize, usize, usize)) -> Shape {
    Shape { name, transposed: true, size }
}

/// A chunk of 8 episodes of the paper's size, 81 slots and 3 UAVs each; one slot of it; and one fleet that is served.
const SHAPES: [Shape; 15] = [
    shape("encoder", (1944, 21, 64)),
    shape("EdgeConv, nodes", (1944, 64, 96)),
    shape("EdgeConv, output", (1944, 96, 64)),
    shape("GRU, input", (1944, 64, 192)),
    shape("GRU, input, backward", (1944, 192, 64)),
    shape("two layers' outputs", (1944, 128, 64)),
    shape("head", (1944, 64, 8)),
    shape("GRU, one slot", (24, 64, 192)),
    shape("GRU, one slot, backward", (24, 128, 64)),
    gradient("encoder, gradient", (64, 1944, 21)),
    gradient("EdgeConv, gradient", (96, 1944, 64)),
    gradient("GRU, gradient", (192, 1944, 64)),
    gradient("head, gradient", (8, 1944, 64)),
    shape("one fleet, EdgeConv", (3, 64, 96)),
    shape("one fleet, GRU", (3, 64, 192)),
];

/// Rounds over all widths and shapes.
const ROUNDS: usize = 20;

/// Independent multiply-adds in registers, as many times as given. Returns their operations.
struct MultiplyAdds(usize);

impl WithSimd for MultiplyAdds {
    type Output = f64;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> f64 {
        let mut sums = [simd.splat_f32s(black_box(0.0)); 12];
        let (factor, term) = (simd.splat_f32s(black_box(0.5)), simd.splat_f32s(black_box(0.25)));
        for _ in 0..self.0 {
            for sum in &mut sums {
                *sum = simd.mul_add_e_f32s(factor, *sum, term);
            }
        }
        black_box(sums.into_iter().fold(0.0, |all, sum| all + simd.reduce_sum_f32s(sum)));
        (2 * S::F32_LANES * sums.len() * self.0) as f64
    }
}

/// Operations per nanosecond of `work`, which returns its operations.
fn rate(work: impl FnOnce() -> f64) -> f64 {
    let begin = Instant::now();
    let operations = work();
    operations / begin.elapsed().as_secs_f64() * 1e-9
}

/// Numbers of A, B and C.
fn matrices(shape: &Shape) -> [Vec<f32>; 3] {
    let (m, k, n) = shape.size;
    let numbers = |len: usize| (0..len).map(|i| ((i * 37 % 101) as f32 - 50.0) / 57.0).collect();
    [numbers(m * k), numbers(k * n), vec![0.0; m * n]]
}

/// Computes the product often enough to be measured. Returns the operations.
fn multiply(width: VectorWidth, shape: &Shape, [a, b, c]: &mut [Vec<f32>; 3]) -> f64 {
    let (m, k, n) = shape.size;
    let operations = 2 * m * k * n;
    let times = (100_000_000 / operations).max(1);
    for _ in 0..times {
        let (lhs, initial) = if shape.transposed {
            (Lhs::transposed(a, m), InitialValue::Previous)
        } else {
            (Lhs::rows(a, k), InitialValue::Zero)
        };
        matmul_with(width, shape.size, (lhs, Rhs { data: b, stride: n }), Out { data: c, stride: n }, initial);
        black_box(&mut *c);
    }
    (times * operations) as f64
}

fn main() {
    let words: Vec<String> = std::env::args().skip(1).filter(|word| !word.starts_with('-')).collect();
    let chosen = |shape: &&Shape| words.is_empty() || words.iter().any(|word| shape.name.contains(word.as_str()));
    let mut shapes: Vec<_> = SHAPES.iter().filter(chosen).map(|shape| (shape, matrices(shape))).collect();
    let widths = VectorWidth::available();
    let mut peaks = vec![0.0_f64; widths.len()];
    let mut rates = vec![vec![0.0_f64; widths.len()]; shapes.len()];
    for _ in 0..ROUNDS {
        for (w, &width) in widths.iter().enumerate() {
            peaks[w] = peaks[w].max(rate(|| width.run(MultiplyAdds(200_000))));
            for ((shape, matrices), rates) in shapes.iter_mut().zip(&mut rates) {
                rates[w] = rates[w].max(rate(|| multiply(width, shape, matrices)));
            }
        }
    }
    // The loop of multiply-adds is not vectorised in the portable form, so it says nothing about the peak there.
    let cell = |rate: f64, w: usize| match widths[w] {
        VectorWidth::Portable => format!("{rate:>9.1}        "),
        _ => format!("{rate:>9.1} ({:>3.0} %)", 100.0 * rate / peaks[w]),
    };
    let row = |name: &str, size: &str, rates: &[f64]| {
        println!("{name:<26}{size:<18}{}", (0..widths.len()).map(|w| cell(rates[w], w)).collect::<String>());
    };
    let names: Vec<String> = widths.iter().map(|width| format!("{:>9}        ", width.name())).collect();
    println!("{:<44}{}", "GFLOP/s", names.concat());
    row("peak", "", &peaks);
    for ((shape, _), rates) in shapes.iter().zip(&rates) {
        let (m, k, n) = shape.size;
        row(shape.name, &format!("{m} x {k} x {n}"), rates);
    }
}
