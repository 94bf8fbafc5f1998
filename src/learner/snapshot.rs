//! Snapshots: everything needed to resume training, exact to the bit, versioned and checksummed.
//!
//! Layout: magic, version, sections, SHA-256 of all bytes before it. A section is its length (u64) and its bytes. The first
//! section is JSON, whose numbers are read back to the bit (`serde_json` with `float_roundtrip`); the others are little-endian
//! arrays. Reading checks everything.

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::replay::{Replay, Ring, RingArrays};
use super::state::{Counters, RunState};
use super::{Evaluation, LearnerState, TrainConfig};
use crate::checkpoint;
use crate::env::EpisodeMetrics;
use crate::invalid::Invalid;

const MAGIC: &[u8; 8] = b"qedgixss";
/// The version that is written.
const VERSION: u32 = 3;
/// The oldest version that is read. Version 2 had no evaluations in progress and no reports.
const OLDEST_VERSION: u32 = 2;
/// Magic and version.
const PREFIX: usize = 12;
const CHECKSUM: usize = 32;

/// Why bytes cannot be restored.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SnapshotError {
    /// The bytes were not written by [`super::Trainer::snapshot`].
    #[error("not a snapshot of a training run")]
    Foreign,
    /// The snapshot was written by another version of this program.
    #[error("snapshot version {found} cannot be read; expected {OLDEST_VERSION} to {VERSION}")]
    Version {
        /// The version found.
        found: u32,
    },
    /// The bytes were truncated or changed after they were written.
    #[error("the snapshot is damaged: its checksum does not match")]
    Checksum,
    /// The checksum matches, but the content is inconsistent.
    #[error("the snapshot is inconsistent: {0}")]
    Content(String),
    /// The configuration in the snapshot is invalid.
    #[error("the snapshot's configuration: {0}")]
    Config(#[from] Invalid),
}

/// What a snapshot holds.
#[derive(Debug)]
pub(super) struct Snapshot {
    pub config: TrainConfig,
    pub run: RunState,
    pub learner: LearnerState,
    pub replay: Replay,
}

/// The JSON section.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Head {
    config: TrainConfig,
    #[serde(rename = "progress")]
    counters: Counters,
    latest: Option<Evaluation>,
    best: Option<Evaluation>,
    #[serde(default)]
    layouts: Vec<EpisodeMetrics>,
    #[serde(default)]
    reports: bool,
    adam_steps: u64,
    replay_next: usize,
}

/// Whether these bytes begin as a snapshot does.
pub fn is_snapshot(bytes: &[u8]) -> bool {
    bytes.starts_with(MAGIC)
}

pub(super) fn encode(config: &TrainConfig, run: &RunState, learner: &LearnerState, replay: &Replay) -> Vec<u8> {
    let head = Head {
        config: config.clone(),
        counters: run.counters,
        latest: run.latest,
        best: run.best.as_ref().map(|(evaluation, _)| *evaluation),
        layouts: run.layouts.clone(),
        reports: run.reports,
        adam_steps: learner.adam_steps,
        replay_next: replay.next(),
    };
    let mut bytes = Vec::with_capacity(replay.bytes() + 32 * learner.online.len());
    bytes.extend(MAGIC);
    bytes.extend(VERSION.to_le_bytes());
    push_section(&mut bytes, &serde_json::to_vec(&head).expect("plain data with string keys"));
    let best = run.best.as_ref().map_or(&[][..], |(_, parameters)| parameters);
    for array in [&learner.online, &learner.target, &learner.adam_m, &learner.adam_v, &learner.average, best] {
        push_numbers(&mut bytes, array.iter().map(|x| x.to_le_bytes()));
    }
    let rings = || replay.rings().map(Ring::arrays);
    let floats: [fn(&RingArrays) -> &Vec<f32>; 4] = [|a| &a.uav_xy, |a| &a.user_xy, |a| &a.reward, |a| &a.identity_token];
    for array in floats {
        push_numbers(&mut bytes, rings().flat_map(array).map(|x| x.to_le_bytes()));
    }
    push_numbers(&mut bytes, rings().flat_map(|a| &a.aoi).map(|x| x.to_le_bytes()));
    push_numbers(&mut bytes, rings().flat_map(|a| &a.actions).map(|x| [*x]));
    let checksum = Sha256::digest(&bytes);
    bytes.extend(checksum);
    bytes
}

