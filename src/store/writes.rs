//! Whether the database can be written, and the transactions that write it.
//!
//! A write that fails must not harm the writes after it, so a connection that a failed transaction leaves in an unknown state is
//! replaced. While writing is known to fail, writes are refused at once instead of waiting for the same failure; `upkeep` finds
//! out when they may continue.

use std::ops::{Deref, DerefMut};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use sqlx::pool::PoolConnection;
use sqlx::{Connection, Sqlite, SqliteConnection, Transaction};
use tokio::sync::{Notify, watch};

use super::{Error, Result, Store};

/// Why the database cannot be written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WriteFailure {
    /// No space is left.
    Full,
    /// The file, or its file system, is read-only.
    ReadOnly,
    /// Another process holds the write lock for longer than [`super::BUSY_TIMEOUT`].
    Locked,
    /// The file, or its write-ahead log, was deleted or replaced. What is written to it would be lost.
    Lost,
    /// The process has as many files and connections open as it may.
    TooManyFiles,
    /// The disk or the file system reports another error, or does not answer.
    Failed,
}

impl WriteFailure {
    /// The reason, as a clause.
    pub fn reason(self) -> &'static str {
        match self {
            Self::Full => "the disk of the database is full",
            Self::ReadOnly => "the database file or its file system is read-only",
            Self::Locked => "another process holds the lock of the database",
            Self::Lost => "the database file or its write-ahead log was deleted or replaced",
            Self::TooManyFiles => "too many files and connections are open; raise the limit (ulimit -n, LimitNOFILE=)",
            Self::Failed => "the disk of the database reports an error or does not answer",
        }
    }

    /// The failure that an error means; `None` if it is about something else, such as a constraint.
    pub(super) fn of(error: &sqlx::Error) -> Option<Self> {
        match error {
            sqlx::Error::Database(error) => {
                let code = error.code()?.parse().ok()?;
                // CANTOPEN has many causes. SQLite keeps that of the operating system for itself.
                if code & 0xff == 14 && few_files_can_be_opened() { Some(Self::TooManyFiles) } else { Self::of_code(code) }
            }
            sqlx::Error::Io(error) if is_limit_of_files(error) => Some(Self::TooManyFiles),
            sqlx::Error::PoolTimedOut | sqlx::Error::WorkerCrashed | sqlx::Error::Io(_) => Some(Self::Failed),
            _ => None,
        }
    }

    /// The failure that an extended result code of SQLite means.
    fn of_code(code: u32) -> Option<Self> {
        /// The file was moved since it was opened.
        const READONLY_DBMOVED: u32 = 1032;
        match (code, code & 0xff) {
            (READONLY_DBMOVED, _) => Some(Self::Lost),
            // BUSY, LOCKED, PROTOCOL.
            (_, 5 | 6 | 15) => Some(Self::Locked),
            (_, 8) => Some(Self::ReadOnly),
            (_, 13) => Some(Self::Full),
            // IOERR, CANTOPEN.
            (_, 10 | 14) => Some(Self::Failed),
            _ => None,
        }
    }
}

/// Whether the process, or the system, has as many files open as it may.
fn is_limit_of_files(error: &std::io::Error) -> bool {
    let limits = [rustix::io::Errno::MFILE, rustix::io::Errno::NFILE].map(rustix::io::Errno::raw_os_error);
    error.raw_os_error().is_some_and(|code| limits.contains(&code))
}

/// Whether few file descriptors are left. SQLite opens up to four for one connection, and those of connections that failed may have been
/// closed since.
fn few_files_can_be_opened() -> bool {
    let opened: std::io::Result<Vec<_>> = (0..16).map(|_| std::fs::File::open("/")).collect();
    opened.is_err_and(|error| is_limit_of_files(&error))
}

/// Device and inode of a file: another file at the same path has others.
type FileId = (u64, u64);

fn file_id(path: &Path) -> Option<FileId> {
    std::fs::metadata(path).ok().map(|metadata| (metadata.dev(), metadata.ino()))
}

/// The files of an open database. They stay the same as long as a connection is open.
#[derive(Debug)]
struct Files([(PathBuf, Option<FileId>); 3]);

impl Files {
    fn of(database: &Path) -> Self {
        Self(["", "-wal", "-shm"].map(|suffix| {
            let path = super::with_suffix(database, suffix);
            let id = file_id(&path);
            (path, id)
        }))
    }

