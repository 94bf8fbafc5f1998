//! The ids of a fleet, in the canonical order that all slots of an episode share.

use std::cmp::Ordering;

use sha2::{Digest, Sha256};

use crate::invalid::Invalid;

/// Ids of UAVs and users in canonical order: shorter first, then bytewise, so that `uav-2` comes before `uav-10`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FleetIds {
    /// Ids of the M UAVs.
    pub uavs: Vec<String>,
    /// Ids of the N users.
    pub users: Vec<String>,
}

impl FleetIds {
    /// Maximum length of an id, in characters.
    pub const MAX_ID_LEN: usize = 128;

    /// Compares two ids in canonical order.
    pub fn order(a: &str, b: &str) -> Ordering {
        a.len().cmp(&b.len()).then_with(|| a.as_bytes().cmp(b.as_bytes()))
    }

    /// The numbers of UAVs and users.
    pub fn size(&self) -> (usize, usize) {
        (self.uavs.len(), self.users.len())
    }

    /// Bytes that the ids take.
    pub fn bytes(&self) -> usize {
        // The allocator rounds sizes up; 16 is a typical unit.
        let bytes = |ids: &Vec<String>| {
            ids.capacity() * size_of::<String>() + ids.iter().map(|id| id.capacity().next_multiple_of(16)).sum::<usize>()
        };
        bytes(&self.uavs) + bytes(&self.users)
    }

    /// A hash of the ids. Different fleets have different fingerprints.
    pub fn fingerprint(&self) -> [u8; 16] {
        let mut hash = Sha256::new();
        for ids in [&self.uavs, &self.users] {
            hash.update((ids.len() as u64).to_le_bytes());
            for id in ids {
                hash.update((id.len() as u64).to_le_bytes());
                hash.update(id);
            }
        }
        let mut fingerprint = [0; 16];
        fingerprint.copy_from_slice(&hash.finalize()[..16]);
        fingerprint
    }

    /// Checks that a repetition of a step lists the UAVs of the step, `self`.
    ///
    /// # Errors
    /// [`Invalid`] with a new and a missing id, if the ids differ.
    pub fn check_repeated(&self, now: &Self) -> Result<(), Invalid> {
        check_same("uavs", (&self.uavs, &now.uavs), |uavs| format!("the same {uavs} UAVs as when the step was sent first"))
    }

    /// Checks that `now` lists the UAVs, or the users, of `self`, for a policy that has a place for each.
    ///
    /// # Errors
    /// [`Invalid`] with a new and a missing id, if the ids differ.
    pub fn check_bound(&self, now: &Self, (uavs, users): (bool, bool)) -> Result<(), Invalid> {
        for (bound, what, ids) in [(uavs, "uavs", (&self.uavs, &now.uavs)), (users, "users", (&self.users, &now.users))] {
            if bound {
                let place = "because the network of this policy has a place for each of them";
                check_same(what, (ids.0, ids.1), |count| format!("the same {count} {what} as in slot 0, {place}"))?;
            }
        }
        Ok(())
    }
}

fn check_same(field: &str, (before, after): (&[String], &[String]), expected: impl Fn(usize) -> String) -> Result<(), Invalid> {
    if before == after {
        return Ok(());
    }
    let lacks = |ids: &[String], id: &String| ids.binary_search_by(|probe| FleetIds::order(probe, id)).is_err();
    let new = after.iter().find(|id| lacks(before, id));
    let missing = before.iter().find(|id| lacks(after, id));
    let value = match (new, missing) {
        (Some(new), Some(missing)) => format!("{new:?} instead of {missing:?}"),
        (Some(new), None) => format!("{new:?} in addition"),
        (None, Some(missing)) => format!("no {missing:?}"),
        (None, None) => format!("{} ids", after.len()),
    };
    Err(Invalid::new(field, value, expected(before.len())))
}
