//! Checkpoints that jobs produce: the best and the last policy of each job, as safetensors.

use std::collections::BTreeMap;
use std::ops::RangeInclusive;

use jiff::Timestamp;
use uuid::Uuid;

use super::attempts::is_active;
use super::named_enum::named_enum;
use super::{JobId, Lease, Result, Store, corrupt, timestamp};

named_enum! {
    /// Which of a job's policies a checkpoint is.
    CheckpointKind {
        /// The policy with the best evaluation.
        Best = "best",
        /// The policy at the end of training.
        Last = "last",
    }
}

/// A checkpoint to store.
#[derive(Clone, Debug)]
pub struct NewCheckpoint {
    /// Which of the job's policies.
    pub kind: CheckpointKind,
    /// Environment steps of training before it.
    pub step: u64,
    /// SHA-256 of `bytes`, lower-case hexadecimal.
    pub sha256: String,
    /// Metrics of the policy.
    pub metrics: BTreeMap<String, f64>,
    /// The checkpoint, as safetensors.
    pub bytes: Vec<u8>,
}

/// A checkpoint without its bytes.
#[derive(Clone, Debug, PartialEq)]
pub struct Checkpoint {
    /// The id. A better policy gets a new one.
    pub id: Uuid,
    /// The job that produced it.
    pub job: JobId,
    /// Which of the job's policies.
    pub kind: CheckpointKind,
    /// The attempt that produced it.
    pub attempt: u32,
    /// Environment steps of training before it.
    pub step: u64,
    /// SHA-256, lower-case hexadecimal.
    pub sha256: String,
    /// Size in bytes.
    pub size: u64,
    /// Metrics of the policy.
    pub metrics: BTreeMap<String, f64>,
    /// The job's resolved training configuration.
    pub config: serde_json::Value,
    /// When it was uploaded.
    pub created_at: Timestamp,
}

from_row! {
    struct CheckpointRow {
        id: String,
        job: String,
        kind: String,
        attempt: i64,
        step: i64,
        sha256: String,
        size: i64,
        metrics: String,
        config: String,
        created_at: i64,
    }
}

impl TryFrom<CheckpointRow> for Checkpoint {
    type Error = super::Error;

    fn try_from(row: CheckpointRow) -> Result<Self> {
        Ok(Self {
            id: Uuid::try_parse(&row.id).map_err(|e| corrupt("checkpoint", &row.id, e))?,
            job: JobId::parse(&row.job).ok_or_else(|| corrupt("job", &row.job, "not an id"))?,
            kind: CheckpointKind::from_column(&row.kind)?,
            attempt: row.attempt as u32,
            step: row.step as u64,
            sha256: row.sha256,
            size: row.size as u64,
            // Documents of other versions are shown as they are, as far as this is possible.
            metrics: serde_json::from_str(&row.metrics).unwrap_or_default(),
            config: serde_json::from_str(&row.config).unwrap_or(serde_json::Value::String(row.config)),
            created_at: timestamp(row.created_at)?,
        })
    }
}

