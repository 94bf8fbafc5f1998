//! Runs policies on threads of its own behind a bounded queue, so that a large fleet does not delay I/O.
//!
//! A thread takes the task that has waited longest, adds waiting tasks of the same policy version, and computes them in one
//! forward pass; results are bit-identical to computing each alone. By default a batch consists of the tasks that arrived
//! while the threads were busy; no task waits for others to join.
//!
//! Handing a task to another thread and its result back takes longer than the forward pass of a small fleet. Small fleets are
//! therefore computed inline, on the thread of the first caller among them, as long as no more than `threads` computations
//! run at once.
//!
//! A task is not computed if its caller stopped waiting (its future was dropped, or its deadline passed). If a policy panics,
//! all callers of the batch receive [`Error::Internal`] and the thread continues.

mod batch;
mod metrics;
mod task;

pub use task::{Decision, OutputBuffers, Task, TaskOutput, Timings};

use std::collections::VecDeque;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use batch::{Queued, TaskBatch};
use metrics::EngineMetrics;
use tokio::sync::oneshot;
use tokio::sync::oneshot::error::TryRecvError;

use super::Error;

/// Maximum work of a batch. A higher limit would delay small fleets that share a batch with large ones.
const MAX_BATCH_WORK: usize = 1 << 17;
/// Maximum work of a batch that is computed inline: well below a millisecond, because the caller's thread also serves
/// connections.
const MAX_INLINE_WORK: usize = 1 << 13;
/// A small task normally yields to other callers before it is computed, so that their tasks can join its batch. This costs as
/// much as a forward pass. After this many inline batches of one task, small tasks no longer yield.
const SINGLES_BEFORE_SKIP: u32 = 4;
/// One in this many small tasks yields nevertheless, to notice other callers.
const BATCHING_PROBE_INTERVAL: u32 = 16;

/// Limits of an engine.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct EngineConfig {
    /// Computing threads.
    pub threads: usize,
    /// Maximum number of tasks in the queue; more are rejected.
    pub queue: usize,
    /// Maximum number of fleets in a batch.
    pub max_batch: usize,
    /// How long the oldest task may wait for others to join its batch; zero: not at all.
    pub max_batch_delay: Duration,
}

#[derive(Default)]
struct Queue {
    waiting: VecDeque<Queued>,
    /// Batches that are being computed.
    running: usize,
    /// Batches that were computed inline, kept for their buffers.
    spare_batches: Vec<TaskBatch>,
    closed: bool,
}

/// State that callers and threads share.
struct EngineState {
    queue: Mutex<Queue>,
    /// Notified when a thread may have work.
    queued: Condvar,
    /// Inline batches of one since the last inline batch of several.
    single_batches: AtomicU32,
    config: EngineConfig,
    metrics: EngineMetrics,
}

impl EngineState {
    fn lock(&self) -> MutexGuard<'_, Queue> {
        // Policies run outside the lock, and nothing else panics while holding it.
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits for work and moves tasks of one policy version into `batch`, the oldest first. Returns false if the engine was
    /// dropped.
    fn next_batch(&self, batch: &mut TaskBatch) -> bool {
        let EngineConfig { max_batch, max_batch_delay, .. } = self.config;
        let mut queue = self.lock();
        loop {
            if queue.closed {
                return false;
            }
            let Some(oldest) = queue.waiting.front() else {
                queue = self.queued.wait(queue).unwrap_or_else(PoisonError::into_inner);
                continue;
            };
            let rest = max_batch_delay.saturating_sub(oldest.since.elapsed());
            let same_policy = |q: &&Queued| Arc::ptr_eq(q.task.policy(), oldest.task.policy());
            if !rest.is_zero() && queue.waiting.iter().filter(same_policy).count() < max_batch {
                queue = self.queued.wait_timeout(queue, rest).unwrap_or_else(PoisonError::into_inner).0;
                continue;
            }
            self.fill(&mut queue, batch, MAX_BATCH_WORK);
            // This thread may have consumed the notification for a task that is still in the queue.
            if !queue.waiting.is_empty() {
                self.queued.notify_one();
            }
            return true;
        }
    }