pub(super) fn decode(bytes: &[u8]) -> Result<Snapshot, SnapshotError> {
    if !bytes.starts_with(MAGIC) || bytes.len() < PREFIX + CHECKSUM {
        return Err(SnapshotError::Foreign);
    }
    let (content, checksum) = bytes.split_at(bytes.len() - CHECKSUM);
    if Sha256::digest(content)[..] != *checksum {
        return Err(SnapshotError::Checksum);
    }
    let found = u32::from_le_bytes([content[8], content[9], content[10], content[11]]);
    if !(OLDEST_VERSION..=VERSION).contains(&found) {
        return Err(SnapshotError::Version { found });
    }
    let mut sections = Sections(&content[PREFIX..]);
    let head: Head = serde_json::from_slice(sections.take()?).map_err(|e| inconsistent(e.to_string()))?;
    head.config.validate()?;
    let learner = LearnerState {
        online: sections.floats()?,
        target: sections.floats()?,
        adam_m: sections.floats()?,
        adam_v: sections.floats()?,
        average: sections.floats()?,
        adam_steps: head.adam_steps,
    };
    let parameters = sections.floats()?;
    let expected = checkpoint::parameter_layout(&head.config).len();
    if head.best.is_some() && parameters.len() != expected {
        return Err(inconsistent(format!("{} best parameters; expected {expected}", parameters.len())));
    }
    let (uav_xy, user_xy, reward, identity_token) =
        (sections.floats()?, sections.floats()?, sections.floats()?, sections.floats()?);
    let aoi = sections.take()?.chunks_exact(2).map(|a| u16::from_le_bytes([a[0], a[1]])).collect();
    let arrays = RingArrays { uav_xy, user_xy, aoi, actions: sections.take()?.to_vec(), reward, identity_token };
    if arrays.actions.iter().any(|&a| usize::from(a) >= head.config.environment.actions()) {
        return Err(inconsistent("an action is out of range"));
    }
    if !sections.0.is_empty() {
        return Err(inconsistent("there are bytes after the last section"));
    }
    let replay = Replay::from_parts(&head.config, head.counters.episodes, head.replay_next, arrays)
        .ok_or_else(|| inconsistent("the replay does not have the size of the configuration"))?;
    if !head.counters.is_consistent(&head.config, replay.len()) {
        return Err(inconsistent("the counters contradict each other"));
    }
    if head.layouts.len() > head.config.training.eval_episodes {
        return Err(inconsistent("an evaluation has more layouts than configured"));
    }
    let run = RunState {
        counters: head.counters,
        latest: head.latest,
        best: head.best.map(|e| (e, parameters)),
        layouts: head.layouts,
        reports: head.reports,
    };
    Ok(Snapshot { config: head.config, run, learner, replay })
}

fn inconsistent(reason: impl Into<String>) -> SnapshotError {
    SnapshotError::Content(reason.into())
}

fn push_section(bytes: &mut Vec<u8>, content: &[u8]) {
    bytes.extend((content.len() as u64).to_le_bytes());
    bytes.extend(content);
}

/// A section of numbers in their little-endian bytes.
fn push_numbers<const N: usize>(bytes: &mut Vec<u8>, numbers: impl Iterator<Item = [u8; N]>) {
    let start = bytes.len();
    bytes.extend([0; 8]);
    bytes.extend(numbers.flatten());
    let len = (bytes.len() - start - 8) as u64;
    bytes[start..start + 8].copy_from_slice(&len.to_le_bytes());
}

/// The bytes of the sections that are not read yet.
struct Sections<'a>(&'a [u8]);

impl<'a> Sections<'a> {
    fn take(&mut self) -> Result<&'a [u8], SnapshotError> {
        let short = || inconsistent("a section is truncated");
        let (len, rest) = self.0.split_first_chunk::<8>().ok_or_else(short)?;
        let len = usize::try_from(u64::from_le_bytes(*len)).map_err(|_| short())?;
        let (section, rest) = rest.split_at_checked(len).ok_or_else(short)?;
        self.0 = rest;
        Ok(section)
    }

    fn floats(&mut self) -> Result<Vec<f32>, SnapshotError> {
        let bytes = self.take()?.chunks_exact(4);
        Ok(bytes.map(|x| f32::from_le_bytes([x[0], x[1], x[2], x[3]])).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train_config::{Algorithm, Preset};

    #[test]
    fn numbers_of_a_configuration_are_read_back_exactly() {
        let mut config = TrainConfig::preset(Algorithm::Qedgix, Preset::Practical);
        // Neighbouring numbers whose shortest decimals have 17 digits.
        for bits in 0..2000 {
            config.training.gamma = f64::from_bits((1.0_f64 / 3.0).to_bits() + bits);
            config.environment.reward_scale = Some(f64::from_bits((1e-5_f64 / 7.0).to_bits() + bits));
            let back: TrainConfig = serde_json::from_slice(&serde_json::to_vec(&config).unwrap()).unwrap();
            assert_eq!(back, config);
        }
    }
}
