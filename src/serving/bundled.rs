//! Checkpoints that are embedded in the binary, so that a server with an empty data directory has learned policies.
//!
//! The server publishes them into its store at start, like any other checkpoint. Publishing identical bytes returns the
//! existing version.

use std::sync::LazyLock;

use sha2::{Digest, Sha256};

use super::PolicyRef;

/// Name and bytes (safetensors) of each bundled policy; `policies/README.md` has the commands that created them.
pub const BUNDLED: &[(&str, &[u8])] = &[
    ("qedgix", include_bytes!("../../policies/qedgix.safetensors")),
    ("qedgix-onboard", include_bytes!("../../policies/qedgix-onboard.safetensors")),
    ("qedgix-paper", include_bytes!("../../policies/qedgix-paper.safetensors")),
    ("qmix", include_bytes!("../../policies/qmix.safetensors")),
];

/// Whether this version is a bundled policy.
pub fn is_bundled(version: &PolicyRef) -> bool {
    static DIGESTS: LazyLock<Vec<[u8; 32]>> =
        LazyLock::new(|| BUNDLED.iter().map(|(_, bytes)| Sha256::digest(bytes).into()).collect());
    let mut bundled = BUNDLED.iter().zip(DIGESTS.iter());
    bundled.any(|((name, _), digest)| version.name == *name && version.digest == *digest)
}
