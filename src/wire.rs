//! Generated types of `proto/`. Only [`crate::api`] and the worker, which is a client, may use them.

#![allow(missing_docs, clippy::all, clippy::pedantic)]

/// `qedgix.v1`.
pub mod v1 {
    tonic::include_proto!("qedgix.v1");
}

/// `inference`, the Open Inference Protocol.
pub mod oip {
    tonic::include_proto!("inference");
}

/// All protocol files as a `FileDescriptorSet`, for reflection.
pub const DESCRIPTORS: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/descriptors.bin"));
