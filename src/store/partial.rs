//! The incomplete copy of a file, beside the file that it will replace.
//!
//! Each copy has a name of its own and is locked while it is written, so that copies at the same time do not touch each other,
//! and what a killed process left behind can be told from a copy in progress.

use std::ffi::OsStr;
use std::fs::{self, File, OpenOptions};
use std::io;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

use uuid::Uuid;

use super::with_suffix;
use crate::files;

/// What SQLite writes beside a file.
const JOURNALS: [&str; 3] = ["-journal", "-wal", "-shm"];
/// How often another process may take a new file for a leftover.
const ATTEMPTS: u32 = 8;

/// A file that is removed when the value is dropped, unless it has replaced its target.
#[derive(Debug)]
pub(super) struct Partial {
    path: PathBuf,
    /// Holds the lock.
    file: File,
}

impl Partial {
    /// Creates an empty file beside `target` that only its owner can read, and removes leftovers of killed processes.
    pub(super) fn create(target: &Path) -> io::Result<Self> {
        remove_leftovers(target);
        for _ in 0..ATTEMPTS {
            let path = with_suffix(target, &format!(".{}.partial", Uuid::now_v7().simple()));
            let file = OpenOptions::new().read(true).write(true).create_new(true).mode(0o600).open(&path)?;
            // Some file systems have no locks. There, leftovers stay.
            let _ = file.lock();
            let partial = Self { path, file };
            // Before it was locked, another process could remove it as a leftover.
            if partial.is_in_place() {
                return Ok(partial);
            }
        }
        Err(io::Error::other("other processes remove the copy"))
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Whether the path still leads to the file that was created.
    fn is_in_place(&self) -> bool {
        let id = |metadata: io::Result<fs::Metadata>| metadata.ok().map(|metadata| (metadata.dev(), metadata.ino()));
        let created = id(self.file.metadata());
        created.is_some() && created == id(fs::symlink_metadata(&self.path))
    }

    /// Replaces `target` by this file. On success this survives a power failure.
    pub(super) fn replace(self, target: &Path) -> io::Result<()> {
        self.file.sync_all()?;
        if !self.is_in_place() {
            return Err(io::Error::other("another process replaced the copy before it was complete"));
        }
        files::replace(&self.path, target)
    }
}

impl Drop for Partial {
    fn drop(&mut self) {
        remove(&self.path);
    }
}

/// Removes a partial file, if it is still there, and its journals.
fn remove(partial: &Path) {
    let _ = fs::remove_file(partial);
    for journal in JOURNALS {
        let _ = fs::remove_file(with_suffix(partial, journal));
    }
}

/// Removes partial files of `target` that no process writes.
fn remove_leftovers(target: &Path) {
    let Some(name) = target.file_name().and_then(OsStr::to_str) else { return };
    let Ok(entries) = fs::read_dir(files::directory_of(target)) else { return };
    for entry in entries.flatten() {
        let entry = entry.path();
        let Some(found) = entry.file_name().and_then(OsStr::to_str) else { continue };
        let partial = JOURNALS.iter().find_map(|journal| found.strip_suffix(journal)).unwrap_or(found);
        if is_partial_of(partial, name) {
            remove_unused(&entry.with_file_name(partial));
        }
    }
}

/// Whether `name` is that of a partial file of `target`. Earlier versions gave all copies the same name.
fn is_partial_of(name: &str, target: &str) -> bool {
    let between = name.strip_prefix(target).and_then(|rest| rest.strip_suffix(".partial"));
    let is_id = |id: &str| id.len() == 32 && id.bytes().all(|byte| byte.is_ascii_hexdigit());
    between.is_some_and(|between| between.is_empty() || between.strip_prefix('.').is_some_and(is_id))
}

fn remove_unused(partial: &Path) {
    match fs::symlink_metadata(partial) {
        Ok(metadata) if metadata.is_file() => {
            // The lock is held until the file is removed, so that its owner, if it has just created it, notices.
            if let Ok(file) = File::open(partial)
                && file.try_lock().is_ok()
            {
                remove(partial);
            }
        }
        Err(error) if error.kind() == io::ErrorKind::NotFound => remove(partial),
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(dir: &Path) -> Vec<String> {
        let names = fs::read_dir(dir).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
        let mut names: Vec<String> = names.collect();
        names.sort();
        names
    }

    #[test]
    fn copies_at_the_same_time_have_files_of_their_own() {
        let dir = tempfile::tempdir().unwrap();
        let target = dir.path().join("b");
        let (first, second) = (Partial::create(&target).unwrap(), Partial::create(&target).unwrap());
        fs::write(first.path(), "first").unwrap();
        fs::write(second.path(), "second, incomplete").unwrap();
        first.replace(&target).unwrap();
        drop(second);
        assert_eq!(fs::read(&target).unwrap(), b"first");
        assert_eq!(names(dir.path()), ["b"]);
    }

    #[test]
    fn a_file_that_was_replaced_meanwhile_replaces_nothing() {
        let dir = tempfile::tempdir().unwrap();
        let target = dir.path().join("b");
        fs::write(&target, "old").unwrap();
        let partial = Partial::create(&target).unwrap();
        fs::remove_file(partial.path()).unwrap();
        fs::write(partial.path(), "of another process").unwrap();
        assert!(partial.replace(&target).is_err());
        assert_eq!(fs::read(&target).unwrap(), b"old");
    }

    #[test]
    fn leftovers_are_removed_and_nothing_else() {
        let dir = tempfile::tempdir().unwrap();
        let target = dir.path().join("b");
        let left = format!("b.{}.partial", "0af".repeat(10) + "00");
        let keep = ["b", "b-wal", "b.1.partial", "c.partial", "partial"];
        let remove = ["b.partial", "b.partial-journal", &left, &format!("{left}-wal")];
        for name in keep.iter().chain(&remove) {
            fs::write(dir.path().join(name), "").unwrap();
        }
        drop(Partial::create(&target).unwrap());
        assert_eq!(names(dir.path()), keep);
    }
}
