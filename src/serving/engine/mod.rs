//! Where headings are computed: threads of its own behind a bounded queue, so that a large fleet delays no I/O.
//!
//! A thread takes the fleet that waits longest and, with it, whatever waits for the same policy version, into one forward
//! pass; answers are the same bits as alone. By default nobody waits for company: a batch is what has gathered while the
//! threads were busy. Handing a fleet over and its answer back wakes two threads, which takes longer than a small fleet's
//! forward pass: small fleets are computed by the first caller among them, if no more than `threads` compute then.
//!
//! A caller that gave up (its future was dropped, or its deadline passed) is not computed for. A policy that panics is a
//! fault of the server, told to the callers of the batch; the thread goes on.

mod batch;
mod reply;

use std::collections::VecDeque;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use batch::{Batch, Queued};
use reply::{Expected, Places};

use super::meters::Meters;
use super::{Error, LoadedPolicy};
use crate::policy::{FleetStep, Slot};

/// Work of a batch beyond which no further fleet joins it: company must not make a small fleet wait for large ones.
const WORK: usize = 1 << 17;
/// Most work of a batch that a caller computes: well below a millisecond, for its thread serves connections, too.
const SMALL: usize = 1 << 13;
/// What a UAV costs, in units of what a detection does.
const UAV: usize = 32;
/// Small fleets one after another without company, after which the next ones do not look for any: looking costs as much as a
/// forward pass.
const LONELY: u32 = 4;
/// Of those, one in so many looks all the same.
const PROBE: u32 = 16;

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

/// One fleet's turn, and room for what comes out.
#[derive(Debug)]
pub struct Task {
    /// Who decides.
    policy: Arc<LoadedPolicy>,
    /// What is seen.
    slot: Slot,
    /// Slots since the episode began.
    step: u64,
    out: Outcome,
}

impl Task {
    /// The turn of a fleet with this memory. Headings and values are written into the room of `used`.
    pub fn new(policy: Arc<LoadedPolicy>, slot: Slot, step: u64, memory: Vec<f32>, used: Room) -> Self {
        let Room { mut headings, mut q_values } = used;
        headings.clear();
        headings.resize(slot.uavs(), 0);
        q_values.clear();
        q_values.resize(slot.uavs() * policy.policy.actions(), f32::NAN);
        Self { policy, slot, step, out: Outcome { memory, headings, q_values, timings: Timings::default() } }
    }

    /// Who decides.
    pub fn policy(&self) -> &LoadedPolicy {
        &self.policy
    }

    fn turn(&mut self) -> FleetStep<'_> {
        let Outcome { memory, headings, q_values, .. } = &mut self.out;
        FleetStep { slot: &self.slot, step: self.step, memory, headings, q_values: Some(q_values) }
    }

    fn done(self, timings: Timings) -> Outcome {
        Outcome { timings, ..self.out }
    }

    /// About what it costs, in units of what a detection does.
    fn work(&self) -> usize {
        UAV * self.slot.uavs() + self.slot.users() + self.slot.detection_count()
    }

    /// Whether a caller may compute it.
    fn is_small(&self) -> bool {
        self.policy.policy.is_cheap() && self.work() <= SMALL
    }
}

