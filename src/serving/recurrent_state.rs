//! The encoding of `recurrent_state`: memory of a policy that the caller keeps between slots.
//!
//! Layout (little endian): `QXRS`, format version (1 byte), policy digest (32), step (8), seed (8), M (4), N (4), flags (1), members,
//! memory, first 8 bytes of the SHA-256 of the preceding bytes. This is a checksum against accidental changes, not a signature: a forged
//! state affects only the forger's own fleet.
//!
//! Members: the hash of the id of each UAV (8) and of each user of which the memory holds something (8); with [`MISSING`], for each of
//! them how many slots before the last one it was listed (4); with [`TURNS`], the angle of each UAV, numerator (4) and denominator (4).
//! The memory is packed (`fleet_memory`).
//!
//! Versions 1 and 2 are still accepted. They have no seed and no flags, and a fingerprint of all ids (16) instead of the members; such a
//! fleet begins to change after the next step. In version 1 the memory is a list of f32.

use bytes::{Buf, BufMut, Bytes, BytesMut};
use sha2::{Digest, Sha256};

use super::roster::{Member, Roster, Turn};
use super::{FleetIds, FleetMemory, LoadedPolicy, UserMemory};
use crate::invalid::Invalid;

const MAGIC: &[u8; 4] = b"QXRS";
const FORMAT: u8 = 3;
/// The oldest version that is accepted.
const OLDEST_FORMAT: u8 = 1;
/// The first version with members.
const WITH_MEMBERS: u8 = 3;
/// Up to the version, and up to the first part that depends on the version.
const VERSION_AT: usize = 4;
const HEADER: usize = VERSION_AT + 1 + 32 + 8;
const CHECKSUM: usize = 8;

/// Flags: some members are missing; UAVs have angles of their own; there may be more users than were listed.
const MISSING: u8 = 1;
const TURNS: u8 = 2;
const OPEN: u8 = 4;

/// The memory of a fleet between two slots, with what is needed to check that it fits the next request.
#[derive(Clone, Debug, PartialEq)]
pub struct RecurrentState<M = FleetMemory> {
    /// Digest of the policy version that wrote it.
    pub digest: [u8; 32],
    /// The next step.
    pub step: u64,
    /// Determines the random numbers of new UAVs.
    pub seed: u64,
    /// Who belongs to the fleet.
    pub members: Members,
    /// The policy's memory: packed bytes to encode, or what was decoded.
    pub memory: M,
}

/// Who belongs to the fleet of a state.
#[derive(Clone, Debug, PartialEq)]
pub enum Members {
    /// The members.
    Roster(Roster),
    /// Those with this fingerprint, in states of versions 1 and 2.
    Fingerprint {
        /// M, the number of UAVs.
        uavs: u32,
        /// N, the number of users.
        users: u32,
        /// Fingerprint of the ids ([`FleetIds::fingerprint`]).
        fleet: [u8; 16],
    },
}

impl RecurrentState<Bytes> {
    /// The bytes for the caller.
    pub fn encode(&self) -> Bytes {
        let Members::Roster(Roster { uavs, turns, users, open }) = &self.members else { return Bytes::new() };
        let last = self.step.saturating_sub(1);
        let missing = uavs.iter().chain(users).any(|member| member.seen != last);
        let mut bytes = BytesMut::with_capacity(HEADER + 17 + 20 * uavs.len() + 12 * users.len() + self.memory.len() + CHECKSUM);
        bytes.put_slice(MAGIC);
        bytes.put_u8(FORMAT);
        bytes.put_slice(&self.digest);
        bytes.put_u64_le(self.step);
        bytes.put_u64_le(self.seed);
        bytes.put_u32_le(uavs.len() as u32);
        bytes.put_u32_le(users.len() as u32);
        let flag = |flag, set| if set { flag } else { 0 };
        bytes.put_u8(flag(MISSING, missing) | flag(TURNS, !turns.is_empty()) | flag(OPEN, *open));
        for member in uavs.iter().chain(users) {
            bytes.put_u64_le(member.key);
        }
        if missing {
            for member in uavs.iter().chain(users) {
                bytes.put_u32_le(u32::try_from(last - member.seen.min(last)).unwrap_or(u32::MAX));
            }
        }
        for turn in turns {
            bytes.put_u32_le(turn.numerator);
            bytes.put_u32_le(turn.denominator);
        }
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
        if bytes.len() < HEADER + CHECKSUM || !bytes.starts_with(MAGIC) {
            return Err(wrong(format!("{} bytes of another format", bytes.len())));
        }
        let (body, sum) = bytes.split_at(bytes.len() - CHECKSUM);
        if Sha256::digest(body)[..CHECKSUM] != *sum {
            return Err(wrong(format!("{} bytes with a wrong checksum", bytes.len())));
        }
        let version = body[VERSION_AT];
        if !(OLDEST_FORMAT..=FORMAT).contains(&version) {
            return Err(wrong(format!("format version {version}")));
        }
        let mut digest = [0; 32];
        let mut rest = bytes.slice(VERSION_AT + 1..body.len());
        rest.copy_to_slice(&mut digest);
        let step = rest.get_u64_le();
        let decoded = if version >= WITH_MEMBERS { read_members(&mut rest, step) } else { read_fingerprint(&mut rest) };
        let (seed, members) = decoded.map_err(|_| wrong(format!("{} bytes, fewer than the fleet needs", bytes.len())))?;
        let memory = match version {
            OLDEST_FORMAT => FleetMemory::Plain(rest.chunks_exact(4).map(|mut value| value.get_f32_le()).collect()),
            _ => FleetMemory::Packed(rest),
        };
        Ok(Self { digest, step, seed, members, memory })
    }

