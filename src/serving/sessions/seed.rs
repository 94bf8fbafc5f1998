//! Seeds of sessions that are opened without one. They depend on the names of session and run alone, so that a run repeats
//! with the same random numbers on every machine and in every version of the program.

use sha2::{Digest, Sha256};

/// The seed of run `run_id` of session `session_id`: the first 8 bytes (little endian) of a SHA-256.
pub(super) fn session_seed(session_id: &str, run_id: Option<&str>) -> u64 {
    hash("session-seed", &[Some(session_id), run_id])
}

/// Identifies a run among the former runs of a session.
pub(super) fn run_hash(run_id: &str) -> u64 {
    hash("run-id", &[Some(run_id)])
}

fn hash(purpose: &str, parts: &[Option<&str>]) -> u64 {
    let mut hash = Sha256::new();
    for part in std::iter::once(&Some(purpose)).chain(parts) {
        // Lengths separate the parts; an absent part differs from an empty one.
        match part {
            None => hash.update(u64::MAX.to_le_bytes()),
            Some(text) => {
                hash.update((text.len() as u64).to_le_bytes());
                hash.update(text);
            }
        }
    }
    let digest = hash.finalize();
    u64::from_le_bytes(digest[..8].try_into().expect("eight bytes of thirty-two"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seeds_do_not_depend_on_the_toolchain() {
        // python3: d = b"".join(len(x).to_bytes(8, "little") + x for x in [b"session-seed", b"s", b"run-1"])
        //          int.from_bytes(hashlib.sha256(d).digest()[:8], "little")
        // An absent run is 8 bytes 0xff.
        assert_eq!(session_seed("s", Some("run-1")), 11_342_871_774_138_756_392);
        assert_eq!(session_seed("s", None), 8_179_827_887_288_966_085);
        assert_eq!(session_seed("uav-fleet/7", Some("")), 15_526_487_097_590_372_168);
    }

    #[test]
    fn seeds_differ_for_different_names() {
        let names = [("a", None), ("a", Some("")), ("a", Some("b")), ("ab", None), ("ab", Some("")), ("", Some("ab"))];
        let seeds: std::collections::BTreeSet<u64> = names.iter().map(|(session, run)| session_seed(session, *run)).collect();
        assert_eq!(seeds.len(), names.len());
    }
}
