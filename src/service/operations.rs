//! What operators ask: whether the server can do its work, part by part, and how much of it there is.

use std::time::Duration;

use super::{App, Error};
use crate::store::JobState;

/// A database that takes longer to answer counts as one that does not.
const PATIENCE: Duration = Duration::from_secs(2);

/// Which parts of the server work.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Vitals {
    /// The database answers.
    pub database: bool,
    /// There is a policy to ask.
    pub policies: bool,
    /// The queue of jobs can be read, so jobs are started.
    pub scheduler: bool,
}

/// Looks which parts of the server work.
pub async fn vitals(app: &App) -> Vitals {
    Vitals {
        database: database(app).await.is_ok(),
        policies: !app.registry.is_empty(),
        scheduler: *app.scheduler.queue_readable().borrow(),
    }
}

/// Returns when [`vitals`] are worth another look.
pub async fn vitals_changed(app: &App) {
    let mut able = app.scheduler.queue_readable();
    tokio::select! {
        // The sender lives in `app`.
        _ = able.changed() => {}
        () = tokio::time::sleep(PATIENCE) => {}
    }
}

async fn database(app: &App) -> Result<(), Error> {
    match tokio::time::timeout(PATIENCE, app.store.ping()).await {
        Ok(answered) => Ok(answered?),
        Err(_) => Err(Error::internal("the database does not answer")),
    }
}

impl App {
    /// Checks that the server can do its work: the database answers, there is something to serve, and it is not draining.
    ///
    /// # Errors
    /// The first of these that is not the case.
    pub async fn ready(&self) -> Result<(), Error> {
        self.admit()?;
        if self.registry.is_empty() {
            return Err(Error::internal("no policy is loaded"));
        }
        database(self).await
    }
}

/// How much of what there is.
#[derive(Clone, Debug, PartialEq)]
pub struct Figures {
    /// Open sessions.
    pub sessions: usize,
    /// Hosted environments.
    pub environments: usize,
    /// Policy versions that can be asked.
    pub policy_versions: usize,
    /// Fleets that wait for the engine.
    pub engine_queue: usize,
    /// Threads that running jobs use.
    pub threads_busy: usize,
    /// Threads that they may use together.
    pub threads: usize,
    /// Streams of jobs' events that are open.
    pub watchers: usize,
    /// Jobs by state; empty where the database does not answer.
    pub jobs: Vec<(JobState, u64)>,
}

/// Counts everything. What the database does not tell in time is left out: the rest is then wanted most.
pub async fn figures(app: &App) -> Figures {
    let jobs = match tokio::time::timeout(PATIENCE, app.store.job_counts()).await {
        Ok(Ok(jobs)) => jobs,
        Ok(Err(e)) => {
            tracing::warn!(error = %e, "jobs could not be counted");
            Vec::new()
        }
        Err(_) => Vec::new(),
    };
    Figures {
        sessions: app.sessions.len(),
        environments: app.environments.table().len(),
        policy_versions: app.registry.len(),
        engine_queue: app.engine.waiting(),
        threads_busy: app.scheduler.threads_busy(),
        threads: app.scheduler.config().cpu_budget,
        watchers: app.watchers.open(),
        jobs,
    }
}
