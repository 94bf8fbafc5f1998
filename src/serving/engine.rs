//! Where headings are computed: threads of its own behind a bounded queue, so that a large fleet delays no I/O.
//!
//! A thread takes the fleet that waits longest and, with it, whatever waits for the same policy version, into one forward
//! pass; answers are the same bits as alone. By default nobody waits for company: a batch is what has gathered while the
//! threads were busy. Handing a fleet over and its answer back wakes two threads, which takes longer than a small fleet's
//! forward pass: small fleets are computed by the first caller among them, if no more than `threads` compute then.
//!
//! A caller that gave up (its future was dropped, or its deadline passed) is not computed for. A policy that panics is a
//! fault of the server, told to the callers of the batch; the thread goes on.

use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tokio::sync::oneshot::{self, error::TryRecvError};

use super::meters::Meters;
use super::{Error, LoadedPolicy};
use crate::policy::{Slot, Turn};

/// Work of a batch beyond which no further fleet joins it: company must not make a small fleet wait for large ones.
const WORK: usize = 1 << 17;
/// Most work of a batch that a caller computes: well below a millisecond, for its thread serves connections, too.
const SMALL: usize = 1 << 13;
/// What a UAV costs, in units of what a detection does.
const UAV: usize = 32;

/// Limits of an engine.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct EngineConfig {
    /// Threads that compute.
    pub threads: usize,
    /// Fleets that may wait; more are refused.
    pub queue: usize,
    /// Most fleets of a batch.
    pub max_batch: usize,
    /// How long the oldest fleet of a batch may wait for company; zero: not at all.
    pub max_batch_delay: Duration,
}

/// One fleet's turn.
#[derive(Debug)]
pub struct Task {
    /// Who decides.
    pub policy: Arc<LoadedPolicy>,
    /// What is seen.
    pub slot: Slot,
    /// Slots since the episode began.
    pub step: u64,
    /// The fleet's memory.
    pub memory: Vec<f32>,
}

impl Task {
    fn work(&self) -> usize {
        UAV * self.slot.uavs() + self.slot.users() + self.slot.all_detections()
    }

    /// Whether a caller may compute it.
    fn is_small(&self) -> bool {
        self.policy.policy.is_linear() && self.work() <= SMALL
    }
}

/// What came out.
#[derive(Clone, Debug, PartialEq)]
pub struct Outcome {
    /// The memory after the slot.
    pub memory: Vec<f32>,
    /// Heading index of each UAV.
    pub headings: Vec<u8>,
    /// Q-values, A per UAV; NaN where the policy has none.
    pub q_values: Vec<f32>,
    /// How long it took.
    pub timings: Timings,
}

/// How long an answer took.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Timings {
    /// Waiting for the engine.
    pub queue: Duration,
    /// Computing.
    pub compute: Duration,
    /// Fleets computed together.
    pub batch_size: u32,
}

struct Queued {
    task: Task,
    since: Instant,
    deadline: Option<Instant>,
    reply: oneshot::Sender<Result<Outcome, Error>>,
}

impl Queued {
    /// About what it costs, in units of what a detection does.
    fn work(&self) -> usize {
        self.task.work()
    }

    /// Whether somebody still waits for the answer; who waited too long is told.
    fn wanted(self, now: Instant) -> Option<Self> {
        if self.reply.is_closed() {
            return None;
        }
        if self.deadline.is_some_and(|deadline| now >= deadline) {
            let _ = self.reply.send(Err(Error::Deadline("in the engine's queue")));
            return None;
        }
        Some(self)
    }
}

#[derive(Default)]
struct Queue {
    waiting: VecDeque<Queued>,
    /// Batches that are being computed.
    running: usize,
    closed: bool,
}

