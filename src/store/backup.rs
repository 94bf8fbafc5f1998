//! Backups: copies of the database as one file, also while a server uses it, and their way back.

use std::fs;
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{ConnectOptions, Connection, SqliteConnection};

use super::partial::Partial;
use super::writes::WriteFailure;
use super::{BUSY_TIMEOUT, FILE, check_version, damage, immutable, on_read_only_file_system, upkeep, with_suffix};
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
    /// Records are not what was stored.
    #[error("{path} is damaged: {}; restore another backup, or this one nevertheless with --accept-damage", damage.join(", "))]
    Refused {
        /// The file.
        path: PathBuf,
        /// What is damaged.
        damage: Vec<String>,
    },
    /// A part of the data is in another file.
    #[error("{0} belongs to the file and has a part of the data; copies made with `qedgix backup` are one file")]
    Unmerged(PathBuf),
    /// The backup would be written to standard output.
    #[error("-: a backup is a file, which is replaced when the new one is complete; name a file")]
    StandardOutput,
    /// No space is left for the copy.
    #[error("{0}: the disk is full; the file is as it was")]
    Full(PathBuf),
    /// The database was not copied.
    #[error("cannot copy {from} to {to}: {cause}")]
    Uncopied {
        /// The database.
        from: PathBuf,
        /// The copy.
        to: PathBuf,
        /// Error of SQLite.
        cause: sqlx::Error,
    },
    /// The user of this process may not read a file.
    #[error(transparent)]
    Denied(#[from] files::Denied),
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

/// A backup that was made.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Backup {
    /// Size of the file in bytes.
    pub bytes: u64,
    /// What is damaged in the database, and so in the backup.
    pub damage: Vec<String>,
}

/// What a restore may do.
#[derive(Clone, Copy, Debug, Default)]
pub struct Restore {
    /// Replace an existing database.
    pub force: bool,
    /// Restore what can be read of a damaged backup.
    pub accept_damage: bool,
}

/// Copies the database in `data_dir`, which a server may use meanwhile, to `target`, which it replaces at the end and only if the
/// copy is complete. A damaged database is copied as far as it can be read completely: a backup with a damaged policy is better
/// than none.
///
/// # Errors
/// [`BackupError`]. `target` is then as it was.
pub async fn backup(data_dir: &Path, target: &Path) -> Result<Backup> {
    let database = data_dir.join(FILE);
    files::check_access(&database, false)?;
    let id = |path: &Path| fs::metadata(path).ok().map(|metadata| (metadata.dev(), metadata.ino()));
    if id(&database).is_none() {
        return Err(BackupError::Missing(database));
    }
    if id(&database) == id(target) {
        return Err(BackupError::Same(target.to_owned()));
    }
    if target == Path::new("-") {
        return Err(BackupError::StandardOutput);
    }
    files::check_replaceable(target).map_err(failed(target))?;
    // The file that a link leads to is replaced, and not the link.
    let target = if target.is_symlink() { &target.canonicalize().map_err(failed(target))? } else { target };
    let source = if upkeep::examine_file_system(data_dir) == Some(WriteFailure::ReadOnly) {
        on_read_only_file_system(&database)?
    } else {
        SqliteConnectOptions::new().filename(&database).busy_timeout(BUSY_TIMEOUT)
    };
    let (partial, damage) = copy(source, target).await?;
    let bytes = fs::metadata(partial.path()).map_err(failed(target))?.len();
    partial.replace(target).map_err(failed(target))?;
    Ok(Backup { bytes, damage })
}

/// Makes the backup `source` the database in `data_dir`, which no server uses. A database that it replaces is kept beside it, with
/// the ending `.replaced`. Returns the damage that was accepted.
///
/// # Errors
/// [`BackupError`]. The database is then as it was.
pub async fn restore(source: &Path, data_dir: &Path, options: Restore) -> Result<Vec<String>> {
    let database = data_dir.join(FILE);
    for path in [source, &database] {
        files::check_access(path, false)?;
    }
    if !source.exists() {
        return Err(BackupError::Missing(source.to_owned()));
    }
    if database.exists() && !options.force {
        return Err(BackupError::Exists(database));
    }
    let log = with_suffix(source, "-wal");
    if fs::metadata(&log).is_ok_and(|metadata| metadata.len() > 0) {
        return Err(BackupError::Unmerged(log));
    }
    // Immutable: the backup may be on a read-only disk.
    let (partial, damage) = copy(immutable(source), &database).await.map_err(|error| match error {
        // The copy contains only what could be read, so damage is in the source.
        BackupError::Damaged { reason, .. } => BackupError::Damaged { path: source.to_owned(), reason },
        error => error,
    })?;
    if !damage.is_empty() && !options.accept_damage {
        return Err(BackupError::Refused { path: source.to_owned(), damage });
    }
    // A server that runs as another user must be able to open it.
    files::give_to_owner_of_directory(partial.path());
    set_aside(&database).await?;
    partial.replace(&database).map_err(failed(&database))?;
    Ok(damage)
}

