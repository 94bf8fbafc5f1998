//! Runs policies on threads of its own behind a bounded queue, so that a large fleet does not delay I/O.
//!
//! A thread takes the next task (`queue` owns the order: fair by work, among callers and among sizes of fleets), adds waiting tasks of
//! the same policy version, and computes them in one forward pass; results are bit-identical to computing each alone. By default a
//! batch consists of the tasks that arrived while the threads were busy; no task waits for others to join. Heavy tasks have threads of
//! their own, as many, with a lower priority: while they compute, others are served as fast as before. A heavy task splits its large
//! loops over as many threads again, which exist only as long as a loop.
//!
//! Handing a task to another thread and its result back takes longer than the forward pass of a small fleet. Small fleets are
//! therefore computed inline, on the thread of the first caller among them, as long as no more than `threads`
//! light computations run at once.
//!
//! Large requests wait unconverted and with packed memory, so that what waits takes little memory; a thread converts them when it
//! computes them. [`Engine::call`] runs other work of large requests in the same order.
//!
//! A task is not computed if its caller stopped waiting (its future was dropped, or its deadline passed). If a policy panics,
//! all callers of the batch receive [`Error::Internal`] and the thread continues.

mod batch;
mod metrics;
mod queue;
mod task;

pub use task::{Decision, NamedInfluence, OutputBuffers, Task, TaskOutput, Timings};

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use batch::{Call, Job, Queued, TaskBatch};
use metrics::EngineMetrics;
use queue::{Lane, Queue};
use tokio::sync::oneshot;
use tokio::sync::oneshot::error::TryRecvError;

use super::{Error, Owner, Statistics};
use crate::threads;

/// Maximum work of a batch. A higher limit would delay small fleets that share a batch with large ones.
const MAX_BATCH_WORK: usize = 1 << 17;
/// Maximum work of a batch that is computed inline: well below a millisecond, because the caller's thread also serves
/// connections.
const MAX_INLINE_WORK: usize = 1 << 13;
/// Length of a memory, in numbers, up to which fleets are computed at the same time: 32 MiB.
const MAX_SHARED_MEMORY: usize = 1 << 23;
/// A small task normally yields to other callers before it is computed, so that their tasks can join its batch. This costs as
/// much as a forward pass. After this many inline batches of one task, small tasks no longer yield.
const SINGLES_BEFORE_SKIP: u32 = 4;
/// One in this many small tasks yields nevertheless, to notice other callers.
const BATCHING_PROBE_INTERVAL: u32 = 16;

/// How much the priority of the threads for heavy tasks is lowered: to a third of the processor time of a thread that serves, while
/// both want it. Training workers have an even lower one.
const HEAVY_NICE: i32 = 5;

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

/// What callers and threads share under one lock.
struct State {
    queue: Queue,
    /// Batches that are being computed inline. Threads do not wait for these.
    inline_running: usize,
    /// Light batches that threads are computing.
    light_running: usize,
    /// Batches that were computed inline, kept for their buffers.
    spare_batches: Vec<TaskBatch>,
    closed: bool,
}

impl State {
    /// Whether one more batch may be computed inline.
    fn may_run_inline(&self, threads: usize) -> bool {
        self.inline_running + self.light_running < threads
    }
}

/// State that callers and threads share.
struct EngineState {
    state: Mutex<State>,
    /// Notified when a thread of the lane may have work.
    light: Condvar,
    heavy: Condvar,
    /// Held while a task is computed that needs much memory.
    huge: Mutex<()>,
    /// Inline batches of one since the last inline batch of several.
    single_batches: AtomicU32,
    config: EngineConfig,
    metrics: EngineMetrics,
}

impl EngineState {
    fn lock(&self) -> MutexGuard<'_, State> {
        // Policies run outside the lock, and nothing else panics while holding it.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What the threads of a lane wait for.
    fn queued(&self, lane: Lane) -> &Condvar {
        match lane {
            Lane::Light => &self.light,
            Lane::Heavy => &self.heavy,
        }
    }

