//! The path from a decoded slot to its headings allocates nothing once it is warm.

use std::pin::pin;
use std::sync::Arc;
use std::task::{Context, Poll, Waker};
use std::time::Duration;

use futures::FutureExt;
use futures::future::BoxFuture;
use jiff::Timestamp;
use qedgix::learner::{Algorithm, Learner, Preset, TrainConfig};
use qedgix::policy::{LearnedPolicy, Slot};
use qedgix::serving::{Engine, EngineConfig, Error, LoadedPolicy, Outcome, PolicyRef, Room, Task};

const UAVS: usize = 3;
const USERS: usize = 5;

fn policy() -> Arc<LoadedPolicy> {
    let config = TrainConfig::preset(Algorithm::Qedgix, Preset::Practical);
    let learner = Learner::new(&config, 1).expect("a thread");
    let policy = LearnedPolicy::new(config.agent(), config.dims(), learner.agent_parameters().to_vec()).expect("its own");
    let reference = PolicyRef { name: "p".into(), version: 1, digest: [0; 32] };
    Arc::new(LoadedPolicy::baseline(reference, "of a test", Arc::new(policy), Timestamp::UNIX_EPOCH))
}

/// Slot `step` of fleet `fleet`; who sees whom changes from slot to slot.
fn slot(fleet: usize, step: usize) -> Slot {
    let at = |i: usize| [((i * 7 + fleet * 3 + step) % 11) as f64 / 20.0, ((i * 5 + step * 2) % 13) as f64 / 24.0];
    let (uavs, users): (Vec<_>, Vec<_>) = ((0..UAVS).map(at).collect(), (UAVS..UAVS + USERS).map(at).collect());
    Slot::from_scene(&uavs, &users, &[3.0; USERS], 0.28)
}

/// Flies `fleets` fleets together for `steps` slots and returns how often each slot allocated, decoding left out.
fn fly(engine: &Engine, policy: &Arc<LoadedPolicy>, fleets: usize, steps: usize) -> Vec<u64> {
    let fresh = || Outcome {
        memory: vec![0.0; policy.policy.memory_len(UAVS, USERS)],
        headings: Vec::new(),
        q_values: Vec::new(),
        timings: qedgix::serving::Timings::default(),
    };
    let mut last: Vec<Outcome> = (0..fleets).map(|_| fresh()).collect();
    let mut counts = Vec::new();
    for step in 0..steps {
        let mut calls: Vec<Option<BoxFuture<'_, Result<Outcome, Error>>>> = last
            .drain(..)
            .enumerate()
            .map(|(fleet, Outcome { memory, headings, q_values, .. })| {
                let task = Task::new(policy.clone(), slot(fleet, step), step as u64, memory, Room { headings, q_values });
                Some(engine.run(task, None).boxed())
            })
            .collect();
        let mut answers: Vec<Option<Outcome>> = calls.iter().map(|_| None).collect();
        let mut context = Context::from_waker(Waker::noop());
        let counted = allocation_counter::measure(|| {
            while answers.iter().any(Option::is_none) {
                for (call, answer) in calls.iter_mut().zip(&mut answers).filter(|(_, answer)| answer.is_none()) {
                    let Some(waiting) = call else { continue };
                    if let Poll::Ready(outcome) = pin!(waiting).as_mut().poll_unpin(&mut context) {
                        *answer = Some(outcome.expect("an answer"));
                    }
                }
            }
        });
        counts.push(counted.count_total);
        last.extend(answers.into_iter().flatten());
        assert!(last.iter().all(|outcome| outcome.timings.batch_size as usize == fleets), "{last:?}");
    }
    counts
}

#[test]
fn nothing_is_allocated_from_slot_to_headings() {
    let config = EngineConfig { threads: 2, queue: 64, max_batch: 64, max_batch_delay: Duration::ZERO };
    let engine = Engine::start(config).unwrap();
    let policy = policy();
    let together = fly(&engine, &policy, 8, 40);
    assert!(together[0] > 0, "buffers are made once, and counted");
    assert_eq!(together[20..], [0; 20]);
    assert_eq!(fly(&engine, &policy, 1, 40)[20..], [0; 20]);
}
