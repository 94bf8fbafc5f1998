//! One forward pass over a batch of fleets of one policy version. In steady state it allocates nothing: output buffers belong
//! to the tasks, other buffers are kept between batches.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::{Duration, Instant};

use tokio::sync::oneshot;

use super::metrics::EngineMetrics;
use super::task::{Task, TaskOutput, Timings};
use crate::policy::FleetStep;
use crate::serving::{Error, LoadedPolicy};

/// A task in the queue.
pub(super) struct Queued {
    pub(super) task: Task,
    pub(super) since: Instant,
    pub(super) deadline: Option<Instant>,
    pub(super) reply: oneshot::Sender<Result<TaskOutput, Error>>,
}

/// Tasks to compute together, and buffers that are kept from one batch to the next.
#[derive(Default)]
pub(super) struct TaskBatch {
    pub(super) tasks: Vec<Queued>,
    fleet_steps: Vec<FleetStep<'static>>,
}

impl TaskBatch {
    /// Computes all tasks whose callers still wait, and replies to them. Returns the number of tasks computed.
    pub(super) fn run(&mut self, metrics: &EngineMetrics) -> usize {
        let started = Instant::now();
        let Some(policy) = self.tasks.first().map(|first| first.task.policy().clone()) else { return 0 };
        let counters = metrics.policy(&policy.reference.name);
        let queued = self.tasks.len();
        let in_time = |queued: &Queued| queued.deadline.is_none_or(|deadline| started < deadline);
        if !self.tasks.iter().all(|queued| in_time(queued) && !queued.reply.is_closed()) {
            for late in self.tasks.extract_if(.., |queued| !in_time(queued)) {
                // Nothing to do if the caller stopped waiting.
                let _ = late.reply.send(Err(Error::Deadline("in the engine's queue")));
            }
            self.tasks.retain(|queued| !queued.reply.is_closed());
        }
        let size = self.tasks.len();
        counters.failure.increment((queued - size) as u64);
        if size == 0 {
            return 0;
        }
        let mut fleet_steps = recycle(std::mem::take(&mut self.fleet_steps));
        fleet_steps.extend(self.tasks.iter_mut().map(|queued| queued.task.as_fleet_step()));
        // Unwind safe: after a panic, the outputs are dropped below.
        let result = catch_unwind(AssertUnwindSafe(|| policy.implementation.act(&mut fleet_steps)));
        self.fleet_steps = recycle(fleet_steps);
        let compute = started.elapsed();
        if result.is_err() {
            counters.failure.increment(size as u64);
            for queued in self.tasks.drain(..) {
                let _ = queued.reply.send(Err(panicked(&policy)));
            }
            return size;
        }
        metrics.record_batch(&counters, size);
        let mut received = 0;
        for Queued { task, since, reply, .. } in self.tasks.drain(..) {
            let timings = Timings { queue: started - since, compute, batch_size: size as u32 };
            metrics.record_times(timings.queue, timings.compute);
            // The caller may have stopped waiting during the forward pass.
            received += u64::from(reply.send(Ok(task.finish(timings))).is_ok());
        }
        counters.success.increment(received);
        counters.failure.increment(size as u64 - received);
        size
    }
}

/// Computes one task on the caller's thread.
pub(super) fn run_single(mut task: Task, metrics: &EngineMetrics) -> Result<TaskOutput, Error> {
    let started = Instant::now();
    let policy = task.policy().clone();
    let counters = metrics.policy(&policy.reference.name);
    // Unwind safe: after a panic, the output is dropped.
    let result = catch_unwind(AssertUnwindSafe(|| policy.implementation.act(&mut [task.as_fleet_step()])));
    if result.is_err() {
        counters.failure.increment(1);
        return Err(panicked(&policy));
    }
    metrics.record_batch(&counters, 1);
    counters.success.increment(1);
    let timings = Timings { queue: Duration::ZERO, compute: started.elapsed(), batch_size: 1 };
    metrics.record_times(timings.queue, timings.compute);
    Ok(task.finish(timings))
}

fn panicked(policy: &LoadedPolicy) -> Error {
    Error::Internal(format!("policy {} panicked", policy.reference))
}

/// An empty vector with the allocation of `fleet_steps`, for elements of another lifetime: a vector that is collected from its own
/// elements keeps its allocation.
fn recycle<'to>(mut fleet_steps: Vec<FleetStep<'_>>) -> Vec<FleetStep<'to>> {
    fleet_steps.clear();
    fleet_steps.into_iter().map(|_| unreachable!("the vector is empty")).collect()
}
