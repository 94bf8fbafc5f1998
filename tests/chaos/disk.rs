//! A small disk that the test can fill, or, without the right to mount one, a directory that it cannot.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// Size of the disk, far above what the jobs of the test store.
const SIZE: &str = "size=64m";

/// The disk of the data directory.
pub struct Disk {
    /// Where the disk is mounted.
    dir: tempfile::TempDir,
    mounted: bool,
}

impl Disk {
    pub fn new() -> Self {
        let dir = tempfile::tempdir().unwrap();
        let mount =
            Command::new("mount").args(["-t", "tmpfs", "-o", SIZE, "tmpfs"]).arg(dir.path()).stderr(Stdio::null()).status();
        Self { mounted: mount.is_ok_and(|status| status.success()), dir }
    }

    pub fn data_dir(&self) -> PathBuf {
        self.dir.path().join("data")
    }

    /// Whether [`Disk::fill`] is possible.
    pub fn can_be_filled(&self) -> bool {
        self.mounted
    }

    /// Takes all space that is left.
    pub fn fill(&self) {
        let mut file = std::fs::File::options().create(true).append(true).open(self.filler()).unwrap();
        while file.write_all(&[0; 4096]).is_ok() {}
    }

    /// Gives the space back.
    pub fn free(&self) {
        // It may not exist.
        let _ = std::fs::remove_file(self.filler());
    }

    fn filler(&self) -> PathBuf {
        self.dir.path().join("filler")
    }
}

impl Drop for Disk {
    fn drop(&mut self) {
        if self.mounted {
            unmount(self.dir.path());
        }
    }
}

/// Unmounts as soon as nothing uses the disk.
fn unmount(path: &Path) {
    let unmounted = Command::new("umount").arg("--lazy").arg(path).status();
    assert!(std::thread::panicking() || unmounted.is_ok_and(|status| status.success()), "{} stays mounted", path.display());
}
