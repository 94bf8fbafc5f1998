//! Launches: workers that a cluster was asked to start. A job has at most one. Its attempt begins with the first call of the worker,
//! so a job waits in the queue of the cluster as it waits in that of the server: queued.

use jiff::Timestamp;

use super::attempts::begin;
use super::jobs::find;
use super::{Job, JobId, JobState, Lease, Result, Store, corrupt, timestamp};

/// A launch.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LaunchRecord {
    /// The attempt that begins, or has begun.
    pub lease: Lease,
    /// Its name at the cluster, which no other launch has.
    pub name: String,
    /// When the attempt began; `None`: the worker has not called.
    pub began_at: Option<Timestamp>,
}

/// Whether attempt `attempt` of a job can begin.
fn is_next(job: &Job, attempt: u32) -> bool {
    job.state == JobState::Queued && job.attempts + 1 == attempt
}

impl Store {
    /// Records that the cluster is about to be asked for a worker of an attempt, in place of an earlier
    /// launch, whose token is not valid any more. Returns false unless the job is queued and this is its
    /// next attempt.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn record_launch(&self, lease: Lease, token: [u8; 32], name: &str, now: Timestamp) -> Result<bool> {
        let mut tx = self.begin().await?;
        if find(&mut tx, lease.job_id).await?.is_none_or(|job| !is_next(&job, lease.attempt)) {
            tx.abandon().await?;
            return Ok(false);
        }
        let sql = "REPLACE INTO launches (job, attempt, token, name, created_at) VALUES (?, ?, ?, ?, ?)";
        let insert = sqlx::query(sql).bind(lease.job_row).bind(lease.attempt).bind(token.as_slice()).bind(name);
        insert.bind(now.as_millisecond()).execute(&mut *tx).await?;
        tx.commit().await?;
        Ok(true)
    }

    /// Begins the attempt of a launch with the first call of its worker. Returns `None` if there is no such launch, and if the job
    /// is not queued any more.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn begin_launched(&self, id: JobId, attempt: u32, token: [u8; 32], now: Timestamp) -> Result<Option<Lease>> {
        let mut tx = self.begin().await?;
        let Some(job) = find(&mut tx, id).await?.filter(|job| is_next(job, attempt)) else {
            tx.abandon().await?;
            return Ok(None);
        };
        let sql = "SELECT 1 FROM launches WHERE job = ? AND attempt = ? AND token = ?";
        let launch = sqlx::query(sql).bind(job.row_id).bind(attempt).bind(token.as_slice());
        if launch.fetch_optional(&mut *tx).await?.is_none() {
            tx.abandon().await?;
            return Ok(None);
        }
        let lease = begin(&mut tx, &job, &token, now).await?;
        tx.commit().await?;
        self.notify(lease.job_row);
        Ok(Some(lease))
    }

    /// Whether there is a launch of attempt `attempt` of job `id` with this token.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn is_launched(&self, id: JobId, attempt: u32, token: [u8; 32]) -> Result<bool> {
        let sql = "SELECT 1 FROM jobs j JOIN launches l ON l.job = j.number WHERE j.id = ? AND l.attempt = ? AND l.token = ?";
        let query = sqlx::query(sql).bind(id.to_string()).bind(attempt).bind(token.as_slice());
        Ok(query.fetch_optional(&self.read).await?.is_some())
    }

    /// All launches.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn launches(&self) -> Result<Vec<LaunchRecord>> {
        let sql = "SELECT j.id, l.job, l.attempt, l.name, a.started_at FROM launches l JOIN jobs j ON j.number = l.job
                   LEFT JOIN attempts a ON a.job = l.job AND a.number = l.attempt ORDER BY l.job";
        let rows: Vec<(String, i64, i64, String, Option<i64>)> = sqlx::query_as(sql).fetch_all(&self.read).await?;
        rows.into_iter()
            .map(|(id, job_row, attempt, name, began_at)| {
                let job_id = JobId::parse(&id).ok_or_else(|| corrupt("job", &id, "no valid id"))?;
                let lease = Lease { job_id, job_row, attempt: attempt as u32 };
                Ok(LaunchRecord { lease, name, began_at: began_at.map(timestamp).transpose()? })
            })
            .collect()
    }

    /// Forgets a launch whose worker has ended.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn forget_launch(&self, lease: Lease) -> Result<()> {
        let mut tx = self.begin().await?;
        let sql = "DELETE FROM launches WHERE job = ? AND attempt = ?";
        sqlx::query(sql).bind(lease.job_row).bind(lease.attempt).execute(&mut *tx).await?;
        tx.commit().await
    }
}
