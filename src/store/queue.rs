//! The queue of jobs: highest priority first, then first come, first served.

use std::collections::BTreeMap;

use jiff::Timestamp;

use super::jobs::{JobRow, find};
use super::transitions::{Transition, transition};
use super::{Job, JobState, Result, Store, timestamp};

impl Store {
    /// The first job of the queue with at most `threads` threads that may start at `now`: highest priority, then first come, first
    /// served. Jobs that wait in the queue of a cluster are not in this one.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn first_in_queue(&self, threads: usize, now: Timestamp) -> Result<Option<Job>> {
        let sql = "SELECT * FROM jobs WHERE state = 'queued' AND blocked = 0 AND threads <= ?
                   AND (not_before IS NULL OR not_before <= ?) AND number NOT IN (SELECT job FROM launches)
                   ORDER BY priority DESC, number LIMIT 1";
        let threads = i64::try_from(threads).unwrap_or(i64::MAX);
        let query = sqlx::query_as(sql).bind(threads).bind(now.as_millisecond());
        let row: Option<JobRow> = query.fetch_optional(&self.read).await?;
        row.map(Job::try_from).transpose()
    }

    /// The earliest time after `now` at which a job of the queue may start that may not start at `now`.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn next_delayed(&self, now: Timestamp) -> Result<Option<Timestamp>> {
        let sql = "SELECT min(not_before) FROM jobs WHERE state = 'queued' AND not_before IS NOT NULL AND not_before > ?";
        let next: Option<i64> = sqlx::query_scalar(sql).bind(now.as_millisecond()).fetch_one(&self.read).await?;
        next.map(timestamp).transpose()
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
            self.notify_all();
        } else {
            tx.abandon().await?;
        }
        Ok(queued)
    }

    /// How many jobs of the queue come before each of these, by row id.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn jobs_before(&self, jobs: &[i64]) -> Result<BTreeMap<i64, u64>> {
        // The whole queue is numbered, because counting for each of the jobs would read it once per job.
        let sql = "SELECT number, place - 1 FROM (
                       SELECT number, row_number() OVER (ORDER BY priority DESC, number) AS place FROM jobs
                       WHERE state = 'queued' AND blocked = 0 AND number NOT IN (SELECT job FROM launches)
                   ) WHERE number IN (SELECT value FROM json_each(?))";
        let rows = sqlx::query_as(sql).bind(serde_json::Value::from(jobs).to_string());
        let rows: Vec<(i64, i64)> = rows.fetch_all(&self.read).await?;
        Ok(rows.into_iter().map(|(job, before)| (job, before as u64)).collect())
    }
}