    /// The first file that is no longer the one that was opened.
    fn lost(&self) -> Option<&Path> {
        self.0.iter().find(|(path, id)| id.is_some() && file_id(path) != *id).map(|(path, _)| path.as_path())
    }
}

/// Whether the database can be written.
#[derive(Debug)]
pub(super) struct Condition {
    files: Files,
    failure: watch::Sender<Option<WriteFailure>>,
    /// Notified when a write may have failed.
    suspected: Notify,
}

impl Condition {
    /// The condition of a database that was just opened, so that its write-ahead log exists.
    pub(super) fn of(database: &Path) -> Self {
        Self { files: Files::of(database), failure: watch::Sender::new(None), suspected: Notify::new() }
    }

    pub(super) fn failure(&self) -> Option<WriteFailure> {
        *self.failure.borrow()
    }

    pub(super) fn watch(&self) -> watch::Receiver<Option<WriteFailure>> {
        self.failure.subscribe()
    }

    /// Returns when a write may have failed since the last call.
    pub(super) async fn suspected(&self) {
        self.suspected.notified().await;
    }

    /// The path of the main file.
    pub(super) fn database(&self) -> &Path {
        &self.files.0[0].0
    }

    /// The path of the write-ahead log.
    pub(super) fn log(&self) -> &Path {
        &self.files.0[1].0
    }

    /// Whether a file of the database was deleted or replaced.
    pub(super) fn lost(&self) -> bool {
        self.files.lost().is_some()
    }

    /// Sets why writing fails, or that it works, and logs a change.
    pub(super) fn set(&self, failure: Option<WriteFailure>) {
        let changed = self.failure.send_if_modified(|current| std::mem::replace(current, failure) != failure);
        match failure {
            _ if !changed => {}
            Some(WriteFailure::Lost) => {
                let file = self.files.lost().unwrap_or(self.database()).display();
                let reason = WriteFailure::Lost.reason();
                tracing::error!(reason, %file, "the database cannot be written; put the file back, or stop the server");
            }
            Some(failure) => tracing::error!(reason = failure.reason(), "the database cannot be written; trying again"),
            None => tracing::info!("the database can be written again"),
        }
    }

    /// Records an error of a write.
    fn record(&self, error: &sqlx::Error) {
        if let Some(failure) = WriteFailure::of(error) {
            tracing::debug!(%error, "a write failed");
            self.set(Some(failure));
            self.suspected.notify_one();
        }
    }

    /// Admits a write.
    fn admit(&self) -> Result<()> {
        if self.lost() {
            self.set(Some(WriteFailure::Lost));
        }
        self.failure().map_or(Ok(()), |failure| Err(Error::Write(failure)))
    }
}

/// A transaction that writes. Dropped without an end, it is rolled back and counts as failed.
pub(super) struct WriteTransaction {
    /// Present until the end.
    transaction: Option<Transaction<'static, Sqlite>>,
    condition: Arc<Condition>,
}

const OPEN: &str = "present until the end, which consumes the value";

impl WriteTransaction {
    /// Commits. When this returns, the change is on the disk.
    pub(super) async fn commit(mut self) -> Result<()> {
        let transaction = self.transaction.take().expect(OPEN);
        transaction.commit().await.inspect_err(|error| self.condition.record(error))?;
        // A commit to a file that was deleted meanwhile is not acknowledged.
        if self.condition.lost() { self.condition.admit() } else { Ok(()) }
    }

    /// Ends the transaction without a change, because there is nothing to change.
    pub(super) async fn abandon(mut self) -> Result<()> {
        let transaction = self.transaction.take().expect(OPEN);
        Ok(transaction.rollback().await.inspect_err(|error| self.condition.record(error))?)
    }
}

impl Deref for WriteTransaction {
    type Target = SqliteConnection;

    fn deref(&self) -> &SqliteConnection {
        self.transaction.as_ref().expect(OPEN)
    }
}

impl DerefMut for WriteTransaction {
    fn deref_mut(&mut self) -> &mut SqliteConnection {
        self.transaction.as_mut().expect(OPEN)
    }
}

impl Drop for WriteTransaction {
    fn drop(&mut self) {
        if self.transaction.is_some() {
            self.condition.suspected.notify_one();
        }
    }
}

