//! Sweeps: jobs that only have other jobs. Their state follows from the states of these.

use jiff::Timestamp;
use sqlx::SqliteConnection;

use super::jobs::get_existing;
use super::submission::{find_submitted, insert};
use super::transitions::{Transition, transition};
use super::{Job, JobAction, JobKind, JobState, NewJob, PendingAction, Result, Store, SubmitResult};

impl Store {
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

/// Whether a job is a sweep.
pub(super) fn is_sweep(job: &Job) -> bool {
    job.spec.kind.as_deref() == Some(JobKind::Sweep.as_str())
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
