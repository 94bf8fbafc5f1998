//! The database: all SQL of the program. One SQLite file in WAL mode, one writer, embedded migrations. Every method returns
//! after its change is on the disk, so acknowledged changes survive `kill -9`.

/// Declares a struct whose fields are read from the columns of their names. It stands in for sqlx's derive macro, for which
/// Cargo compiles SQLite and sqlx a second time.
macro_rules! from_row {
    (struct $name:ident { $($(#[$doc:meta])* $field:ident: $type:ty,)+ }) => {
        struct $name {
            $($(#[$doc])* $field: $type,)+
        }

        impl<'r> sqlx::FromRow<'r, sqlx::sqlite::SqliteRow> for $name {
            fn from_row(row: &'r sqlx::sqlite::SqliteRow) -> sqlx::Result<Self> {
                Ok(Self { $($field: sqlx::Row::try_get(row, stringify!($field))?,)+ })
            }
        }
    };
}

mod aliases;
mod attempts;
mod checkpoints;
mod events;
mod jobs;
mod keys;
mod metrics;
mod named_enum;
mod policies;
mod snapshots;
mod upkeep;
mod writes;

pub use aliases::{AliasHistoryEntry, AliasHistoryFilter, AliasMove, PolicyAlias};
pub use attempts::{Attempt, AttemptOutcome, EndedAttempt, Lease, LeaseRecord, WorkerResult};
pub use checkpoints::{Checkpoint, CheckpointKind, NewCheckpoint};
pub use events::{JobEvent, JobEventKind};
pub use jobs::{
    ActionResult, Job, JobAction, JobFilter, JobId, JobKind, JobSpec, JobState, JobSummary, NewJob, PendingAction, SpecSummary,
    SubmitResult,
};
pub use keys::KeyRecord;
pub use metrics::{Metric, MetricCursor, MetricRow, is_metric_name};
pub use policies::{NewPolicyVersion, PolicyVersion, PublishedPolicy};
pub use snapshots::{PartialSnapshot, Snapshot};
pub use writes::WriteFailure;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use sqlx::migrate::{Migration, MigrationType, Migrator};
use sqlx::sqlite::{SqliteConnectOptions, SqliteJournalMode, SqlitePoolOptions, SqliteSynchronous};
use sqlx::{Connection, SqlSafeStr, SqliteConnection, SqlitePool};

macro_rules! migrations {
    ($($file:literal),+ $(,)?) => {
        [$(($file, include_str!(concat!("../../migrations/", $file)))),+]
    };
}

/// Name and content of every file in `migrations/`.
const MIGRATIONS: &[(&str, &str)] = &migrations![
    "0001_jobs.sql",
    "0002_policies.sql",
    "0003_promotions.sql",
    "0004_events.sql",
    "0005_api_keys.sql",
    "0008_owners.sql",
    "0009_consecutive_failures.sql",
];

/// Name of the database file inside the data directory.
pub const FILE: &str = "qedgix.sqlite";

/// Longest time that a write waits for another process that writes.
const BUSY_TIMEOUT: Duration = Duration::from_secs(2);
/// Longest time that an operation waits for a connection.
const ACQUIRE_TIMEOUT: Duration = Duration::from_secs(10);

/// Why an operation on the database failed.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// SQLite or the disk failed.
    #[error("database: {0}")]
    Sqlx(#[from] sqlx::Error),
    /// The database cannot be written at present, so nothing was tried.
    #[error("{}; nothing was stored", .0.reason())]
    Write(WriteFailure),
    /// The file cannot be migrated, for example because a newer version has written it.
    #[error("database migration: {0}")]
    Migrate(#[from] sqlx::migrate::MigrateError),
    /// A stored record cannot be parsed.
    #[error("database holds an unreadable {what}: {reason}")]
    Corrupt {
        /// Which record.
        what: String,
        /// What is wrong with it.
        reason: String,
    },
}

impl Error {
    /// Why the database cannot be written, if that is the cause.
    pub fn write_failure(&self) -> Option<WriteFailure> {
        match self {
            Self::Write(failure) => Some(*failure),
            Self::Sqlx(error) => WriteFailure::of(error),
            Self::Migrate(_) | Self::Corrupt { .. } => None,
        }
    }
}

/// Handle to the database; cheap to clone.
#[derive(Clone, Debug)]
pub struct Store {
    /// Connections for reading. In WAL mode they do not wait for the writer.
    read: SqlitePool,
    /// A single connection for writing: writers queue for it instead of failing with `SQLITE_BUSY`.
    write: SqlitePool,
    condition: Arc<writes::Condition>,
    notifier: Arc<events::Notifier>,
}

impl Store {
    /// Opens the database in the existing directory `data_dir`. Creates and migrates it when needed.
    ///
    /// # Errors
    /// [`Error::Sqlx`] when the file cannot be opened; [`Error::Migrate`] when a newer version has migrated it.
    pub async fn open(data_dir: &Path) -> Result<Self, Error> {
        let path = data_dir.join(FILE);
        let options = SqliteConnectOptions::new()
            .filename(&path)
            .journal_mode(SqliteJournalMode::Wal)
            .pragma("journal_size_limit", upkeep::LOG_LIMIT.to_string())
            // FULL: a commit is on the disk when it returns.
            .synchronous(SqliteSynchronous::Full)
            .foreign_keys(true)
            .busy_timeout(BUSY_TIMEOUT);
        SqliteConnection::connect_with(&options.clone().create_if_missing(true)).await?.close().await?;
        // From here on a missing file is an error: a new, empty one would hide that the data is lost. Connections do not age,
        // because the last one to be closed would delete the write-ahead log.
        let pool = SqlitePoolOptions::new().acquire_timeout(ACQUIRE_TIMEOUT).idle_timeout(None).max_lifetime(None);
        let write = pool.clone().max_connections(1).after_release(|connection, _| Box::pin(writes::is_reusable(connection)));
        let write = write.connect_with(options.clone()).await?;
        migrator().run(&write).await?;
        let read = pool.max_connections(4).min_connections(1).connect_with(options.read_only(true)).await?;
        let condition = Arc::new(writes::Condition::of(&path));
        Ok(Self { read, write, condition, notifier: Arc::new(events::Notifier::new()) })
    }
}

/// The path of a file beside the database: its write-ahead log (`-wal`) or its shared memory (`-shm`).
fn with_suffix(database: &Path, suffix: &str) -> PathBuf {
    let mut name = database.as_os_str().to_owned();
    name.push(suffix);
    name.into()
}

fn migrator() -> Migrator {
    let migration = |&(file, sql): &(&'static str, &'static str)| {
        let parts = file.strip_suffix(".sql").and_then(|name| name.split_once('_'));
        let (number, name) = parts.expect("files are named NUMBER_NAME.sql");
        let number = number.parse().expect("files are named NUMBER_NAME.sql");
        Migration::new(number, name.replace('_', " ").into(), MigrationType::Simple, sql.into_sql_str(), false)
    };
    Migrator::with_migrations(MIGRATIONS.iter().map(migration).collect())
}

/// A result of the store.
pub type Result<T, E = Error> = std::result::Result<T, E>;

fn corrupt(what: &str, id: impl std::fmt::Display, reason: impl std::fmt::Display) -> Error {
    Error::Corrupt { what: format!("{what} {id}"), reason: reason.to_string() }
}

fn timestamp(milliseconds: i64) -> Result<Timestamp> {
    Timestamp::from_millisecond(milliseconds).map_err(|e| corrupt("time", milliseconds, e))
}

#[cfg(test)]
mod tests {
    use std::path::{Path, PathBuf};

    use sqlx::migrate::Migrator;

    #[tokio::test]
    async fn every_migration_of_the_folder_is_embedded() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("migrations");
        let read = |migrator: &Migrator| {
            let all =
                migrator.iter().map(|m| (m.version, m.description.to_string(), m.migration_type, m.checksum.to_vec(), m.no_tx));
            all.collect::<Vec<_>>()
        };
        assert_eq!(read(&super::migrator()), read(&Migrator::new(folder).await.unwrap()));
    }
}
