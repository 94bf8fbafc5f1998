//! Snapshots: everything that a training run's future depends on, exact to the bit, versioned and checksummed.
//!
//! Layout: magic, version, then sections, each a length (u64) and its bytes, then SHA-256 of all before. The first section is
//! JSON, whose numbers come back to the bit (`serde_json` with `float_roundtrip`); the others are little-endian arrays.
//! Reading trusts nothing.

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::replay::{Data, Replay, Shape};
use super::trainer::{Evaluated, Progress, State};
use super::{LearnerState, TrainConfig};
use crate::checkpoint;
use crate::invalid::Invalid;

const MAGIC: &[u8; 8] = b"qedgixss";
const VERSION: u32 = 2;
/// Magic and version.
const PREFIX: usize = 12;
const CHECKSUM: usize = 32;

/// Why bytes are not a snapshot that can be continued.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SnapshotError {
    /// Not written by [`super::Trainer::snapshot`].
    #[error("not a snapshot of a training run")]
    Foreign,
    /// Written by another version of this program.
    #[error("snapshot version {found} cannot be read; expected {VERSION}")]
    Version {
        /// The version found.
        found: u32,
    },
    /// Truncated or changed since it was written.
    #[error("the snapshot is damaged: its checksum does not match")]
    Checksum,
    /// The checksum matches, but the content contradicts itself.
    #[error("the snapshot is inconsistent: {0}")]
    Content(String),
    /// The configuration in it is invalid.
    #[error("the snapshot's configuration: {0}")]
    Config(#[from] Invalid),
}

/// What a snapshot is written from.
pub(super) struct Parts<'a> {
    pub config: &'a TrainConfig,
    pub progress: &'a Progress,
    pub latest: Option<&'a Evaluated>,
    pub best: Option<&'a (Evaluated, Vec<f32>)>,
    pub learner: &'a LearnerState,
    pub replay: &'a Replay,
}

/// The JSON section.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Head {
    config: TrainConfig,
    progress: Progress,
    latest: Option<Evaluated>,
    best: Option<Evaluated>,
    adam_steps: u64,
    replay_next: usize,
}

pub(super) fn encode(parts: &Parts<'_>) -> Vec<u8> {
    let head = Head {
        config: parts.config.clone(),
        progress: *parts.progress,
        latest: parts.latest.copied(),
        best: parts.best.map(|(e, _)| *e),
        adam_steps: parts.learner.adam_steps,
        replay_next: parts.replay.next(),
    };
    let (learner, replay) = (parts.learner, parts.replay.data());
    let mut bytes = Vec::with_capacity(parts.replay.bytes() + 32 * learner.online.len());
    bytes.extend(MAGIC);
    bytes.extend(VERSION.to_le_bytes());
    section(&mut bytes, &serde_json::to_vec(&head).expect("plain data with string keys"));
    let best = parts.best.map_or(&[][..], |(_, weights)| weights);
    for array in [&learner.online, &learner.target, &learner.adam_m, &learner.adam_v, &learner.average, best] {
        floats(&mut bytes, array);
    }
    for array in [&replay.uav_xy, &replay.user_xy, &replay.reward, &replay.token] {
        floats(&mut bytes, array);
    }
    let aoi: Vec<u8> = replay.aoi.iter().flat_map(|a| a.to_le_bytes()).collect();
    section(&mut bytes, &aoi);
    section(&mut bytes, &replay.actions);
    let checksum = Sha256::digest(&bytes);
    bytes.extend(checksum);
    bytes
}

pub(super) fn decode(bytes: &[u8]) -> Result<State, SnapshotError> {
    if !bytes.starts_with(MAGIC) || bytes.len() < PREFIX + CHECKSUM {
        return Err(SnapshotError::Foreign);
    }
    let (content, checksum) = bytes.split_at(bytes.len() - CHECKSUM);
    if Sha256::digest(content)[..] != *checksum {
        return Err(SnapshotError::Checksum);
    }
    let found = u32::from_le_bytes([content[8], content[9], content[10], content[11]]);
    if found != VERSION {
        return Err(SnapshotError::Version { found });
    }
    let mut rest = Sections(&content[PREFIX..]);
    let head: Head = serde_json::from_slice(rest.take()?).map_err(|e| inconsistent(e.to_string()))?;
    head.config.validate()?;
    let learner = LearnerState {
        online: rest.floats()?,
        target: rest.floats()?,
        adam_m: rest.floats()?,
        adam_v: rest.floats()?,
        average: rest.floats()?,
        adam_steps: head.adam_steps,
    };
    let weights = rest.floats()?;
    let expected = checkpoint::layout(&head.config).len();
    if head.best.is_some() && weights.len() != expected {
        return Err(inconsistent(format!("{} best weights, expected {expected}", weights.len())));
    }
    let (uav_xy, user_xy, reward, token) = (rest.floats()?, rest.floats()?, rest.floats()?, rest.floats()?);
    let aoi = rest.take()?.chunks_exact(2).map(|a| u16::from_le_bytes([a[0], a[1]])).collect();
    let data = Data { uav_xy, user_xy, aoi, actions: rest.take()?.to_vec(), reward, token };
    if data.actions.iter().any(|&a| usize::from(a) >= head.config.environment.headings()) {
        return Err(inconsistent("an action that does not exist"));
    }
    if !rest.0.is_empty() {
        return Err(inconsistent("more than was written"));
    }
    let shape = Shape::of_environment(&head.config.environment);
    let replay = Replay::from_parts(shape, head.config.training.buffer, head.replay_next, data)
        .ok_or_else(|| inconsistent("a replay of another size"))?;
    if !head.progress.fits(&head.config, replay.len()) {
        return Err(inconsistent("counters that contradict each other"));
    }
    Ok(State {
        best: head.best.map(|e| (e, weights)),
        config: head.config,
        progress: head.progress,
        latest: head.latest,
        learner,
        replay,
    })
}

fn inconsistent(what: impl Into<String>) -> SnapshotError {
    SnapshotError::Content(what.into())
}

fn section(bytes: &mut Vec<u8>, content: &[u8]) {
    bytes.extend((content.len() as u64).to_le_bytes());
    bytes.extend(content);
}

fn floats(bytes: &mut Vec<u8>, values: &[f32]) {
    bytes.extend((4 * values.len() as u64).to_le_bytes());
    bytes.extend(values.iter().flat_map(|x| x.to_le_bytes()));
}

/// The sections not read yet.
struct Sections<'a>(&'a [u8]);

impl<'a> Sections<'a> {
    fn take(&mut self) -> Result<&'a [u8], SnapshotError> {
        let short = || inconsistent("a section is cut short");
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
    use crate::recipe::{Algorithm, Preset};

    #[test]
    fn configurations_survive_exactly() {
        let mut config = TrainConfig::preset(Algorithm::Qedgix, Preset::Practical);
        // Shortest decimals of 17 digits, and neighbours that text tends to confuse.
        for bits in 0..2000 {
            config.training.gamma = f64::from_bits((1.0_f64 / 3.0).to_bits() + bits);
            config.environment.reward_scale = Some(f64::from_bits((1e-5_f64 / 7.0).to_bits() + bits));
            let back: TrainConfig = serde_json::from_slice(&serde_json::to_vec(&config).unwrap()).unwrap();
            assert_eq!(back, config);
        }
    }
}
