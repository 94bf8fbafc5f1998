//! Where headings are computed: threads of its own behind a bounded queue, so that a large fleet delays no I/O.
//!
//! A caller that gave up (its future was dropped, or its deadline passed) is not computed for. A policy that panics is a
//! fault of the server, told to its caller; the thread goes on.

use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tokio::sync::oneshot;

use super::{Error, LoadedPolicy};
use crate::policy::{Slot, Turn};

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

#[derive(Default)]
struct Queue {
    waiting: VecDeque<Queued>,
    closed: bool,
}

struct Shared {
    queue: Mutex<Queue>,
    filled: Condvar,
    capacity: usize,
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, Queue> {
        // Policies run outside the lock; the queue is whole at every step.
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits for work; `None` when the engine was dropped.
    fn next(&self) -> Option<Queued> {
        let mut queue = self.lock();
        loop {
            if let Some(next) = queue.waiting.pop_front() {
                return Some(next);
            }
            if queue.closed {
                return None;
            }
            queue = self.filled.wait(queue).unwrap_or_else(PoisonError::into_inner);
        }
    }
}

/// The engine; dropping it ends its threads after the work they have begun.
pub struct Engine {
    shared: Arc<Shared>,
    threads: usize,
}

impl Engine {
    /// Starts `threads` threads with room for `capacity` waiting fleets.
    ///
    /// # Errors
    /// The system refuses a thread.
    pub fn start(threads: usize, capacity: usize) -> std::io::Result<Self> {
        let shared = Arc::new(Shared { queue: Mutex::default(), filled: Condvar::new(), capacity });
        let engine = Self { shared: shared.clone(), threads };
        for i in 0..threads {
            let shared = shared.clone();
            let work = move || {
                while let Some(queued) = shared.next() {
                    compute(queued);
                }
            };
            std::thread::Builder::new().name(format!("engine-{i}")).spawn(work)?;
        }
        Ok(engine)
    }

    /// Computes one turn.
    ///
    /// # Errors
    /// The queue is full, the deadline passed, or the policy panicked.
    pub async fn run(&self, task: Task, deadline: Option<Instant>) -> Result<Outcome, Error> {
        let (reply, answer) = oneshot::channel();
        {
            let mut queue = self.shared.lock();
            if queue.waiting.len() >= self.shared.capacity {
                return Err(Error::Busy(format!("the engine's queue is full ({} fleets)", self.shared.capacity)));
            }
            queue.waiting.push_back(Queued { task, since: Instant::now(), deadline, reply });
        }
        self.shared.filled.notify_one();
        let gone = || Error::Fault("the engine stopped".into());
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
        write!(f, "Engine({} threads)", self.threads)
    }
}

fn compute(queued: Queued) {
    let Queued { task, since, deadline, reply } = queued;
    if reply.is_closed() {
        return;
    }
    let begun = Instant::now();
    if deadline.is_some_and(|deadline| begun >= deadline) {
        let _ = reply.send(Err(Error::Deadline("in the engine's queue")));
        return;
    }
    let name = task.policy.reference.to_string();
    // The task is owned by the closure: nothing half-written is seen after a panic.
    let outcome = catch_unwind(AssertUnwindSafe(move || {
        let Task { policy, slot, step, mut memory } = task;
        let mut headings = vec![0; slot.uavs()];
        let mut q_values = vec![f32::NAN; slot.uavs() * policy.policy.actions()];
        let turn = Turn { slot: &slot, step, memory: &mut memory, headings: &mut headings, q_values: Some(&mut q_values) };
        policy.policy.act(&mut [turn]);
        let timings = Timings { queue: begun - since, compute: begun.elapsed(), batch_size: 1 };
        Outcome { memory, headings, q_values, timings }
    }));
    // A caller that left meanwhile needs no answer.
    let _ = reply.send(outcome.map_err(|_| Error::Fault(format!("policy {name} panicked"))));
}
