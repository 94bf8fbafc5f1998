//! Backups: copies of the database as one file, also while a server uses it, and their way back.

use std::fs::{self, File, OpenOptions};
use std::io;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{ConnectOptions, Connection, SqliteConnection};

use super::{BUSY_TIMEOUT, FILE, check_version, with_suffix};
use crate::files;

/// Why a backup was not made or not restored.
#[derive(Debug, thiserror::Error)]
pub enum BackupError {
    /// There is no such database.
    #[error("{0} does not exist")]
    Missing(PathBuf),
    /// The data directory has a database.
    #[error("{0} exists; stop the server and use --force to replace it")]
    Exists(PathBuf),
    /// The backup would overwrite its own source.
    #[error("{0} is the database itself")]
    Same(PathBuf),
    /// The file is not a complete database.
    #[error("{path} is not a complete database: {reason}")]
    Damaged {
        /// The file.
        path: PathBuf,
        /// The first damage.
        reason: String,
    },
    /// A part of the data is in another file.
    #[error("{0} belongs to the file and has a part of the data; copies made with `qedgix backup` are one file")]
    Unmerged(PathBuf),
    /// A file cannot be read or written.
    #[error("{path}: {cause}")]
    File {
        /// The file.
        path: PathBuf,
        /// Error of the operating system.
        cause: io::Error,
    },
    /// The database cannot be read or written.
    #[error(transparent)]
    Database(#[from] super::Error),
}

impl From<sqlx::Error> for BackupError {
    fn from(error: sqlx::Error) -> Self {
        Self::Database(error.into())
    }
}

type Result<T, E = BackupError> = std::result::Result<T, E>;

fn failed(path: &Path) -> impl FnOnce(io::Error) -> BackupError {
    move |cause| BackupError::File { path: path.to_owned(), cause }
}

/// Copies the database in `data_dir`, which a server may use meanwhile, to `target`, which it replaces at the end and only if the
/// copy is complete. Returns the size of the copy in bytes.
///
/// # Errors
/// [`BackupError`]. `target` is then as it was.
pub async fn backup(data_dir: &Path, target: &Path) -> Result<u64> {
    let database = data_dir.join(FILE);
    let id = |path: &Path| fs::metadata(path).ok().map(|metadata| (metadata.dev(), metadata.ino()));
    if id(&database).is_none() {
        return Err(BackupError::Missing(database));
    }
    if id(&database) == id(target) {
        return Err(BackupError::Same(target.to_owned()));
    }
    let source = SqliteConnectOptions::new().filename(&database).busy_timeout(BUSY_TIMEOUT);
    let partial = copy(source, target).await?;
    let size = fs::metadata(&partial).map_err(failed(&partial))?.len();
    files::replace(&partial, target).map_err(failed(target))?;
    Ok(size)
}

/// Makes the backup `source` the database in `data_dir`, which no server uses. A database that it replaces is kept beside it, with
/// the ending `.replaced`.
///
/// # Errors
/// [`BackupError`]. The database is then as it was.
pub async fn restore(source: &Path, data_dir: &Path, force: bool) -> Result<()> {
    let database = data_dir.join(FILE);
    if !source.exists() {
        return Err(BackupError::Missing(source.to_owned()));
    }
    if database.exists() && !force {
        return Err(BackupError::Exists(database));
    }
    let log = with_suffix(source, "-wal");
    if fs::metadata(&log).is_ok_and(|metadata| metadata.len() > 0) {
        return Err(BackupError::Unmerged(log));
    }
    // Immutable: reading creates no files beside the backup, which may be on a read-only disk.
    let options = SqliteConnectOptions::new().filename(source).read_only(true).immutable(true);
    let partial = copy(options, &database).await.map_err(|error| match error {
        // The copy contains only what could be read, so damage is in the source.
        BackupError::Damaged { reason, .. } => BackupError::Damaged { path: source.to_owned(), reason },
        error => error,
    })?;
    set_aside(&database).await?;
    files::replace(&partial, &database).map_err(failed(&database))
}

/// Copies a database to a file beside `target`, which only its owner can read, and checks the copy. Returns the path of the copy.
async fn copy(source: SqliteConnectOptions, target: &Path) -> Result<PathBuf> {
    let (from, partial) = (source.get_filename().to_owned(), files::partial_path(target));
    // The rest of a copy that was interrupted.
    let _ = fs::remove_file(&partial);
    OpenOptions::new().write(true).create_new(true).mode(0o600).open(&partial).map_err(failed(&partial))?;
    let copied = async {
        let name = partial.to_str().ok_or_else(|| failed(&partial)(io::Error::other("the path is not valid UTF-8")))?;
        let mut connection = source.connect().await?;
        let copied = sqlx::query("VACUUM INTO ?").bind(name).execute(&mut connection).await;
        connection.close().await?;
        copied.map_err(|error| damaged(&from, error))?;
        check(&partial).await?;
        File::open(&partial).and_then(|file| file.sync_all()).map_err(failed(&partial))
    };
    match copied.await {
        Ok(()) => Ok(partial),
        Err(error) => {
            let _ = fs::remove_file(&partial);
            Err(error)
        }
    }
}

/// Tells damage of `path` from other errors.
fn damaged(path: &Path, error: sqlx::Error) -> BackupError {
    let code = error.as_database_error().and_then(|error| error.code()?.parse::<u32>().ok());
    // CORRUPT, NOTADB.
    match code.map(|code| code & 0xff) {
        Some(11 | 26) => BackupError::Damaged { path: path.to_owned(), reason: error.to_string() },
        _ => error.into(),
    }
}

/// Checks that a file is a complete database of this program, and of no newer version.
async fn check(path: &Path) -> Result<()> {
    let mut connection = SqliteConnectOptions::new().filename(path).read_only(true).immutable(true).connect().await?;
    let checked = check_open(path, &mut connection).await;
    connection.close().await?;
    checked
}

async fn check_open(path: &Path, connection: &mut SqliteConnection) -> Result<()> {
    let report: String = sqlx::query_scalar("PRAGMA integrity_check(1)")
        .fetch_one(&mut *connection)
        .await
        .map_err(|error| damaged(path, error))?;
    if report != "ok" {
        return Err(BackupError::Damaged { path: path.to_owned(), reason: report });
    }
    let sql = "SELECT count(*) FROM sqlite_schema WHERE name IN ('jobs', '_sqlx_migrations')";
    let tables: i64 = sqlx::query_scalar(sql).fetch_one(&mut *connection).await?;
    if tables < 2 {
        return Err(BackupError::Damaged { path: path.to_owned(), reason: "it lacks the tables of this program".into() });
    }
    Ok(check_version(connection).await?)
}

/// Keeps the present database under another name.
async fn set_aside(database: &Path) -> Result<()> {
    if !database.exists() {
        return Ok(());
    }
    // Merges the log into the file. A database that is too damaged for this is kept as it is, with its log.
    if let Ok(mut connection) = SqliteConnectOptions::new().filename(database).busy_timeout(BUSY_TIMEOUT).connect().await {
        let _ = sqlx::query("PRAGMA wal_checkpoint(TRUNCATE)").execute(&mut connection).await;
        let _ = connection.close().await;
    }
    let replaced = with_suffix(database, ".replaced");
    let (log, shared) = (with_suffix(database, "-wal"), with_suffix(database, "-shm"));
    for old in [&replaced, &with_suffix(&replaced, "-wal"), &shared] {
        let _ = fs::remove_file(old);
    }
    // A link instead of a new name: at no moment is the data directory without a database, which a start would create.
    fs::hard_link(database, &replaced).or_else(|_| fs::copy(database, &replaced).map(drop)).map_err(failed(&replaced))?;
    if log.exists() {
        fs::rename(&log, with_suffix(&replaced, "-wal")).map_err(failed(&log))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use jiff::Timestamp;

    use super::*;
    use crate::store::{KeyRecord, Store};

    fn key(id: &str) -> KeyRecord {
        KeyRecord {
            id: id.into(),
            name: "backup".into(),
            owner: id.into(),
            digest: [7; 32],
            scopes: "read".into(),
            rate: None,
            burst: None,
            created_at: Timestamp::UNIX_EPOCH,
            expires_at: None,
            revoked_at: None,
            last_used_at: None,
        }
    }

    async fn keys(dir: &Path) -> Vec<String> {
        let store = Store::open(dir).await.unwrap();
        let keys = store.keys().await.unwrap().into_iter().map(|key| key.id).collect();
        store.close().await;
        keys
    }

    #[tokio::test]
    async fn a_backup_of_an_open_database_is_restored() {
        let (dir, other) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let store = Store::open(dir.path()).await.unwrap();
        store.insert_key(&key("first")).await.unwrap();
        let file = other.path().join("backup");
        fs::write(&file, "an older backup").unwrap();
        let size = backup(dir.path(), &file).await.unwrap();
        assert_eq!(fs::metadata(&file).unwrap().len(), size);
        assert_eq!(fs::metadata(&file).unwrap().mode() & 0o777, 0o600);
        store.insert_key(&key("second")).await.unwrap();
        store.close().await;

        assert!(matches!(restore(&file, dir.path(), false).await, Err(BackupError::Exists(_))));
        assert_eq!(keys(dir.path()).await, ["first", "second"]);
        restore(&file, dir.path(), true).await.unwrap();
        assert_eq!(keys(dir.path()).await, ["first"]);
        // The database that was replaced is still there.
        let third = tempfile::tempdir().unwrap();
        restore(&dir.path().join("qedgix.sqlite.replaced"), third.path(), false).await.unwrap();
        assert_eq!(keys(third.path()).await, ["first", "second"]);
    }

    #[tokio::test]
    async fn what_is_not_a_complete_database_is_refused() {
        let (dir, other) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let store = Store::open(dir.path()).await.unwrap();
        store.insert_key(&key("first")).await.unwrap();
        store.close().await;
        let database = dir.path().join(FILE);
        assert!(matches!(backup(dir.path(), &database).await, Err(BackupError::Same(_))));
        assert!(matches!(backup(other.path(), &database).await, Err(BackupError::Missing(_))));

        let whole = fs::read(&database).unwrap();
        let mut overwritten = whole.clone();
        overwritten[4096..].fill(0x55);
        for (name, bytes) in [("empty", Vec::new()), ("text", b"no database".repeat(100)), ("overwritten", overwritten)] {
            let file = other.path().join(name);
            fs::write(&file, bytes).unwrap();
            let refused = restore(&file, dir.path(), true).await.unwrap_err();
            assert!(matches!(refused, BackupError::Damaged { .. }), "{name}: {refused:?}");
            assert_eq!(fs::read(&database).unwrap(), whole, "{name}");
        }
        let file = other.path().join("copied");
        fs::write(&file, &whole).unwrap();
        fs::write(with_suffix(&file, "-wal"), "frames").unwrap();
        assert!(matches!(restore(&file, dir.path(), true).await, Err(BackupError::Unmerged(_))));
        assert!(!files::partial_path(&database).exists());
    }
}