/// Whether a connection can be used again. After some errors SQLite has already rolled back, so that the rollback of the driver
/// fails and the driver believes to be in a transaction for ever.
pub(super) async fn is_reusable(connection: &mut SqliteConnection) -> sqlx::Result<bool> {
    // Waits for the rollback.
    connection.ping().await?;
    Ok(!connection.is_in_transaction())
}

impl Store {
    /// Begins a transaction that writes. It takes the lock at once: a transaction that first reads fails at its first write
    /// if another process (`qedgix keys`) has written meanwhile.
    pub(super) async fn begin(&self) -> Result<WriteTransaction> {
        self.condition.admit()?;
        let connection = self.writer().await?;
        // Writing may have failed while this waited.
        self.condition.admit()?;
        let begun = Transaction::begin(connection, Some(sqlx::SqlSafeStr::into_sql_str("BEGIN IMMEDIATE"))).await;
        let transaction = begun.inspect_err(|error| self.condition.record(error))?;
        Ok(WriteTransaction { transaction: Some(transaction), condition: Arc::clone(&self.condition) })
    }

    /// The connection that writes.
    pub(super) async fn writer(&self) -> Result<PoolConnection<Sqlite>> {
        Ok(self.write.acquire().await.inspect_err(|error| self.condition.record(error))?)
    }

    /// Why the database cannot be written at present; `None` while it can.
    pub fn write_failure(&self) -> Option<WriteFailure> {
        self.condition.failure()
    }

    /// Changes when the database can no longer be written, or can be written again.
    pub fn write_failures(&self) -> watch::Receiver<Option<WriteFailure>> {
        self.condition.watch()
    }
}

#[cfg(test)]
mod tests {
    use jiff::Timestamp;
    use uuid::Uuid;

    use super::*;
    use crate::store::NewPolicyVersion;

    async fn publish(store: &Store, checkpoint: &[u8]) -> Result<()> {
        let digest = Uuid::now_v7().to_string();
        let now = Timestamp::UNIX_EPOCH;
        let new = NewPolicyVersion {
            name: "p",
            digest: &digest,
            checkpoint,
            info: "",
            now,
            alias: None,
            by: None,
            owner: None,
            any_name: false,
        };
        store.publish_policy(new).await.map(drop)
    }

    #[tokio::test]
    async fn a_write_that_fills_the_disk_does_not_harm_the_next_one() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).await.unwrap();
        for _ in 0..3 {
            // The limit belongs to this connection, so it ends when the connection is replaced.
            let mut writer = store.writer().await.unwrap();
            sqlx::query("PRAGMA max_page_count = 1").execute(&mut *writer).await.unwrap();
            drop(writer);
            // Large enough to fail within the transaction, which SQLite then rolls back on its own.
            let failed = publish(&store, &vec![7; 1 << 20]).await.unwrap_err();
            assert_eq!(failed.write_failure(), Some(WriteFailure::Full), "{failed}");
            publish(&store, &vec![7; 1 << 20]).await.unwrap();
        }
        assert_eq!(store.policy_versions().await.unwrap().len(), 3);
    }

    #[tokio::test]
    async fn a_transaction_that_is_dropped_half_way_does_not_harm_the_next_one() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).await.unwrap();
        let mut half = store.begin().await.unwrap();
        sqlx::query("INSERT INTO policies (name, created_at) VALUES ('half', 0)").execute(&mut *half).await.unwrap();
        drop(half);
        publish(&store, b"x").await.unwrap();
        let names: Vec<(String,)> = sqlx::query_as("SELECT name FROM policies").fetch_all(&store.read).await.unwrap();
        assert_eq!(names, [("p".to_owned(),)]);
    }

    #[test]
    fn result_codes_of_sqlite_are_told_apart() {
        // FULL, BUSY, BUSY_SNAPSHOT, READONLY, READONLY_DBMOVED, IOERR_FSYNC, CANTOPEN; ERROR, CORRUPT, CONSTRAINT.
        let cases = [13, 5, 517, 8, 1032, 1034, 14, 1, 11, 19];
        let expected = [
            Some(WriteFailure::Full),
            Some(WriteFailure::Locked),
            Some(WriteFailure::Locked),
            Some(WriteFailure::ReadOnly),
            Some(WriteFailure::Lost),
            Some(WriteFailure::Failed),
            Some(WriteFailure::Failed),
            None,
            None,
            None,
        ];
        assert_eq!(cases.map(WriteFailure::of_code), expected);
    }
}