    /// Moves the oldest task and the tasks of its policy version into `batch`, up to `max_work`. Other tasks keep their order.
    fn fill(&self, queue: &mut Queue, batch: &mut TaskBatch, max_work: usize) {
        let Some(oldest) = queue.waiting.pop_front() else { return };
        queue.running += 1;
        let mut work = oldest.task.work();
        let tasks = &mut batch.tasks;
        tasks.push(oldest);
        let mut i = 0;
        while i < queue.waiting.len() && tasks.len() < self.config.max_batch {
            let next = &queue.waiting[i].task;
            if Arc::ptr_eq(next.policy(), tasks[0].task.policy()) && work + next.work() <= max_work {
                work += next.work();
                tasks.extend(queue.waiting.remove(i));
            } else {
                i += 1;
            }
        }
    }

    /// Counts a task that leaves the queue without being computed.
    fn count_failure(&self, task: &Task) {
        self.metrics.policy(&task.policy().reference.name).failure.increment(1);
    }

    /// Reserves one of the concurrent computations for [`EngineState::run_inline`], if nothing waits.
    fn reserve_inline(&self) -> bool {
        let mut queue = self.lock();
        let free = queue.waiting.is_empty() && queue.running < self.config.threads;
        queue.running += usize::from(free);
        free
    }

    /// Computes one task on this thread. [`EngineState::reserve_inline`] has returned true.
    fn run_inline(&self, task: Task) -> Result<TaskOutput, Error> {
        let output = batch::run_single(task, &self.metrics);
        self.single_batches.fetch_add(1, Ordering::Relaxed);
        self.lock().running -= 1;
        output
    }

    /// Computes a batch on this thread, if the oldest task is small and fewer than `threads` computations run. Returns
    /// whether it did.
    fn run_batch_inline(&self) -> bool {
        let mut batch = {
            let mut queue = self.lock();
            let small = queue.waiting.front().is_some_and(|oldest| is_small(&oldest.task));
            if !small || queue.running >= self.config.threads {
                return false;
            }
            let mut batch = queue.spare_batches.pop().unwrap_or_default();
            self.fill(&mut queue, &mut batch, MAX_INLINE_WORK);
            batch
        };
        let size = batch.run(&self.metrics);
        if size > 1 {
            self.single_batches.store(0, Ordering::Relaxed);
        } else {
            self.single_batches.fetch_add(1, Ordering::Relaxed);
        }
        let mut queue = self.lock();
        queue.running -= 1;
        queue.spare_batches.push(batch);
        true
    }

    /// Whether a small task should yield so that others can join its batch: after a recent batch of several tasks, and at regular
    /// intervals.
    fn expects_batch(&self) -> bool {
        let single_batches = self.single_batches.load(Ordering::Relaxed);
        single_batches < SINGLES_BEFORE_SKIP || single_batches.is_multiple_of(BATCHING_PROBE_INTERVAL)
    }

    fn enqueue(&self, task: Task, deadline: Option<Instant>) -> Result<oneshot::Receiver<Result<TaskOutput, Error>>, Error> {
        let mut queue = self.lock();
        let capacity = self.config.queue;
        if queue.waiting.len() >= capacity {
            // Remove tasks whose callers stopped waiting.
            queue.waiting.retain(|queued| {
                let closed = queued.reply.is_closed();
                if closed {
                    self.count_failure(&queued.task);
                }
                !closed
            });
        }
        if queue.waiting.len() >= capacity {
            self.count_failure(&task);
            return Err(Error::Busy(format!("the engine's queue is full ({capacity} fleets)")));
        }
        let (reply, receiver) = oneshot::channel();
        queue.waiting.push_back(Queued { task, since: Instant::now(), deadline, reply });
        Ok(receiver)
    }
}

