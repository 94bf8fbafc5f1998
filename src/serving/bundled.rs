//! Checkpoints that are part of the program, so that an empty data directory has something learned to serve.
//!
//! They are published into the store at start like any other checkpoint; publishing equal bytes twice changes nothing.

/// Name and bytes (safetensors) of each bundled policy; `policies/README.md` has the command that made each.
pub const BUNDLED: &[(&str, &[u8])] = &[
    ("qedgix", include_bytes!("../../policies/qedgix.safetensors")),
    ("qmix", include_bytes!("../../policies/qmix.safetensors")),
];
