//! Reading and writing files, with errors that name the file.

use std::fs;
use std::path::Path;

use anyhow::Context;

/// Writes a file atomically ([`crate::files::write_atomic`]).
///
/// # Errors
/// The file cannot be written.
pub fn write_atomic(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    crate::files::write_atomic(path, bytes).with_context(|| format!("cannot write {}", path.display()))
}

/// Reads a file; `None` if it does not exist.
///
/// # Errors
/// The file exists and cannot be read.
pub fn read_if_exists(path: &Path) -> anyhow::Result<Option<Vec<u8>>> {
    match fs::read(path) {
        Ok(bytes) => Ok(Some(bytes)),
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => Ok(None),
        Err(e) => Err(e).with_context(|| format!("cannot read {}", path.display())),
    }
}
