//! Backups of a data directory, and their way back.

use std::path::Path;

use crate::store;
pub use crate::store::{Backup, BackupError, Restore};

/// Copies the database in `data_dir`, which a server may use meanwhile, to `target`. A damaged database is copied as far as it
/// can be read completely.
///
/// # Errors
/// [`BackupError`]. `target` is then as it was.
pub async fn backup(data_dir: &Path, target: &Path) -> Result<Backup, BackupError> {
    store::backup(data_dir, target).await
}

/// Makes the backup `source` the database in `data_dir`, which no server may use. Returns the damage that was
/// accepted.
///
/// # Errors
/// [`BackupError`]. The database is then as it was.
pub async fn restore(source: &Path, data_dir: &Path, options: Restore) -> Result<Vec<String>, BackupError> {
    store::restore(source, data_dir, options).await
}