struct Shared {
    queue: Mutex<Queue>,
    filled: Condvar,
    config: EngineConfig,
    meters: Meters,
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, Queue> {
        // Policies run outside the lock; the queue is whole at every step.
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits for work and puts it into `batch`: fleets of one policy version, the oldest first. False when the engine was
    /// dropped.
    fn next(&self, batch: &mut Vec<Queued>) -> bool {
        let EngineConfig { max_batch, max_batch_delay, .. } = self.config;
        let mut queue = self.lock();
        loop {
            if queue.closed {
                return false;
            }
            let Some(oldest) = queue.waiting.front() else {
                queue = self.filled.wait(queue).unwrap_or_else(PoisonError::into_inner);
                continue;
            };
            let rest = max_batch_delay.saturating_sub(oldest.since.elapsed());
            let alike = |q: &&Queued| Arc::ptr_eq(&q.task.policy, &oldest.task.policy);
            if !rest.is_zero() && queue.waiting.iter().filter(alike).count() < max_batch {
                queue = self.filled.wait_timeout(queue, rest).unwrap_or_else(PoisonError::into_inner).0;
                continue;
            }
            self.gather(&mut queue, batch, WORK);
            // Notices may have been meant for what is left.
            if !queue.waiting.is_empty() {
                self.filled.notify_one();
            }
            return true;
        }
    }

    /// Computes a batch for the caller and others if the oldest fleet is small and not too many compute; whether it did.
    fn lead(&self) -> bool {
        let mut batch = Vec::new();
        {
            let mut queue = self.lock();
            let small = queue.waiting.front().is_some_and(|oldest| oldest.task.is_small());
            if !small || queue.running >= self.config.threads {
                return false;
            }
            self.gather(&mut queue, &mut batch, SMALL);
        }
        self.compute(batch);
        true
    }

    /// Takes the oldest and what joins it up to `most` work, each at its first chance; the others keep their order.
    fn gather(&self, queue: &mut Queue, batch: &mut Vec<Queued>, most: usize) {
        let Some(oldest) = queue.waiting.pop_front() else { return };
        queue.running += 1;
        let mut work = oldest.work();
        batch.push(oldest);
        let mut i = 0;
        while i < queue.waiting.len() && batch.len() < self.config.max_batch {
            let next = &queue.waiting[i];
            if Arc::ptr_eq(&next.task.policy, &batch[0].task.policy) && work + next.work() <= most {
                work += next.work();
                batch.extend(queue.waiting.remove(i));
            } else {
                i += 1;
            }
        }
    }

    /// Counts a fleet that leaves without having been computed for.
    fn unanswered(&self, task: &Task) {
        self.meters.policy(&task.policy.reference.name).failure.increment(1);
    }

    /// One forward pass over a batch.
    fn compute(&self, batch: Vec<Queued>) {
        compute(batch, &self.meters);
        self.lock().running -= 1;
    }
}

/// The engine; dropping it ends its threads after the work they have begun.
pub struct Engine {
    shared: Arc<Shared>,
}

impl Engine {
    /// Starts its threads.
    ///
    /// # Errors
    /// The system refuses a thread.
    pub fn start(config: EngineConfig) -> std::io::Result<Self> {
        let shared = Arc::new(Shared { queue: Mutex::default(), filled: Condvar::new(), config, meters: Meters::new() });
        let engine = Self { shared: shared.clone() };
        for i in 0..config.threads {
            let shared = shared.clone();
            let work = move || {
                let mut batch = Vec::new();
                while shared.next(&mut batch) {
                    shared.compute(std::mem::take(&mut batch));
                }
            };
            std::thread::Builder::new().name(format!("engine-{i}")).spawn(work)?;
        }
        Ok(engine)
    }

    /// Fleets that wait.
    pub fn waiting(&self) -> usize {
        self.shared.lock().waiting.len()
    }

