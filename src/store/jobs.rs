//! Jobs: their specifications, their states, and the rules by which states change.

use std::fmt;

use futures::TryStreamExt;
use jiff::Timestamp;
use serde::Serialize;
use sqlx::SqliteConnection;
use uuid::Uuid;

use super::named_enum::named_enum;
use super::specs::{JobSpec, StoredSpec};
use super::{Error, Result, Store, corrupt, timestamp};

/// Identifies a job.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(transparent)]
pub struct JobId(pub Uuid);

impl JobId {
    /// Parses an id in its canonical form: lower case, with hyphens.
    pub fn parse(text: &str) -> Option<Self> {
        let id = Uuid::try_parse(text).ok()?;
        (id.to_string() == text).then_some(Self(id))
    }
}

impl fmt::Display for JobId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

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
    /// When the job was submitted.
    pub created_at: Timestamp,
    /// When the first attempt began.
    pub started_at: Option<Timestamp>,
    /// When the job ended.
    pub ended_at: Option<Timestamp>,
}

from_row! {
    struct JobRow {
        number: i64,
        id: String,
        owner: Option<String>,
        any_name: bool,
        state: String,
        /// The pending action.
        wanted: Option<String>,
        reason: Option<String>,
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
            created_at: timestamp(row.created_at)?,
            started_at: row.started_at.map(timestamp).transpose()?,
            ended_at: row.ended_at.map(timestamp).transpose()?,
        })
    }
}

/// A job to submit.
#[derive(Clone, Debug)]
pub struct NewJob {
    /// The id.
    pub id: JobId,
    /// Who submits the job; `None`: nobody, on a server without keys.
    pub owner: Option<String>,
    /// Whether the job may publish under a name that another owner made.
    pub any_name: bool,
    /// The specification.
    pub spec: JobSpec,
    /// The current time.
    pub now: Timestamp,
    /// The idempotency key of the request, which belongs to the owner, and the SHA-256 of its body.
    pub idempotency: Option<(String, [u8; 32])>,
}

impl NewJob {
    /// The owner of the idempotency key.
    fn owner(&self) -> &str {
        self.owner.as_deref().unwrap_or_default()
    }
}

/// The jobs that a list contains.
#[derive(Clone, Copy, Debug, Default)]
pub struct JobFilter<'a> {
    /// Only those of this owner.
    pub owner: Option<&'a str>,
    /// Only those in this state.
    pub state: Option<JobState>,
    /// Only those with smaller row ids.
    pub before: Option<i64>,
}

/// The result of a submission.
#[derive(Clone, Debug, PartialEq)]
pub enum SubmitResult {
    /// The job was created and queued.
    Created(Job),
    /// A job with the same idempotency key and body exists.
    Existing(Job),
    /// A job with the same idempotency key and another body exists.
    Conflict,
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

/// A change of state and its entry in the event log.
pub(super) struct Transition<'a> {
    pub(super) job: i64,
    pub(super) to: JobState,
    pub(super) attempt: u32,
    pub(super) reason: Option<&'a str>,
    pub(super) now: Timestamp,
}

/// Moves a job to another state and appends an event. Deletes the snapshot of a job that ends, unless it failed: a failed job can
/// be retried.
pub(super) async fn transition(db: &mut SqliteConnection, t: Transition<'_>) -> Result<()> {
    let now = t.now.as_millisecond();
    let ended = t.to.ended().then_some(now);
    let started = (t.to == JobState::Running).then_some(now);
    let state = t.to.as_str();
    let sql = "UPDATE jobs SET state = ?2, wanted = NULL, reason = ?3, ended_at = ?4, started_at = coalesce(started_at, ?5),
               seq = seq + 1 WHERE number = ?1 RETURNING seq";
    let update = sqlx::query_scalar(sql).bind(t.job).bind(state).bind(t.reason).bind(ended).bind(started);
    let seq: i64 = update.fetch_one(&mut *db).await?;
    let sql = "INSERT INTO events (job, at, state, attempt, reason, seq) VALUES (?, ?, ?, ?, ?, ?)";
    let insert = sqlx::query(sql).bind(t.job).bind(now).bind(state).bind(t.attempt).bind(t.reason).bind(seq);
    insert.execute(&mut *db).await?;
    if t.to.ended() && t.to != JobState::Failed {
        sqlx::query("DELETE FROM snapshots WHERE job = ?").bind(t.job).execute(&mut *db).await?;
    }
    Ok(())
}

pub(super) async fn find(db: &mut SqliteConnection, id: JobId) -> Result<Option<Job>> {
    let row: Option<JobRow> =
        sqlx::query_as("SELECT * FROM jobs WHERE id = ?").bind(id.to_string()).fetch_optional(&mut *db).await?;
    row.map(Job::try_from).transpose()
}

async fn get_existing(db: &mut SqliteConnection, id: JobId) -> Result<Job> {
    find(db, id).await?.ok_or_else(|| corrupt("job", id, "deleted within a transaction"))
}

