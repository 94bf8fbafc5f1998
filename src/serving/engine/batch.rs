//! One forward pass over a batch of fleets of one policy version. In steady state it allocates nothing: buffers are the
//! tasks' own or are kept between batches.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::{Duration, Instant};

use metrics::Histogram;

use super::reply::Promise;
use super::{Outcome, Task, Timings};
use crate::policy::Turn;
use crate::serving::{Error, LoadedPolicy};

/// Handles of metrics, kept because making one takes as long as some fleets.
pub(super) struct Meters {
    queue: Histogram,
    compute: Histogram,
    batch_size: Histogram,
}

impl Meters {
    pub(super) fn new() -> Self {
        Self {
            queue: metrics::histogram!("qedgix_act_queue_seconds"),
            compute: metrics::histogram!("qedgix_act_compute_seconds"),
            batch_size: metrics::histogram!("qedgix_act_batch_size"),
        }
    }

    fn record(&self, timings: &Timings) {
        self.queue.record(timings.queue.as_secs_f64());
        self.compute.record(timings.compute.as_secs_f64());
    }
}

/// A fleet that waits.
pub(super) struct Queued {
    pub(super) task: Task,
    pub(super) since: Instant,
    pub(super) deadline: Option<Instant>,
    pub(super) promise: Promise,
}

/// Fleets to be computed together, and room kept from one batch to the next.
#[derive(Default)]
pub(super) struct Batch {
    pub(super) fleets: Vec<Queued>,
    turns: Vec<Turn<'static>>,
}

impl Batch {
    /// Computes all fleets that somebody still waits for, and answers them. Returns how many that were.
    pub(super) fn compute(&mut self, meters: &Meters) -> usize {
        let begun = Instant::now();
        let in_time = |queued: &Queued| queued.deadline.is_none_or(|deadline| begun < deadline);
        if !self.fleets.iter().all(|queued| in_time(queued) && !queued.promise.is_void()) {
            for late in self.fleets.extract_if(.., |queued| !in_time(queued)) {
                late.promise.keep(Err(Error::Deadline("in the engine's queue")));
            }
            self.fleets.retain(|queued| !queued.promise.is_void());
        }
        let Some(first) = self.fleets.first() else { return 0 };
        let policy = first.task.policy.clone();
        let mut turns = recycled(std::mem::take(&mut self.turns));
        turns.extend(self.fleets.iter_mut().map(|queued| queued.task.turn()));
        // What is half-written after a panic is dropped below.
        let decided = catch_unwind(AssertUnwindSafe(|| policy.policy.act(&mut turns)));
        self.turns = recycled(turns);
        let size = self.fleets.len();
        meters.batch_size.record(size as f64);
        let compute = begun.elapsed();
        for Queued { task, since, promise, .. } in self.fleets.drain(..) {
            if decided.is_err() {
                promise.keep(Err(panicked(&policy)));
                continue;
            }
            let timings = Timings { queue: begun - since, compute, batch_size: size as u32 };
            meters.record(&timings);
            promise.keep(Ok(task.done(timings)));
        }
        size
    }
}

/// Computes one fleet for its caller.
pub(super) fn alone(mut task: Task, meters: &Meters) -> Result<Outcome, Error> {
    let begun = Instant::now();
    // What is half-written after a panic is dropped.
    let decided = catch_unwind(AssertUnwindSafe(|| task.policy.clone().policy.act(&mut [task.turn()])));
    meters.batch_size.record(1.0);
    if decided.is_err() {
        return Err(panicked(&task.policy));
    }
    let timings = Timings { queue: Duration::ZERO, compute: begun.elapsed(), batch_size: 1 };
    meters.record(&timings);
    Ok(task.done(timings))
}

fn panicked(policy: &LoadedPolicy) -> Error {
    Error::Fault(format!("policy {} panicked", policy.reference))
}

/// The room of `turns`, for turns of another time: a vector that is collected from its own elements keeps its allocation.
fn recycled<'to>(mut turns: Vec<Turn<'_>>) -> Vec<Turn<'to>> {
    turns.clear();
    turns.into_iter().map(|_| unreachable!("it was cleared")).collect()
}
