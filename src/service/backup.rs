//! Backups of a data directory, and their way back.

use std::path::Path;

use crate::store;
pub use crate::store::BackupError;

/// Copies the database in `data_dir`, which a server may use meanwhile, to `target`. Returns the size of the copy in bytes.
///
/// # Errors
/// [`BackupError`]. `target` is then as it was.
pub async fn backup(data_dir: &Path, target: &Path) -> Result<u64, BackupError> {
    store::backup(data_dir, target).await
}

/// Makes the backup `source` the database in `data_dir`, which no server may use. With `force`, it replaces another one.
///
/// # Errors
/// [`BackupError`]. The database is then as it was.
pub async fn restore(source: &Path, data_dir: &Path, force: bool) -> Result<(), BackupError> {
    store::restore(source, data_dir, force).await
}
