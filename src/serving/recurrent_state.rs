//! The encoding of `recurrent_state`: memory of a policy that the caller keeps between slots.
//!
//! Layout (little endian): `QXRS`, format version (1 byte), policy digest (32), step (8), M (4), N (4), fingerprint of
//! the ids (16), memory, first 8 bytes of the SHA-256 of the preceding bytes. This is a checksum against accidental
//! changes, not a signature: a forged state affects only the forger's own fleet.
//!
//! In version 2 the memory is packed (`fleet_memory`). In version 1 it is a list of f32; such states are still accepted.

use bytes::{Buf, BufMut, Bytes, BytesMut};
use sha2::{Digest, Sha256};

use super::{FleetIds, FleetMemory};
use crate::invalid::Invalid;

const MAGIC: &[u8; 4] = b"QXRS";
const FORMAT: u8 = 2;
/// The oldest version that is accepted.
const OLDEST_FORMAT: u8 = 1;
const HEADER: usize = 4 + 1 + 32 + 8 + 4 + 4 + 16;
const CHECKSUM: usize = 8;

/// The memory of a fleet between two slots, with what is needed to check that it fits the next request.
#[derive(Clone, Debug, PartialEq)]
pub struct RecurrentState<M = FleetMemory> {
    /// Digest of the policy version that wrote it.
    pub digest: [u8; 32],
    /// The next step.
    pub step: u64,
    /// M, the number of UAVs.
    pub uavs: u32,
    /// N, the number of users.
    pub users: u32,
    /// Fingerprint of the ids ([`FleetIds::fingerprint`]).
    pub fleet: [u8; 16],
    /// The policy's memory: packed bytes to encode, or what was decoded.
    pub memory: M,
}

impl RecurrentState<Bytes> {
    /// The packed memory of `fleet` before `step`.
    pub fn new(digest: [u8; 32], step: u64, fleet: &FleetIds, memory: Bytes) -> Self {
        let (uavs, users) = (fleet.uavs.len() as u32, fleet.users.len() as u32);
        Self { digest, step, uavs, users, fleet: fleet.fingerprint(), memory }
    }

    /// The bytes for the caller.
    pub fn encode(&self) -> Bytes {
        let mut bytes = BytesMut::with_capacity(HEADER + self.memory.len() + CHECKSUM);
        bytes.put_slice(MAGIC);
        bytes.put_u8(FORMAT);
        bytes.put_slice(&self.digest);
        bytes.put_u64_le(self.step);
        bytes.put_u32_le(self.uavs);
        bytes.put_u32_le(self.users);
        bytes.put_slice(&self.fleet);
        bytes.put_slice(&self.memory);
        let sum = Sha256::digest(&bytes);
        bytes.put_slice(&sum[..CHECKSUM]);
        bytes.freeze()
    }
}

impl RecurrentState {
    /// Decodes bytes from a caller.
    ///
    /// # Errors
    /// Names `recurrent_state` if the bytes are not the unchanged result of [`RecurrentState::encode`].
    pub fn decode(bytes: &Bytes) -> Result<Self, Invalid> {
        let wrong = |value: String| {
            let expected = "the unchanged recurrent_state of the previous response, or none in slot 0";
            Invalid::new("recurrent_state", value, expected)
        };
        if bytes.len() < HEADER + CHECKSUM || !bytes.starts_with(MAGIC) {
            return Err(wrong(format!("{} bytes of another format", bytes.len())));
        }
        let (body, sum) = bytes.split_at(bytes.len() - CHECKSUM);
        if Sha256::digest(body)[..CHECKSUM] != *sum {
            return Err(wrong(format!("{} bytes with a wrong checksum", bytes.len())));
        }
        if !(OLDEST_FORMAT..=FORMAT).contains(&body[4]) {
            return Err(wrong(format!("format version {}", body[4])));
        }
        let (mut digest, mut fleet) = ([0; 32], [0; 16]);
        let mut rest = &body[MAGIC.len() + 1..];
        rest.copy_to_slice(&mut digest);
        let step = rest.get_u64_le();
        let (uavs, users) = (rest.get_u32_le(), rest.get_u32_le());
        rest.copy_to_slice(&mut fleet);
        let memory = match body[4] {
            OLDEST_FORMAT => FleetMemory::Plain(rest.chunks_exact(4).map(|mut value| value.get_f32_le()).collect()),
            _ => FleetMemory::Packed(bytes.slice(HEADER..body.len())),
        };
        Ok(Self { digest, step, uavs, users, fleet, memory })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn state(memory: &'static [u8]) -> RecurrentState<Bytes> {
        let fleet = FleetIds { uavs: vec!["a".into(), "b".into()], users: vec!["u".into()] };
        RecurrentState::new([7; 32], 3, &fleet, Bytes::from_static(memory))
    }

    #[test]
    fn changed_or_missing_byte_is_rejected() {
        let state = state(b"packed");
        let bytes = state.encode();
        let back = RecurrentState::decode(&bytes).unwrap();
        assert_eq!((back.step, back.uavs, back.users, back.fleet), (3, 2, 1, state.fleet));
        assert_eq!(back.memory, FleetMemory::Packed(state.memory));
        for i in 0..bytes.len() {
            let mut changed = bytes.to_vec();
            changed[i] ^= 1;
            assert!(RecurrentState::decode(&changed.into()).is_err(), "byte {i}");
            assert!(RecurrentState::decode(&bytes.slice(..i)).is_err(), "length {i}");
        }
    }

    #[test]
    fn states_of_version_1_are_accepted_and_of_later_versions_refused() {
        let bytes = state(b"").encode();
        for version in 0..4 {
            let mut body = bytes[..HEADER].to_vec();
            body[4] = version;
            body.put_f32_le(0.5);
            let sum = Sha256::digest(&body);
            body.extend_from_slice(&sum[..CHECKSUM]);
            let memory = RecurrentState::decode(&body.into()).map(|state| state.memory).map_err(|e| e.field);
            match version {
                1 => assert_eq!(memory, Ok(FleetMemory::Plain(vec![0.5]))),
                2 => assert!(matches!(memory, Ok(FleetMemory::Packed(_)))),
                _ => assert_eq!(memory, Err("recurrent_state".into())),
            }
        }
    }
}
