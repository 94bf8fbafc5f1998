//! One forward pass over a batch of fleets of one policy version. In steady state it allocates nothing: buffers are the
//! tasks' own or are kept between batches.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::{Duration, Instant};

use super::reply::Promise;
use super::{Outcome, Task, Timings};
use crate::policy::FleetStep;
use crate::serving::meters::Meters;
use crate::serving::{Error, LoadedPolicy};

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
    turns: Vec<FleetStep<'static>>,
}

impl Batch {
    /// Computes all fleets that somebody still waits for, and answers them. Returns how many that were.
    pub(super) fn compute(&mut self, meters: &Meters) -> usize {
        let begun = Instant::now();
        let Some(policy) = self.fleets.first().map(|first| first.task.policy.clone()) else { return 0 };
        let meter = meters.policy(&policy.reference.name);
        let asked = self.fleets.len();
        let in_time = |queued: &Queued| queued.deadline.is_none_or(|deadline| begun < deadline);
        if !self.fleets.iter().all(|queued| in_time(queued) && !queued.promise.is_void()) {
            for late in self.fleets.extract_if(.., |queued| !in_time(queued)) {
                late.promise.keep(Err(Error::Deadline("in the engine's queue")));
            }
            self.fleets.retain(|queued| !queued.promise.is_void());
        }
        let size = self.fleets.len();
        meter.failure.increment((asked - size) as u64);
        if size == 0 {
            return 0;
        }
        let mut turns = recycled(std::mem::take(&mut self.turns));
        turns.extend(self.fleets.iter_mut().map(|queued| queued.task.turn()));
        // What is half-written after a panic is dropped below.
        let decided = catch_unwind(AssertUnwindSafe(|| policy.policy.act(&mut turns)));
        self.turns = recycled(turns);
        let compute = begun.elapsed();
        if decided.is_err() {
            meter.failure.increment(size as u64);
            for queued in self.fleets.drain(..) {
                queued.promise.keep(Err(panicked(&policy)));
            }
            return size;
        }
        meters.pass(&meter, size);
        let mut answered = 0;
        for Queued { task, since, promise, .. } in self.fleets.drain(..) {
            let timings = Timings { queue: begun - since, compute, batch_size: size as u32 };
            meters.times(timings.queue, timings.compute);
            // A caller that left meanwhile needs no answer.
            answered += u64::from(promise.keep(Ok(task.done(timings))));
        }
        meter.success.increment(answered);
        meter.failure.increment(size as u64 - answered);
        size
    }
}

/// Computes one fleet for its caller.
pub(super) fn alone(mut task: Task, meters: &Meters) -> Result<Outcome, Error> {
    let begun = Instant::now();
    let meter = meters.policy(&task.policy.reference.name);
    // What is half-written after a panic is dropped.
    let decided = catch_unwind(AssertUnwindSafe(|| task.policy.clone().policy.act(&mut [task.turn()])));
    if decided.is_err() {
        meter.failure.increment(1);
        return Err(panicked(&task.policy));
    }
    meters.pass(&meter, 1);
    meter.success.increment(1);
    let timings = Timings { queue: Duration::ZERO, compute: begun.elapsed(), batch_size: 1 };
    meters.times(timings.queue, timings.compute);
    Ok(task.done(timings))
}

fn panicked(policy: &LoadedPolicy) -> Error {
    Error::Fault(format!("policy {} panicked", policy.reference))
}

/// The room of `turns`, for turns of another time: a vector that is collected from its own elements keeps its allocation.
fn recycled<'to>(mut turns: Vec<FleetStep<'_>>) -> Vec<FleetStep<'to>> {
    turns.clear();
    turns.into_iter().map(|_| unreachable!("it was cleared")).collect()
}
