//! Allocations of the engine in steady state: one reply channel per task that is queued, none for a task that is computed
//! inline.

use std::pin::pin;
use std::sync::Arc;
use std::task::{Context, Poll, Waker};
use std::time::Duration;

use futures::FutureExt;
use futures::future::BoxFuture;
use jiff::Timestamp;
use qedgix::learner::{Algorithm, Learner, Preset, TrainConfig};
use qedgix::policy::{FleetGraph, LearnedPolicy};
use qedgix::serving::{
    Decision, Engine, EngineConfig, Error, FleetMemory, LoadedPolicy, OutputBuffers, Owner, PolicyRef, Task, TaskOutput,
};

const UAVS: usize = 3;
const USERS: usize = 5;

fn policy() -> Arc<LoadedPolicy> {
    let config = TrainConfig::preset(Algorithm::Qedgix, Preset::Practical);
    let learner = Learner::new(&config, 1).expect("a thread");
    let policy = LearnedPolicy::new(config.agent(), config.dims(), learner.agent_parameters().to_vec()).expect("its own");
    let reference = PolicyRef { name: "p".into(), version: 1, digest: [0; 32] };
    Arc::new(LoadedPolicy::baseline(reference, "of a test", Arc::new(policy), Timestamp::UNIX_EPOCH))
}

/// Slot `step` of fleet `fleet`. Detections differ from slot to slot.
fn slot(fleet: usize, step: usize) -> FleetGraph {
    let at = |i: usize| [((i * 7 + fleet * 3 + step) % 11) as f64 / 20.0, ((i * 5 + step * 2) % 13) as f64 / 24.0];
    let (uavs, users): (Vec<_>, Vec<_>) = ((0..UAVS).map(at).collect(), (UAVS..UAVS + USERS).map(at).collect());
    FleetGraph::from_scene(&uavs, &users, &[3.0; USERS], 0.28)
}

/// Runs `fleets` fleets concurrently for `steps` slots. Returns the number of allocations of each slot.
fn allocations_per_slot(engine: &Engine, policy: &Arc<LoadedPolicy>, fleets: usize, steps: usize) -> Vec<u64> {
    let plain = || FleetMemory::Plain(vec![0.0; policy.implementation.memory_len(UAVS, USERS)]);
    let fresh = || TaskOutput { memory: plain(), decision: Decision::default() };
    let mut last: Vec<TaskOutput> = (0..fleets).map(|_| fresh()).collect();
    let mut counts = Vec::new();
    for step in 0..steps {
        let mut calls: Vec<Option<BoxFuture<'_, Result<TaskOutput, Error>>>> = last
            .drain(..)
            .enumerate()
            .map(|(fleet, TaskOutput { memory, decision: Decision { headings, q_values, .. } })| {
                let buffers = OutputBuffers { headings, q_values };
                let task = Task::new(policy.clone(), slot(fleet, step).into(), step as u64, memory, buffers);
                Some(engine.run(&Owner::NOBODY, task, None).boxed())
            })
            .collect();
        let mut answers: Vec<Option<TaskOutput>> = calls.iter().map(|_| None).collect();
        let mut context = Context::from_waker(Waker::noop());
        let counted = allocation_counter::measure(|| {
            while answers.iter().any(Option::is_none) {
                for (call, answer) in calls.iter_mut().zip(&mut answers).filter(|(_, answer)| answer.is_none()) {
                    let Some(waiting) = call else { continue };
                    if let Poll::Ready(outcome) = pin!(waiting).as_mut().poll_unpin(&mut context) {
                        *answer = Some(outcome.expect("a decision"));
                    }
                }
            }
        });
        counts.push(counted.count_total);
        last.extend(answers.into_iter().flatten());
        assert!(last.iter().all(|output| output.decision.timings.batch_size as usize == fleets), "{last:?}");
    }
    counts
}

#[test]
fn engine_allocates_only_reply_channels_in_steady_state() {
    let config = EngineConfig { threads: 2, queue: 64, max_batch: 64, max_batch_delay: Duration::ZERO };
    let engine = Engine::start(config).unwrap();
    let policy = policy();
    let batched = allocations_per_slot(&engine, &policy, 8, 40);
    assert!(batched[0] > 0, "the first slot allocates the buffers");
    assert_eq!(batched[20..], [8; 20], "eight tasks are queued per slot");
    // Most single tasks are computed without the queue; one in sixteen is queued to find out whether others join it.
    let single = allocations_per_slot(&engine, &policy, 1, 40);
    assert!(single[20..].iter().sum::<u64>() <= 2, "{single:?}");
}
