//! Atomic writes of files: after a crash, a file has its old or its new content, never a part of it. Directories and files that
//! only their owner may read.

use std::fs::{self, DirBuilder, File, OpenOptions, Permissions};
use std::io::{self, Write};
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt, PermissionsExt, chown};
use std::path::{Path, PathBuf};

use rustix::fs::Access;
use rustix::process::geteuid;

/// The file beside `path` that [`write_atomic`] writes first. It is left behind when the process is killed during a write.
pub fn partial_path(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".partial");
    name.into()
}

/// Replaces the content of `path` by `bytes`, or leaves the file as it is. On success the content survives a power failure.
///
/// # Errors
/// The directory is missing or not writable, or the disk is full.
pub fn write_atomic(path: &Path, bytes: &[u8]) -> io::Result<()> {
    write_with(path, bytes, OpenOptions::new().create(true).truncate(true).write(true))
}

/// As [`write_atomic`], for a file that only its owner may read.
///
/// # Errors
/// As [`write_atomic`].
pub fn write_private(path: &Path, bytes: &[u8]) -> io::Result<()> {
    write_with(path, bytes, private_file().truncate(true))
}

fn write_with(path: &Path, bytes: &[u8], options: &OpenOptions) -> io::Result<()> {
    let partial = partial_path(path);
    let written = write_synced(&partial, bytes, options).and_then(|()| fs::rename(&partial, path));
    if written.is_err() {
        let _ = fs::remove_file(&partial);
    }
    written.and_then(|()| sync_directory_of(path))
}

/// Replaces `path` by the file `partial`, whose content is on disk. On success this survives a power failure.
///
/// # Errors
/// The directory is not writable.
pub fn replace(partial: &Path, path: &Path) -> io::Result<()> {
    fs::rename(partial, path)?;
    sync_directory_of(path)
}

/// Writes `bytes` and waits until they are on disk. Renamed without this, a file can be empty after a power failure.
fn write_synced(path: &Path, bytes: &[u8], options: &OpenOptions) -> io::Result<()> {
    let mut file = options.open(path)?;
    file.write_all(bytes)?;
    file.sync_all()
}

/// Options that create a file which only its owner may read and write.
pub fn private_file() -> OpenOptions {
    let mut options = OpenOptions::new();
    options.create(true).write(true).mode(0o600);
    options
}

/// Creates a directory that only its owner may enter, and its parents, unless it exists.
///
/// # Errors
/// A parent is not writable, or no directory.
pub fn create_private_dir(path: &Path) -> io::Result<()> {
    DirBuilder::new().recursive(true).mode(0o700).create(path)
}

/// Takes the permissions of a file or directory from all but its owner. Returns whether others had any; false if it is missing.
///
/// # Errors
/// It belongs to another user.
pub fn make_private(path: &Path) -> io::Result<bool> {
    let mode = match fs::metadata(path) {
        Ok(metadata) => metadata.permissions().mode() & 0o777,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(false),
        Err(error) => return Err(error),
    };
    let others = mode & 0o077;
    if others == 0 {
        return Ok(false);
    }
    fs::set_permissions(path, Permissions::from_mode(mode & 0o700)).map(|()| true)
}

/// The user of this process may not read or write a file.
#[derive(Debug, thiserror::Error)]
#[error("permission denied: {path} (this process runs as {user})")]
pub struct Denied {
    /// The file.
    pub path: PathBuf,
    /// Name of the user, or its number.
    pub user: String,
}

/// Checks that the user of this process may read the file, and with `write` also write it. A file that is missing is no error. The
/// file is not opened: closing it would release the locks that SQLite holds on it.
///
/// # Errors
/// [`Denied`].
pub fn check_access(path: &Path, write: bool) -> Result<(), Denied> {
    let access = if write { Access::READ_OK | Access::WRITE_OK } else { Access::READ_OK };
    match rustix::fs::access(path, access) {
        Err(rustix::io::Errno::ACCESS) => Err(Denied { path: path.to_owned(), user: user() }),
        _ => Ok(()),
    }
}

/// The user of this process.
fn user() -> String {
    let id = geteuid().as_raw().to_string();
    let users = fs::read_to_string("/etc/passwd").unwrap_or_default();
    let of_id = |line: &str| {
        let mut fields = line.split(':');
        let name = fields.next()?;
        (fields.nth(1) == Some(id.as_str())).then(|| name.to_owned())
    };
    users.lines().find_map(of_id).unwrap_or_else(|| format!("user {id}"))
}