impl Store {
    /// Stores a checkpoint in place of the previous one of its kind. Returns its id, which is the previous one's if the two
    /// are the same, or `None` if the attempt has ended.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn store_checkpoint(&self, lease: Lease, new: NewCheckpoint, now: Timestamp) -> Result<Option<Uuid>> {
        let metrics = serde_json::to_string(&new.metrics).map_err(|e| corrupt("checkpoint", new.kind, e))?;
        let mut tx = self.begin().await?;
        if !is_active(&mut tx, lease).await? {
            tx.abandon().await?;
            return Ok(None);
        }
        let sql = "SELECT id FROM checkpoints WHERE job = ? AND kind = ? AND sha256 = ? AND step = ?";
        let same: Option<String> = sqlx::query_scalar(sql)
            .bind(lease.job_row)
            .bind(new.kind.as_str())
            .bind(&new.sha256)
            .bind(new.step as i64)
            .fetch_optional(&mut *tx)
            .await?;
        if let Some(id) = same {
            tx.abandon().await?;
            return Ok(Some(Uuid::try_parse(&id).map_err(|e| corrupt("checkpoint", &id, e))?));
        }
        let id = Uuid::now_v7();
        let sql = "REPLACE INTO checkpoints (id, job, kind, attempt, step, sha256, config, metrics, created_at, size, bytes)
                   SELECT ?, number, ?, ?, ?, ?, CASE WHEN json_valid(spec) THEN spec -> '$.config' ELSE spec END, ?, ?, ?, ? FROM jobs WHERE number = ?";
        sqlx::query(sql)
            .bind(id.to_string())
            .bind(new.kind.as_str())
            .bind(lease.attempt)
            .bind(new.step as i64)
            .bind(new.sha256)
            .bind(metrics)
            .bind(now.as_millisecond())
            .bind(new.bytes.len() as i64)
            .bind(new.bytes)
            .bind(lease.job_row)
            .execute(&mut *tx)
            .await?;
        tx.commit().await?;
        Ok(Some(id))
    }

    /// Checkpoints of a job, oldest first.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn checkpoints(&self, job: JobId) -> Result<Vec<Checkpoint>> {
        let sql = "SELECT c.id, j.id AS job, c.kind, c.attempt, c.step, c.sha256, c.size, c.metrics, c.config, c.created_at
                   FROM jobs j JOIN checkpoints c ON c.job = j.number WHERE j.id = ? ORDER BY c.created_at, c.id";
        let rows: Vec<CheckpointRow> = sqlx::query_as(sql).bind(job.to_string()).fetch_all(&self.read).await?;
        let read =
            |row| Checkpoint::try_from(row).inspect_err(|error| tracing::error!(%error, "a checkpoint is left out of a list"));
        Ok(rows.into_iter().filter_map(|row| read(row).ok()).collect())
    }

    /// Bytes of a job's best checkpoint, or else of its last.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn best_checkpoint(&self, job: JobId) -> Result<Option<Vec<u8>>> {
        let sql = "SELECT c.bytes FROM checkpoints c JOIN jobs j ON j.number = c.job
                   WHERE j.id = ? ORDER BY c.kind = 'best' DESC LIMIT 1";
        Ok(sqlx::query_scalar(sql).bind(job.to_string()).fetch_optional(&self.read).await?)
    }

    /// The checkpoint `id` and its bytes, if its job has this owner; `None`: any owner.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn checkpoint(&self, id: Uuid, owner: Option<&str>) -> Result<Option<(Checkpoint, Vec<u8>)>> {
        let mut tx = self.read.begin().await?;
        let sql = "SELECT c.id, j.id AS job, c.kind, c.attempt, c.step, c.sha256, c.size, c.metrics, c.config, c.created_at
                   FROM checkpoints c JOIN jobs j ON j.number = c.job WHERE c.id = ?1 AND (?2 IS NULL OR j.owner = ?2)";
        let row: Option<CheckpointRow> = sqlx::query_as(sql).bind(id.to_string()).bind(owner).fetch_optional(&mut *tx).await?;
        let Some(row) = row else { return Ok(None) };
        let sql = "SELECT bytes FROM checkpoints WHERE id = ?";
        let bytes = sqlx::query_scalar(sql).bind(id.to_string()).fetch_one(&mut *tx).await?;
        Ok(Some((row.try_into()?, bytes)))
    }

    /// Deletes the checkpoints of ended jobs beyond the first `keep` of each, in the order best, last: of the jobs with row ids
    /// in `jobs`.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn trim_checkpoints(&self, jobs: RangeInclusive<i64>, keep: u32) -> Result<u64> {
        let sql = "DELETE FROM checkpoints WHERE job BETWEEN ?1 AND ?2
                   AND (SELECT state FROM jobs WHERE number = checkpoints.job) IN ('cancelled', 'succeeded', 'failed')
                   AND (SELECT count(*) FROM checkpoints c WHERE c.job = checkpoints.job AND c.kind < checkpoints.kind) >= ?3";
        let mut tx = self.begin().await?;
        let deleted = sqlx::query(sql).bind(*jobs.start()).bind(*jobs.end()).bind(keep).execute(&mut *tx).await?;
        tx.commit().await?;
        Ok(deleted.rows_affected())
    }

    /// The largest row id of a job; 0 without jobs.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn last_job(&self) -> Result<i64> {
        Ok(sqlx::query_scalar("SELECT coalesce(max(number), 0) FROM jobs").fetch_one(&self.read).await?)
    }
}
