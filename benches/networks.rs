//! Time of an update, of a rollout step and of a served answer, at the paper's sizes: `cargo bench --bench networks`.
#![allow(missing_docs)] // criterion's macros

#[path = "../tests/sample/mod.rs"]
mod sample;

use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use qedgix::learner::{Algorithm, Learner, MixerKind, Preset, TrainConfig};
use qedgix::policy::{Actor, Aggregation, Learned, Policy, Slot, StepInput, TOKEN, Turn};
use sample::episodes;

/// What `reference/torch_qedgix.py speed` runs: flat, one-hot, mean, qmix.
fn config(algorithm: Algorithm) -> TrainConfig {
    let mut config = TrainConfig::preset(algorithm, Preset::Paper);
    config.training.aggregation = Aggregation::Mean;
    config.training.mixer = MixerKind::Qmix;
    config
}

const ALGORITHMS: [(&str, Algorithm); 4] =
    [("qedgix", Algorithm::Qedgix), ("qmix", Algorithm::Qmix), ("agggnn", Algorithm::Agggnn), ("rgcn", Algorithm::Rgcn)];

fn update(c: &mut Criterion) {
    let mut group = c.benchmark_group("update of 128 episodes");
    group.sample_size(10);
    for (name, algorithm) in ALGORITHMS {
        let config = config(algorithm);
        let batch = episodes(&config.dims(), 128, 1);
        for threads in [1, 2] {
            let mut learner = Learner::new(&config, threads).expect("threads");
            group.bench_with_input(BenchmarkId::new(name, threads), &batch, |b, batch| b.iter(|| learner.update(batch, 1e-3)));
        }
    }
    group.finish();
}

fn step(c: &mut Criterion) {
    let mut group = c.benchmark_group("rollout step");
    for fleets in [8, 256] {
        for (name, algorithm) in ALGORITHMS {
            let learner = Learner::new(&config(algorithm), 1).expect("a thread");
            let ep = episodes(&config(algorithm).dims(), fleets, 1);
            let (m, n, k) = (ep.uavs, ep.users, ep.slots);
            // Slot K/2 of every episode.
            let middle = |x: &[f32], width: usize| -> Vec<f32> {
                (0..fleets).flat_map(|e| &x[(e * (k + 1) + k / 2) * width..][..width]).copied().collect()
            };
            let (uav_xy, aoi) = (middle(&ep.uav_xy, 2 * m), middle(&ep.aoi, n));
            let mut actor = Actor::new(learner.agent(), fleets);
            actor.begin(learner.agent(), learner.agent_parameters(), &vec![0.0; fleets * m * TOKEN]);
            let input = StepInput { uav_xy: &uav_xy, user_xy: &ep.user_xy, aoi: &aoi };
            group.bench_function(BenchmarkId::new(name, fleets), |b| b.iter(|| actor.step(learner.agent(), input)[0]));
        }
    }
    group.finish();
}

fn act(c: &mut Criterion) {
    let mut group = c.benchmark_group("served answer");
    for (uavs, users) in [(3, 5), (20, 100), (1000, 10_000)] {
        let config = TrainConfig::preset(Algorithm::Qedgix, Preset::Practical);
        let learner = Learner::new(&config, 1).expect("a thread");
        let policy = Learned::new(config.agent(), config.dims(), learner.agent_parameters().to_vec()).expect("its own");
        // One user per 1/10 of a square as wide as the detection range, however many there are.
        let width = 0.28 * (users as f64 / 10.0).sqrt();
        let spread = |n: usize, step: f64| -> Vec<[f64; 2]> {
            (0..n).map(|i| [(i as f64 * step).fract() * width, (i as f64 + 0.5) / n as f64 * width]).collect()
        };
        let (own, all, aoi) = (spread(uavs, 0.618), spread(users, 0.7548), vec![3.0; users]);
        let mut memory = vec![0.0; policy.memory_len(uavs, users)];
        policy.start(uavs, users, 1, &mut memory);
        let (mut headings, mut slot) = (vec![0; uavs], Slot::default());
        group.bench_function(format!("{uavs} UAVs, {users} users"), |b| {
            b.iter(|| {
                slot.set_scene(&own, &all, &aoi, 0.28);
                let (memory, headings) = (&mut memory[..], &mut headings[..]);
                policy.act(&mut [Turn { slot: &slot, step: 0, memory, headings, q_values: None }]);
            });
        });
    }
    group.finish();
}

criterion_group!(benches, update, step, act);
criterion_main!(benches);