    /// Waits for work and moves the next task of `lane`, and tasks of its policy version, into `batch`. Returns false if the engine was
    /// dropped.
    fn next_batch(&self, lane: Lane, batch: &mut TaskBatch) -> bool {
        let EngineConfig { max_batch, max_batch_delay, .. } = self.config;
        let mut state = self.lock();
        loop {
            if state.closed {
                return false;
            }
            let waiting = state.queue.lane(lane);
            let Some(next) = waiting.front() else {
                state = self.queued(lane).wait(state).unwrap_or_else(PoisonError::into_inner);
                continue;
            };
            let rest = max_batch_delay.saturating_sub(next.since.elapsed());
            let joins = |other: &&Queued| other.job.shares_batch_with(&next.job);
            if lane == Lane::Light && !rest.is_zero() && waiting.iter().filter(joins).count() < max_batch {
                state = self.light.wait_timeout(state, rest).unwrap_or_else(PoisonError::into_inner).0;
                continue;
            }
            state.queue.take(lane, max_batch, MAX_BATCH_WORK, &mut batch.queued);
            state.light_running += usize::from(lane == Lane::Light);
            // This thread may have consumed the notification for a task that is still in the queue.
            if !state.queue.lane(lane).is_empty() {
                self.queued(lane).notify_one();
            }
            return true;
        }
    }

    /// Computes batches of a lane until the engine is dropped.
    fn work(&self, lane: Lane) {
        let mut batch = TaskBatch::default();
        while self.next_batch(lane, &mut batch) {
            let work = batch.queued.iter().map(|queued| queued.work).sum();
            let huge = batch.queued.iter().any(|queued| matches!(&queued.job, Job::Fleet { task, .. } if is_huge(task)));
            let alone = huge.then(|| self.huge.lock().unwrap_or_else(PoisonError::into_inner));
            let started = Instant::now();
            // What is light is shorter than it takes to start a thread.
            let threads = if lane == Lane::Heavy { self.config.threads } else { 1 };
            let running = (lane == Lane::Light).then(|| Running { shared: self, count: |state| &mut state.light_running });
            threads::allow(threads, || batch.run(&self.metrics));
            drop(running);
            drop(alone);
            if lane == Lane::Heavy {
                self.lock().queue.measure(work, started.elapsed());
            }
        }
    }

    /// Counts what leaves the queue without being computed.
    fn count_failure(&self, job: &Job, since: Instant) {
        if let Job::Fleet { task, .. } = job {
            self.metrics.record_failure(task.policy(), since.elapsed());
        }
    }

    /// Reserves one of the light computations for [`EngineState::run_inline`], if nothing light waits.
    fn reserve_inline(&self) -> bool {
        let mut state = self.lock();
        let free = state.queue.lane(Lane::Light).is_empty() && state.may_run_inline(self.config.threads);
        state.inline_running += usize::from(free);
        free
    }

    /// Computes one task on this thread. [`EngineState::reserve_inline`] has returned true.
    fn run_inline(&self, task: Task) -> Result<TaskOutput, Error> {
        let _running = Running { shared: self, count: |state| &mut state.inline_running };
        let output = batch::run_single(task, &self.metrics);
        self.single_batches.fetch_add(1, Ordering::Relaxed);
        output
    }

    /// Computes a batch on this thread, if the next light task is small and fewer than `threads` light computations run.
    fn run_batch_inline(&self) -> InlineBatch {
        let mut batch = {
            let mut state = self.lock();
            let Some(next) = state.queue.lane(Lane::Light).front() else { return InlineBatch::NothingWaits };
            let small = matches!(&next.job, Job::Fleet { task, .. } if is_small(task));
            if !small || !state.may_run_inline(self.config.threads) {
                return InlineBatch::NeedsThread;
            }
            let mut batch = state.spare_batches.pop().unwrap_or_default();
            state.queue.take(Lane::Light, self.config.max_batch, MAX_INLINE_WORK, &mut batch.queued);
            state.inline_running += 1;
            batch
        };
        let running = Running { shared: self, count: |state| &mut state.inline_running };
        let size = batch.run(&self.metrics);
        drop(running);
        if size > 1 {
            self.single_batches.store(0, Ordering::Relaxed);
        } else {
            self.single_batches.fetch_add(1, Ordering::Relaxed);
        }
        self.lock().spare_batches.push(batch);
        InlineBatch::Computed
    }