    /// The members before the next step, whose request lists `fleet`.
    ///
    /// # Errors
    /// [`Invalid`] if the policy, or a state of an older version, does not accept these ids.
    pub fn roster(&self, fleet: &FleetIds, policy: &LoadedPolicy) -> Result<Roster, Invalid> {
        match &self.members {
            Members::Roster(roster) => roster.check_bound(fleet, policy).map(|()| roster.clone()),
            Members::Fingerprint { uavs, users, fleet: fingerprint } => {
                if (*uavs as usize, *users as usize) != fleet.size() {
                    return Err(wrong(format!("the state of {uavs} UAVs and {users} users")));
                }
                if *fingerprint != fleet.fingerprint() {
                    return Err(wrong("the state of UAVs or users with other ids".into()));
                }
                Ok(Roster::new(fleet, self.step.saturating_sub(1), false, UserMemory::of(policy)))
            }
        }
    }
}

fn wrong(value: String) -> Invalid {
    let expected = "the unchanged recurrent_state of the previous response, or none in slot 0";
    Invalid::new("recurrent_state", value, expected)
}

fn read_fingerprint(rest: &mut Bytes) -> Result<(u64, Members), bytes::TryGetError> {
    let (uavs, users) = (rest.try_get_u32_le()?, rest.try_get_u32_le()?);
    let mut fleet = [0; 16];
    rest.try_copy_to_slice(&mut fleet)?;
    Ok((0, Members::Fingerprint { uavs, users, fleet }))
}

fn read_members(rest: &mut Bytes, step: u64) -> Result<(u64, Members), bytes::TryGetError> {
    let seed = rest.try_get_u64_le()?;
    let (uavs, users) = (rest.try_get_u32_le()? as usize, rest.try_get_u32_le()? as usize);
    let flags = rest.try_get_u8()?;
    let last = step.saturating_sub(1);
    // The bytes bound what is allocated.
    let count = uavs.saturating_add(users).min(rest.len() / 8 + 1);
    let mut members = Vec::with_capacity(count);
    for _ in 0..uavs.saturating_add(users) {
        members.push(Member { key: rest.try_get_u64_le()?, seen: last });
    }
    if flags & MISSING != 0 {
        for member in &mut members {
            member.seen = last.saturating_sub(rest.try_get_u32_le()?.into());
        }
    }
    let mut turns = Vec::new();
    if flags & TURNS != 0 {
        for _ in 0..uavs {
            let (numerator, denominator) = (rest.try_get_u32_le()?, rest.try_get_u32_le()?.max(1));
            turns.push(Turn { numerator: numerator % denominator, denominator });
        }
    }
    let users = members.split_off(uavs);
    Ok((seed, Members::Roster(Roster { uavs: members, turns, users, open: flags & OPEN != 0 })))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn state(memory: &'static [u8]) -> RecurrentState<Bytes> {
        let uavs = vec![Member { key: 1, seen: 2 }, Member { key: 2, seen: 0 }];
        let turns = vec![Turn { numerator: 0, denominator: 2 }, Turn { numerator: 3, denominator: 7 }];
        let roster = Roster { uavs, turns, users: vec![Member { key: 9, seen: 2 }], open: true };
        let memory = Bytes::from_static(memory);
        RecurrentState { digest: [7; 32], step: 3, seed: 11, members: Members::Roster(roster), memory }
    }

    #[test]
    fn changed_or_missing_byte_is_rejected() {
        let state = state(b"packed");
        let bytes = state.encode();
        let back = RecurrentState::decode(&bytes).unwrap();
        assert_eq!((back.step, back.seed, back.members), (3, 11, state.members));
        assert_eq!(back.memory, FleetMemory::Packed(state.memory));
        for i in 0..bytes.len() {
            let mut changed = bytes.to_vec();
            changed[i] ^= 1;
            assert!(RecurrentState::decode(&changed.into()).is_err(), "byte {i}");
            assert!(RecurrentState::decode(&bytes.slice(..i)).is_err(), "length {i}");
        }
    }

    /// `body` with its checksum.
    fn signed(mut body: Vec<u8>) -> Bytes {
        let sum = Sha256::digest(&body);
        body.extend_from_slice(&sum[..CHECKSUM]);
        body.into()
    }

    #[test]
    fn states_of_older_versions_are_accepted_and_of_later_ones_refused() {
        let fleet = FleetIds { uavs: vec!["a".into(), "b".into()], users: vec!["u".into()] };
        let header = state(b"").encode();
        for version in 0..5 {
            let mut body = header[..HEADER].to_vec();
            body[VERSION_AT] = version;
            body.put_u32_le(2);
            body.put_u32_le(1);
            body.put_slice(&fleet.fingerprint());
            body.put_f32_le(0.5);
            let decoded = RecurrentState::decode(&signed(body)).map_err(|e| e.field);
            let of_fleet = |members| members == Members::Fingerprint { uavs: 2, users: 1, fleet: fleet.fingerprint() };
            match (version, decoded) {
                (1, Ok(state)) => assert!(of_fleet(state.members) && state.memory == FleetMemory::Plain(vec![0.5])),
                (2, Ok(state)) => assert!(of_fleet(state.members) && matches!(state.memory, FleetMemory::Packed(_))),
                (0 | 3.., Err(field)) => assert_eq!(field, "recurrent_state"),
                (version, decoded) => panic!("version {version}: {decoded:?}"),
            }
        }
    }

    #[test]
    fn counts_do_not_allocate_more_than_the_bytes() {
        let mut body = state(b"").encode()[..HEADER].to_vec();
        body.put_u64_le(0);
        body.put_u32_le(u32::MAX);
        body.put_u32_le(u32::MAX);
        body.put_u8(MISSING | TURNS);
        assert!(RecurrentState::decode(&signed(body)).is_err());
    }
}