/// Copies a database to a file beside `target`, which only its owner can read, and checks the copy. Returns it and the damage of the
/// source that did not prevent the copy.
async fn copy(source: SqliteConnectOptions, target: &Path) -> Result<(Partial, Vec<String>)> {
    let from = source.get_filename().to_owned();
    let partial = Partial::create(target).map_err(failed(target))?;
    let name = partial.path().to_str().ok_or_else(|| failed(target)(io::Error::other("the path is not valid UTF-8")))?;
    let of_copy = |cause| uncopied(&from, target, cause);
    let mut connection = source.connect().await.map_err(of_copy)?;
    let copied = async {
        // The copy is built anew from the records, so it does not show damage of the structure.
        let structure = damage::of_structure(&mut connection).await?;
        sqlx::query("VACUUM INTO ?").bind(name).execute(&mut connection).await?;
        Ok(structure)
    };
    let copied = copied.await;
    connection.close().await?;
    let structure = copied.map_err(of_copy)?;
    let content = check(partial.path()).await?;
    let damage = structure.into_iter().map(|report| format!("the structure of the file: {report}")).chain(content);
    Ok((partial, damage.collect()))
}

/// Why a database was not copied.
fn uncopied(from: &Path, to: &Path, cause: sqlx::Error) -> BackupError {
    if damage::is_damage(&cause) {
        return BackupError::Damaged { path: from.to_owned(), reason: cause.to_string() };
    }
    let failure = match WriteFailure::of(&cause) {
        // SQLite reports some effects of a full disk as errors of the disk.
        Some(WriteFailure::Failed) => upkeep::examine_file_system(files::directory_of(to)),
        failure => failure,
    };
    if failure == Some(WriteFailure::Full) {
        return BackupError::Full(to.to_owned());
    }
    BackupError::Uncopied { from: from.to_owned(), to: to.to_owned(), cause }
}

/// Checks that a file is a complete database of this program, and of no newer version. Returns damage of its content.
async fn check(path: &Path) -> Result<Vec<String>> {
    let mut connection = immutable(path).connect().await?;
    let checked = check_open(path, &mut connection).await;
    connection.close().await?;
    checked
}