    /// Whether a small task should yield so that others can join its batch: after a recent batch of several tasks, and at regular
    /// intervals.
    fn expects_batch(&self) -> bool {
        let single_batches = self.single_batches.load(Ordering::Relaxed);
        single_batches < SINGLES_BEFORE_SKIP || single_batches.is_multiple_of(BATCHING_PROBE_INTERVAL)
    }

    /// Adds `queued` to the queue.
    fn enqueue(&self, queued: Queued) -> Result<(), Error> {
        let removed = self.lock().queue.push(queued, self.config.threads)?;
        for Queued { job, since, .. } in removed {
            self.count_failure(&job, since);
            job.refuse(Error::Busy("the engine's queue is full, mostly of requests of this caller".into()));
        }
        Ok(())
    }
}

/// A computation that counts as running until it ends, also by a panic: a count that stayed too high would keep later ones from running.
struct Running<'a> {
    shared: &'a EngineState,
    count: fn(&mut State) -> &mut usize,
}

impl Drop for Running<'_> {
    fn drop(&mut self) {
        *(self.count)(&mut self.shared.lock()) -= 1;
    }
}

/// What [`EngineState::run_batch_inline`] did.
enum InlineBatch {
    Computed,
    /// The caller's task, too, has been taken by another thread.
    NothingWaits,
    /// A thread of the engine has to compute what waits.
    NeedsThread,
}

/// Whether a task may be computed inline.
fn is_small(task: &Task) -> bool {
    task.is_prepared() && task.policy().implementation.is_cheap() && task.work() <= MAX_INLINE_WORK
}

/// Whether a task needs so much memory that such tasks are computed one after another.
fn is_huge(task: &Task) -> bool {
    task.memory_len() > MAX_SHARED_MEMORY
}

/// The error of a caller whose task was dropped without a reply: a bug in the engine.
fn lost_request() -> Error {
    Error::Internal("the engine lost a request".into())
}

/// Wakes a thread when a caller stops waiting, so that its task leaves the queue soon.
struct AbandonGuard<'a> {
    shared: &'a EngineState,
    lane: Lane,
    replied: bool,
}

