//! The bytes of messages between UAVs, and of the state that a UAV keeps between two calls.
//!
//! Layout (little endian) of a message: `QXUM`, format version (1 byte), mission (16), step (8), canonical index of the UAV (4), observation,
//! memory. Of a state: `QXUS`, format version (1), digest of the policy version (32), seed (8), step (8), index of the UAV (4), M (4), N (4),
//! ids (length in 2 bytes, then the id), 1 and an observation if one waits for the messages of others, else 0, memory. Both end with the
//! first 8 bytes of the SHA-256 of the preceding bytes, a checksum against accidental changes.
//!
//! Observation: flags (1: position, 2: speed), position (16), speed (8), number of detections (4), detections: target (4), relative position
//! (16), AoI of users (4). Positions have f64, so that a receiver computes with the bits of the sender. The memory is that of a fleet of one
//! UAV and N users, packed (`fleet_memory`).

use bytes::{Buf, BufMut, Bytes, BytesMut};
use sha2::{Digest, Sha256};

use super::observation::{Observation, OwnDetection};
use crate::invalid::Invalid;
use crate::policy::Policy;
use crate::serving::{FleetIds, FleetMemory, MAX_NODES};

const STATE: &[u8; 4] = b"QXUS";
const MESSAGE: &[u8; 4] = b"QXUM";
const FORMAT: u8 = 1;
const CHECKSUM: usize = 8;
const HAS_POSITION: u8 = 1;
const HAS_SPEED: u8 = 2;
/// Largest number of a position or a speed in a message, in the unit square.
const MAX_NUMBER: f64 = 1e3;
const MAX_AOI: f32 = 1e6;

/// Identifies what all UAVs must have in common: the policy version, the ids of the fleet and the seed.
pub type Mission = [u8; 16];

/// What a UAV knows between two calls.
#[derive(Clone, Debug, PartialEq)]
pub struct UavState {
    /// Digest of the policy version.
    pub digest: [u8; 32],
    /// Seed of the fleet.
    pub seed: u64,
    /// The slot that the UAV decides next.
    pub step: u64,
    /// Its canonical index.
    pub uav: u32,
    /// The ids of the fleet.
    pub ids: FleetIds,
    /// What it observes in the slot, once it has encoded it.
    pub observation: Option<Observation>,
    /// What it remembered before the slot.
    pub memory: FleetMemory,
}

/// What a UAV tells others in a slot.
#[derive(Clone, Debug, PartialEq)]
pub struct Message {
    /// What all UAVs have in common.
    pub mission: Mission,
    /// The slot.
    pub step: u64,
    /// Canonical index of the sender.
    pub uav: u32,
    /// What it observes in the slot.
    pub observation: Observation,
    /// What it remembered before the slot.
    pub memory: FleetMemory,
}

impl UavState {
    /// What all UAVs of the fleet have in common.
    pub fn mission(&self) -> Mission {
        let mut hash = Sha256::new();
        hash.update(self.digest);
        hash.update(self.seed.to_le_bytes());
        hash.update(self.ids.fingerprint());
        let mut mission = [0; 16];
        mission.copy_from_slice(&hash.finalize()[..16]);
        mission
    }

    /// The bytes for the caller.
    pub fn encode(&self, policy: &dyn Policy) -> Bytes {
        let (uavs, users) = self.ids.size();
        let mut bytes = BytesMut::new();
        bytes.put_slice(STATE);
        bytes.put_u8(FORMAT);
        bytes.put_slice(&self.digest);
        bytes.put_u64_le(self.seed);
        bytes.put_u64_le(self.step);
        bytes.put_u32_le(self.uav);
        bytes.put_u32_le(uavs as u32);
        bytes.put_u32_le(users as u32);
        for id in self.ids.uavs.iter().chain(&self.ids.users) {
            bytes.put_u16_le(id.len() as u16);
            bytes.put_slice(id.as_bytes());
        }
        bytes.put_u8(self.observation.is_some().into());
        if let Some(observation) = &self.observation {
            put_observation(&mut bytes, observation, uavs);
        }
        sealed(bytes, &self.memory.clone().into_packed(policy, (1, users)))
    }

    /// Decodes bytes from a caller.
    ///
    /// # Errors
    /// Names `state` if the bytes are not the unchanged result of [`UavState::encode`].
    pub fn decode(bytes: &Bytes) -> Result<Self, Invalid> {
        let wrong = |value: String| Invalid::new("state", value, "the unchanged state of the UAV's previous response, or none");
        let mut rest = opened(bytes, *STATE).map_err(wrong)?;
        let mut read = || {
            let mut digest = [0; 32];
            rest.try_copy_to_slice(&mut digest).ok()?;
            let (seed, step, uav) = (rest.try_get_u64_le().ok()?, rest.try_get_u64_le().ok()?, rest.try_get_u32_le().ok()?);
            let (uavs, users) = (rest.try_get_u32_le().ok()? as usize, rest.try_get_u32_le().ok()? as usize);
            if uavs.saturating_add(users) > MAX_NODES {
                return None;
            }
            let list = |rest: &mut Bytes, count: usize| -> Option<Vec<String>> { (0..count).map(|_| read_id(rest)).collect() };
            let ids = FleetIds { uavs: list(&mut rest, uavs)?, users: list(&mut rest, users)? };
            let waits = rest.try_get_u8().ok()? != 0;
            let observation = if waits { Some(read_observation(&mut rest, (uavs, users))?) } else { None };
            let known = (uav as usize) < uavs;
            known.then(|| Self { digest, seed, step, uav, ids, observation, memory: FleetMemory::Packed(rest.clone()) })
        };
        read().ok_or_else(|| wrong(format!("{} bytes of another form", bytes.len())))
    }
}