/// Vectors whose contents nobody needs any more.
#[derive(Debug, Default)]
pub struct Room {
    /// For headings.
    pub headings: Vec<u8>,
    /// For values.
    pub q_values: Vec<f32>,
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

#[derive(Default)]
struct Queue {
    waiting: VecDeque<Queued>,
    /// Batches that are being computed.
    running: usize,
    /// Room of batches that are over.
    rooms: Vec<Batch>,
    closed: bool,
}

struct Shared {
    queue: Mutex<Queue>,
    filled: Condvar,
    places: Arc<Places>,
    /// Small fleets computed since the last that had company.
    lonely: AtomicU32,
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
    fn next(&self, batch: &mut Batch) -> bool {
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

    /// Takes the oldest and what joins it up to `most` work, each at its first chance; the others keep their order.
    fn gather(&self, queue: &mut Queue, batch: &mut Batch, most: usize) {
        let Some(oldest) = queue.waiting.pop_front() else { return };
        queue.running += 1;
        let mut work = oldest.task.work();
        let fleets = &mut batch.fleets;
        fleets.push(oldest);
        let mut i = 0;
        while i < queue.waiting.len() && fleets.len() < self.config.max_batch {
            let next = &queue.waiting[i].task;
            if Arc::ptr_eq(&next.policy, &fleets[0].task.policy) && work + next.work() <= most {
                work += next.work();
                fleets.extend(queue.waiting.remove(i));
            } else {
                i += 1;
            }
        }
    }

    /// Counts a fleet that leaves without having been computed for.
    fn unanswered(&self, task: &Task) {
        self.meters.policy(&task.policy.reference.name).failure.increment(1);
    }

    /// Lets the caller compute its small fleet at once, if nothing else is to be done; then it calls [`Shared::alone`].
    fn may_compute(&self) -> bool {
        let mut queue = self.lock();
        let may = queue.waiting.is_empty() && queue.running < self.config.threads;
        queue.running += usize::from(may);
        may
    }

    fn alone(&self, task: Task) -> Result<Outcome, Error> {
        let outcome = batch::alone(task, &self.meters);
        self.lonely.fetch_add(1, Ordering::Relaxed);
        self.lock().running -= 1;
        outcome
    }

    /// Computes a batch for the caller and others if the oldest fleet is small and not too many compute; whether it did.
    fn lead(&self) -> bool {
        let mut batch = {
            let mut queue = self.lock();
            let small = queue.waiting.front().is_some_and(|oldest| oldest.task.is_small());
            if !small || queue.running >= self.config.threads {
                return false;
            }
            let mut batch = queue.rooms.pop().unwrap_or_default();
            self.gather(&mut queue, &mut batch, SMALL);
            batch
        };
        let size = batch.compute(&self.meters);
        if size > 1 {
            self.lonely.store(0, Ordering::Relaxed);
        } else {
            self.lonely.fetch_add(1, Ordering::Relaxed);
        }
        let mut queue = self.lock();
        queue.running -= 1;
        queue.rooms.push(batch);
        true
    }

    /// Whether a call should let others that are ready ask before it computes: where some did lately, and now and then.
    fn expects_company(&self) -> bool {
        let lonely = self.lonely.load(Ordering::Relaxed);
        lonely < LONELY || lonely.is_multiple_of(PROBE)
    }

    /// Puts a fleet into the queue.
    fn enqueue(&self, task: Task, deadline: Option<Instant>) -> Result<Expected, Error> {
        let mut queue = self.lock();
        let capacity = self.config.queue;
        if queue.waiting.len() >= capacity {
            // Who gave up makes room.
            queue.waiting.retain(|queued| {
                let wanted = !queued.promise.is_void();
                if !wanted {
                    self.unanswered(&queued.task);
                }
                wanted
            });
        }
        if queue.waiting.len() >= capacity {
            self.unanswered(&task);
            return Err(Error::Busy(format!("the engine's queue is full ({capacity} fleets)")));
        }
        let (promise, expected) = self.places.pair();
        queue.waiting.push_back(Queued { task, since: Instant::now(), deadline, promise });
        Ok(expected)
    }
}

/// A caller that waits. Dropped, its fleet leaves the queue soon.
struct Caller<'a> {
    shared: &'a Shared,
    answered: bool,
}

impl Drop for Caller<'_> {
    fn drop(&mut self) {
        if !self.answered {
            // Nobody else may come by to see that this one is gone.
            self.shared.filled.notify_one();
        }
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
        let shared = Arc::new(Shared {
            queue: Mutex::default(),
            filled: Condvar::new(),
            places: Arc::default(),
            lonely: AtomicU32::new(0),
            config,
            meters: Meters::new(),
        });
        let engine = Self { shared: shared.clone() };
        for i in 0..config.threads {
            let shared = shared.clone();
            let work = move || {
                let mut batch = Batch::default();
                while shared.next(&mut batch) {
                    batch.compute(&shared.meters);
                    shared.lock().running -= 1;
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
        let shared = &*self.shared;
        if deadline.is_some_and(|deadline| deadline <= Instant::now()) {
            return Err(Error::Deadline("before the engine's queue"));
        }
        let small = task.is_small() && shared.config.max_batch_delay.is_zero();
        let company = small && shared.expects_company();
        if small && !company && shared.may_compute() {
            return shared.alone(task);
        }
        let mut caller = Caller { shared, answered: false };
        let mut answer = shared.enqueue(task, deadline)?;
        if small {
            if company {
                // Callers that are ready to ask do so before the first of them computes for all.
                tokio::task::yield_now().await;
            }
            loop {
                if let Some(answer) = answer.look() {
                    caller.answered = true;
                    return answer;
                }
                if !shared.lead() {
                    // A thread will; it is told only now, because until now it was not needed.
                    break;
                }
            }
        }
        shared.filled.notify_one();
        let answer = match deadline {
            None => answer.await,
            Some(deadline) => {
                let late = |_| Err(Error::Deadline("in the engine's queue"));
                tokio::time::timeout_at(deadline.into(), answer).await.unwrap_or_else(late)
            }
        };
        caller.answered = !matches!(answer, Err(Error::Deadline(_)));
        answer
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
