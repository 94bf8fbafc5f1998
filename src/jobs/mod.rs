//! When and where work runs: the embedded scheduler, the CPU budget, executors, the worker process.
//!
//! The scheduler and the service write states through [`crate::store`]; a worker reaches the server only through the
//! `WorkerService` protocol, so it can run on any machine.

mod executor;
mod local;
mod scheduler;
pub mod spec;
pub mod worker;

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use jiff::Timestamp;
use sha2::{Digest, Sha256};
use subtle::ConstantTimeEq;
use tokio::sync::{Notify, watch};
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

pub use executor::{Executor, Exit, Launch, LogTail};
pub use local::LocalProcess;

use crate::store::{self, Lease, Store, Wanted};

/// How jobs are run.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Threads that all running jobs may use together.
    pub cpu_budget: usize,
    /// Failed attempts after which a job has failed.
    pub max_attempts: u32,
    /// Time between snapshots of a job.
    pub snapshot_every: Duration,
    /// A worker that is not heard of for this long is killed.
    pub silence: Duration,
    /// A worker that does not obey a cancel for this long is killed.
    pub cancel_grace: Duration,
    /// A worker that has not paused (its snapshot is large) after this long is killed.
    pub pause_grace: Duration,
}

impl Settings {
    /// The defaults.
    pub fn new(cpu_budget: usize) -> Self {
        Self {
            cpu_budget,
            max_attempts: 3,
            snapshot_every: Duration::from_secs(10),
            silence: Duration::from_secs(30),
            cancel_grace: Duration::from_secs(3),
            pause_grace: Duration::from_secs(30),
        }
    }
}

/// What a worker is to do next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Directive {
    /// Go on.
    Continue,
    /// Stop; nothing is needed any more.
    Cancel,
    /// Upload a snapshot, then stop.
    Pause,
}

/// Handle to the scheduler; cheap to clone.
#[derive(Clone)]
pub struct Jobs(Arc<Inner>);

struct Inner {
    store: Store,
    settings: Settings,
    executor: Arc<dyn Executor>,
    /// Rung when there may be something to start.
    wake: Notify,
    /// Rung when an attempt has left `running`.
    left: Notify,
    draining: CancellationToken,
    /// Whether the queue could be read when it was last looked at.
    able: watch::Sender<bool>,
    /// By job number. A job stays here until its worker's process has ended, whatever its state says.
    running: Mutex<HashMap<i64, Running>>,
}

#[derive(Clone)]
struct Running {
    attempt: u32,
    threads: usize,
    log: LogTail,
    /// Rung when the job's state has changed under its worker.
    changed: Arc<Notify>,
    heard: Arc<Mutex<Instant>>,
}

impl Jobs {
    /// Opens the scheduler: jobs that ran when the server last stopped are queued again. Nothing starts before [`Jobs::run`].
    ///
    /// # Errors
    /// The database.
    pub async fn open(store: Store, settings: Settings, executor: Arc<dyn Executor>) -> Result<Self, store::Error> {
        for job in store.recover_jobs(Timestamp::now()).await? {
            tracing::info!(job = %job.id, state = %job.state, step = job.step, "found a job whose server had stopped");
        }
        Ok(Self(Arc::new(Inner {
            store,
            settings,
            executor,
            wake: Notify::new(),
            left: Notify::new(),
            draining: CancellationToken::new(),
            able: watch::Sender::new(true),
            running: Mutex::default(),
        })))
    }

    /// How jobs are run.
    pub fn settings(&self) -> &Settings {
        &self.0.settings
    }

    /// Whether nothing is started any more.
    pub fn draining(&self) -> bool {
        self.0.draining.is_cancelled()
    }

    /// Whether the queue could be read when it was last looked at, and when that changes.
    pub fn able(&self) -> watch::Receiver<bool> {
        self.0.able.subscribe()
    }

    /// Threads that running jobs use.
    pub fn threads_busy(&self) -> usize {
        scheduler::used(&self.running())
    }

    /// Says that the queue, or what is wanted of job number `job`, has changed.
    pub fn changed(&self, job: i64) {
        if let Some(running) = self.running().get(&job) {
            running.changed.notify_one();
        }
        self.0.wake.notify_one();
    }

    /// Notes that an attempt's worker lives.
    pub fn heard(&self, lease: Lease) {
        if let Some(running) = self.running().get(&lease.job).filter(|r| r.attempt == lease.attempt) {
            *running.heard.lock().unwrap_or_else(PoisonError::into_inner) = Instant::now();
        }
    }

    /// What the worker of a job of which this is wanted shall do.
    pub fn directive(&self, wanted: Option<Wanted>) -> Directive {
        match wanted {
            Some(Wanted::Cancel) => Directive::Cancel,
            Some(Wanted::Pause) => Directive::Pause,
            None if self.draining() => Directive::Pause,
            None => Directive::Continue,
        }
    }

    /// What the worker of attempt `attempt` has printed so far, while it runs.
    pub fn live_log(&self, job: i64, attempt: u32) -> Option<String> {
        let running = self.running().get(&job).filter(|r| r.attempt == attempt).cloned()?;
        Some(running.log.text())
    }

    /// Starts nothing more, lets the workers pause, and waits until their processes have ended, at most for `patience`;
    /// then they are killed. Their jobs are queued. gRPC must go on being served meanwhile: workers send their snapshots.
    pub async fn drain(&self, patience: Duration) {
        self.0.draining.cancel();
        let all_left = async {
            loop {
                let left = self.0.left.notified();
                if self.running().is_empty() {
                    break;
                }
                left.await;
            }
        };
        // Every attempt ends within its grace; `patience` only bounds a database that does not answer.
        if tokio::time::timeout(patience, all_left).await.is_err() {
            tracing::warn!("some workers had not paused in time; their jobs go on from their last snapshots");
        }
    }

    fn running(&self) -> MutexGuard<'_, HashMap<i64, Running>> {
        self.0.running.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// SHA-256 of a token, as the store keeps it.
pub fn token_digest(token: &str) -> [u8; 32] {
    Sha256::digest(token).into()
}

/// Compares secrets in a time that does not depend on where they differ.
pub fn equal_secrets(a: &[u8], b: &[u8]) -> bool {
    a.ct_eq(b).into()
}
