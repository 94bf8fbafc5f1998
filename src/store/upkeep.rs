//! The background work of an open database: finds out when it cannot be written and when it can again, and bounds its
//! write-ahead log.

use std::path::Path;
use std::time::Duration;

use sqlx::sqlite::SqliteConnection;
use tokio::time::MissedTickBehavior;

use super::writes::WriteFailure;
use super::{BUSY_TIMEOUT, Result, Store};

/// Time between two examinations.
const INTERVAL: Duration = Duration::from_secs(1);
/// Free space below which the disk counts as full, even before a write has failed: the space of one small transaction.
const FULL: u64 = 128 << 10;
/// Free space that must be there before writes continue after the disk was full. Otherwise they would fail again at once.
const NO_LONGER_FULL: u64 = 1 << 20;
/// Size of the write-ahead log above which it is emptied. SQLite empties it itself after about 4 MiB, unless readers prevent it.
pub(super) const LOG_LIMIT: u64 = 16 << 20;
/// Longest time that emptying the log waits for readers. Writes wait meanwhile.
const CHECKPOINT_TIMEOUT: Duration = Duration::from_millis(250);
/// Longest time for [`Store::close`].
const CLOSE_TIMEOUT: Duration = Duration::from_secs(10);

impl Store {
    /// Examines the database every second, and at once when a write has failed. Runs until it is dropped.
    pub async fn upkeep(self) {
        let mut ticks = tokio::time::interval(INTERVAL);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            let suspected = tokio::select! {
                () = self.condition.suspected() => true,
                _ = ticks.tick() => false,
            };
            let failure = self.examine(suspected).await;
            self.condition.set(failure);
            if failure.is_none() {
                self.bound_log().await;
            }
        }
    }

    /// Why the database cannot be written. Writes to find out if a write has failed.
    async fn examine(&self, suspected: bool) -> Option<WriteFailure> {
        let known = self.condition.failure();
        if self.condition.lost() {
            if known != Some(WriteFailure::Lost) {
                // The connections still reach the files. If only the log was deleted, the main file has everything after this.
                self.empty_log().await;
            }
            return Some(WriteFailure::Lost);
        }
        let needed = if known == Some(WriteFailure::Full) { NO_LONGER_FULL } else { FULL };
        if let Some(failure) = examine_space(self.condition.database(), needed) {
            return Some(failure);
        }
        if !suspected && known.is_none() {
            return None;
        }
        let probe = async {
            let mut writer = self.write.acquire().await?;
            // Writes the first page, whatever the value was.
            sqlx::query("PRAGMA user_version = 0").execute(&mut *writer).await
        };
        match probe.await {
            Ok(_) => None,
            Err(error) => WriteFailure::of(&error).or_else(|| {
                tracing::error!(%error, "the database cannot be written");
                Some(WriteFailure::Failed)
            }),
        }
    }

    /// Empties the write-ahead log if it is too large.
    async fn bound_log(&self) {
        let size = std::fs::metadata(self.condition.log()).map_or(0, |metadata| metadata.len());
        if size > LOG_LIMIT && !self.empty_log().await {
            tracing::debug!(size, "readers use the write-ahead log; trying again");
        }
    }

    /// Copies the write-ahead log to the main file and empties it. Returns whether it is empty.
    async fn empty_log(&self) -> bool {
        let empty = async {
            let mut writer = self.writer().await?;
            let emptied = checkpoint(&mut writer).await;
            // The connection returns to the other writers, so it gets its time limit back.
            set_busy_timeout(&mut writer, BUSY_TIMEOUT).await?;
            emptied
        };
        empty.await.unwrap_or_else(|error: super::Error| {
            tracing::warn!(%error, "the write-ahead log could not be emptied");
            false
        })
    }

    /// Closes the database. Afterwards it is one file, which can be copied, unless another process has it open.
    pub async fn close(&self) {
        let close = async {
            self.read.close().await;
            if !self.write.is_closed() {
                self.empty_log().await;
            }
            self.write.close().await;
        };
        if tokio::time::timeout(CLOSE_TIMEOUT, close).await.is_err() {
            tracing::warn!("the database is still open; its write-ahead log remains, and the next start reads it");
        }
    }
}

async fn checkpoint(writer: &mut SqliteConnection) -> Result<bool> {
    set_busy_timeout(writer, CHECKPOINT_TIMEOUT).await?;
    let (busy, _, _): (i64, i64, i64) = sqlx::query_as("PRAGMA wal_checkpoint(TRUNCATE)").fetch_one(&mut *writer).await?;
    Ok(busy == 0)
}

async fn set_busy_timeout(connection: &mut SqliteConnection, time: Duration) -> Result<()> {
    let sql = sqlx::AssertSqlSafe(format!("PRAGMA busy_timeout = {}", time.as_millis()));
    sqlx::query(sql).execute(connection).await?;
    Ok(())
}

/// Why nothing can be written to the file system of `path`, as far as the file system knows.
pub(super) fn examine_file_system(path: &Path) -> Option<WriteFailure> {
    examine_space(path, FULL)
}

/// As [`examine_file_system`], with the free space below which the disk counts as full.
fn examine_space(path: &Path, needed: u64) -> Option<WriteFailure> {
    let system = rustix::fs::statvfs(path).ok()?;
    if system.f_flag.contains(rustix::fs::StatVfsMountFlags::RDONLY) {
        return Some(WriteFailure::ReadOnly);
    }
    // Some file systems report no sizes at all.
    let full = system.f_blocks > 0 && system.f_bfree.saturating_mul(system.f_frsize) < needed;
    full.then_some(WriteFailure::Full)
}