impl Drop for AbandonGuard<'_> {
    fn drop(&mut self) {
        if !self.replied {
            self.shared.queued(self.lane).notify_one();
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
        let queue = Queue::new(config.queue);
        let state = State { queue, inline_running: 0, light_running: 0, spare_batches: Vec::new(), closed: false };
        let shared = Arc::new(EngineState {
            state: Mutex::new(state),
            light: Condvar::new(),
            heavy: Condvar::new(),
            huge: Mutex::default(),
            single_batches: AtomicU32::new(0),
            config,
            metrics: EngineMetrics::new(),
        });
        let engine = Self { shared: shared.clone() };
        for i in 0..config.threads {
            let (light, heavy) = (shared.clone(), shared.clone());
            std::thread::Builder::new().name(format!("engine-{i}")).spawn(move || light.work(Lane::Light))?;
            std::thread::Builder::new().name(format!("engine-heavy-{i}")).spawn(move || {
                // Linux lowers the priority of this thread only. Without permission it stays as it is.
                let _ = rustix::process::nice(HEAVY_NICE);
                heavy.work(Lane::Heavy);
            })?;
        }
        Ok(engine)
    }

    /// What a version has computed since the server started.
    pub fn statistics(&self, name: &str, version: u64) -> Statistics {
        self.shared.metrics.statistics.get(name, version)
    }

    /// Number of tasks in the queue.
    pub fn waiting(&self) -> usize {
        self.shared.lock().queue.len()
    }

    /// Runs the policy of `task`, which `owner` sent.
    ///
    /// # Errors
    /// [`Error::Busy`] if the queue is full, or so long that the deadline would pass; [`Error::Invalid`] if the policy does not accept the
    /// input; [`Error::Deadline`] if the deadline passes; [`Error::Internal`] if the policy panics.
    pub async fn run(&self, owner: &Owner, task: Task, deadline: Option<Instant>) -> Result<TaskOutput, Error> {
        let shared = &*self.shared;
        if deadline.is_some_and(|deadline| deadline <= Instant::now()) {
            return Err(Error::Deadline("before the policy could begin"));
        }
        let small = is_small(&task) && shared.config.max_batch_delay.is_zero();
        let expects_batch = small && shared.expects_batch();
        if small && !expects_batch && shared.reserve_inline() {
            return shared.run_inline(task);
        }
        let (reply, mut receiver) = oneshot::channel();
        let (work, policy) = (task.work(), task.policy().clone());
        let lane = Lane::of(work);
        let mut guard = AbandonGuard { shared, lane, replied: false };
        shared.enqueue(Queued::new(Job::Fleet { task, reply }, work, owner, deadline)).inspect_err(|_| {
            shared.metrics.record_failure(&policy, Duration::ZERO);
        })?;
        let mut needs_thread = true;
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
                    Err(TryRecvError::Empty) => match shared.run_batch_inline() {
                        InlineBatch::Computed => {}
                        InlineBatch::NothingWaits => {
                            needs_thread = false;
                            break;
                        }
                        InlineBatch::NeedsThread => break,
                    },
                }
            }
        }
        if needs_thread {
            shared.queued(lane).notify_one();
        }
        let result = reply_of(receiver, deadline).await;
        guard.replied = !matches!(result, Err(Error::Deadline(_)));
        result
    }

    /// Runs `work` of `owner`, which costs about `cost` (see [`Policy::work`](crate::policy::Policy::work)), on a thread of the engine, in
    /// the same order as fleets.
    ///
    /// # Errors
    /// As [`Engine::run`].
    pub async fn call<T: Send + 'static>(
        &self,
        owner: &Owner,
        cost: usize,
        deadline: Option<Instant>,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> Result<T, Error> {
        let (reply, receiver) = oneshot::channel();
        let job = Job::Call(Box::new(CallWithReply { work, reply }));
        let lane = Lane::of(cost);
        let mut guard = AbandonGuard { shared: &self.shared, lane, replied: false };
        self.shared.enqueue(Queued::new(job, cost, owner, deadline))?;
        self.shared.queued(lane).notify_one();
        let result = reply_of(receiver, deadline).await;
        guard.replied = !matches!(result, Err(Error::Deadline(_)));
        result
    }
}

/// Waits for a reply until the deadline.
async fn reply_of<T>(receiver: oneshot::Receiver<Result<T, Error>>, deadline: Option<Instant>) -> Result<T, Error> {
    let result = match deadline {
        None => receiver.await,
        Some(deadline) => match tokio::time::timeout_at(deadline.into(), receiver).await {
            Ok(result) => result,
            Err(_) => return Err(Error::Deadline("in the engine's queue")),
        },
    };
    result.unwrap_or_else(|_| Err(lost_request()))
}

/// A computation that is not a fleet, and where its result goes.
struct CallWithReply<T, F> {
    work: F,
    reply: oneshot::Sender<Result<T, Error>>,
}

impl<T: Send, F: FnOnce() -> T + Send> Call for CallWithReply<T, F> {
    fn run(self: Box<Self>) {
        // Unwind safe: after a panic, nothing of the work remains.
        let result = catch_unwind(AssertUnwindSafe(self.work)).map_err(|_| Error::Internal("a request panicked".into()));
        // Nothing to do if the caller stopped waiting.
        let _ = self.reply.send(result);
    }

    fn refuse(self: Box<Self>, error: Error) {
        // Nothing to do if the caller stopped waiting.
        let _ = self.reply.send(Err(error));
    }

    fn is_abandoned(&self) -> bool {
        self.reply.is_closed()
    }
}

impl Drop for Engine {
    fn drop(&mut self) {
        self.shared.lock().closed = true;
        // Not joined: no caller waits any more, and a policy that hangs must not keep the process alive.
        self.shared.light.notify_all();
        self.shared.heavy.notify_all();
    }
}

impl std::fmt::Debug for Engine {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Engine({:?})", self.shared.config)
    }
}