/// Gives a file that root has created to the owner of its directory, who could not open it otherwise. Other users cannot give files
/// away.
pub fn give_to_owner_of_directory(path: &Path) {
    if !geteuid().is_root() {
        return;
    }
    let given = fs::metadata(directory_of(path)).and_then(|owner| chown(path, Some(owner.uid()), Some(owner.gid())));
    if let Err(error) = given {
        // In some containers root may not do this either.
        tracing::warn!(path = %path.display(), %error, "the file belongs to root, and not to the owner of its directory");
    }
}

/// Checks that `path` is a file or missing: directories, devices and pipes are not replaced.
///
/// # Errors
/// It is something else.
pub fn check_replaceable(path: &Path) -> io::Result<()> {
    match fs::metadata(path) {
        Ok(found) if !found.is_file() => {
            Err(io::Error::other("it exists and is not a file; nothing else than a file is replaced"))
        }
        _ => Ok(()),
    }
}

/// The directory of `path`.
pub fn directory_of(path: &Path) -> &Path {
    path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Waits until the directory entry of `path` is on disk.
fn sync_directory_of(path: &Path) -> io::Result<()> {
    if cfg!(unix) { File::open(directory_of(path))?.sync_all() } else { Ok(()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_write_replaces_the_content_and_leaves_no_partial_file() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("a.json");
        write_atomic(&path, b"first, longer").unwrap();
        write_atomic(&path, b"second").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"second");
        // A process that was killed left a partial file.
        fs::write(partial_path(&path), b"rest of a killed write").unwrap();
        write_atomic(&path, b"third").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"third");
        assert_eq!(fs::read_dir(directory.path()).unwrap().count(), 1);
    }

    #[test]
    fn private_files_are_for_their_owner() {
        let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode() & 0o777;
        let directory = tempfile::tempdir().unwrap();
        let (inner, file) = (directory.path().join("a/b"), directory.path().join("a/b/file"));
        create_private_dir(&inner).unwrap();
        create_private_dir(&inner).unwrap();
        write_private(&file, b"secret").unwrap();
        assert_eq!([mode(&inner), mode(&file)], [0o700, 0o600]);
        assert!(!make_private(&file).unwrap() && !make_private(&inner.join("missing")).unwrap());
        fs::set_permissions(&file, Permissions::from_mode(0o644)).unwrap();
        fs::set_permissions(&inner, Permissions::from_mode(0o755)).unwrap();
        assert!(make_private(&file).unwrap() && make_private(&inner).unwrap());
        assert_eq!([mode(&inner), mode(&file)], [0o700, 0o600]);
    }

    #[test]
    fn a_failed_write_keeps_the_old_content() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("a.json");
        write_atomic(&path, b"old").unwrap();
        fs::create_dir(partial_path(&path)).unwrap();
        assert!(write_atomic(&path, b"new").is_err());
        assert_eq!(fs::read(&path).unwrap(), b"old");
        assert!(write_atomic(&directory.path().join("missing/a.json"), b"new").is_err());
        // A directory cannot be replaced by a file; the partial file is removed.
        let other = directory.path().join("directory");
        fs::create_dir(&other).unwrap();
        assert!(write_atomic(&other, b"new").is_err());
        assert!(!partial_path(&other).exists());
    }

    #[test]
    fn files_of_root_belong_to_the_owner_of_the_directory() {
        if !geteuid().is_root() {
            println!("skipped: needs root");
            return;
        }
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("a");
        chown(directory.path(), Some(12345), Some(54321)).unwrap();
        fs::write(&path, "").unwrap();
        give_to_owner_of_directory(&path);
        let metadata = fs::metadata(&path).unwrap();
        assert_eq!((metadata.uid(), metadata.gid()), (12345, 54321));
    }

    #[test]
    fn only_files_are_replaceable() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("a");
        check_replaceable(&path).unwrap();
        fs::write(&path, "").unwrap();
        check_replaceable(&path).unwrap();
        for other in [directory.path(), Path::new("/dev/null")] {
            assert!(check_replaceable(other).is_err(), "{}", other.display());
        }
    }

    #[test]
    fn the_directory_of_a_bare_name_is_the_current_one() {
        sync_directory_of(Path::new("a.json")).unwrap();
    }
}
