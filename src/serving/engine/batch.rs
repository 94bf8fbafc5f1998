//! What a thread computes at a time: a forward pass over a batch of fleets of one policy version, or another call. In steady state a
//! batch allocates nothing: output buffers belong to the tasks, other buffers are kept between batches.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::sync::oneshot;

use super::metrics::EngineMetrics;
use super::task::{Task, TaskOutput, Timings};
use crate::policy::FleetStep;
use crate::serving::{ComputeTimes, Error, LoadedPolicy, Owner};

/// What waits in the queue.
pub(super) struct Queued {
    pub(super) job: Job,
    /// Estimated cost.
    pub(super) work: usize,
    pub(super) owner: Owner,
    pub(super) since: Instant,
    pub(super) deadline: Option<Instant>,
    /// Its start in virtual time, which the queue sets.
    pub(super) start: u64,
}

impl Queued {
    pub(super) fn new(job: Job, work: usize, owner: &Owner, deadline: Option<Instant>) -> Self {
        Self { job, work, owner: owner.clone(), since: Instant::now(), deadline, start: 0 }
    }
}

/// What a thread computes.
#[allow(clippy::large_enum_variant, reason = "fleets are the common case, and a box would be an allocation per task")]
pub(super) enum Job {
    /// A fleet in one slot.
    Fleet { task: Task, reply: oneshot::Sender<Result<TaskOutput, Error>> },
    /// Any other computation.
    Call(Box<dyn Call>),
}

/// A computation that replies by itself.
pub(super) trait Call: Send {
    /// Computes and replies.
    fn run(self: Box<Self>);

    /// Replies with `error` instead.
    fn refuse(self: Box<Self>, error: Error);

    /// Whether the caller stopped waiting.
    fn is_abandoned(&self) -> bool;
}

impl Job {
    /// Whether the caller stopped waiting.
    pub(super) fn is_abandoned(&self) -> bool {
        match self {
            Self::Fleet { reply, .. } => reply.is_closed(),
            Self::Call(call) => call.is_abandoned(),
        }
    }

    /// Replies with `error`.
    pub(super) fn refuse(self, error: Error) {
        match self {
            Self::Fleet { reply, .. } => {
                // Nothing to do if the caller stopped waiting.
                let _ = reply.send(Err(error));
            }
            Self::Call(call) => call.refuse(error),
        }
    }

    /// Whether both are computed in one forward pass.
    pub(super) fn shares_batch_with(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Fleet { task, .. }, Self::Fleet { task: other, .. }) => Arc::ptr_eq(task.policy(), other.policy()),
            _ => false,
        }
    }
}

/// What a thread has taken from the queue, and buffers that are kept from one batch to the next.
#[derive(Default)]
pub(super) struct TaskBatch {
    /// Fleets of one policy version, or one call.
    pub(super) queued: Vec<Queued>,
    fleets: Vec<Fleet>,
    fleet_steps: Vec<FleetStep<'static>>,
    /// Time in the queue of each fleet, and whether its caller received the decision.
    outcomes: Vec<(Duration, bool)>,
}

/// A fleet of a batch.
struct Fleet {
    task: Task,
    since: Instant,
    reply: oneshot::Sender<Result<TaskOutput, Error>>,
}

impl TaskBatch {
    /// Computes what was taken from the queue, unless the callers stopped waiting, and replies. Returns the number of fleets computed.
    pub(super) fn run(&mut self, metrics: &EngineMetrics) -> usize {
        let started = Instant::now();
        let mut policy = None;
        for Queued { job, since, deadline, .. } in self.queued.drain(..) {
            let late = deadline.is_some_and(|deadline| deadline <= started);
            match job {
                Job::Call(call) if late => call.refuse(Error::Deadline("in the engine's queue")),
                Job::Call(call) if call.is_abandoned() => drop(call),
                Job::Call(call) => call.run(),
                Job::Fleet { mut task, reply } => {
                    let policy = policy.get_or_insert_with(|| task.policy().clone());
                    debug_assert!(Arc::ptr_eq(policy, task.policy()));
                    let prepared = if late { Err(Error::Deadline("in the engine's queue")) } else { Ok(()) };
                    if reply.is_closed() {
                        metrics.record_failure(policy, since.elapsed());
                    } else if let Err(error) = prepared.and_then(|()| prepare(&mut task)) {
                        metrics.record_failure(policy, since.elapsed());
                        // Nothing to do if the caller stopped waiting.
                        let _ = reply.send(Err(error));
                    } else {
                        self.fleets.push(Fleet { task, since, reply });
                    }
                }
            }
        }
        let Some(policy) = policy else { return 0 };
        self.run_fleets(&policy, metrics, started)
    }

