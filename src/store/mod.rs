//! The database: all SQL of the program. One SQLite file in WAL mode, one writer, embedded migrations. Every method returns
//! after its change is on the disk, so acknowledged changes survive `kill -9`.

/// Declares a struct whose fields are read from the columns of their names. It stands in for sqlx's derive macro, for which
/// Cargo compiles SQLite and sqlx a second time.
macro_rules! from_row {
    ($vis:vis struct $name:ident { $($(#[$doc:meta])* $field:ident: $type:ty,)+ }) => {
        $vis struct $name {
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
mod backup;
mod checkpoints;
mod damage;
mod events;
mod followed;
mod job_changes;
mod job_id;
mod job_list;
mod jobs;
mod keys;
mod launches;
mod metric_summaries;
mod metrics;
mod named_enum;
mod old_jobs;
mod partial;
mod policies;
#[cfg(test)]
mod query_plans;
mod queue;
mod snapshots;
mod space;
mod specs;
mod submission;
mod sweeps;
mod transitions;
mod upkeep;
mod webhooks;
mod writes;

pub use aliases::{AliasHistoryEntry, AliasHistoryFilter, AliasMove, PolicyAlias};
pub use attempts::{Attempt, AttemptOutcome, EndedAttempt, Lease, LeaseRecord, WorkerResult};
pub use backup::{Backup, BackupError, Restore, backup, restore};
pub use checkpoints::{Checkpoint, CheckpointKind, NewCheckpoint};
pub use events::{JobEvent, JobEventKind};
pub use followed::FollowedVersion;
pub use job_changes::{ActionResult, JobEdit};
pub use job_id::JobId;
pub use job_list::{JobCursor, JobFilter, JobList, JobOrder, JobSort, ListedJob, SortKey};
pub use jobs::{Job, JobAction, JobState, PendingAction};
pub use keys::KeyRecord;
pub use launches::LaunchRecord;
pub use metric_summaries::{MetricSummary, larger_is_better};
pub use metrics::{Metric, MetricCursor, MetricRow, is_metric_name};
pub use policies::{NewPolicyVersion, PolicyVersion, PublishedPolicy, VersionKey};
pub use snapshots::{PartialSnapshot, Snapshot};
pub use specs::{EarlyStop, InitKind, JobInit, JobKind, JobLimits, JobSpec, PublishRule, StoredSpec, UnreadableSpec};
pub use submission::{Beginning, NewJob, SubmitResult};
pub use webhooks::{JobEnd, Secret, Webhook, WebhookMessage};
pub use writes::WriteFailure;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use sqlx::migrate::{MigrateError, Migration, MigrationType, Migrator};
use sqlx::sqlite::{SqliteAutoVacuum, SqliteConnectOptions, SqliteJournalMode, SqlitePoolOptions, SqliteSynchronous};
use sqlx::{ConnectOptions, Connection, SqlSafeStr, SqliteConnection, SqlitePool};

use crate::files;

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
    "0006_job_specifications.sql",
    "0007_versions.sql",
    "0008_owners.sql",
    "0009_consecutive_failures.sql",
    "0010_finding_jobs.sql",
    "0011_lifecycle.sql",
    "0012_initial_weights.sql",
    "0013_launches.sql",
    "0014_followed_versions.sql",
    "0015_webhooks.sql",
    "0016_old_jobs.sql",
];

/// Name of the database file inside the data directory.
pub const FILE: &str = "qedgix.sqlite";

/// Names of the files of the database; all but the first exist only while it is open, or after a crash.
pub const FILES: [&str; 3] = [FILE, "qedgix.sqlite-wal", "qedgix.sqlite-shm"];

/// Longest time that a write waits for another process that writes.
const BUSY_TIMEOUT: Duration = Duration::from_secs(2);
/// Longest time that an operation waits for a connection.
const ACQUIRE_TIMEOUT: Duration = Duration::from_secs(10);

/// Why an operation on the database failed.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// SQLite or the disk failed.
    #[error("{}", describe(.0))]
    Sqlx(#[from] sqlx::Error),
    /// The file is damaged, or not a database.
    #[error("{path} is damaged ({reason}): stop the server and restore a backup (qedgix restore)")]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What SQLite says.
        reason: String,
    },
    /// The file is the database of another program.
    #[error(
        "{path} is not a database of qedgix: it has the table {table:?} and no list of migrations; choose another --data-dir"
    )]
    Foreign {
        /// The file.
        path: PathBuf,
        /// One of its tables.
        table: String,
    },
    /// The user of this process may not read or write a file.
    #[error(transparent)]
    Denied(#[from] files::Denied),
    /// A part of the data cannot be read on a read-only file system.
    #[error(
        "{0} exists and cannot be read on a read-only file system: a server runs, or was killed; make the file system writable"
    )]
    Unmerged(PathBuf),
    /// The database cannot be written at present, so nothing was tried.
    #[error("{}; nothing was stored", .0.reason())]
    Write(WriteFailure),
    /// A newer version of the program has written the database.
    #[error(
        "qedgix {written_by} has written this database (migration {migration}), and this program is qedgix {}: start the newer \
         program, or restore a backup that this one has made (qedgix restore)",
        env!("CARGO_PKG_VERSION")
    )]
    Newer {
        /// The newest migration in the database.
        migration: i64,
        /// The version that wrote the database last.
        written_by: String,
    },
    /// The file cannot be migrated.
    #[error("database migration: {0}")]
    Migrate(#[from] MigrateError),
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
            Self::Sqlx(error) | Self::Migrate(MigrateError::Execute(error) | MigrateError::ExecuteMigration(error, _)) => {
                WriteFailure::of(error)
            }
            _ => None,
        }
    }

    /// Says more about an error of opening the database `path`.
    fn of_opening(self, path: &Path) -> Self {
        let directory = files::directory_of(path);
        match &self {
            Self::Sqlx(cause) | Self::Migrate(MigrateError::Execute(cause) | MigrateError::ExecuteMigration(cause, _))
                if damage::is_damage(cause) =>
            {
                return Self::Damaged { path: path.to_owned(), reason: cause.to_string() };
            }
            _ => {}
        }
        match self.write_failure() {
            Some(failure @ (WriteFailure::Failed | WriteFailure::ReadOnly)) => {
                let access = files::check_access(directory, true).and_then(|()| files::check_access(path, true));
                if let Err(denied) = access {
                    return denied.into();
                }
                if failure == WriteFailure::ReadOnly {
                    return Self::Write(failure);
                }
                // SQLite reports some effects of a full disk as errors of the disk.
                upkeep::examine_file_system(directory).map_or(self, Self::Write)
            }
            Some(failure) => Self::Write(failure),
            None => self,
        }
    }
}

