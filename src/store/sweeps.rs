//! Sweeps and experiments: jobs that only have other jobs. Their state follows from the states of these.

use jiff::Timestamp;
use sqlx::SqliteConnection;

use super::jobs::get_existing;
use super::submission::{find_submitted, insert};
use super::transitions::{Transition, transition};
use super::{Job, JobAction, JobId, JobKind, JobState, NewJob, PendingAction, Result, Store, SubmitResult};

impl Store {
    /// The results of the jobs that the job `parent` has made, as JSON, in the order of submission.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn results_of_jobs(&self, parent: JobId) -> Result<Vec<Option<String>>> {
        let query = sqlx::query_scalar("SELECT result FROM jobs WHERE parent = ? ORDER BY number").bind(parent.to_string());
        Ok(query.fetch_all(&self.read).await?)
    }

    /// Keeps the result of a job that has succeeded, as JSON.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn keep_result(&self, job: JobId, result: &str) -> Result<()> {
        let mut tx = self.begin().await?;
        let sql = "UPDATE jobs SET result = ? WHERE id = ? AND state = 'succeeded'";
        sqlx::query(sql).bind(result).bind(job.to_string()).execute(&mut *tx).await?;
        tx.commit().await
    }

    /// Submits a sweep together with its jobs, which are queued.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn submit_sweep(&self, sweep: NewJob, jobs: &[NewJob]) -> Result<SubmitResult> {
        let mut tx = self.begin().await?;
        if let Some((key, body)) = &sweep.idempotency
            && let Some(first) = find_submitted(&mut tx, sweep.owner.as_deref(), key, body).await?
        {
            tx.abandon().await?;
            return Ok(first);
        }
        let parent = insert(&mut tx, &sweep).await?;
        for job in jobs {
            insert(&mut tx, job).await?;
        }
        let running = Transition { job: parent.row_id, to: JobState::Running, attempt: 0, reason: None, now: sweep.now };
        transition(&mut tx, running).await?;
        let parent = get_existing(&mut tx, sweep.id).await?;
        tx.commit().await?;
        Ok(SubmitResult::Created(parent))
    }
}

/// Whether a job only has other jobs: a sweep or an experiment.
pub(super) fn is_sweep(job: &Job) -> bool {
    let kind = job.spec.kind.as_deref();
    [JobKind::Sweep, JobKind::Experiment].iter().any(|makes_jobs| kind == Some(makes_jobs.as_str()))
}

/// Applies `action` to the jobs of a sweep that it concerns. Returns whether there were any.
pub(super) async fn change_jobs(db: &mut SqliteConnection, sweep: &Job, action: JobAction, now: Timestamp) -> Result<bool> {
    let sql = "SELECT number, state, attempts FROM jobs WHERE parent = ? ORDER BY number";
    let jobs: Vec<(i64, String, i64)> = sqlx::query_as(sql).bind(sweep.id.to_string()).fetch_all(&mut *db).await?;
    let mut changed = false;
    for (job, state, attempts) in jobs {
        let (to, pending) = match (action, JobState::from_column(&state)?) {
            (JobAction::Cancel, JobState::Queued | JobState::Paused) => (Some(JobState::Cancelled), None),
            (JobAction::Cancel, JobState::Running) => (None, Some(PendingAction::Cancel)),
            (JobAction::Pause, JobState::Queued) => (Some(JobState::Paused), None),
            (JobAction::Pause, JobState::Running) => (None, Some(PendingAction::Pause)),
            (JobAction::Resume, JobState::Paused) | (JobAction::Retry, JobState::Failed) => (Some(JobState::Queued), None),
            _ => continue,
        };
        changed = true;
        if let Some(pending) = pending {
            // A cancel is final.
            let sql = "UPDATE jobs SET wanted = ? WHERE number = ? AND wanted IS NOT 'cancel'";
            sqlx::query(sql).bind(pending.as_str()).bind(job).execute(&mut *db).await?;
        }
        if let Some(to) = to {
            if action == JobAction::Retry {
                let sql = "UPDATE jobs SET consecutive_failures = 0, ran = 0 WHERE number = ?";
                sqlx::query(sql).bind(job).execute(&mut *db).await?;
            }
            transition(db, Transition { job, to, attempt: attempts as u32, reason: None, now }).await?;
        }
    }
    Ok(changed)
}
