//! Metrics as event files of TensorBoard: TFRecords of `tensorflow.Event` messages, with the few fields that scalars need.
//!
//! Each attempt of a job has its own file. A row is in the file of the attempt that computed its value first: where a later attempt
//! repeats a step, the same value changes nothing, and another one (a speed) replaces the row. So every row is in one file, and the
//! steps of a metric rise from file to file.

use std::fs::{self, File};
use std::io::{self, BufRead, BufWriter, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use crc::{CRC_32_ISCSI, Crc};
use jiff::Timestamp;
use prost::Message;

/// CRC-32C.
const CRC: Crc<u32> = Crc::<u32>::new(&CRC_32_ISCSI);

#[derive(Clone, PartialEq, Message)]
struct Event {
    /// Seconds since 1970.
    #[prost(double, tag = "1")]
    wall_time: f64,
    #[prost(int64, tag = "2")]
    step: i64,
    /// In the first event of a file only.
    #[prost(string, optional, tag = "3")]
    file_version: Option<String>,
    #[prost(message, optional, tag = "5")]
    summary: Option<Summary>,
}

#[derive(Clone, PartialEq, Message)]
struct Summary {
    #[prost(message, repeated, tag = "1")]
    value: Vec<Scalar>,
}

#[derive(Clone, PartialEq, Message)]
struct Scalar {
    #[prost(string, tag = "1")]
    tag: String,
    #[prost(float, optional, tag = "2")]
    simple_value: Option<f32>,
}

/// An attempt of a job: its number, and when it began.
pub type Attempt = (u64, Timestamp);

/// Writes the rows of `csv` (name, step, value, at; by name and step) as one event file per attempt into `dir`, which is emptied of
/// earlier event files. `attempts` are in the order of their begin. Returns the names of the files.
///
/// # Errors
/// A row is malformed, or a file cannot be written.
pub fn write(dir: &Path, csv: impl BufRead, attempts: &[Attempt]) -> anyhow::Result<Vec<String>> {
    fs::create_dir_all(dir).with_context(|| format!("cannot create {}", dir.display()))?;
    for entry in fs::read_dir(dir)? {
        let entry = entry?;
        if entry.file_name().to_string_lossy().starts_with(PREFIX) {
            fs::remove_file(entry.path())?;
        }
    }
    let mut files: Vec<Option<EventFile>> = attempts.iter().map(|_| None).collect();
    for line in csv.lines().skip(1) {
        let line = line?;
        let malformed = || format!("the server sent {line:?}; expected a metric: name,step,value,at");
        let [name, step, value, at] = line.split(',').collect::<Vec<_>>()[..] else { bail!(malformed()) };
        let at: Timestamp = at.parse().with_context(malformed)?;
        let step: i64 = step.parse().with_context(malformed)?;
        // The number of REST, rounded: text that is read as f32 could be rounded to another neighbour.
        let value = if value.is_empty() { f32::NAN } else { value.parse::<f64>().with_context(malformed)? as f32 };
        // Rows from before the first attempt do not exist, except if the clock of the server was moved.
        let index = attempts.partition_point(|attempt| attempt.1 <= at).saturating_sub(1);
        let Some((number, began)) = attempts.get(index) else { bail!("the job has metrics but no attempt") };
        let file = match &mut files[index] {
            Some(file) => file,
            none => none.insert(EventFile::create(dir, *number, *began)?),
        };
        let scalar = Scalar { tag: name.to_owned(), simple_value: Some(value) };
        let summary = Some(Summary { value: vec![scalar] });
        file.write(&Event { wall_time: seconds(at), step, file_version: None, summary })?;
    }
    files.into_iter().flatten().map(EventFile::finish).collect()
}

/// TensorBoard finds its files by this.
const PREFIX: &str = "events.out.tfevents.";

fn seconds(at: Timestamp) -> f64 {
    at.as_millisecond() as f64 / 1e3
}

/// An event file.
struct EventFile {
    path: PathBuf,
    out: BufWriter<File>,
}

impl EventFile {
    fn create(dir: &Path, attempt: u64, began: Timestamp) -> anyhow::Result<Self> {
        // TensorBoard reads the files of a directory in the order of their names.
        let path = dir.join(format!("{PREFIX}{:010}.attempt-{attempt:05}", began.as_second()));
        let out = BufWriter::new(File::create(&path).with_context(|| format!("cannot write {}", path.display()))?);
        let mut file = Self { path, out };
        let file_version = Some("brain.Event:2".to_owned());
        file.write(&Event { wall_time: seconds(began), step: 0, file_version, summary: None })?;
        Ok(file)
    }

    fn write(&mut self, event: &Event) -> anyhow::Result<()> {
        record(&mut self.out, &event.encode_to_vec()).with_context(|| format!("cannot write {}", self.path.display()))
    }

    fn finish(mut self) -> anyhow::Result<String> {
        self.out.flush().with_context(|| format!("cannot write {}", self.path.display()))?;
        Ok(self.path.file_name().unwrap_or_default().to_string_lossy().into_owned())
    }
}

/// Writes a TFRecord: length, its checksum, data, its checksum; all little-endian.
fn record(out: &mut impl Write, data: &[u8]) -> io::Result<()> {
    let length = (data.len() as u64).to_le_bytes();
    out.write_all(&length)?;
    out.write_all(&masked(&length).to_le_bytes())?;
    out.write_all(data)?;
    out.write_all(&masked(data).to_le_bytes())
}

/// The checksum of a TFRecord.
fn masked(data: &[u8]) -> u32 {
    CRC.checksum(data).rotate_right(15).wrapping_add(0xa282_ead8)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(path: &Path) -> Vec<Event> {
        let (bytes, mut at, mut events) = (fs::read(path).unwrap(), 0, Vec::new());
        while at < bytes.len() {
            let number = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
            let length = u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap()) as usize;
            let data = &bytes[at + 12..at + 12 + length];
            assert_eq!((number(at + 8), number(at + 12 + length)), (masked(&bytes[at..at + 8]), masked(data)));
            events.push(Event::decode(data).unwrap());
            at += 16 + length;
        }
        events
    }

    #[test]
    fn checksums_are_those_of_the_format() {
        // RFC 3720, B.4: 32 bytes of zeroes.
        assert_eq!(CRC.checksum(&[0; 32]), 0x8a91_36aa);
        assert_eq!(masked(&[0; 32]), 0x8a91_36aa_u32.rotate_right(15).wrapping_add(0xa282_ead8));
    }

    #[test]
    fn every_row_is_in_the_file_of_the_attempt_that_computed_it() {
        let dir = tempfile::tempdir().unwrap();
        let time = |second: u64| format!("2026-01-01T00:00:{second:02}.5Z");
        let attempts = [1, 2].map(|n| (n, time(10 * n).parse().unwrap()));
        // The second attempt computed the loss at step 20 again.
        let rows = [("loss", 10, "0", 11), ("loss", 20, "0.25", 21), ("q", 10, "", 11), ("q", 20, "3", 12), ("q", 30, "4", 22)];
        let lines = rows.map(|(name, step, value, at)| format!("{name},{step},{value},{}\n", time(at)));
        let csv = lines.concat();
        for _ in 0..2 {
            let files = write(dir.path(), format!("name,step,value,at\n{csv}").as_bytes(), &attempts).unwrap();
            assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 2);
            let [one, two] = &files[..] else { panic!("{files:?}") };
            assert!(one < two, "{files:?}");
            let scalars = |file: &String| -> Vec<(String, i64, f32)> {
                let events = read(&dir.path().join(file));
                assert_eq!(events[0].file_version.as_deref(), Some("brain.Event:2"));
                let of = |event: &Event| (event.summary.as_ref().unwrap().value[0].clone(), event.step);
                events[1..].iter().map(of).map(|(scalar, step)| (scalar.tag, step, scalar.simple_value.unwrap())).collect()
            };
            let first = scalars(one);
            assert!(first[1].2.is_nan());
            assert_eq!((&first[0], &first[2]), (&("loss".to_owned(), 10, 0.0), &("q".to_owned(), 20, 3.0)));
            assert_eq!(scalars(two), [("loss".to_owned(), 20, 0.25), ("q".to_owned(), 30, 4.0)]);
        }
        assert!(write(dir.path(), "name,step,value,at\nloss,1\n".as_bytes(), &attempts).is_err());
    }
}