/// An error of SQLite, with what to do about damage.
fn describe(error: &sqlx::Error) -> String {
    if damage::is_damage(error) {
        format!("the database is damaged ({error}): stop the server and restore a backup (qedgix restore)")
    } else {
        format!("database: {error}")
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
    /// [`Error::Sqlx`] when the file cannot be opened; [`Error::Damaged`], [`Error::Denied`]; [`Error::Foreign`] when another
    /// program, [`Error::Newer`] when a newer version has written it.
    pub async fn open(data_dir: &Path) -> Result<Self, Error> {
        let path = data_dir.join(FILE);
        Self::open_file(&path).await.map_err(|error| error.of_opening(&path))
    }

    /// Opens an existing database for a caller that only reads. Unlike [`Self::open`], this works on a read-only file system.
    ///
    /// # Errors
    /// As [`Self::open`]; [`Error::Unmerged`].
    pub async fn open_to_read(data_dir: &Path) -> Result<Self, Error> {
        let path = data_dir.join(FILE);
        if upkeep::examine_file_system(data_dir) != Some(WriteFailure::ReadOnly) {
            return Self::open(data_dir).await;
        }
        Self::open_immutable(&path).await.map_err(|error| error.of_opening(&path))
    }

    async fn open_immutable(path: &Path) -> Result<Self, Error> {
        let options = on_read_only_file_system(path)?;
        let pool = SqlitePoolOptions::new().acquire_timeout(ACQUIRE_TIMEOUT);
        let read = pool.clone().connect_with(options.clone()).await?;
        check_version(&mut *read.acquire().await?).await?;
        let condition = Arc::new(writes::Condition::of(path));
        condition.set(Some(WriteFailure::ReadOnly));
        Ok(Self { read, write: pool.connect_lazy_with(options), condition, notifier: Arc::new(events::Notifier::new()) })
    }

    async fn open_file(path: &Path) -> Result<Self, Error> {
        let options = SqliteConnectOptions::new()
            .filename(path)
            .journal_mode(SqliteJournalMode::Wal)
            .pragma("journal_size_limit", upkeep::LOG_LIMIT.to_string())
            // FULL: a commit is on the disk when it returns.
            .synchronous(SqliteSynchronous::Full)
            .foreign_keys(true)
            .busy_timeout(BUSY_TIMEOUT);
        let mut create = options.clone().create_if_missing(true);
        // SQLite gives the other files of the database the permissions of this one.
        let is_new = match files::private_file().create_new(true).open(path) {
            Ok(_) => {
                files::give_to_owner_of_directory(path);
                true
            }
            Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => !has_content(path).await?,
            Err(error) => return Err(sqlx::Error::Io(error).into()),
        };
        // In an old file the setting has no effect before `rewrite`, and it would be a write at every start.
        if is_new {
            create = create.auto_vacuum(SqliteAutoVacuum::Incremental);
        }
        SqliteConnection::connect_with(&create).await?.close().await?;
        // From here on a missing file is an error: a new, empty one would hide that the data is lost. Connections do not age,
        // because the last one to be closed would delete the write-ahead log.
        let pool = SqlitePoolOptions::new().acquire_timeout(ACQUIRE_TIMEOUT).idle_timeout(None).max_lifetime(None);
        let write = pool.clone().max_connections(1).after_release(|connection, _| Box::pin(writes::is_reusable(connection)));
        let write = write.connect_with(options.clone()).await?;
        check_version(&mut *write.acquire().await?).await?;
        migrator().run(&write).await?;
        record_version(&mut *write.acquire().await?).await?;
        let read = pool.max_connections(4).min_connections(1).connect_with(options.read_only(true)).await?;
        let condition = Arc::new(writes::Condition::of(path));
        Ok(Self { read, write, condition, notifier: Arc::new(events::Notifier::new()) })
    }
}

/// The path of a file beside the database: its write-ahead log (`-wal`) or its shared memory (`-shm`).
fn with_suffix(database: &Path, suffix: &str) -> PathBuf {
    let mut name = database.as_os_str().to_owned();
    name.push(suffix);
    name.into()
}

/// How a database is read where nothing can be written.
fn on_read_only_file_system(path: &Path) -> Result<SqliteConnectOptions> {
    let log = with_suffix(path, "-wal");
    // Reading the log takes a file of shared memory, which cannot be created.
    if log.exists() { Err(Error::Unmerged(log)) } else { Ok(immutable(path)) }
}

/// How a file is read that nobody writes: without creating files beside it.
fn immutable(path: &Path) -> SqliteConnectOptions {
    SqliteConnectOptions::new().filename(path).read_only(true).immutable(true)
}

/// Whether an existing file is not empty. Checks, before anything is written to it, that it is not the database of another program.
/// One without tables is left by a first start that was interrupted.
async fn has_content(path: &Path) -> Result<bool> {
    if std::fs::metadata(path).is_ok_and(|file| file.len() == 0) {
        tracing::warn!(path = %path.display(), "the database file was empty; a new database begins");
        return Ok(false);
    }
    let mut database = SqliteConnectOptions::new().filename(path).busy_timeout(BUSY_TIMEOUT).connect().await?;
    let foreign = foreign_table(&mut database).await;
    database.close().await?;
    match foreign? {
        Some(table) => Err(Error::Foreign { path: path.to_owned(), table }),
        None => Ok(true),
    }
}

/// A table of a database that is not one of this program.
async fn foreign_table(database: &mut SqliteConnection) -> Result<Option<String>> {
    if has_table(database, "_sqlx_migrations").await? {
        return Ok(None);
    }
    let sql = "SELECT name FROM sqlite_schema WHERE type = 'table' LIMIT 1";
    Ok(sqlx::query_scalar(sql).fetch_optional(database).await?)
}

/// Checks that no newer version has written the database.
async fn check_version(database: &mut SqliteConnection) -> Result<()> {
    if !has_table(database, "_sqlx_migrations").await? {
        return Ok(());
    }
    let sql = "SELECT version FROM _sqlx_migrations ORDER BY version DESC";
    let versions: Vec<i64> = sqlx::query_scalar(sql).fetch_all(&mut *database).await?;
    let known = migrator();
    let Some(migration) = versions.into_iter().find(|version| !known.version_exists(*version)) else { return Ok(()) };
    let written_by = if has_table(database, "written_by").await? { written_by(database).await? } else { None };
    Err(Error::Newer { migration, written_by: written_by.unwrap_or_else(|| "of an unknown version".into()) })
}

async fn has_table(database: &mut SqliteConnection, name: &str) -> sqlx::Result<bool> {
    let sql = "SELECT 1 FROM sqlite_schema WHERE type = 'table' AND name = ?";
    Ok(sqlx::query(sql).bind(name).fetch_optional(database).await?.is_some())
}

/// The version of the program that wrote the database last.
async fn written_by(database: &mut SqliteConnection) -> Result<Option<String>> {
    Ok(sqlx::query_scalar("SELECT version FROM written_by").fetch_optional(database).await?)
}

/// Records that this version writes the database.
async fn record_version(database: &mut SqliteConnection) -> Result<()> {
    let version = env!("CARGO_PKG_VERSION");
    if written_by(database).await?.as_deref() != Some(version) {
        let sql = "REPLACE INTO written_by (id, version) VALUES (1, ?)";
        sqlx::query(sql).bind(version).execute(database).await?;
    }
    Ok(())
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

/// A stored time. One that cannot be represented becomes the nearest one, so that it affects no other row.
fn timestamp(milliseconds: i64) -> Result<Timestamp> {
    let nearest = if milliseconds < 0 { Timestamp::MIN } else { Timestamp::MAX };
    Timestamp::from_millisecond(milliseconds).or(Ok(nearest))
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use sqlx::migrate::Migrator;
    use sqlx::sqlite::{SqliteConnectOptions, SqliteConnection};
    use sqlx::{ConnectOptions, Connection};

    use super::{Error, FILE, JobList, Store};

    async fn raw(dir: &Path) -> SqliteConnection {
        SqliteConnectOptions::new().filename(dir.join(FILE)).create_if_missing(true).connect().await.unwrap()
    }

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

    #[tokio::test]
    async fn columns_of_old_jobs_are_filled_where_their_documents_are_readable() {
        let dir = tempfile::tempdir().unwrap();
        let mut old = raw(dir.path()).await;
        let before = super::migrator().iter().filter(|migration| migration.version < 6).cloned().collect();
        Migrator::with_migrations(before).run(&mut old).await.unwrap();
        let documents = [
            r#"{"kind": "train", "name": "n", "labels": {"a": "b"}, "config": {"algorithm": "vdn", "preset": "practical",
                "seed": 18446744073709551615, "training": {"steps": 7}}}"#,
            r#"{"kind": 3, "config": {"training": {"steps": "many"}, "seed": []}}"#,
            "no JSON",
        ];
        for (i, document) in documents.into_iter().enumerate() {
            let sql = "INSERT INTO jobs (id, state, spec, threads, priority, created_at) VALUES (?, 'queued', ?, 1, 0, 0)";
            let id = uuid::Uuid::from_u128(i as u128).to_string();
            sqlx::query(sql).bind(id).bind(document).execute(&mut old).await.unwrap();
        }
        old.close().await.unwrap();

        let store = Store::open(dir.path()).await.unwrap();
        let (jobs, _) = store.jobs(&JobList { limit: 10, max_bytes: usize::MAX, ..JobList::default() }).await.unwrap();
        let specs: Vec<_> = jobs.into_iter().rev().map(|listed| listed.job.spec).collect();
        assert_eq!((specs[0].seed, specs[0].steps, specs[0].labels["a"].as_str()), (Some(u64::MAX), 7, "b"));
        assert_eq!((specs[0].algorithm.as_deref(), specs[0].name.as_deref()), (Some("vdn"), Some("n")));
        assert_eq!((specs[1].seed, specs[1].steps, specs[1].kind.as_deref()), (None, 0, Some("3")));
        assert_eq!((specs[2].kind.as_deref(), specs[2].document.as_str()), (None, "no JSON"));
        assert!(specs.iter().all(|spec| spec.decode().is_err()));
    }

    #[tokio::test]
    async fn a_database_of_a_newer_version_is_refused_by_name() {
        let dir = tempfile::tempdir().unwrap();
        Store::open(dir.path()).await.unwrap().close().await;
        let mut database = raw(dir.path()).await;
        let sql = "INSERT INTO _sqlx_migrations (version, description, success, checksum, execution_time)
                   VALUES (9999, 'later', TRUE, x'00', 0)";
        sqlx::query(sql).execute(&mut database).await.unwrap();
        sqlx::query("UPDATE written_by SET version = '99.1.0'").execute(&mut database).await.unwrap();
        database.close().await.unwrap();
        let refused = Store::open(dir.path()).await.unwrap_err();
        let Error::Newer { migration, written_by } = refused else { panic!("{refused}") };
        assert_eq!((migration, written_by.as_str()), (9999, "99.1.0"));
    }

    #[tokio::test]
    async fn the_database_of_another_program_is_refused_and_not_changed() {
        let dir = tempfile::tempdir().unwrap();
        let mut other = raw(dir.path()).await;
        sqlx::query("CREATE TABLE t (a)").execute(&mut other).await.unwrap();
        other.close().await.unwrap();
        let before = std::fs::read(dir.path().join(FILE)).unwrap();
        let refused = Store::open(dir.path()).await.unwrap_err();
        assert!(matches!(&refused, Error::Foreign { table, .. } if table == "t"), "{refused:?}");
        assert_eq!(std::fs::read(dir.path().join(FILE)).unwrap(), before);
    }

    #[tokio::test]
    async fn a_first_start_that_was_interrupted_is_continued() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join(FILE), "").unwrap();
        let store = Store::open(dir.path()).await.unwrap();
        assert!(store.can_give_back().await.unwrap(), "the file is not taken for that of an older version");
        store.close().await;
        // The header is written before the first table.
        let dir = tempfile::tempdir().unwrap();
        let mut headed = raw(dir.path()).await;
        sqlx::query("PRAGMA user_version = 1").execute(&mut headed).await.unwrap();
        headed.close().await.unwrap();
        assert!(std::fs::metadata(dir.path().join(FILE)).unwrap().len() > 0);
        Store::open(dir.path()).await.unwrap().close().await;
    }

    #[tokio::test]
    async fn a_damaged_database_is_named_with_the_remedy() {
        let dir = tempfile::tempdir().unwrap();
        Store::open(dir.path()).await.unwrap().close().await;
        let path = dir.path().join(FILE);
        let whole = std::fs::read(&path).unwrap();
        let mut overwritten = whole.clone();
        overwritten[100..4096].fill(0x55);
        for bytes in [overwritten, whole[..8192].to_vec(), b"no database".repeat(1000)] {
            std::fs::write(&path, bytes).unwrap();
            let text = crate::causes::text(&Store::open(dir.path()).await.unwrap_err());
            assert!(text.starts_with(&format!("{} is damaged", path.display())) && text.contains("qedgix restore"), "{text}");
            assert_eq!(text.matches("(code: ").count(), 1, "{text}");
        }
    }
}