async fn check_open(path: &Path, connection: &mut SqliteConnection) -> Result<Vec<String>> {
    let damaged = |reason| BackupError::Damaged { path: path.to_owned(), reason };
    if let Some(reason) = damage::of_structure(connection).await? {
        return Err(damaged(reason));
    }
    let sql = "SELECT count(*) FROM sqlite_schema WHERE name IN ('jobs', '_sqlx_migrations')";
    let tables: i64 = sqlx::query_scalar(sql).fetch_one(&mut *connection).await?;
    if tables < 2 {
        return Err(damaged("it lacks the tables of this program".into()));
    }
    check_version(connection).await?;
    Ok(damage::of_content(connection).await?)
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
    use std::os::unix::fs::FileTypeExt;

    use jiff::Timestamp;
    use sha2::{Digest, Sha256};

    use super::*;
    use crate::store::{KeyRecord, NewPolicyVersion, Store};

    const FORCE: Restore = Restore { force: true, accept_damage: false };

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
        let made = backup(dir.path(), &file).await.unwrap();
        assert_eq!(made, Backup { bytes: fs::metadata(&file).unwrap().len(), damage: Vec::new() });
        assert_eq!(fs::metadata(&file).unwrap().mode() & 0o777, 0o600);
        store.insert_key(&key("second")).await.unwrap();
        store.close().await;

        assert!(matches!(restore(&file, dir.path(), Restore::default()).await, Err(BackupError::Exists(_))));
        assert_eq!(keys(dir.path()).await, ["first", "second"]);
        restore(&file, dir.path(), FORCE).await.unwrap();
        assert_eq!(keys(dir.path()).await, ["first"]);
        // The database that was replaced is still there.
        let third = tempfile::tempdir().unwrap();
        restore(&dir.path().join("qedgix.sqlite.replaced"), third.path(), Restore::default()).await.unwrap();
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
            let refused = restore(&file, dir.path(), FORCE).await.unwrap_err();
            assert!(matches!(refused, BackupError::Damaged { .. }), "{name}: {refused:?}");
            assert_eq!(fs::read(&database).unwrap(), whole, "{name}");
        }
        let file = other.path().join("copied");
        fs::write(&file, &whole).unwrap();
        fs::write(with_suffix(&file, "-wal"), "frames").unwrap();
        assert!(matches!(restore(&file, dir.path(), FORCE).await, Err(BackupError::Unmerged(_))));
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1, "nothing is left beside the database");
    }

    /// A database with one policy version, whose checkpoint is damaged as a bad disk damages it.
    async fn with_a_damaged_policy() -> tempfile::TempDir {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).await.unwrap();
        let checkpoint = b"the weights of a policy".repeat(1000);
        let new = NewPolicyVersion {
            name: "mine",
            digest: &hex::encode(Sha256::digest(&checkpoint)),
            checkpoint: &checkpoint,
            info: "",
            now: Timestamp::UNIX_EPOCH,
            alias: None,
            by: None,
            owner: None,
            any_name: false,
        };
        store.publish_policy(new).await.unwrap();
        store.close().await;
        let database = dir.path().join(FILE);
        let mut bytes = fs::read(&database).unwrap();
        // The first page of the checkpoint has its beginning, others follow.
        let at = bytes.windows(23).rposition(|window| window == b"the weights of a policy").unwrap();
        bytes[at] ^= 1;
        fs::write(&database, bytes).unwrap();
        dir
    }

    #[tokio::test]
    async fn a_damaged_policy_is_named_and_restored_only_on_request() {
        let (dir, other) = (with_a_damaged_policy().await, tempfile::tempdir().unwrap());
        let file = other.path().join("backup");
        let named = ["the checkpoint of policy mine:1 has changed"];
        assert_eq!(backup(dir.path(), &file).await.unwrap().damage, named);
        for source in [&file, &dir.path().join(FILE)] {
            let target = tempfile::tempdir().unwrap();
            let refused = restore(source, target.path(), FORCE).await.unwrap_err();
            assert!(refused.to_string().contains(named[0]), "{refused}");
            assert_eq!(fs::read_dir(target.path()).unwrap().count(), 0);
            let accepted = Restore { accept_damage: true, ..FORCE };
            assert_eq!(restore(source, target.path(), accepted).await.unwrap(), named);
        }
    }

    #[tokio::test]
    async fn damage_that_a_copy_does_not_show_is_found() {
        let (dir, other) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        Store::open(dir.path()).await.unwrap().close().await;
        let database = dir.path().join(FILE);
        let mut raw = SqliteConnectOptions::new().filename(&database).connect().await.unwrap();
        let page: i64 =
            sqlx::query_scalar("SELECT rootpage FROM sqlite_schema WHERE name = 'webhooks'").fetch_one(&mut raw).await.unwrap();
        raw.close().await.unwrap();
        let mut bytes = fs::read(&database).unwrap();
        // Free space of the page of an empty table, counted wrongly.
        bytes[(page as usize - 1) * 4096 + 7] = 0x55;
        let file = other.path().join("damaged");
        fs::write(&file, bytes).unwrap();
        let refused = restore(&file, dir.path(), FORCE).await.unwrap_err();
        assert!(matches!(&refused, BackupError::Refused { .. }), "{refused:?}");
    }

    #[tokio::test]
    async fn backups_at_the_same_time_do_not_harm_each_other() {
        let (dir, other) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let store = Store::open(dir.path()).await.unwrap();
        store.insert_key(&key("first")).await.unwrap();
        let file = other.path().join("backup");
        for _ in 0..8 {
            let (source, target) = (SqliteConnectOptions::new().filename(dir.path().join(FILE)), &file);
            // A copy that was begun later does not touch the first one, and is then given up.
            let (first, second) = tokio::join!(copy(source.clone(), target), copy(source, target));
            first.unwrap().0.replace(target).unwrap();
            drop(second);
            assert!(check(target).await.unwrap().is_empty());
            assert_eq!(fs::read_dir(other.path()).unwrap().count(), 1);
        }
    }

    #[tokio::test]
    async fn only_files_are_replaced_and_links_remain() {
        let (dir, other) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        Store::open(dir.path()).await.unwrap().close().await;
        for target in ["/dev/null", "-", "/dev/stdout/", other.path().to_str().unwrap()] {
            assert!(backup(dir.path(), Path::new(target)).await.is_err(), "{target}");
        }
        assert!(!Path::new("-").exists() && fs::metadata("/dev/null").unwrap().file_type().is_char_device());
        let (file, link) = (other.path().join("file"), other.path().join("link"));
        fs::write(&file, "an older backup").unwrap();
        std::os::unix::fs::symlink(&file, &link).unwrap();
        let made = backup(dir.path(), &link).await.unwrap();
        assert!(link.is_symlink());
        assert_eq!(fs::metadata(&file).unwrap().len(), made.bytes);
    }
}