/// Whether a task may be computed inline.
fn is_small(task: &Task) -> bool {
    task.policy().implementation.is_cheap() && task.work() <= MAX_INLINE_WORK
}

/// The error of a caller whose task was dropped without a reply: a bug in the engine.
fn lost_request() -> Error {
    Error::Internal("the engine lost a request".into())
}

/// Wakes a thread when a caller stops waiting, so that its task leaves the queue soon.
struct AbandonGuard<'a> {
    shared: &'a EngineState,
    replied: bool,
}

impl Drop for AbandonGuard<'_> {
    fn drop(&mut self) {
        if !self.replied {
            self.shared.queued.notify_one();
        }
    }
}

/// The engine. Dropping it stops its threads after their current batches.
pub struct Engine {
    shared: Arc<EngineState>,
}

impl Engine {
    /// Starts the engine's threads.
    ///
    /// # Errors
    /// If the system cannot create a thread.
    pub fn start(config: EngineConfig) -> std::io::Result<Self> {
        let shared = Arc::new(EngineState {
            queue: Mutex::default(),
            queued: Condvar::new(),
            single_batches: AtomicU32::new(0),
            config,
            metrics: EngineMetrics::new(),
        });
        let engine = Self { shared: shared.clone() };
        for i in 0..config.threads {
            let shared = shared.clone();
            let work = move || {
                let mut batch = TaskBatch::default();
                while shared.next_batch(&mut batch) {
                    batch.run(&shared.metrics);
                    shared.lock().running -= 1;
                }
            };
            std::thread::Builder::new().name(format!("engine-{i}")).spawn(work)?;
        }
        Ok(engine)
    }

    /// Number of tasks in the queue.
    pub fn waiting(&self) -> usize {
        self.shared.lock().waiting.len()
    }

    /// Runs the policy of `task`.
    ///
    /// # Errors
    /// [`Error::Busy`] if the queue is full, [`Error::Deadline`] if the deadline passes, [`Error::Internal`] if the policy
    /// panics.
    pub async fn run(&self, task: Task, deadline: Option<Instant>) -> Result<TaskOutput, Error> {
        let shared = &*self.shared;
        if deadline.is_some_and(|deadline| deadline <= Instant::now()) {
            return Err(Error::Deadline("before the engine's queue"));
        }
        let small = is_small(&task) && shared.config.max_batch_delay.is_zero();
        let expects_batch = small && shared.expects_batch();
        if small && !expects_batch && shared.reserve_inline() {
            return shared.run_inline(task);
        }
        let mut guard = AbandonGuard { shared, replied: false };
        let mut receiver = shared.enqueue(task, deadline)?;
        if small {
            if expects_batch {
                // Lets other callers that are ready enqueue their tasks before the first of them computes all.
                tokio::task::yield_now().await;
            }
            loop {
                match receiver.try_recv() {
                    Ok(result) => {
                        guard.replied = true;
                        return result;
                    }
                    Err(TryRecvError::Closed) => return Err(lost_request()),
                    Err(TryRecvError::Empty) if shared.run_batch_inline() => {}
                    Err(TryRecvError::Empty) => break,
                }
            }
        }
        // Only now is a thread needed.
        shared.queued.notify_one();
        let result = match deadline {
            None => receiver.await,
            Some(deadline) => match tokio::time::timeout_at(deadline.into(), receiver).await {
                Ok(result) => result,
                Err(_) => Ok(Err(Error::Deadline("in the engine's queue"))),
            },
        };
        let result = result.unwrap_or_else(|_| Err(lost_request()));
        guard.replied = !matches!(result, Err(Error::Deadline(_)));
        result
    }
}

impl Drop for Engine {
    fn drop(&mut self) {
        self.shared.lock().closed = true;
        // Not joined: no caller waits any more, and a policy that hangs must not keep the process alive.
        self.shared.queued.notify_all();
    }
}

impl std::fmt::Debug for Engine {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Engine({:?})", self.shared.config)
    }
}
