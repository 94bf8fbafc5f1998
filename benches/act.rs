//! Time of one `Act` without transport, by size of the fleet: conversion of a scene plus forward pass. Run it with
//! `cargo bench --bench act`.
#![allow(missing_docs)] // criterion's macros

use criterion::{Criterion, criterion_group, criterion_main};
use qedgix::learner::{Algorithm, Learner, Preset, TrainConfig};
use qedgix::policy::{FleetGraph, FleetStep, LearnedPolicy, Policy};

fn act(c: &mut Criterion) {
    let mut group = c.benchmark_group("act");
    for (uavs, users) in [(3, 5), (20, 100), (1000, 10_000)] {
        let config = TrainConfig::preset(Algorithm::Qedgix, Preset::Practical);
        let learner = Learner::new(&config, 1).expect("a thread");
        let policy = LearnedPolicy::new(config.agent(), config.dims(), learner.agent_parameters().to_vec()).expect("its own");
        // Ten users per square of the side of the detection range, for all fleet sizes.
        let width = 0.28 * (users as f64 / 10.0).sqrt();
        let spread = |n: usize, step: f64| -> Vec<[f64; 2]> {
            (0..n).map(|i| [(i as f64 * step).fract() * width, (i as f64 + 0.5) / n as f64 * width]).collect()
        };
        let (own, all, aoi) = (spread(uavs, 0.618), spread(users, 0.7548), vec![3.0; users]);
        let mut memory = vec![0.0; policy.memory_len(uavs, users)];
        policy.start(uavs, users, 1, &mut memory);
        let (mut headings, mut graph) = (vec![0; uavs], FleetGraph::default());
        group.bench_function(format!("{uavs} UAVs, {users} users"), |b| {
            b.iter(|| {
                graph.set_scene(&own, &all, &aoi, 0.28);
                let (memory, headings) = (&mut memory[..], &mut headings[..]);
                policy.act(&mut [FleetStep {
                    env: policy.env(),
                    graph: &graph,
                    profile: None,
                    step: 0,
                    memory,
                    headings,
                    q_values: None,
                }]);
            });
        });
    }
    group.finish();
}

criterion_group!(benches, act);
criterion_main!(benches);
