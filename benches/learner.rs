//! Time of an update and of a rollout step, by algorithm, fleet size, batch and threads: `cargo bench --bench learner`.
#![allow(missing_docs)] // criterion's macros

#[path = "../tests/sample/mod.rs"]
mod sample;

use std::time::Duration;

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use qedgix::learner::{Algorithm, Learner, MixerKind, Preset, TrainConfig};
use qedgix::policy::{Aggregation, BatchedAgent, Identity, ObservationKind, StepInput, TOKEN};
use sample::episodes;

/// The configuration of docs/performance.md: flat, one-hot, mean, qmix.
fn config(algorithm: Algorithm) -> TrainConfig {
    let mut config = TrainConfig::preset(algorithm, Preset::Paper);
    config.training.aggregation = Aggregation::Mean;
    config.training.mixer = MixerKind::Qmix;
    config
}

/// Networks that fit a fleet of any size.
fn sized(uavs: usize, users: usize, range: f64) -> TrainConfig {
    let mut config = config(Algorithm::Qedgix);
    config.training.observation = ObservationKind::Set;
    config.training.identity = Identity::Phase;
    config.training.mixer = MixerKind::Invariant;
    config.environment.uavs = uavs;
    config.environment.users = users;
    config.environment.detection_range = range;
    config
}

const ALGORITHMS: [(&str, Algorithm); 4] =
    [("qedgix", Algorithm::Qedgix), ("qmix", Algorithm::Qmix), ("agggnn", Algorithm::Agggnn), ("rgcn", Algorithm::Rgcn)];

fn update(c: &mut Criterion) {
    let mut measure = |group: &str, name: String, config: &TrainConfig, batch: usize, threads: usize| {
        let mut group = c.benchmark_group(group);
        group.sample_size(10).warm_up_time(Duration::from_secs(1)).measurement_time(Duration::from_secs(2));
        // Nodes times slots, of all episodes.
        group.throughput(Throughput::Elements((batch * config.environment.nodes() * config.environment.slots) as u64));
        let episodes = episodes(&config.dims(), batch, 1);
        let mut learner = Learner::new(config, threads).expect("threads");
        group.bench_function(name, |b| b.iter(|| learner.update(std::slice::from_ref(&episodes), 1e-3)));
        group.finish();
    };
    for (name, algorithm) in ALGORITHMS {
        for threads in [1, 2] {
            measure("update of 128, by algorithm and threads", format!("{name}/{threads}"), &config(algorithm), 128, threads);
        }
    }
    for batch in [8, 32, 128] {
        measure("update, by batch", batch.to_string(), &config(Algorithm::Qedgix), batch, 2);
    }
    // Larger fleets in the same area: the number of edges per node grows with V.
    for (uavs, users, range) in [(2, 4, 0.28), (3, 5, 0.28), (4, 8, 0.28), (8, 32, 0.1), (16, 64, 0.1), (32, 128, 0.1)] {
        measure("update of 8, by size", format!("{uavs} UAVs, {users} users"), &sized(uavs, users, range), 8, 2);
    }
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
            let mut batched_agent = BatchedAgent::new(learner.agent(), config(algorithm).dims(), fleets);
            batched_agent.begin(learner.agent(), learner.agent_parameters(), &vec![0.0; fleets * m * TOKEN]);
            let input = StepInput { uav_xy: &uav_xy, user_xy: &ep.user_xy, aoi: &aoi };
            group.bench_function(BenchmarkId::new(name, fleets), |b| b.iter(|| batched_agent.step(learner.agent(), input)[0]));
        }
    }
    group.finish();
}

criterion_group!(benches, update, step);
criterion_main!(benches);