async fn find_submitted(
    db: &mut SqliteConnection,
    owner: Option<&str>,
    key: &str,
    body: &[u8; 32],
) -> Result<Option<SubmitResult>> {
    let sql = "SELECT k.body, j.id FROM idempotency_keys k JOIN jobs j ON j.number = k.job WHERE k.owner = ? AND k.key = ?";
    let query = sqlx::query_as(sql).bind(owner.unwrap_or_default()).bind(key);
    let first: Option<(Vec<u8>, String)> = query.fetch_optional(&mut *db).await?;
    let Some((first, id)) = first else { return Ok(None) };
    if first != body {
        return Ok(Some(SubmitResult::Conflict));
    }
    let id = JobId::parse(&id).ok_or_else(|| corrupt("job", &id, "not an id"))?;
    Ok(find(db, id).await?.map(SubmitResult::Existing))
}

impl Store {
    /// Queues a job.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn submit_job(&self, new: NewJob) -> Result<SubmitResult> {
        let mut tx = self.begin().await?;
        if let Some((key, body)) = &new.idempotency
            && let Some(first) = find_submitted(&mut tx, new.owner.as_deref(), key, body).await?
        {
            tx.abandon().await?;
            return Ok(first);
        }
        let job = insert(&mut tx, &new).await?;
        tx.commit().await?;
        Ok(SubmitResult::Created(job))
    }

    /// The result of repeating a submission of `owner` with this idempotency key and SHA-256 of its body; `None` if the key is new.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn submitted_job(&self, owner: Option<&str>, key: &str, body: &[u8; 32]) -> Result<Option<SubmitResult>> {
        find_submitted(&mut *self.read.acquire().await?, owner, key, body).await
    }

    /// The job `id`.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn job(&self, id: JobId) -> Result<Option<Job>> {
        find(&mut *self.read.acquire().await?, id).await
    }

    /// Jobs, newest first, and whether there are more. At most `limit` jobs whose summaries have together about `max_bytes`
    /// bytes, but at least one.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn jobs(&self, filter: JobFilter<'_>, limit: usize, max_bytes: usize) -> Result<(Vec<Job>, bool)> {
        /// Bytes of a summary besides its texts.
        const FIXED: usize = 512;
        let JobFilter { owner, state, before } = filter;
        let before = before.unwrap_or(i64::MAX);
        let state = state.map(JobState::as_str);
        // One statement per combination, so that each finds its rows by an index.
        let numbers = match (owner, state) {
            (None, None) => {
                let sql = "SELECT number FROM jobs WHERE number < ? ORDER BY number DESC LIMIT ?";
                sqlx::query_scalar(sql).bind(before)
            }
            (Some(owner), None) => {
                let sql = "SELECT number FROM jobs WHERE owner = ? AND number < ? ORDER BY number DESC LIMIT ?";
                sqlx::query_scalar(sql).bind(owner).bind(before)
            }
            (None, Some(state)) => {
                let sql = "SELECT number FROM jobs WHERE state = ? AND number < ? ORDER BY number DESC LIMIT ?";
                sqlx::query_scalar(sql).bind(state).bind(before)
            }
            (Some(owner), Some(state)) => {
                let sql = "SELECT number FROM jobs WHERE owner = ? AND state = ? AND number < ? ORDER BY number DESC LIMIT ?";
                sqlx::query_scalar(sql).bind(owner).bind(state).bind(before)
            }
        };
        let mut db = self.read.begin().await?;
        let mut numbers: Vec<i64> = numbers.bind(limit as i64 + 1).fetch_all(&mut *db).await?;
        let more = numbers.len() > limit;
        numbers.truncate(limit);
        let sql = "SELECT * FROM jobs WHERE number IN (SELECT value FROM json_each(?)) ORDER BY number DESC";
        let query = sqlx::query_as(sql).bind(serde_json::Value::from(numbers).to_string());
        let (mut rows, mut jobs, mut bytes) = (query.fetch(&mut *db), Vec::new(), 0);
        while let Some(row) = rows.try_next().await? {
            let row: JobRow = row;
            let job = match Job::try_from(row) {
                Ok(job) => job,
                Err(error) => {
                    tracing::error!(%error, "a job is left out of a list");
                    continue;
                }
            };
            bytes += FIXED + job.spec.shown_bytes() + job.reason.as_ref().map_or(0, String::len);
            if bytes > max_bytes && !jobs.is_empty() {
                return Ok((jobs, true));
            }
            jobs.push(job);
        }
        Ok((jobs, more))
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

    /// The queued job that starts next: highest priority, then first come, first served.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn head_of_queue(&self) -> Result<Option<Job>> {
        let sql = "SELECT * FROM jobs WHERE state = 'queued' ORDER BY priority DESC, number LIMIT 1";
        let row: Option<JobRow> = sqlx::query_as(sql).fetch_optional(&self.read).await?;
        row.map(Job::try_from).transpose()
    }

    /// Ends a queued job that cannot be started. Returns whether it was queued.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn fail_queued_job(&self, job: &Job, reason: &str, now: Timestamp) -> Result<bool> {
        let mut tx = self.begin().await?;
        let queued = find(&mut tx, job.id).await?.is_some_and(|job| job.state == JobState::Queued);
        if queued {
            let (to, attempt, reason) = (JobState::Failed, job.attempts, Some(reason));
            transition(&mut tx, Transition { job: job.row_id, to, attempt, reason, now }).await?;
            tx.commit().await?;
            self.notify(job.row_id);
        } else {
            tx.abandon().await?;
        }
        Ok(queued)
    }

    /// Applies `action` if the state of the job allows it. A running job gets a pending action and changes when its worker
    /// has stopped.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn change_job(&self, id: JobId, action: JobAction, now: Timestamp) -> Result<ActionResult> {
        use JobState::{Cancelled, Failed, Paused, Queued, Running};
        let mut tx = self.begin().await?;
        let Some(job) = find(&mut tx, id).await? else {
            tx.abandon().await?;
            return Ok(ActionResult::NotFound);
        };
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
                let sql = "UPDATE jobs SET consecutive_failures = 0 WHERE number = ?";
                sqlx::query(sql).bind(job.row_id).execute(&mut *tx).await?;
                transition_now(&mut tx, &job, Queued, now).await?;
            }
            (JobAction::Cancel, Running, _) => set_pending_action(&mut tx, &job, PendingAction::Cancel).await?,
            (JobAction::Pause, Running, None) => set_pending_action(&mut tx, &job, PendingAction::Pause).await?,
            (JobAction::Delete, state, _) if state.ended() => {
                sqlx::query("DELETE FROM jobs WHERE number = ?").bind(job.row_id).execute(&mut *tx).await?;
                tx.commit().await?;
                self.notify(job.row_id);
                return Ok(ActionResult::Accepted(Box::new(job)));
            }
            _ => {
                tx.abandon().await?;
                return Ok(ActionResult::WrongState(Box::new(job)));
            }
        }
        let job = get_existing(&mut tx, id).await?;
        tx.commit().await?;
        self.notify(job.row_id);
        Ok(ActionResult::Accepted(Box::new(job)))
    }
}

