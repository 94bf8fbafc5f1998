//! What callers change of jobs: the rules by which their actions change states, and edits.

use std::collections::BTreeMap;

use jiff::Timestamp;
use sqlx::SqliteConnection;

use super::jobs::{find, get_existing};
use super::submission::set_labels;
use super::sweeps::{change_jobs, is_sweep};
use super::transitions::{Transition, release_dependents, transition};
use super::writes::WriteTransaction;
use super::{Job, JobAction, JobId, JobState, PendingAction, Result, Store, corrupt};

/// What a caller changes of a job; what is absent stays.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct JobEdit {
    /// The name, or no name.
    pub name: Option<Option<String>>,
    /// All labels.
    pub labels: Option<BTreeMap<String, String>>,
    /// The priority.
    pub priority: Option<i64>,
    /// The notes.
    pub notes: Option<String>,
}

/// The result of a [`JobAction`].
#[derive(Clone, Debug, PartialEq)]
pub enum ActionResult {
    /// The action is done or begun; the job after it.
    Accepted(Box<Job>),
    /// The state of the job does not allow the action.
    WrongState(Box<Job>),
    /// There is no such job.
    NotFound,
}

impl Store {
    /// Applies `action` if the state of the job allows it. A running job gets a pending action and changes when its worker
    /// has stopped.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn change_job(&self, id: JobId, action: JobAction, now: Timestamp) -> Result<ActionResult> {
        use JobState::{Cancelled, Failed, Paused, Queued, Running, Succeeded};
        let mut tx = self.begin().await?;
        let Some(job) = find(&mut tx, id).await? else {
            tx.abandon().await?;
            return Ok(ActionResult::NotFound);
        };
        if is_sweep(&job) && action != JobAction::Delete {
            return self.change_sweep(tx, job, action, now).await;
        }
        match (action, job.state, job.pending_action) {
            (JobAction::Cancel, Cancelled, _)
            | (JobAction::Cancel, Running, Some(PendingAction::Cancel))
            | (JobAction::Pause, Paused, _)
            | (JobAction::Pause, Running, Some(PendingAction::Pause))
            | (JobAction::Resume | JobAction::Retry, Queued, _)
            | (JobAction::Resume | JobAction::Retry, Running, None) => {
                tx.abandon().await?;
                return Ok(ActionResult::Accepted(Box::new(job)));
            }
            (JobAction::Cancel, Queued | Paused, _) => transition_now(&mut tx, &job, Cancelled, now).await?,
            (JobAction::Pause, Queued, _) => transition_now(&mut tx, &job, Paused, now).await?,
            (JobAction::Resume, Paused, _) => transition_now(&mut tx, &job, Queued, now).await?,
            (JobAction::Retry, Failed, _) => {
                let sql = "UPDATE jobs SET consecutive_failures = 0, ran = 0 WHERE number = ?";
                sqlx::query(sql).bind(job.row_id).execute(&mut *tx).await?;
                transition_now(&mut tx, &job, Queued, now).await?;
            }
            (JobAction::Cancel, Running, _) => set_pending_action(&mut tx, &job, PendingAction::Cancel).await?,
            (JobAction::Pause, Running, None) => set_pending_action(&mut tx, &job, PendingAction::Pause).await?,
            (JobAction::Delete, state, _) if state.ended() => {
                release_dependents(&mut tx, job.row_id, state == Succeeded, now).await?;
                let sql = "SELECT number, state FROM jobs WHERE parent = ?";
                let children: Vec<(i64, String)> = sqlx::query_as(sql).bind(id.to_string()).fetch_all(&mut *tx).await?;
                for (child, state) in children {
                    release_dependents(&mut tx, child, JobState::from_column(&state)? == Succeeded, now).await?;
                }
                sqlx::query("DELETE FROM jobs WHERE parent = ?").bind(id.to_string()).execute(&mut *tx).await?;
                sqlx::query("DELETE FROM jobs WHERE number = ?").bind(job.row_id).execute(&mut *tx).await?;
                tx.commit().await?;
                self.notify_all();
                return Ok(ActionResult::Accepted(Box::new(job)));
            }
            _ => {
                tx.abandon().await?;
                return Ok(ActionResult::WrongState(Box::new(job)));
            }
        }
        let job = get_existing(&mut tx, id).await?;
        tx.commit().await?;
        self.notify_all();
        Ok(ActionResult::Accepted(Box::new(job)))
    }

    /// Applies `action` to the jobs of a sweep, whose state follows.
    async fn change_sweep(
        &self,
        mut tx: WriteTransaction,
        sweep: Job,
        action: JobAction,
        now: Timestamp,
    ) -> Result<ActionResult> {
        let changed = change_jobs(&mut tx, &sweep, action, now).await?;
        // Where nothing is left to do, the sweep has the state that was asked for, or one that does not allow the action.
        let done = matches!(
            (action, sweep.state),
            (JobAction::Cancel, JobState::Cancelled)
                | (JobAction::Pause, JobState::Paused)
                | (JobAction::Resume, JobState::Running)
        );
        if !changed && !done {
            tx.abandon().await?;
            return Ok(ActionResult::WrongState(Box::new(sweep)));
        }
        let sweep = get_existing(&mut tx, sweep.id).await?;
        tx.commit().await?;
        self.notify_all();
        Ok(ActionResult::Accepted(Box::new(sweep)))
    }

    /// Edits what people choose of a job, in any state. Returns the job after it, or `None` if there is no such job.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn edit_job(&self, id: JobId, edit: JobEdit) -> Result<Option<Job>> {
        let mut tx = self.begin().await?;
        let Some(job) = find(&mut tx, id).await? else {
            tx.abandon().await?;
            return Ok(None);
        };
        let JobEdit { name, labels, priority, notes } = edit;
        let labels = labels.unwrap_or(job.spec.labels);
        let labels_document = serde_json::to_string(&labels).map_err(|e| corrupt("job", id, e))?;
        // The columns are what lists show and what the queue is ordered by; the document is what the worker reads.
        let sql = "UPDATE jobs SET name = ?2, labels = ?3, priority = ?4, notes = coalesce(?5, notes),
                   spec = CASE WHEN json_valid(spec)
                          THEN json_set(spec, '$.name', ?2, '$.labels', json(?3), '$.priority', ?4) ELSE spec END
                   WHERE number = ?1";
        sqlx::query(sql)
            .bind(job.row_id)
            .bind(name.unwrap_or(job.spec.name))
            .bind(labels_document)
            .bind(priority.unwrap_or(job.spec.priority))
            .bind(notes)
            .execute(&mut *tx)
            .await?;
        set_labels(&mut tx, job.row_id, &labels).await?;
        let job = get_existing(&mut tx, id).await?;
        tx.commit().await?;
        Ok(Some(job))
    }
}

async fn transition_now(tx: &mut SqliteConnection, job: &Job, to: JobState, now: Timestamp) -> Result<()> {
    transition(tx, Transition { job: job.row_id, to, attempt: job.attempts, reason: None, now }).await
}

async fn set_pending_action(tx: &mut SqliteConnection, job: &Job, action: PendingAction) -> Result<()> {
    let sql = "UPDATE jobs SET wanted = ? WHERE number = ?";
    sqlx::query(sql).bind(action.as_str()).bind(job.row_id).execute(&mut *tx).await?;
    Ok(())
}
