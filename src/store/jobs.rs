//! Jobs: their records, their states, and how a state changes.

use std::time::Duration;

use jiff::Timestamp;
use sqlx::SqliteConnection;

use super::named_enum::named_enum;
use super::specs::StoredSpec;
use super::{Error, JobId, Result, Store, corrupt, timestamp};

named_enum! {
    /// The state of a job.
    JobState {
        /// Waits to be started.
        Queued = "queued",
        /// A worker works on it.
        Running = "running",
        /// Waits to be resumed.
        Paused = "paused",
        /// Ended by a cancel.
        Cancelled = "cancelled",
        /// Ended with all steps done.
        Succeeded = "succeeded",
        /// Ended because too many attempts failed.
        Failed = "failed",
    }
}

impl JobState {
    /// Whether the state is final.
    pub fn ended(self) -> bool {
        matches!(self, Self::Cancelled | Self::Succeeded | Self::Failed)
    }
}

named_enum! {
    /// An action on a running job that its worker has not carried out yet.
    PendingAction {
        /// End the job.
        Cancel = "cancel",
        /// Stop the worker and keep its snapshot.
        Pause = "pause",
    }
}

/// An action of a caller on a job.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum JobAction {
    /// End the job.
    Cancel,
    /// Stop the job's worker until the job is resumed.
    Pause,
    /// Queue a paused job again.
    Resume,
    /// Queue a failed job again.
    Retry,
    /// Delete the record of a job that has ended.
    Delete,
}

/// The current record of a job.
#[derive(Clone, Debug, PartialEq)]
pub struct Job {
    /// The id.
    pub id: JobId,
    /// Key of the row. Jobs submitted later have larger keys.
    pub row_id: i64,
    /// Who submitted the job; `None`: nobody, on a server without keys.
    pub owner: Option<String>,
    /// Whether the job may publish under a name that another owner made.
    pub any_name: bool,
    /// The state.
    pub state: JobState,
    /// Action that the worker has not carried out yet.
    pub pending_action: Option<PendingAction>,
    /// Why the job, or its last attempt, failed.
    pub reason: Option<String>,
    /// What people write about the job.
    pub notes: String,
    /// The job that made this one; `None`: a caller made it.
    pub parent: Option<JobId>,
    /// The specification.
    pub spec: StoredSpec,
    /// Number of attempts that have begun.
    pub attempts: u32,
    /// Number of attempts that have failed.
    pub failures: u32,
    /// Number of attempts that have failed since the job last made progress.
    pub consecutive_failures: u32,
    /// Environment steps done.
    pub step: u64,
    /// `NAME:VERSION` of the published policy.
    pub policy: Option<String>,
    /// Id of the newest event.
    pub last_event: u64,
    /// Number of jobs that must succeed before this one can start and have not.
    pub blocked: u64,
    /// When the next attempt may begin; `None`: at once.
    pub not_before: Option<Timestamp>,
    /// Time for which the attempts that have ended ran, since the job was last retried.
    pub ran: Duration,
    /// When the job was submitted.
    pub created_at: Timestamp,
    /// When the first attempt began.
    pub started_at: Option<Timestamp>,
    /// When the job ended.
    pub ended_at: Option<Timestamp>,
}

from_row! {
    pub(super) struct JobRow {
        number: i64,
        id: String,
        owner: Option<String>,
        any_name: bool,
        state: String,
        /// The pending action.
        wanted: Option<String>,
        reason: Option<String>,
        notes: String,
        parent: Option<String>,
        spec: String,
        kind: Option<String>,
        name: Option<String>,
        labels: Option<String>,
        threads: i64,
        priority: i64,
        algorithm: Option<String>,
        preset: Option<String>,
        seed: Option<String>,
        steps: Option<i64>,
        attempts: i64,
        failures: i64,
        consecutive_failures: i64,
        step: i64,
        policy: Option<String>,
        seq: i64,
        blocked: i64,
        not_before: Option<i64>,
        ran: i64,
        created_at: i64,
        started_at: Option<i64>,
        ended_at: Option<i64>,
    }
}

impl TryFrom<JobRow> for Job {
    type Error = Error;

    fn try_from(row: JobRow) -> Result<Self> {
        Ok(Self {
            id: JobId::parse(&row.id).ok_or_else(|| corrupt("job", &row.id, "not an id"))?,
            row_id: row.number,
            owner: row.owner,
            any_name: row.any_name,
            state: JobState::from_column(&row.state)?,
            pending_action: row.wanted.as_deref().map(PendingAction::from_column).transpose()?,
            reason: row.reason,
            notes: row.notes,
            parent: row.parent.as_deref().and_then(JobId::parse),
            spec: StoredSpec {
                kind: row.kind,
                name: row.name,
                labels: row.labels.and_then(|labels| serde_json::from_str(&labels).ok()).unwrap_or_default(),
                threads: row.threads as usize,
                priority: row.priority,
                algorithm: row.algorithm,
                preset: row.preset,
                seed: row.seed.and_then(|seed| seed.parse().ok()),
                steps: row.steps.unwrap_or_default() as u64,
                document: row.spec,
            },
            attempts: row.attempts as u32,
            failures: row.failures as u32,
            consecutive_failures: row.consecutive_failures as u32,
            step: row.step as u64,
            policy: row.policy,
            last_event: row.seq as u64,
            blocked: row.blocked as u64,
            not_before: row.not_before.map(timestamp).transpose()?,
            ran: Duration::from_millis(row.ran.max(0) as u64),
            created_at: timestamp(row.created_at)?,
            started_at: row.started_at.map(timestamp).transpose()?,
            ended_at: row.ended_at.map(timestamp).transpose()?,
        })
    }
}

pub(super) async fn find(db: &mut SqliteConnection, id: JobId) -> Result<Option<Job>> {
    let row: Option<JobRow> =
        sqlx::query_as("SELECT * FROM jobs WHERE id = ?").bind(id.to_string()).fetch_optional(&mut *db).await?;
    row.map(Job::try_from).transpose()
}

pub(super) async fn get_existing(db: &mut SqliteConnection, id: JobId) -> Result<Job> {
    find(db, id).await?.ok_or_else(|| corrupt("job", id, "deleted within a transaction"))
}

impl Store {
    /// The job `id`.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn job(&self, id: JobId) -> Result<Option<Job>> {
        find(&mut *self.read.acquire().await?, id).await
    }

    /// The result of the job `id`, as JSON.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn job_result(&self, id: JobId) -> Result<Option<String>> {
        let query = sqlx::query_scalar("SELECT result FROM jobs WHERE id = ?").bind(id.to_string());
        Ok(query.fetch_optional(&self.read).await?.flatten())
    }

    /// The number of jobs in each state.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn job_counts(&self) -> Result<Vec<(JobState, u64)>> {
        let sql = "SELECT state, count(*) FROM jobs GROUP BY state";
        let rows: Vec<(String, i64)> = sqlx::query_as(sql).fetch_all(&self.read).await?;
        let count = |name: &str| rows.iter().find(|(state, _)| state == name).map_or(0, |(_, count)| *count as u64);
        JobState::NAMES.iter().map(|name| Ok((JobState::from_column(name)?, count(name)))).collect()
    }
}
