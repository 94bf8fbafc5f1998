//! Attempts: one worker process working on a job each, from its token to its outcome. Only the newest attempt of a job may
//! write, and only until it has ended. The store refuses writes of all other attempts.

use jiff::Timestamp;
use sqlx::SqliteConnection;

use super::jobs::find;
use super::named_enum::named_enum;
use super::policies::{NewPolicyVersion, PublishedPolicy, may_publish, publish};
use super::transitions::{Transition, transition};
use super::{Job, JobId, JobState, PendingAction, Result, Store, corrupt, timestamp};

named_enum! {
    /// How an attempt ended, as stored. It follows from the [`WorkerResult`] and the pending action of the job.
    AttemptOutcome {
        /// All steps are done.
        Succeeded = "succeeded",
        /// The worker died or gave up.
        Failed = "failed",
        /// A caller cancelled the job.
        Cancelled = "cancelled",
        /// A caller paused the job.
        Paused = "paused",
        /// The server or the worker was stopped, or the host could not run the worker. Not a failure of the job.
        Interrupted = "interrupted",
    }
}

/// The right of one attempt to work on a job.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Lease {
    /// Id of the job.
    pub job_id: JobId,
    /// Row id of the job ([`Job::row_id`]).
    pub job_row: i64,
    /// Number of the attempt, from 1.
    pub attempt: u32,
}

/// A lease as stored, to check the token of a worker.
#[derive(Clone, Debug)]
pub struct LeaseRecord {
    /// The lease.
    pub lease: Lease,
    /// SHA-256 of the token.
    pub token: Vec<u8>,
    /// Whether the attempt may write.
    pub active: bool,
}

/// The result of an attempt as its worker reports it, or the scheduler for a worker that did not.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum WorkerResult {
    /// All environment steps are completed.
    Succeeded,
    /// Training ended before all steps were done, as the job asks for: a success.
    EndedEarly {
        /// Why.
        reason: String,
    },
    /// The worker stopped early because of a directive. The pending action of the job is applied; without one the job is queued
    /// again.
    Stopped,
    /// The worker died or gave up.
    Failed {
        /// Why.
        reason: String,
        /// Whether another attempt would fail in the same way, so that none is made.
        permanent: bool,
    },
}

/// The end of an attempt.
#[derive(Clone, Debug)]
pub struct EndedAttempt<'a> {
    /// The attempt.
    pub lease: Lease,
    /// How it ended.
    pub result: &'a WorkerResult,
    /// The policy to publish if the job succeeds, in the same transaction.
    pub publish: Option<NewPolicyVersion<'a>>,
    /// The result of a job that succeeds, as JSON.
    pub document: Option<&'a str>,
    /// Consecutive attempts that fail without progress after which the job has failed.
    pub max_attempts: u32,
    /// When it ended.
    pub now: Timestamp,
}

/// Attempts of a job that are kept. The number of attempts of a job has no limit.
pub const KEPT_ATTEMPTS: i64 = 100;

/// The current record of an attempt.
#[derive(Clone, Debug, PartialEq)]
pub struct Attempt {
    /// Number of the attempt, from 1.
    pub number: u32,
    /// When the attempt began.
    pub started_at: Timestamp,
    /// When the attempt ended.
    pub ended_at: Option<Timestamp>,
    /// How the attempt ended.
    pub outcome: Option<AttemptOutcome>,
    /// Why the attempt failed, or ended early.
    pub reason: Option<String>,
    /// Last output of the worker. While the worker runs, it is stored with a delay of a second.
    pub log: String,
}

from_row! {
    struct AttemptRow {
        number: i64,
        started_at: i64,
        ended_at: Option<i64>,
        outcome: Option<String>,
        reason: Option<String>,
        log: String,
    }
}

/// Whether the attempt may write: it is the newest of its job and has not ended.
pub(super) async fn is_active(db: &mut SqliteConnection, lease: Lease) -> Result<bool> {
    let sql = "SELECT 1 FROM attempts a JOIN jobs j ON j.number = a.job
               WHERE a.job = ? AND a.number = ? AND a.number = j.attempts AND a.ended_at IS NULL";
    Ok(sqlx::query(sql).bind(lease.job_row).bind(lease.attempt).fetch_optional(&mut *db).await?.is_some())
}

