//! The scheduler, the CPU budget, executors and the worker process.
//!
//! The scheduler and the service change jobs through [`crate::store`]. A worker reaches the server only through the
//! `WorkerService` protocol, so it can run on any machine.

mod backfill;
mod cores;
pub mod evaluation;
mod executor;
pub mod experiment_jobs;
mod launched;
mod local;
pub mod memory;
pub mod metric_names;
mod scheduler;
mod slurm;
pub mod spec;
mod starting;
mod supervision;
pub mod sweep;
pub mod sweep_jobs;
pub mod webhooks;
pub mod worker;

use std::collections::HashMap;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use sha2::{Digest, Sha256};
use subtle::ConstantTimeEq;
use tokio::sync::{Notify, watch};

pub use executor::{Executor, Launch, LogTail, Resources, WorkerExit, WorkerStatus};
pub use local::LocalProcess;
pub use slurm::{Slurm, SlurmConfig, SlurmTimes};

use crate::clock::Clock;
use crate::draining::Draining;
use crate::store::{self, Lease, PendingAction, Store};

/// Time between two tries to use a database that fails.
const RETRY_DELAY: Duration = Duration::from_secs(1);

/// Limits and times of the scheduler.
#[derive(Clone, Debug)]
pub struct SchedulerConfig {
    /// Threads that all running jobs may use together, until that is changed.
    pub cpu_budget: usize,
    /// Consecutive attempts that fail without progress after which a job has failed.
    pub max_attempts: u32,
    /// Time between snapshots of a job.
    pub snapshot_every: Duration,
    /// Time without a heartbeat after which a worker is killed. Time in which this server did not run does not count.
    pub heartbeat_timeout: Duration,
    /// Time after a cancel after which the worker is killed.
    pub cancel_grace: Duration,
    /// Time after a pause after which the worker is killed. The worker uploads a snapshot first, which may be large.
    pub pause_grace: Duration,
    /// Memory in bytes that a job can use at most. A job whose configuration needs more is refused.
    pub memory: u64,
}

impl SchedulerConfig {
    /// The defaults.
    pub fn new(cpu_budget: usize) -> Self {
        Self {
            cpu_budget,
            max_attempts: 3,
            snapshot_every: Duration::from_secs(10),
            heartbeat_timeout: Duration::from_secs(30),
            cancel_grace: Duration::from_millis(600),
            pause_grace: Duration::from_secs(30),
            memory: memory::available(),
        }
    }
}

/// What a worker has to do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Directive {
    /// Continue training.
    Continue,
    /// Stop without a snapshot.
    Cancel,
    /// Upload a snapshot, then stop.
    Pause,
}

/// Handle to the scheduler; cheap to clone.
#[derive(Clone)]
pub struct Scheduler(Arc<Inner>);

struct Inner {
    store: Store,
    config: SchedulerConfig,
    /// Threads that all running jobs may use together; at first [`SchedulerConfig::cpu_budget`].
    cpu_budget: AtomicUsize,
    executor: Arc<dyn Executor>,
    clock: Clock,
    draining: Draining,
    /// Notified when a job may be ready to start.
    wake: Notify,
    /// Notified when an attempt has been removed from `running`.
    removed: Notify,
    /// Whether the last read of the queue succeeded.
    queue_readable: watch::Sender<bool>,
    /// Attempts by row id of the job. An attempt stays here until its worker process has ended, whatever the state of its job.
    running: Mutex<HashMap<i64, RunningAttempt>>,
}

#[derive(Clone)]
struct RunningAttempt {
    attempt: u32,
    threads: usize,
    log: LogTail,
    /// Notified when the job has changed while its worker runs.
    job_changed: Arc<Notify>,
    /// What the executor knows of the worker.
    status: WorkerStatus,
    /// Time from the begin of the attempt until the job exceeds its timeout.
    time_left: Option<Duration>,
    /// Monotonic time of the last call of the worker.
    last_heartbeat: Arc<Mutex<Duration>>,
}

impl RunningAttempt {
    /// Monotonic time at which the job exceeds its timeout.
    fn deadline(&self) -> Option<Duration> {
        Some(self.status.began()?.saturating_add(self.time_left?))
    }

