//! Snapshots: everything needed to resume the training of a job exactly. They contain the replay and are large, so they are
//! stored in chunks. A snapshot replaces the previous one of its job when it is complete.

use jiff::Timestamp;
use sqlx::SqliteConnection;

use super::attempts::is_active;
use super::{JobId, Lease, Result, Store};

/// A complete snapshot, without its bytes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Snapshot {
    /// Key of the chunks.
    pub id: i64,
    /// Environment steps of training before it.
    pub step: u64,
    /// Size in bytes.
    pub size: u64,
    /// SHA-256, lower-case hexadecimal.
    pub sha256: String,
}

/// A snapshot that is being uploaded.
#[derive(Debug)]
pub struct PartialSnapshot {
    lease: Lease,
    id: i64,
    chunks: u32,
    size: u64,
}

impl PartialSnapshot {
    /// Bytes stored so far.
    pub fn size(&self) -> u64 {
        self.size
    }
}

async fn discard_incomplete(db: &mut SqliteConnection, job: i64) -> Result<()> {
    sqlx::query("DELETE FROM snapshots WHERE job = ? AND sha256 IS NULL").bind(job).execute(&mut *db).await?;
    Ok(())
}

/// Gives a new job a copy of another job's snapshot.
pub(super) async fn copy_snapshot(db: &mut SqliteConnection, job: i64, snapshot: &Snapshot, now: i64) -> Result<()> {
    let sql = "INSERT INTO snapshots (job, attempt, step, size, sha256, created_at)
               SELECT ?, 0, step, size, sha256, ? FROM snapshots WHERE id = ? AND sha256 IS NOT NULL";
    let copied = sqlx::query(sql).bind(job).bind(now).bind(snapshot.id).execute(&mut *db).await?;
    if copied.rows_affected() == 0 {
        return Err(super::corrupt("snapshot", snapshot.id, "deleted meanwhile"));
    }
    let sql =
        "INSERT INTO snapshot_chunks (snapshot, number, bytes) SELECT ?, number, bytes FROM snapshot_chunks WHERE snapshot = ?";
    sqlx::query(sql).bind(copied.last_insert_rowid()).bind(snapshot.id).execute(&mut *db).await?;
    sqlx::query("UPDATE jobs SET step = ? WHERE number = ?").bind(snapshot.step as i64).bind(job).execute(&mut *db).await?;
    Ok(())
}

impl Store {
    /// Begins a snapshot taken at `step` and deletes the rest of an interrupted upload. Returns `None` if the attempt has
    /// ended.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn begin_snapshot(&self, lease: Lease, step: u64, now: Timestamp) -> Result<Option<PartialSnapshot>> {
        let mut tx = self.begin().await?;
        if !is_active(&mut tx, lease).await? {
            tx.abandon().await?;
            return Ok(None);
        }
        discard_incomplete(&mut tx, lease.job_row).await?;
        let sql = "INSERT INTO snapshots (job, attempt, step, created_at) VALUES (?, ?, ?, ?)";
        let id = sqlx::query(sql)
            .bind(lease.job_row)
            .bind(lease.attempt)
            .bind(step as i64)
            .bind(now.as_millisecond())
            .execute(&mut *tx)
            .await?
            .last_insert_rowid();
        tx.commit().await?;
        Ok(Some(PartialSnapshot { lease, id, chunks: 0, size: 0 }))
    }

    /// Appends a chunk. Returns false if the attempt has ended.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn append_snapshot(&self, partial: &mut PartialSnapshot, bytes: &[u8]) -> Result<bool> {
        let mut tx = self.begin().await?;
        if !is_active(&mut tx, partial.lease).await? {
            tx.abandon().await?;
            return Ok(false);
        }
        let sql = "INSERT INTO snapshot_chunks (snapshot, number, bytes) VALUES (?, ?, ?)";
        sqlx::query(sql).bind(partial.id).bind(partial.chunks).bind(bytes).execute(&mut *tx).await?;
        tx.commit().await?;
        partial.chunks += 1;
        partial.size += bytes.len() as u64;
        Ok(true)
    }

    /// Makes the snapshot the job's newest and deletes the previous one. If their contents differ, the job has made progress, so
    /// its earlier failures no longer count. Returns false if the attempt has ended.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn complete_snapshot(&self, partial: PartialSnapshot, sha256: &str) -> Result<bool> {
        let mut tx = self.begin().await?;
        if !is_active(&mut tx, partial.lease).await? {
            tx.abandon().await?;
            return Ok(false);
        }
        let sql = "UPDATE jobs SET consecutive_failures = 0 WHERE number = ?1 AND consecutive_failures > 0
                   AND NOT EXISTS (SELECT 1 FROM snapshots WHERE job = ?1 AND sha256 = ?2)";
        sqlx::query(sql).bind(partial.lease.job_row).bind(sha256).execute(&mut *tx).await?;
        let sql = "UPDATE snapshots SET size = ?, sha256 = ? WHERE id = ?";
        sqlx::query(sql).bind(partial.size as i64).bind(sha256).bind(partial.id).execute(&mut *tx).await?;
        let sql = "DELETE FROM snapshots WHERE job = ? AND id <> ?";
        sqlx::query(sql).bind(partial.lease.job_row).bind(partial.id).execute(&mut *tx).await?;
        tx.commit().await?;
        Ok(true)
    }

    /// The newest complete snapshot of a job.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn snapshot(&self, job: JobId) -> Result<Option<Snapshot>> {
        let sql = "SELECT s.id, s.step, s.size, s.sha256 FROM snapshots s JOIN jobs j ON j.number = s.job
                   WHERE j.id = ? AND s.sha256 IS NOT NULL ORDER BY s.id DESC LIMIT 1";
        let row: Option<(i64, i64, i64, String)> = sqlx::query_as(sql).bind(job.to_string()).fetch_optional(&self.read).await?;
        Ok(row.map(|(id, step, size, sha256)| Snapshot { id, step: step as u64, size: size as u64, sha256 }))
    }

    /// Chunk `number` of a snapshot; `None` after the last.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn snapshot_chunk(&self, snapshot: i64, number: u32) -> Result<Option<Vec<u8>>> {
        let sql = "SELECT bytes FROM snapshot_chunks WHERE snapshot = ? AND number = ?";
        Ok(sqlx::query_scalar(sql).bind(snapshot).bind(number).fetch_optional(&self.read).await?)
    }
}
