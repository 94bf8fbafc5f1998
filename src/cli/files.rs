//! Reading and writing files, with errors that name the file.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};

use crate::files::{check_replaceable, partial_path};

/// Checks that [`write_atomic`] can write `path`, without changing it.
///
/// # Errors
/// The directory is missing or cannot be written, or the path is something else than a file.
pub fn check_writable(path: &Path) -> anyhow::Result<()> {
    let check = || -> anyhow::Result<()> {
        check_replaceable(path)?;
        let partial = partial_path(path);
        fs::OpenOptions::new().create(true).append(true).open(&partial)?;
        fs::remove_file(&partial)?;
        Ok(())
    };
    check().with_context(|| format!("cannot write {}", path.display()))
}

/// Checks that the files of these flags are different ones.
///
/// # Errors
/// Two flags name one file.
pub fn check_distinct(files: &[(&str, &Path)]) -> anyhow::Result<()> {
    let full: Vec<PathBuf> = files.iter().map(|(_, path)| full_path(path)).collect();
    for (i, (flag, path)) in files.iter().enumerate() {
        if let Some(first) = full[..i].iter().position(|other| *other == full[i]) {
            bail!("{flag} {}: the file of {}; expected another one", path.display(), files[first].0);
        }
    }
    Ok(())
}

/// The path without links, if its directory exists.
pub fn full_path(path: &Path) -> PathBuf {
    if let Ok(path) = path.canonicalize() {
        return path;
    }
    let parent = path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
    match (parent.canonicalize(), path.file_name()) {
        (Ok(parent), Some(name)) => parent.join(name),
        _ => path.to_owned(),
    }
}

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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_check_changes_nothing_and_finds_what_cannot_be_written() {
        let dir = tempfile::tempdir().unwrap();
        let (new, old) = (dir.path().join("new"), dir.path().join("old"));
        fs::write(&old, "old").unwrap();
        check_writable(&new).unwrap();
        check_writable(&old).unwrap();
        assert_eq!(fs::read(&old).unwrap(), b"old");
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
        for path in [dir.path(), &dir.path().join("missing/file"), &old.join("file"), Path::new("/dev/null")] {
            assert!(check_writable(path).is_err(), "{}", path.display());
        }
    }

    #[test]
    fn one_file_under_two_names_is_found() {
        let dir = tempfile::tempdir().unwrap();
        let (a, b, link) = (dir.path().join("a"), dir.path().join("./b"), dir.path().join("link"));
        check_distinct(&[("--out", &a), ("--metrics", &b)]).unwrap();
        assert!(check_distinct(&[("--out", &b), ("--metrics", &dir.path().join("b"))]).is_err());
        fs::write(&a, "").unwrap();
        std::os::unix::fs::symlink(&a, &link).unwrap();
        assert!(check_distinct(&[("--out", &a), ("--metrics", &link)]).is_err());
    }
}