    fn last_heartbeat(&self) -> MutexGuard<'_, Duration> {
        self.last_heartbeat.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Scheduler {
    /// Opens the scheduler and queues again the jobs that ran when the server last stopped. No job starts before
    /// [`Scheduler::run`], and none once `draining` has begun.
    ///
    /// # Errors
    /// [`store::Error`] when the database fails.
    pub async fn open(
        store: Store,
        config: SchedulerConfig,
        executor: Arc<dyn Executor>,
        clock: Clock,
        draining: Draining,
    ) -> Result<Self, store::Error> {
        for job in store.recover_jobs(executor.is_cluster(), clock.now()).await? {
            tracing::info!(job = %job.id, state = %job.state, step = job.step, "recovered a job of a server that stopped");
        }
        Ok(Self(Arc::new(Inner {
            store,
            cpu_budget: AtomicUsize::new(config.cpu_budget),
            config,
            executor,
            clock,
            draining,
            wake: Notify::new(),
            removed: Notify::new(),
            queue_readable: watch::Sender::new(true),
            running: Mutex::default(),
        })))
    }

    /// Limits and times.
    pub fn config(&self) -> &SchedulerConfig {
        &self.0.config
    }

    /// Threads that all running jobs may use together.
    pub fn cpu_budget(&self) -> usize {
        self.0.cpu_budget.load(Ordering::Relaxed)
    }

    /// Changes the CPU budget until the server stops. Jobs that run stay, so a smaller budget is reached when some have ended.
    pub fn set_cpu_budget(&self, threads: usize) {
        let before = self.0.cpu_budget.swap(threads, Ordering::Relaxed);
        tracing::info!(before, threads, "the CPU budget has changed");
        self.0.wake.notify_one();
    }

    /// Whether the last read of the queue succeeded.
    pub fn queue_readable(&self) -> watch::Receiver<bool> {
        self.0.queue_readable.subscribe()
    }

    /// Threads that running jobs use.
    pub fn threads_busy(&self) -> usize {
        scheduler::threads_used(&self.running())
    }

    /// Notifies the scheduler that the queue, or the state or pending action of the job with row id `job`, has changed.
    pub fn job_changed(&self, job: i64) {
        if let Some(running) = self.running().get(&job) {
            running.job_changed.notify_one();
        }
        self.0.wake.notify_one();
    }

    /// Notifies the scheduler that the queue, or the states or pending actions of several jobs have changed.
    pub fn all_jobs_changed(&self) {
        self.running().values().for_each(|running| running.job_changed.notify_one());
        self.0.wake.notify_one();
    }

    /// Records that the worker of an attempt has called.
    pub fn record_heartbeat(&self, lease: Lease) {
        if let Some(running) = self.running().get(&lease.job_row).filter(|running| running.attempt == lease.attempt) {
            *running.last_heartbeat() = self.0.clock.monotonic();
        }
    }

    /// Records that the attempt of a launch has begun, with the first call of its worker.
    pub fn attempt_begun(&self, lease: Lease) {
        if let Some(running) = self.running().get(&lease.job_row).filter(|running| running.attempt == lease.attempt) {
            running.status.set_began(self.0.clock.monotonic());
            running.status.set_waiting(None);
        }
    }

    /// Why the worker of a job, which the cluster was asked for, does not run at present.
    pub fn waiting(&self, job: i64) -> Option<String> {
        self.running().get(&job)?.status.waiting()
    }

    /// The directive for the worker of a job with this pending action. The workers of a cluster go on while this server restarts.
    pub fn directive(&self, pending: Option<PendingAction>) -> Directive {
        match pending {
            Some(PendingAction::Cancel) => Directive::Cancel,
            Some(PendingAction::Pause) => Directive::Pause,
            None if self.0.draining.begun() && !self.0.executor.is_cluster() => Directive::Pause,
            None => Directive::Continue,
        }
    }

    /// The output of the worker of attempt `attempt` so far; `None` unless that attempt is running.
    pub fn live_log(&self, job: i64, attempt: u32) -> Option<LogTail> {
        let running = self.running().get(&job).filter(|running| running.attempt == attempt).cloned()?;
        Some(running.log)
    }

    /// Begins draining, lets the workers pause, and waits until their processes have ended, at most for `timeout`. Workers
    /// that do not pause in time are killed. The jobs are queued again. Workers of a cluster go on. gRPC must be served meanwhile: workers upload
    /// snapshots.
    pub async fn drain(&self, timeout: Duration) {
        self.0.draining.begin();
        let all_removed = async {
            loop {
                let removed = self.0.removed.notified();
                if self.running().is_empty() {
                    break;
                }
                removed.await;
            }
        };
        // Every attempt ends within its grace period; `timeout` only bounds a database that does not answer.
        if tokio::time::timeout(timeout, all_removed).await.is_err() {
            tracing::warn!("some workers have not paused in time; their jobs will resume from their last snapshots");
        }
    }

    fn running(&self) -> MutexGuard<'_, HashMap<i64, RunningAttempt>> {
        self.0.running.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// SHA-256 of a token, as the database stores it.
pub fn token_digest(token: &str) -> [u8; 32] {
    Sha256::digest(token).into()
}

/// Compares secrets in a time that does not depend on where they differ.
pub fn equal_secrets(a: &[u8], b: &[u8]) -> bool {
    a.ct_eq(b).into()
}
