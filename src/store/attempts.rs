//! Attempts at jobs: one worker's turn each, from its token to its outcome. Only the newest attempt that has not ended may
//! write anything; whoever holds an older token is fenced.

use jiff::Timestamp;
use sqlx::{FromRow, SqliteConnection};

use super::jobs::{Transition, find, named, transition};
use super::{Job, JobId, JobState, Result, Store, Wanted, corrupt, timestamp};

named! {
    /// How an attempt ended.
    Outcome {
        /// The job is done.
        Succeeded = "succeeded",
        /// The worker died or gave up.
        Failed = "failed",
        /// Somebody cancelled the job.
        Cancelled = "cancelled",
        /// Somebody paused the job.
        Paused = "paused",
        /// The server stopped, or the worker had to; not a failure.
        Interrupted = "interrupted",
    }
}

/// The right to work at a job: one attempt.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Lease {
    /// The job.
    pub id: JobId,
    /// Its number.
    pub job: i64,
    /// The attempt, from 1.
    pub attempt: u32,
}

/// What is known of a lease that somebody claims.
#[derive(Clone, Debug)]
pub struct LeaseRecord {
    /// The lease.
    pub lease: Lease,
    /// SHA-256 of its token.
    pub token: Vec<u8>,
    /// Whether it still lasts.
    pub live: bool,
}

/// How an attempt ends.
#[derive(Clone, Debug, PartialEq)]
pub enum Ending {
    /// All is done, and published as this `NAME:VERSION`.
    Succeeded(Option<String>),
    /// Stopped before the end, as asked; the job does what was wanted of it, else it waits for its next turn.
    Stopped,
    /// Died or gave up; the job is tried again until this many attempts have failed.
    Failed {
        /// What happened.
        reason: String,
        /// Failures after which the job has failed.
        max_attempts: u32,
    },
}

/// An attempt as it stands.
#[derive(Clone, Debug, PartialEq)]
pub struct Attempt {
    /// From 1.
    pub number: u32,
    /// When it began.
    pub started_at: Timestamp,
    /// When it ended.
    pub ended_at: Option<Timestamp>,
    /// How it ended.
    pub outcome: Option<Outcome>,
    /// What happened.
    pub reason: Option<String>,
    /// Last output of its worker, known when the worker's process has ended.
    pub log: String,
}

#[derive(FromRow)]
struct AttemptRow {
    number: i64,
    started_at: i64,
    ended_at: Option<i64>,
    outcome: Option<String>,
    reason: Option<String>,
    log: String,
}

/// Whether the lease still lasts.
pub(super) async fn live(db: &mut SqliteConnection, lease: Lease) -> Result<bool> {
    let sql = "SELECT 1 FROM attempts a JOIN jobs j ON j.number = a.job
               WHERE a.job = ? AND a.number = ? AND a.number = j.attempts AND a.ended_at IS NULL";
    Ok(sqlx::query(sql).bind(lease.job).bind(lease.attempt).fetch_optional(&mut *db).await?.is_some())
}

/// Ends an attempt and moves its job on. Does nothing when it has ended before.
async fn end(db: &mut SqliteConnection, lease: Lease, ending: &Ending, now: Timestamp) -> Result<Option<Job>> {
    if !live(db, lease).await? {
        return Ok(None);
    }
    let job = find(db, lease.id).await?.ok_or_else(|| corrupt("job", lease.id, "vanished within a transaction"))?;
    // A cancel that was acknowledged is kept, even where the worker was faster.
    let (outcome, state) = match (ending, job.wanted) {
        (Ending::Succeeded(_) | Ending::Stopped, Some(Wanted::Cancel)) => (Outcome::Cancelled, JobState::Cancelled),
        (Ending::Succeeded(_), _) => (Outcome::Succeeded, JobState::Succeeded),
        (Ending::Stopped, Some(Wanted::Pause)) => (Outcome::Paused, JobState::Paused),
        (Ending::Stopped, None) => (Outcome::Interrupted, JobState::Queued),
        (Ending::Failed { .. }, Some(Wanted::Cancel)) => (Outcome::Failed, JobState::Cancelled),
        (Ending::Failed { max_attempts, .. }, wanted) => match wanted {
            _ if job.failures + 1 >= *max_attempts => (Outcome::Failed, JobState::Failed),
            Some(_) => (Outcome::Failed, JobState::Paused),
            None => (Outcome::Failed, JobState::Queued),
        },
    };
    let reason = if let Ending::Failed { reason, .. } = ending { Some(reason.as_str()) } else { None };
    let sql = "UPDATE attempts SET ended_at = ?3, outcome = ?4, reason = ?5 WHERE job = ?1 AND number = ?2";
    sqlx::query(sql)
        .bind(lease.job)
        .bind(lease.attempt)
        .bind(now.as_millisecond())
        .bind(outcome.as_str())
        .bind(reason)
        .execute(&mut *db)
        .await?;
    let failed = i64::from(outcome == Outcome::Failed);
    let policy = if let (Ending::Succeeded(policy), JobState::Succeeded) = (ending, state) { policy.as_deref() } else { None };
    let sql = "UPDATE jobs SET failures = failures + ?2, policy = coalesce(?3, policy) WHERE number = ?1";
    sqlx::query(sql).bind(lease.job).bind(failed).bind(policy).execute(&mut *db).await?;
    transition(db, Transition { job: lease.job, to: state, attempt: lease.attempt, reason, now }).await?;
    find(db, lease.id).await
}