/// Ends an attempt and changes the state of its job; publishes the policy of a job that succeeds. Does nothing if the attempt
/// has already ended.
async fn end(db: &mut SqliteConnection, ended: EndedAttempt<'_>) -> Result<Option<(Job, Option<PublishedPolicy>)>> {
    let EndedAttempt { lease, result, publish: policy, document, max_attempts, now } = ended;
    if !is_active(db, lease).await? {
        return Ok(None);
    }
    let job = find(db, lease.job_id).await?.ok_or_else(|| corrupt("job", lease.job_id, "deleted within a transaction"))?;
    // Another owner may have made the name since the job was submitted. Another attempt would fail in the same way.
    let name_taken;
    let result = match policy {
        Some(new) if !may_publish(db, new).await? => {
            let reason = format!("another owner made the policy {}; the checkpoints of the job remain", new.name);
            name_taken = WorkerResult::Failed { reason, permanent: true };
            &name_taken
        }
        _ => result,
    };
    let limits = job.spec.decode().map(|spec| spec.limits).unwrap_or_default();
    let max_attempts = limits.max_attempts.unwrap_or(max_attempts);
    // An acknowledged cancel wins, even over a worker that succeeded before it noticed.
    let (outcome, state) = match (result, job.pending_action) {
        (WorkerResult::Succeeded | WorkerResult::EndedEarly { .. } | WorkerResult::Stopped, Some(PendingAction::Cancel)) => {
            (AttemptOutcome::Cancelled, JobState::Cancelled)
        }
        (WorkerResult::Succeeded | WorkerResult::EndedEarly { .. }, _) => (AttemptOutcome::Succeeded, JobState::Succeeded),
        (WorkerResult::Stopped, Some(PendingAction::Pause)) => (AttemptOutcome::Paused, JobState::Paused),
        (WorkerResult::Stopped, None) => (AttemptOutcome::Interrupted, JobState::Queued),
        (WorkerResult::Failed { .. }, Some(PendingAction::Cancel)) => (AttemptOutcome::Failed, JobState::Cancelled),
        (WorkerResult::Failed { permanent, .. }, pending) => {
            let state = match pending {
                _ if *permanent || job.consecutive_failures + 1 >= max_attempts => JobState::Failed,
                Some(_) => JobState::Paused,
                None => JobState::Queued,
            };
            (AttemptOutcome::Failed, state)
        }
    };
    let reason = match result {
        WorkerResult::Failed { reason, .. } => Some(reason.as_str()),
        WorkerResult::EndedEarly { reason } if state == JobState::Succeeded => Some(reason.as_str()),
        _ => None,
    };
    let sql = "UPDATE attempts SET ended_at = ?3, outcome = ?4, reason = ?5 WHERE job = ?1 AND number = ?2";
    sqlx::query(sql)
        .bind(lease.job_row)
        .bind(lease.attempt)
        .bind(now.as_millisecond())
        .bind(outcome.as_str())
        .bind(reason)
        .execute(&mut *db)
        .await?;
    let failed = i64::from(outcome == AttemptOutcome::Failed);
    let (mut name, mut published) = (None, None);
    if let Some(policy) = policy.filter(|_| state == JobState::Succeeded) {
        let new = publish(db, policy).await?;
        name = Some(format!("{}:{}", policy.name, new.version));
        published = Some(new);
    }
    let sql = "UPDATE jobs SET failures = failures + ?2, consecutive_failures = consecutive_failures + ?2,
               policy = coalesce(?3, policy),
               ran = ran + (SELECT max(ended_at - started_at, 0) FROM attempts WHERE job = ?1 AND number = ?4) WHERE number = ?1";
    sqlx::query(sql).bind(lease.job_row).bind(failed).bind(name).bind(lease.attempt).execute(&mut *db).await?;
    transition(db, Transition { job: lease.job_row, to: state, attempt: lease.attempt, reason, now }).await?;
    if let Some(document) = document.filter(|_| state == JobState::Succeeded) {
        sqlx::query("UPDATE jobs SET result = ? WHERE number = ?").bind(document).bind(lease.job_row).execute(&mut *db).await?;
    }
    let delay = limits.delay(job.consecutive_failures + 1);
    if outcome == AttemptOutcome::Failed && state == JobState::Queued && delay > 0 {
        let not_before = now.as_millisecond().saturating_add_unsigned(delay.saturating_mul(1000));
        sqlx::query("UPDATE jobs SET not_before = ? WHERE number = ?")
            .bind(not_before)
            .bind(lease.job_row)
            .execute(&mut *db)
            .await?;
    }
    Ok(find(db, lease.job_id).await?.map(|job| (job, published)))
}

/// Begins the next attempt of a job.
pub(super) async fn begin(db: &mut SqliteConnection, job: &Job, token: &[u8], now: Timestamp) -> Result<Lease> {
    let lease = Lease { job_id: job.id, job_row: job.row_id, attempt: job.attempts + 1 };
    let sql = "INSERT INTO attempts (job, number, token, started_at) VALUES (?, ?, ?, ?)";
    let insert = sqlx::query(sql).bind(lease.job_row).bind(lease.attempt).bind(token).bind(now.as_millisecond());
    insert.execute(&mut *db).await?;
    let sql = "DELETE FROM attempts WHERE job = ? AND number <= ?";
    sqlx::query(sql).bind(lease.job_row).bind(i64::from(lease.attempt) - KEPT_ATTEMPTS).execute(&mut *db).await?;
    let sql = "UPDATE jobs SET attempts = ? WHERE number = ?";
    sqlx::query(sql).bind(lease.attempt).bind(lease.job_row).execute(&mut *db).await?;
    let to = JobState::Running;
    transition(db, Transition { job: lease.job_row, to, attempt: lease.attempt, reason: None, now }).await?;
    Ok(lease)
}