async fn insert(tx: &mut SqliteConnection, new: &NewJob) -> Result<Job> {
    let spec = serde_json::to_string(&new.spec).map_err(|e| corrupt("job", new.id, e))?;
    let now = new.now.as_millisecond();
    let NewJob { id, owner, any_name, spec: JobSpec { kind, name, labels, threads, priority, config }, .. } = new;
    let labels = serde_json::to_string(labels).map_err(|e| corrupt("job", id, e))?;
    let sql = "INSERT INTO jobs
               (id, owner, any_name, state, spec, threads, priority, created_at, kind, name, labels, algorithm, preset, seed, steps)
               VALUES (?, ?, ?, 'queued', ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)";
    let row_id = sqlx::query(sql)
        .bind(id.to_string())
        .bind(owner)
        .bind(any_name)
        .bind(spec)
        .bind(*threads as i64)
        .bind(priority)
        .bind(now)
        .bind(kind.as_str())
        .bind(name)
        .bind(labels)
        .bind(text_of(&config.algorithm))
        .bind(text_of(&config.preset))
        .bind(config.seed.to_string())
        .bind(config.training.steps as i64)
        .execute(&mut *tx)
        .await?
        .last_insert_rowid();
    transition(tx, Transition { job: row_id, to: JobState::Queued, attempt: 0, reason: None, now: new.now }).await?;
    if let Some((key, body)) = &new.idempotency {
        let sql = "INSERT INTO idempotency_keys (owner, key, body, job, created_at) VALUES (?, ?, ?, ?, ?)";
        sqlx::query(sql).bind(new.owner()).bind(key).bind(body.as_slice()).bind(row_id).bind(now).execute(&mut *tx).await?;
    }
    get_existing(tx, new.id).await
}

/// The name of a value in documents.
fn text_of(value: &impl Serialize) -> Option<String> {
    serde_json::to_value(value).ok()?.as_str().map(str::to_owned)
}

async fn transition_now(tx: &mut SqliteConnection, job: &Job, to: JobState, now: Timestamp) -> Result<()> {
    transition(tx, Transition { job: job.row_id, to, attempt: job.attempts, reason: None, now }).await
}

async fn set_pending_action(tx: &mut SqliteConnection, job: &Job, action: PendingAction) -> Result<()> {
    let sql = "UPDATE jobs SET wanted = ? WHERE number = ?";
    sqlx::query(sql).bind(action.as_str()).bind(job.row_id).execute(&mut *tx).await?;
    Ok(())
}
