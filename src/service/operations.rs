//! State of the server for operators: health of its components, readiness, and gauges of the current load.

use std::time::Duration;

use super::{App, Error, Replica};
use crate::invalid::in_range;
use crate::store::JobState;

/// If the database takes longer to answer, it counts as unavailable.
const DATABASE_TIMEOUT: Duration = Duration::from_secs(2);

/// Health of the server's components.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(clippy::struct_excessive_bools, reason = "one per component")]
pub struct ServerHealth {
    /// The database responds.
    pub database: bool,
    /// The database can be written.
    pub writes: bool,
    /// At least one policy version exists, loaded or not; a replica has those of its primary.
    pub policies: bool,
    /// The queue of jobs is readable, so jobs are started. Not on a replica.
    pub scheduler: bool,
}

/// Checks the server's components.
pub async fn server_health(app: &App) -> ServerHealth {
    ServerHealth {
        database: ping_database(app).await.is_ok(),
        writes: app.store.write_failure().is_none(),
        policies: !app.registry.is_empty() && app.check_copy().is_ok(),
        // A replica has no jobs.
        scheduler: app.replica.is_none() && *app.scheduler.queue_readable().borrow(),
    }
}

/// Waits until [`server_health`] may have changed.
pub async fn server_health_changed(app: &App) {
    let (mut readable, mut writes) = (app.scheduler.queue_readable(), app.store.write_failures());
    tokio::select! {
        // Never an error: `app` owns the senders.
        _ = readable.changed() => {}
        _ = writes.changed() => {}
        () = tokio::time::sleep(DATABASE_TIMEOUT) => {}
    }
}

/// Whether the database answers, or why not.
async fn ping_database(app: &App) -> Result<(), String> {
    match tokio::time::timeout(DATABASE_TIMEOUT, app.store.ping()).await {
        Ok(result) => result.map_err(|e| e.to_string()),
        Err(_) => Err(format!("no answer within {} s", DATABASE_TIMEOUT.as_secs())),
    }
}

impl App {
    /// Checks that the server is ready: it is not draining, a policy exists (on a replica, those of its primary), and the database responds and can be written.
    ///
    /// # Errors
    /// [`Error::Draining`], or [`Error::Unavailable`] with what is missing.
    pub async fn ready(&self) -> Result<(), Error> {
        self.admit()?;
        if self.registry.is_empty() {
            return Err(Error::Unavailable("there is no policy"));
        }
        self.check_copy()?;
        ping_database(self).await.map_err(|reason| {
            tracing::warn!(reason, "the database does not answer");
            Error::Unavailable("the database does not answer")
        })?;
        self.store.write_failure().map_or(Ok(()), |failure| Err(Error::Unavailable(failure.reason())))
    }
}

/// Metrics of the server's present load.
#[derive(Clone, Debug, PartialEq)]
pub struct ServerMetrics {
    /// Whether the server is ready.
    pub ready: bool,
    /// Whether the database can be written.
    pub database_writable: bool,
    /// Open sessions.
    pub sessions: usize,
    /// Bytes that sessions take.
    pub session_memory: usize,
    /// Hosted environments.
    pub environments: usize,
    /// Policy versions, loaded or not.
    pub policy_versions: usize,
    /// Bytes of the policies in memory.
    pub policy_memory: usize,
    /// Policy versions read into memory since the start.
    pub policy_loads: u64,
    /// Fleets in the engine's queue.
    pub engine_queue: usize,
    /// Threads that running jobs use.
    pub threads_busy: usize,
    /// The CPU budget of jobs, in threads.
    pub threads: usize,
    /// Open streams of jobs' events.
    pub watchers: usize,
    /// Of a replica: time since its policies were last known to be those of the primary; `None`: never.
    pub replica_age: Option<Duration>,
    /// Of a replica: versions of the primary that could not be taken over.
    pub replica_missing: Option<usize>,
    /// Jobs by state; empty if the database does not answer.
    pub jobs: Vec<(JobState, u64)>,
}

/// Collects the metrics. Never fails, because metrics are most needed when the database does not answer.
pub async fn server_metrics(app: &App) -> ServerMetrics {
    // One after the other, so that a scrape needs one connection to the database.
    let ready = app.ready().await.is_ok();
    let jobs = match tokio::time::timeout(DATABASE_TIMEOUT, app.store.job_counts()).await {
        Ok(Ok(jobs)) => jobs,
        Ok(Err(e)) => {
            tracing::warn!(error = %e, "cannot count jobs");
            Vec::new()
        }
        Err(_) => Vec::new(),
    };
    ServerMetrics {
        ready,
        database_writable: app.store.write_failure().is_none(),
        sessions: app.sessions.len(),
        session_memory: app.sessions.memory_used(),
        environments: app.environments.table().len(),
        policy_versions: app.registry.len(),
        policy_memory: app.registry.memory_used(),
        policy_loads: app.loads.count(),
        engine_queue: app.engine.waiting(),
        threads_busy: app.scheduler.threads_busy(),
        threads: app.scheduler.cpu_budget(),
        watchers: app.watchers.open(),
        replica_age: app.replica.as_ref().and_then(|replica| replica.age(&app.clock)),
        replica_missing: app.replica.as_ref().map(Replica::missing),
        jobs,
    }
}

/// The CPU budget of training.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Budget {
    /// Threads that all running jobs may use together.
    pub threads: usize,
    /// Threads that running jobs use; more than `threads` while a smaller budget is not reached yet.
    pub threads_busy: usize,
}

/// The CPU budget.
pub fn budget(app: &App) -> Budget {
    Budget { threads: app.scheduler.cpu_budget(), threads_busy: app.scheduler.threads_busy() }
}

/// Largest CPU budget.
pub const MAX_CPU_BUDGET: usize = 4096;

/// Changes the CPU budget until the server stops.
///
/// # Errors
/// [`Error::Invalid`]: the number is out of range.
pub fn set_budget(app: &App, threads: usize) -> Result<Budget, Error> {
    in_range("threads", threads, 1..=MAX_CPU_BUDGET)?;
    app.scheduler.set_cpu_budget(threads);
    Ok(budget(app))
}
