//! The file of `--metrics`: the training curve as CSV with the columns step, name and value.
//!
//! Every row is written once: a run that is resumed removes the rows after its snapshot, which it computes again, and an incomplete
//! last line. Rows that cannot be written stay in memory until they can.

use std::collections::HashSet;
use std::fs::{self, File};
use std::io::{self, BufRead, BufReader, BufWriter, Write};
use std::path::Path;

use anyhow::{Context, bail};

use crate::files::{partial_path, replace};

/// The first line.
pub const HEADER: &str = "step,name,value\n";

/// A curve that is written while training runs.
pub struct CurveFile {
    file: File,
    /// Text that is not written yet.
    pending: Vec<u8>,
    /// The step of the snapshot, and the names of the rows that the file has of this step.
    known: (u64, HashSet<String>),
}

impl CurveFile {
    /// The curve of a new run. Replaces an existing file.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn create(path: &Path) -> anyhow::Result<Self> {
        let file = File::create(path).with_context(|| format!("cannot write {}", path.display()))?;
        let mut curve = Self { file, pending: HEADER.into(), known: (0, HashSet::new()) };
        curve.flush().with_context(|| format!("cannot write {}", path.display()))?;
        Ok(curve)
    }

    /// The curve of a run that is resumed at `step`: the rows of the file up to this step stay. A missing file is created.
    ///
    /// # Errors
    /// The file has other content than a curve, or cannot be read or written.
    pub fn resume(path: &Path, step: u64) -> anyhow::Result<Self> {
        if !path.exists() {
            return Self::create(path);
        }
        let known = keep_until(path, step).with_context(|| format!("--metrics {}", path.display()))?;
        let file = File::options().append(true).open(path).with_context(|| format!("cannot write {}", path.display()))?;
        Ok(Self { file, pending: Vec::new(), known: (step, known) })
    }

    /// Adds rows, which [`CurveFile::flush`] writes.
    pub fn push(&mut self, rows: &[(u64, &'static str, f64)]) {
        for (step, name, value) in rows {
            if *step != self.known.0 || !self.known.1.contains(*name) {
                writeln!(self.pending, "{step},{name},{value}").expect("memory takes what is written");
            }
        }
    }

    /// Writes the rows that are not written yet. After an error, the next call continues behind what was written.
    ///
    /// # Errors
    /// The disk is full, or the file cannot be written any more.
    pub fn flush(&mut self) -> io::Result<()> {
        let mut written = 0;
        let result = loop {
            match self.file.write(&self.pending[written..]) {
                _ if written == self.pending.len() => break Ok(()),
                Ok(0) => break Err(io::ErrorKind::WriteZero.into()),
                Ok(bytes) => written += bytes,
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => break Err(error),
            }
        };
        self.pending.drain(..written);
        result
    }
}

/// Rewrites the file without the rows after `step` and without an incomplete last line. Returns the names of the rows of `step`.
fn keep_until(path: &Path, step: u64) -> anyhow::Result<HashSet<String>> {
    let partial = partial_path(path);
    let kept = File::create(&partial)?;
    let copied = copy_until(BufReader::new(File::open(path)?), &kept, step);
    if copied.is_err() {
        fs::remove_file(&partial)?;
    } else {
        kept.sync_all()?;
        replace(&partial, path)?;
    }
    copied
}

fn copy_until(mut lines: impl BufRead, kept: impl Write, step: u64) -> anyhow::Result<HashSet<String>> {
    let mut kept = BufWriter::new(kept);
    kept.write_all(HEADER.as_bytes())?;
    let (mut names, mut line) = (HashSet::new(), String::new());
    for number in 1.. {
        line.clear();
        lines.read_line(&mut line)?;
        if number == 1 && HEADER.starts_with(&line) {
            continue;
        }
        // The end of the file, or of what a killed process could write.
        let Some(row) = line.strip_suffix('\n') else { break };
        let mut fields = row.splitn(3, ',');
        let parsed = (|| Some((fields.next()?.parse::<u64>().ok()?, fields.next()?, fields.next()?.parse::<f64>().ok()?)))();
        let Some((at, name, _)) = parsed else {
            bail!("line {number} is {row:?}; expected a row of a curve: {}", HEADER.trim_end());
        };
        if at < step || (at == step && names.insert(name.to_owned())) {
            kept.write_all(line.as_bytes())?;
        }
    }
    kept.flush()?;
    Ok(names)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_resumed_curve_has_every_row_once() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("curve.csv");
        let rows =
            [(0, "eval/mean_aoi", 38.123_456_789_012_3), (640, "loss", 1e-12), (640, "eval/mean_aoi", 2.0), (1280, "loss", 3.0)];
        let mut whole = CurveFile::create(&path).unwrap();
        whole.push(&rows);
        whole.flush().unwrap();
        let expected = fs::read_to_string(&path).unwrap();
        assert_eq!(expected.lines().count(), 5);
        // Killed at every byte, with a snapshot of every step: before and after the evaluation of the step.
        for end in 0..=expected.len() {
            for (step, next) in [(0, 0), (640, 1), (640, 2), (1280, 3)] {
                let complete = expected[..end].lines().count() > next && expected[..end].ends_with('\n');
                if !complete {
                    continue;
                }
                fs::write(&path, &expected[..end]).unwrap();
                let mut resumed = CurveFile::resume(&path, step).unwrap();
                resumed.push(&rows[next..]);
                resumed.flush().unwrap();
                assert_eq!(fs::read_to_string(&path).unwrap(), expected, "cut at {end}, resumed at {step}");
            }
        }
        fs::write(&path, format!("{expected}1920,lo")).unwrap();
        CurveFile::resume(&path, 1280).unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), expected);
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
    }

    #[test]
    fn other_files_stay_as_they_are() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("notes.txt");
        for text in ["remember the milk\n", "step,name,value\n1,loss\n", "name,step,value,at\nloss,1,2,3\n"] {
            fs::write(&path, text).unwrap();
            assert!(CurveFile::resume(&path, 5).is_err(), "{text}");
            assert_eq!(fs::read_to_string(&path).unwrap(), text);
        }
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
        CurveFile::resume(&dir.path().join("new.csv"), 5).unwrap();
    }
}
