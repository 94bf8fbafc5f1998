//! Snapshots: everything a job needs to go on exactly where it was. They are large (replay is in them), so they are kept in
//! chunks and become visible, in place of the former one, only when complete.

use jiff::Timestamp;
use sqlx::SqliteConnection;

use super::attempts::live;
use super::{JobId, Lease, Result, Store};

/// A complete snapshot, without its bytes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Snapshot {
    /// Key of its chunks.
    pub id: i64,
    /// Environment steps done.
    pub step: u64,
    /// Bytes.
    pub size: u64,
    /// SHA-256, lower-case hexadecimal.
    pub sha256: String,
}

/// A snapshot that is being uploaded.
#[derive(Debug)]
pub struct OpenSnapshot {
    lease: Lease,
    id: i64,
    chunks: u32,
    size: u64,
}

impl OpenSnapshot {
    /// Bytes received.
    pub fn size(&self) -> u64 {
        self.size
    }
}

async fn discard_incomplete(db: &mut SqliteConnection, job: i64) -> Result<()> {
    sqlx::query("DELETE FROM snapshots WHERE job = ? AND sha256 IS NULL").bind(job).execute(&mut *db).await?;
    Ok(())
}

impl Store {
    /// Begins a snapshot taken at `step`; what an interrupted upload left is dropped. `None` when the lease lasts no longer.
    ///
    /// # Errors
    /// The database.
    pub async fn open_snapshot(&self, lease: Lease, step: u64, now: Timestamp) -> Result<Option<OpenSnapshot>> {
        let mut tx = self.begin().await?;
        if !live(&mut tx, lease).await? {
            return Ok(None);
        }
        discard_incomplete(&mut tx, lease.job).await?;
        let sql = "INSERT INTO snapshots (job, attempt, step, created_at) VALUES (?, ?, ?, ?)";
        let id = sqlx::query(sql)
            .bind(lease.job)
            .bind(lease.attempt)
            .bind(step as i64)
            .bind(now.as_millisecond())
            .execute(&mut *tx)
            .await?
            .last_insert_rowid();
        tx.commit().await?;
        Ok(Some(OpenSnapshot { lease, id, chunks: 0, size: 0 }))
    }

    /// Adds the next chunk; false when the lease lasts no longer.
    ///
    /// # Errors
    /// The database.
    pub async fn extend_snapshot(&self, open: &mut OpenSnapshot, bytes: &[u8]) -> Result<bool> {
        let mut tx = self.begin().await?;
        if !live(&mut tx, open.lease).await? {
            return Ok(false);
        }
        let sql = "INSERT INTO snapshot_chunks (snapshot, number, bytes) VALUES (?, ?, ?)";
        sqlx::query(sql).bind(open.id).bind(open.chunks).bind(bytes).execute(&mut *tx).await?;
        tx.commit().await?;
        open.chunks += 1;
        open.size += bytes.len() as u64;
        Ok(true)
    }

    /// Makes the snapshot the job's newest and drops the former one; false when the lease lasts no longer.
    ///
    /// # Errors
    /// The database.
    pub async fn complete_snapshot(&self, open: OpenSnapshot, sha256: &str) -> Result<bool> {
        let mut tx = self.begin().await?;
        if !live(&mut tx, open.lease).await? {
            return Ok(false);
        }
        let sql = "UPDATE snapshots SET size = ?, sha256 = ? WHERE id = ?";
        sqlx::query(sql).bind(open.size as i64).bind(sha256).bind(open.id).execute(&mut *tx).await?;
        let sql = "DELETE FROM snapshots WHERE job = ? AND id <> ?";
        sqlx::query(sql).bind(open.lease.job).bind(open.id).execute(&mut *tx).await?;
        tx.commit().await?;
        Ok(true)
    }

    /// The newest complete snapshot of a job.
    ///
    /// # Errors
    /// The database.
    pub async fn snapshot(&self, job: JobId) -> Result<Option<Snapshot>> {
        let sql = "SELECT s.id, s.step, s.size, s.sha256 FROM snapshots s JOIN jobs j ON j.number = s.job
                   WHERE j.id = ? AND s.sha256 IS NOT NULL ORDER BY s.id DESC LIMIT 1";
        let row: Option<(i64, i64, i64, String)> = sqlx::query_as(sql).bind(job.to_string()).fetch_optional(&self.read).await?;
        Ok(row.map(|(id, step, size, sha256)| Snapshot { id, step: step as u64, size: size as u64, sha256 }))
    }

    /// Chunk `number` of a snapshot, `None` behind the last.
    ///
    /// # Errors
    /// The database.
    pub async fn snapshot_chunk(&self, snapshot: i64, number: u32) -> Result<Option<Vec<u8>>> {
        let sql = "SELECT bytes FROM snapshot_chunks WHERE snapshot = ? AND number = ?";
        Ok(sqlx::query_scalar(sql).bind(snapshot).bind(number).fetch_optional(&self.read).await?)
    }
}