    /// Computes all fleets of the batch in one forward pass.
    fn run_fleets(&mut self, policy: &LoadedPolicy, metrics: &EngineMetrics, started: Instant) -> usize {
        let size = self.fleets.len();
        if size == 0 {
            return 0;
        }
        let prepared = Instant::now();
        let mut fleet_steps = recycle(std::mem::take(&mut self.fleet_steps));
        fleet_steps.extend(self.fleets.iter_mut().map(|fleet| fleet.task.as_fleet_step()));
        // Unwind safe: after a panic, the outputs are dropped below.
        let result = catch_unwind(AssertUnwindSafe(|| policy.implementation.act(&mut fleet_steps)));
        self.fleet_steps = recycle(fleet_steps);
        let computed = Instant::now();
        if result.is_err() {
            for fleet in self.fleets.drain(..) {
                metrics.record_failure(policy, computed - fleet.since);
                let _ = fleet.reply.send(Err(panicked(policy)));
            }
            return size;
        }
        let counters = metrics.policy(&policy.reference.name);
        metrics.record_batch(&counters, size);
        let mut received = 0;
        self.outcomes.clear();
        for Fleet { task, since, reply } in self.fleets.drain(..) {
            let timings = Timings { queue: started - since, compute: computed - started, batch_size: size as u32 };
            metrics.record_times(timings.queue, timings.compute);
            // The caller may have stopped waiting during the forward pass.
            let output = finish(task, timings, policy);
            let is_computed = output.is_ok();
            let is_received = reply.send(output).is_ok() && is_computed;
            received += u64::from(is_received);
            self.outcomes.push((timings.queue, is_received));
        }
        counters.success.increment(received);
        counters.failure.increment(size as u64 - received);
        let end = Instant::now();
        let times = ComputeTimes { input: prepared - started, infer: computed - prepared, output: end - computed };
        metrics.of_version(policy).record_batch(self.outcomes.iter().copied(), &times, end);
        size
    }
}

/// As [`Task::prepare`]; a panic is an error as well.
fn prepare(task: &mut Task) -> Result<(), Error> {
    // Unwind safe: after a panic, the task is dropped.
    match catch_unwind(AssertUnwindSafe(|| task.prepare())) {
        Ok(prepared) => Ok(prepared?),
        Err(_) => Err(panicked(task.policy())),
    }
}

/// As [`Task::finish`], which runs constraints, and the policy again to explain; a panic is an error as well.
fn finish(task: Task, timings: Timings, policy: &LoadedPolicy) -> Result<TaskOutput, Error> {
    // Unwind safe: after a panic, nothing of the task remains.
    catch_unwind(AssertUnwindSafe(|| task.finish(timings))).map_err(|_| panicked(policy))
}

/// Computes one task on the caller's thread.
pub(super) fn run_single(mut task: Task, metrics: &EngineMetrics) -> Result<TaskOutput, Error> {
    let started = Instant::now();
    let policy = task.policy().clone();
    if let Err(error) = prepare(&mut task) {
        metrics.record_failure(&policy, started.elapsed());
        return Err(error);
    }
    let prepared = Instant::now();
    // Unwind safe: after a panic, the output is dropped.
    let result = catch_unwind(AssertUnwindSafe(|| policy.implementation.act(&mut [task.as_fleet_step()])));
    let computed = Instant::now();
    if result.is_err() {
        metrics.record_failure(&policy, computed - started);
        return Err(panicked(&policy));
    }
    let timings = Timings { queue: Duration::ZERO, compute: computed - started, batch_size: 1 };
    let output = finish(task, timings, &policy).inspect_err(|_| metrics.record_failure(&policy, started.elapsed()))?;
    let counters = metrics.policy(&policy.reference.name);
    metrics.record_batch(&counters, 1);
    counters.success.increment(1);
    metrics.record_times(timings.queue, timings.compute);
    let end = Instant::now();
    let times = ComputeTimes { input: prepared - started, infer: computed - prepared, output: end - computed };
    metrics.of_version(&policy).record_batch([(Duration::ZERO, true)].into_iter(), &times, end);
    Ok(output)
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
