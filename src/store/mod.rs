//! The only SQL: one SQLite file in WAL mode, one writer, embedded migrations. What was acknowledged survives `kill -9`.

mod attempts;
mod checkpoints;
mod events;
mod jobs;
mod keys;
mod metrics;
mod policies;
mod promotions;
mod snapshots;

pub use attempts::{Attempt, Ending, Lease, LeaseRecord, Outcome};
pub use checkpoints::{Checkpoint, CheckpointKind, NewCheckpoint};
pub use events::{Happened, JobEvent};
pub use jobs::{Changed, Job, JobId, JobKind, JobSpec, JobState, JobSummary, NewJob, SpecSummary, Submitted, Verb, Wanted};
pub use keys::KeyRecord;
pub use metrics::{Metric, MetricCursor, MetricRow};
pub use policies::{NewPolicyVersion, PolicyVersion, PublishedPolicy};
pub use promotions::{AliasMove, PolicyAlias, Promotion, PromotionFilter};
pub use snapshots::{OpenSnapshot, Snapshot};

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use sqlx::sqlite::{SqliteConnectOptions, SqliteJournalMode, SqlitePoolOptions, SqliteSynchronous};
use sqlx::{Sqlite, SqlitePool, Transaction};

static MIGRATIONS: sqlx::migrate::Migrator = sqlx::migrate!("./migrations");

/// Name of the database file inside the data directory.
pub const FILE: &str = "qedgix.sqlite";

/// Why the database did not do as told.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// SQLite or the disk.
    #[error("database: {0}")]
    Sqlx(#[from] sqlx::Error),
    /// The file was written by another version.
    #[error("database migration: {0}")]
    Migrate(#[from] sqlx::migrate::MigrateError),
    /// What is stored does not read as what was written.
    #[error("database holds an unreadable {what}: {reason}")]
    Corrupt {
        /// Which record.
        what: String,
        /// What is wrong with it.
        reason: String,
    },
}

/// Handle to the database; cheap to clone.
#[derive(Clone, Debug)]
pub struct Store {
    /// Readers; WAL lets them go on while somebody writes.
    read: SqlitePool,
    /// A single connection: writers queue here instead of meeting `SQLITE_BUSY`.
    write: SqlitePool,
    bells: Arc<events::Bells>,
}

impl Store {
    /// Opens (and creates or migrates) the database in `data_dir`, which exists.
    ///
    /// # Errors
    /// The file cannot be opened or was migrated by a newer version.
    pub async fn open(data_dir: &Path) -> Result<Self, Error> {
        let options = SqliteConnectOptions::new()
            .filename(data_dir.join(FILE))
            .create_if_missing(true)
            .journal_mode(SqliteJournalMode::Wal)
            // FULL: a commit is on the disk before it is acknowledged.
            .synchronous(SqliteSynchronous::Full)
            .foreign_keys(true)
            .busy_timeout(Duration::from_secs(10));
        let write = SqlitePoolOptions::new().max_connections(1).connect_with(options.clone()).await?;
        MIGRATIONS.run(&write).await?;
        let read = SqlitePoolOptions::new().max_connections(4).connect_with(options.read_only(true)).await?;
        Ok(Self { read, write, bells: Arc::new(events::Bells::new()) })
    }

    /// A transaction that writes. It takes the lock at once: one that reads first and finds that another process (`qedgix keys`)
    /// wrote meanwhile could not go on.
    async fn begin(&self) -> Result<Transaction<'static, Sqlite>> {
        Ok(self.write.begin_with("BEGIN IMMEDIATE").await?)
    }
}

/// A result of the store.
pub type Result<T, E = Error> = std::result::Result<T, E>;

fn corrupt(what: &str, id: impl std::fmt::Display, reason: impl std::fmt::Display) -> Error {
    Error::Corrupt { what: format!("{what} {id}"), reason: reason.to_string() }
}

fn timestamp(milliseconds: i64) -> Result<Timestamp> {
    Timestamp::from_millisecond(milliseconds).map_err(|e| corrupt("time", milliseconds, e))
}