    /// Computes one turn.
    ///
    /// # Errors
    /// The queue is full, the deadline passed, or the policy panicked.
    pub async fn run(&self, task: Task, deadline: Option<Instant>) -> Result<Outcome, Error> {
        let small = task.is_small() && self.shared.config.max_batch_delay.is_zero();
        let (reply, mut answer) = oneshot::channel();
        {
            let mut queue = self.shared.lock();
            let capacity = self.shared.config.queue;
            if queue.waiting.len() >= capacity {
                // Who gave up makes room.
                queue.waiting.retain(|queued| {
                    let wanted = !queued.reply.is_closed();
                    if !wanted {
                        self.shared.unanswered(&queued.task);
                    }
                    wanted
                });
            }
            if queue.waiting.len() >= capacity {
                self.shared.unanswered(&task);
                return Err(Error::Busy(format!("the engine's queue is full ({capacity} fleets)")));
            }
            queue.waiting.push_back(Queued { task, since: Instant::now(), deadline, reply });
        }
        let gone = || Error::Fault("the engine stopped".into());
        if small {
            // Callers that are ready to ask do so before the first of them computes for all.
            tokio::task::yield_now().await;
            loop {
                match answer.try_recv() {
                    Ok(answer) => return answer,
                    Err(TryRecvError::Closed) => return Err(gone()),
                    Err(TryRecvError::Empty) if self.shared.lead() => {}
                    // A thread will; it is told only now, because until now it was not needed.
                    Err(TryRecvError::Empty) => break,
                }
            }
        }
        self.shared.filled.notify_one();
        match deadline {
            None => answer.await.map_err(|_| gone())?,
            Some(deadline) => match tokio::time::timeout_at(deadline.into(), answer).await {
                Ok(answer) => answer.map_err(|_| gone())?,
                Err(_) => Err(Error::Deadline("in the engine's queue")),
            },
        }
    }
}

impl Drop for Engine {
    fn drop(&mut self) {
        self.shared.lock().closed = true;
        // Not joined: nobody waits for an answer any more, and a policy that hangs must not keep the process.
        self.shared.filled.notify_all();
    }
}

impl std::fmt::Debug for Engine {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Engine({:?})", self.shared.config)
    }
}

fn compute(batch: Vec<Queued>, meters: &Meters) {
    let begun = Instant::now();
    let Some(policy) = batch.first().map(|first| first.task.policy.clone()) else { return };
    let meter = meters.policy(&policy.reference.name);
    let asked = batch.len();
    let batch: Vec<Queued> = batch.into_iter().filter_map(|queued| queued.wanted(begun)).collect();
    meter.failure.increment((asked - batch.len()) as u64);
    if batch.is_empty() {
        return;
    }
    let actions = policy.policy.actions();
    let batch_size = batch.len() as u32;
    let mut replies = Vec::with_capacity(batch.len());
    let mut tasks = Vec::with_capacity(batch.len());
    for Queued { task: Task { slot, step, memory, .. }, since, reply, .. } in batch {
        let outcome = Outcome {
            memory,
            headings: vec![0; slot.uavs()],
            q_values: vec![f32::NAN; slot.uavs() * actions],
            timings: Timings { queue: begun - since, compute: Duration::ZERO, batch_size },
        };
        tasks.push((slot, step, outcome));
        replies.push(reply);
    }
    // The tasks are owned by the closure: nothing half-written is seen after a panic.
    let deciding = policy.clone();
    let outcomes = catch_unwind(AssertUnwindSafe(move || {
        let mut turns: Vec<Turn<'_>> = tasks
            .iter_mut()
            .map(|(slot, step, outcome)| Turn {
                slot,
                step: *step,
                memory: &mut outcome.memory,
                headings: &mut outcome.headings,
                q_values: Some(&mut outcome.q_values),
            })
            .collect();
        deciding.policy.act(&mut turns);
        drop(turns);
        let compute = begun.elapsed();
        tasks
            .into_iter()
            .map(move |(_, _, outcome)| Outcome { timings: Timings { compute, ..outcome.timings }, ..outcome })
            .collect::<Vec<_>>()
    }));
    let Ok(outcomes) = outcomes else {
        meter.failure.increment(u64::from(batch_size));
        let fault = || Error::Fault(format!("policy {} panicked", policy.reference));
        return replies.into_iter().for_each(|reply| drop(reply.send(Err(fault()))));
    };
    meters.batch_size.record(f64::from(batch_size));
    meter.passes.increment(1);
    meter.fleets.increment(u64::from(batch_size));
    let mut answered = 0;
    for (reply, outcome) in replies.into_iter().zip(outcomes) {
        meters.queue.record(outcome.timings.queue.as_secs_f64());
        meters.compute.record(outcome.timings.compute.as_secs_f64());
        // A caller that left meanwhile needs no answer.
        answered += u64::from(reply.send(Ok(outcome)).is_ok());
    }
    meter.success.increment(answered);
    meter.failure.increment(u64::from(batch_size) - answered);
}