impl Store {
    /// Gives `job`, if it is still queued, to a worker that will show the token with this SHA-256.
    ///
    /// # Errors
    /// The database.
    pub async fn begin_attempt(&self, id: JobId, token: [u8; 32], now: Timestamp) -> Result<Option<Lease>> {
        let mut tx = self.write.begin().await?;
        let Some(job) = find(&mut tx, id).await?.filter(|job| job.state == JobState::Queued) else { return Ok(None) };
        let lease = Lease { id, job: job.number, attempt: job.attempts + 1 };
        let sql = "INSERT INTO attempts (job, number, token, started_at) VALUES (?, ?, ?, ?)";
        sqlx::query(sql)
            .bind(lease.job)
            .bind(lease.attempt)
            .bind(token.as_slice())
            .bind(now.as_millisecond())
            .execute(&mut *tx)
            .await?;
        let sql = "UPDATE jobs SET attempts = ? WHERE number = ?";
        sqlx::query(sql).bind(lease.attempt).bind(lease.job).execute(&mut *tx).await?;
        let to = JobState::Running;
        transition(&mut tx, Transition { job: lease.job, to, attempt: lease.attempt, reason: None, now }).await?;
        tx.commit().await?;
        self.ring(lease.job);
        Ok(Some(lease))
    }

    /// Ends an attempt and moves its job on; nothing when it has ended before.
    ///
    /// # Errors
    /// The database.
    pub async fn end_attempt(&self, lease: Lease, ending: &Ending, now: Timestamp) -> Result<Option<Job>> {
        let mut tx = self.write.begin().await?;
        let job = end(&mut tx, lease, ending, now).await?;
        tx.commit().await?;
        self.ring(lease.job);
        Ok(job)
    }

    /// Keeps the last output of an attempt's worker.
    ///
    /// # Errors
    /// The database.
    pub async fn keep_log(&self, lease: Lease, log: &str) -> Result<()> {
        let sql = "UPDATE attempts SET log = ?3 WHERE job = ?1 AND number = ?2";
        sqlx::query(sql).bind(lease.job).bind(lease.attempt).bind(log).execute(&self.write).await?;
        Ok(())
    }

    /// After a restart: whoever worked for the server before does so no longer, and their jobs wait for their next turn.
    ///
    /// # Errors
    /// The database.
    pub async fn recover_jobs(&self, now: Timestamp) -> Result<Vec<Job>> {
        let mut tx = self.write.begin().await?;
        let sql = "SELECT id, number, attempts FROM jobs WHERE state = 'running'";
        let rows: Vec<(String, i64, i64)> = sqlx::query_as(sql).fetch_all(&mut *tx).await?;
        let mut jobs = Vec::with_capacity(rows.len());
        for (id, job, attempt) in rows {
            let id = JobId::parse(&id).ok_or_else(|| corrupt("job", &id, "not an id"))?;
            jobs.extend(end(&mut tx, Lease { id, job, attempt: attempt as u32 }, &Ending::Stopped, now).await?);
        }
        sqlx::query("DELETE FROM snapshots WHERE sha256 IS NULL").execute(&mut *tx).await?;
        tx.commit().await?;
        Ok(jobs)
    }

    /// What is known of attempt `attempt` at job `id`.
    ///
    /// # Errors
    /// The database.
    pub async fn lease(&self, id: JobId, attempt: u32) -> Result<Option<LeaseRecord>> {
        let sql = "SELECT j.number, a.token, a.number = j.attempts AND a.ended_at IS NULL FROM jobs j
                   JOIN attempts a ON a.job = j.number WHERE j.id = ? AND a.number = ?";
        let row: Option<(i64, Vec<u8>, bool)> =
            sqlx::query_as(sql).bind(id.to_string()).bind(attempt).fetch_optional(&self.read).await?;
        Ok(row.map(|(job, token, live)| LeaseRecord { lease: Lease { id, job, attempt }, token, live }))
    }

    /// All attempts at a job, oldest first.
    ///
    /// # Errors
    /// The database.
    pub async fn attempts(&self, id: JobId) -> Result<Vec<Attempt>> {
        let sql = "SELECT a.* FROM attempts a JOIN jobs j ON j.number = a.job WHERE j.id = ? ORDER BY a.number";
        let rows: Vec<AttemptRow> = sqlx::query_as(sql).bind(id.to_string()).fetch_all(&self.read).await?;
        rows.into_iter()
            .map(|row| {
                Ok(Attempt {
                    number: row.number as u32,
                    started_at: timestamp(row.started_at)?,
                    ended_at: row.ended_at.map(timestamp).transpose()?,
                    outcome: row.outcome.as_deref().map(Outcome::read).transpose()?,
                    reason: row.reason,
                    log: row.log,
                })
            })
            .collect()
    }
}