impl Store {
    /// Begins an attempt of the job `id` whose worker presents the token with the SHA-256 `token`. Returns `None` unless the
    /// job is queued.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn begin_attempt(&self, id: JobId, token: [u8; 32], now: Timestamp) -> Result<Option<Lease>> {
        let mut tx = self.begin().await?;
        let Some(job) = find(&mut tx, id).await?.filter(|job| job.state == JobState::Queued) else {
            tx.abandon().await?;
            return Ok(None);
        };
        let lease = begin(&mut tx, &job, &token, now).await?;
        tx.commit().await?;
        self.notify(lease.job_row);
        Ok(Some(lease))
    }

    /// Ends an attempt, changes the state of its job, and publishes the policy if the job succeeds, in one transaction. Returns
    /// the job and what was published, or `None` if the attempt has already ended.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn end_attempt(&self, ended: EndedAttempt<'_>) -> Result<Option<(Job, Option<PublishedPolicy>)>> {
        let mut tx = self.begin().await?;
        let result = end(&mut tx, ended).await?;
        tx.commit().await?;
        self.notify_all();
        Ok(result)
    }

    /// Stores the last output of an attempt's worker.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn store_log(&self, lease: Lease, log: &str) -> Result<()> {
        let sql = "UPDATE attempts SET log = ?3 WHERE job = ?1 AND number = ?2";
        let mut tx = self.begin().await?;
        sqlx::query(sql).bind(lease.job_row).bind(lease.attempt).bind(log).execute(&mut *tx).await?;
        tx.commit().await
    }

    /// Ends the attempts that were running when the server last stopped, and queues their jobs again. Returns these jobs. The
    /// workers of a cluster have gone on: with `keep_launches`, their attempts stay; without, they are given up.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn recover_jobs(&self, keep_launches: bool, now: Timestamp) -> Result<Vec<Job>> {
        let mut tx = self.begin().await?;
        if !keep_launches {
            sqlx::query("DELETE FROM launches").execute(&mut *tx).await?;
        }
        let sql = "SELECT id, number, attempts FROM jobs WHERE state = 'running' AND number NOT IN (SELECT job FROM launches)";
        let rows: Vec<(String, i64, i64)> = sqlx::query_as(sql).fetch_all(&mut *tx).await?;
        let mut jobs = Vec::with_capacity(rows.len());
        for (id, job, attempt) in rows {
            let Some(id) = JobId::parse(&id) else {
                tracing::error!(job = id, "a job has no valid id, so it is left as it is");
                continue;
            };
            let lease = Lease { job_id: id, job_row: job, attempt: attempt as u32 };
            // A stopped attempt is not a failure, so the limit has no effect.
            let ended = EndedAttempt {
                lease,
                result: &WorkerResult::Stopped,
                publish: None,
                document: None,
                max_attempts: u32::MAX,
                now,
            };
            jobs.extend(end(&mut tx, ended).await?.map(|(job, _)| job));
        }
        sqlx::query("DELETE FROM snapshots WHERE sha256 IS NULL").execute(&mut *tx).await?;
        tx.commit().await?;
        Ok(jobs)
    }

    /// The lease of attempt `attempt` of job `id`.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn lease(&self, id: JobId, attempt: u32) -> Result<Option<LeaseRecord>> {
        let sql = "SELECT j.number, a.token, a.number = j.attempts AND a.ended_at IS NULL FROM jobs j
                   JOIN attempts a ON a.job = j.number WHERE j.id = ? AND a.number = ?";
        let row: Option<(i64, Vec<u8>, bool)> =
            sqlx::query_as(sql).bind(id.to_string()).bind(attempt).fetch_optional(&self.read).await?;
        Ok(row.map(|(job, token, active)| LeaseRecord { lease: Lease { job_id: id, job_row: job, attempt }, token, active }))
    }

    /// The newest attempts of a job (at most [`KEPT_ATTEMPTS`]), oldest first.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn attempts(&self, id: JobId) -> Result<Vec<Attempt>> {
        let sql = "SELECT a.* FROM attempts a JOIN jobs j ON j.number = a.job WHERE j.id = ? ORDER BY a.number";
        let rows: Vec<AttemptRow> = sqlx::query_as(sql).bind(id.to_string()).fetch_all(&self.read).await?;
        rows.into_iter()
            .map(|row| {
                Ok(Attempt {
                    number: row.number as u32,
                    started_at: timestamp(row.started_at)?,
                    ended_at: row.ended_at.map(timestamp).transpose()?,
                    outcome: row.outcome.as_deref().map(AttemptOutcome::from_column).transpose()?,
                    reason: row.reason,
                    log: row.log,
                })
            })
            .collect()
    }
}
