//! Checkpoints that are embedded in the binary, so that a server with an empty data directory has learned policies.
//!
//! The server publishes them into its store at start, like any other checkpoint. Publishing identical bytes returns the
//! existing version.

/// Name and bytes (safetensors) of each bundled policy; `policies/README.md` has the commands that created them.
pub const BUNDLED: &[(&str, &[u8])] = &[
    ("qedgix", include_bytes!("../../policies/qedgix.safetensors")),
    ("qmix", include_bytes!("../../policies/qmix.safetensors")),
];
