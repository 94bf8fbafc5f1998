//! The time of the matrix products of an update alone, with the same shapes on the same number of threads.
//!
//! An update multiplies by every weight four times: forward through the online and the target network, and backward to the weights
//! and to the inputs of the online network. The mixers, about 3 % of the arithmetic, are left out.

use std::hint::black_box;
use std::time::Instant;

use crate::learner::Episodes;
use crate::learner::loss::episodes_per_chunk;
use crate::nn::matmul::{InitialValue, Lhs, Out, Rhs, matmul};
use crate::policy::{Agent, Geometry};

/// The matrix products of an update: a lower bound of its time.
pub(super) struct MatmulTime {
    /// Floating-point operations of all products, in 10^9.
    pub gflop: f64,
    /// Median time of all products, in seconds.
    pub seconds: f64,
}

/// Measures the matrix products of an update with `batch`.
pub(super) fn measure(agent: &Agent, batch: &Episodes, threads: usize, repeat: usize) -> MatmulTime {
    let chunks = batch.len.div_ceil(episodes_per_chunk(batch.uavs));
    let slots = batch.slots + 1;
    let products: Vec<[usize; 3]> = agent
        .products(&geometry(agent, batch), slots)
        .into_iter()
        .map(|[rows, k, columns]| [rows.div_ceil(chunks), k, columns])
        .collect();
    let operations: usize = products.iter().map(|[m, k, n]| 2 * m * k * n).sum();
    let mut seconds: Vec<f64> = (0..repeat).map(|_| multiply(&products, chunks, threads)).collect();
    seconds.sort_by(f64::total_cmp);
    MatmulTime { gflop: (4 * chunks * operations) as f64 * 1e-9, seconds: seconds[repeat / 2] }
}

/// The graphs of all slots of all episodes.
fn geometry(agent: &Agent, ep: &Episodes) -> Geometry {
    let config = agent.geometry_config(&ep.env);
    let mut geometry = Geometry::default();
    geometry.clear();
    for at in 0..ep.len * (ep.slots + 1) {
        let users = if ep.users_move { at } else { at / (ep.slots + 1) };
        let uav_xy = &ep.uav_xy[at * 2 * ep.uavs..][..2 * ep.uavs];
        let user_xy = &ep.user_xy[users * 2 * ep.users..][..2 * ep.users];
        geometry.push_scene(&config, uav_xy, user_xy, &ep.aoi[at * ep.users..][..ep.users]);
    }
    geometry.finish(&config);
    geometry
}

/// Time of the products of `chunks` chunks, in seconds.
fn multiply(products: &[[usize; 3]], chunks: usize, threads: usize) -> f64 {
    let widest = products.iter().map(|[m, k, n]| m * k.max(n)).max().unwrap_or(0);
    let weights = products.iter().map(|[_, k, n]| k * n).max().unwrap_or(0);
    let begin = Instant::now();
    std::thread::scope(|scope| {
        for thread in 0..threads {
            scope.spawn(move || {
                let (x, w) = (vec![0.5_f32; widest], vec![0.25_f32; weights]);
                let (mut y, mut dw) = (vec![0.0; widest], vec![0.0; weights]);
                for _ in (thread..chunks).step_by(threads) {
                    for &[m, k, n] in products {
                        for _ in 0..2 {
                            let out = Out { data: &mut y, stride: n };
                            matmul((m, k, n), Lhs::rows(&x, k), Rhs { data: &w, stride: n }, out, InitialValue::Zero);
                        }
                        let out = Out { data: &mut dw, stride: k };
                        matmul((n, m, k), Lhs::transposed(&x, n), Rhs { data: &x, stride: k }, out, InitialValue::Previous);
                        let out = Out { data: &mut y, stride: k };
                        matmul((m, n, k), Lhs::rows(&x, n), Rhs { data: &w, stride: k }, out, InitialValue::Zero);
                    }
                }
                black_box((y, dw));
            });
        }
    });
    begin.elapsed().as_secs_f64()
}