impl Message {
    /// The bytes for the other UAVs of a fleet of this size.
    pub fn encode(&self, policy: &dyn Policy, (uavs, users): (usize, usize)) -> Bytes {
        let mut bytes = BytesMut::new();
        bytes.put_slice(MESSAGE);
        bytes.put_u8(FORMAT);
        bytes.put_slice(&self.mission);
        bytes.put_u64_le(self.step);
        bytes.put_u32_le(self.uav);
        put_observation(&mut bytes, &self.observation, uavs);
        sealed(bytes, &self.memory.clone().into_packed(policy, (1, users)))
    }

    /// Decodes the bytes of message `index` of a request of the UAV with `state`.
    ///
    /// # Errors
    /// Names `messages[index]` if it is not an unchanged message of this mission and slot.
    pub fn decode(index: usize, bytes: &Bytes, state: &UavState, mission: &Mission) -> Result<Self, Invalid> {
        let field = || format!("messages[{index}]");
        let wrong = |value: String| Invalid::new(field(), value, "the unchanged message of another UAV");
        let mut rest = opened(bytes, *MESSAGE).map_err(wrong)?;
        let mut theirs = [0; 16];
        let mut head = || {
            rest.try_copy_to_slice(&mut theirs).ok()?;
            Some((rest.try_get_u64_le().ok()?, rest.try_get_u32_le().ok()?))
        };
        let Some((step, uav)) = head() else { return Err(wrong(format!("{} bytes", bytes.len()))) };
        if theirs != *mission {
            let expected = "a message of the same fleet with the same policy version and seed";
            return Err(Invalid::new(field(), "a message of another mission", expected));
        }
        if step != state.step {
            return Err(Invalid::new(field(), format!("a message of step {step}"), format!("one of step {}", state.step)));
        }
        let size = state.ids.size();
        let known = (uav as usize) < size.0;
        let observation = if known { read_observation(&mut rest, size) } else { None };
        let Some(observation) = observation.filter(|observation| observation.detections.iter().all(|d| d.target != uav)) else {
            return Err(wrong(format!("{} bytes of another form", bytes.len())));
        };
        Ok(Self { mission: theirs, step, uav, observation, memory: FleetMemory::Packed(rest) })
    }
}

fn put_observation(bytes: &mut BytesMut, observation: &Observation, uavs: usize) {
    let Observation { position, speed, detections } = observation;
    let flag = |set: bool, flag: u8| if set { flag } else { 0 };
    bytes.put_u8(flag(position.is_some(), HAS_POSITION) | flag(speed.is_some(), HAS_SPEED));
    position.iter().flatten().chain(speed).for_each(|&number| bytes.put_f64_le(number));
    bytes.put_u32_le(detections.len() as u32);
    for OwnDetection { target, rel, aoi } in detections {
        bytes.put_u32_le(*target);
        rel.iter().for_each(|&number| bytes.put_f64_le(number));
        if *target as usize >= uavs {
            bytes.put_f32_le(*aoi);
        }
    }
}

fn read_observation(rest: &mut Bytes, (uavs, users): (usize, usize)) -> Option<Observation> {
    let number = |rest: &mut Bytes| rest.try_get_f64_le().ok().filter(|number| number.abs() <= MAX_NUMBER);
    let flags = rest.try_get_u8().ok()?;
    let position = if flags & HAS_POSITION == 0 { None } else { Some([number(rest)?, number(rest)?]) };
    let speed = if flags & HAS_SPEED == 0 { None } else { Some(number(rest).filter(|speed| *speed >= 0.0)?) };
    let count = rest.try_get_u32_le().ok()? as usize;
    if count > uavs + users {
        return None;
    }
    let mut detections: Vec<OwnDetection> = Vec::with_capacity(count);
    for _ in 0..count {
        let target = rest.try_get_u32_le().ok()?;
        let after = detections.last().is_none_or(|last| last.target < target);
        if !after || target as usize >= uavs + users {
            return None;
        }
        let rel = [number(rest)?, number(rest)?];
        let is_user = target as usize >= uavs;
        let aoi = if is_user { rest.try_get_f32_le().ok().filter(|aoi| (0.0..=MAX_AOI).contains(aoi))? } else { 0.0 };
        detections.push(OwnDetection { target, rel, aoi });
    }
    Some(Observation { position, speed, detections })
}

fn read_id(rest: &mut Bytes) -> Option<String> {
    let len = rest.try_get_u16_le().ok()? as usize;
    let id = (len <= rest.len()).then(|| rest.split_to(len))?;
    String::from_utf8(id.to_vec()).ok()
}

/// `bytes` and the memory with their checksum.
fn sealed(mut bytes: BytesMut, memory: &Bytes) -> Bytes {
    bytes.put_slice(memory);
    let sum = Sha256::digest(&bytes);
    bytes.put_slice(&sum[..CHECKSUM]);
    bytes.freeze()
}

/// The content after the format version.
///
/// # Errors
/// What `bytes` are instead.
fn opened(bytes: &Bytes, magic: [u8; 4]) -> Result<Bytes, String> {
    let head = magic.len() + 1;
    if bytes.len() < head + CHECKSUM || !bytes.starts_with(&magic) {
        return Err(format!("{} bytes of another format", bytes.len()));
    }
    let (body, sum) = bytes.split_at(bytes.len() - CHECKSUM);
    if Sha256::digest(body)[..CHECKSUM] != *sum {
        return Err(format!("{} bytes with a wrong checksum", bytes.len()));
    }
    if body[magic.len()] != FORMAT {
        return Err(format!("format version {}", body[magic.len()]));
    }
    Ok(bytes.slice(head..body.len()))
}
