//! The encoding of `recurrent_state`: memory of a policy that the caller keeps between slots.
//!
//! Layout (little endian): `QXRS`, format version (1 byte), policy digest (32), step (8), M (4), N (4), fingerprint of
//! the ids (16), memory (4 each), first 8 bytes of the SHA-256 of the preceding bytes. This is a checksum against accidental
//! changes, not a signature: a forged state affects only the forger's own fleet.

use bytes::{Buf, BufMut, Bytes, BytesMut};
use sha2::{Digest, Sha256};

use super::FleetIds;
use crate::invalid::Invalid;

const MAGIC: &[u8; 4] = b"QXRS";
const FORMAT: u8 = 1;
const HEADER: usize = 4 + 1 + 32 + 8 + 4 + 4 + 16;
const CHECKSUM: usize = 8;

/// The memory of a fleet between two slots, with what is needed to check that it fits the next request.
#[derive(Clone, Debug, PartialEq)]
pub struct RecurrentState {
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
    /// The policy's memory.
    pub memory: Vec<f32>,
}

impl RecurrentState {
    /// The memory of `fleet` before `step`.
    pub fn new(digest: [u8; 32], step: u64, fleet: &FleetIds, memory: Vec<f32>) -> Self {
        let (uavs, users) = (fleet.uavs.len() as u32, fleet.users.len() as u32);
        Self { digest, step, uavs, users, fleet: fleet.fingerprint(), memory }
    }

    /// The bytes for the caller.
    pub fn encode(&self) -> Bytes {
        let mut bytes = BytesMut::with_capacity(HEADER + 4 * self.memory.len() + CHECKSUM);
        bytes.put_slice(MAGIC);
        bytes.put_u8(FORMAT);
        bytes.put_slice(&self.digest);
        bytes.put_u64_le(self.step);
        bytes.put_u32_le(self.uavs);
        bytes.put_u32_le(self.users);
        bytes.put_slice(&self.fleet);
        for &value in &self.memory {
            bytes.put_f32_le(value);
        }
        let sum = Sha256::digest(&bytes);
        bytes.put_slice(&sum[..CHECKSUM]);
        bytes.freeze()
    }

    /// Decodes bytes from a caller.
    ///
    /// # Errors
    /// Names `recurrent_state` if the bytes are not the unchanged result of [`RecurrentState::encode`].
    pub fn decode(bytes: &[u8]) -> Result<Self, Invalid> {
        let wrong = |value: String| {
            let expected = "the unchanged recurrent_state of the previous response, or none in slot 0";
            Invalid::new("recurrent_state", value, expected)
        };
        let inside = bytes.len().checked_sub(HEADER + CHECKSUM);
        if inside.is_none_or(|len| len % 4 != 0) || !bytes.starts_with(MAGIC) {
            return Err(wrong(format!("{} bytes of another format", bytes.len())));
        }
        let (body, sum) = bytes.split_at(bytes.len() - CHECKSUM);
        if Sha256::digest(body)[..CHECKSUM] != *sum {
            return Err(wrong(format!("{} bytes with a wrong checksum", bytes.len())));
        }
        if body[4] != FORMAT {
            return Err(wrong(format!("format version {}", body[4])));
        }
        let (mut digest, mut fleet) = ([0; 32], [0; 16]);
        let mut rest = &body[MAGIC.len() + 1..];
        rest.copy_to_slice(&mut digest);
        let step = rest.get_u64_le();
        let (uavs, users) = (rest.get_u32_le(), rest.get_u32_le());
        rest.copy_to_slice(&mut fleet);
        let memory = rest.chunks_exact(4).map(|mut value| value.get_f32_le()).collect();
        Ok(Self { digest, step, uavs, users, fleet, memory })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn changed_or_missing_byte_is_rejected() {
        let fleet = FleetIds { uavs: vec!["a".into(), "b".into()], users: vec!["u".into()] };
        let state = RecurrentState::new([7; 32], 3, &fleet, vec![0.5, -1.0, f32::NAN]);
        let bytes = state.encode();
        let back = RecurrentState::decode(&bytes).unwrap();
        assert_eq!((back.step, back.uavs, back.users, back.fleet), (3, 2, 1, fleet.fingerprint()));
        assert!(back.memory[2].is_nan());
        for i in 0..bytes.len() {
            let mut changed = bytes.to_vec();
            changed[i] ^= 1;
            assert!(RecurrentState::decode(&changed).is_err(), "byte {i}");
            assert!(RecurrentState::decode(&bytes[..i]).is_err(), "length {i}");
        }
    }
}
