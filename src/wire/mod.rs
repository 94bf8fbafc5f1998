//! Generated types of `proto/`. Only [`crate::api`] and the worker, which is a client, may use
//! them; [`crate::onnx`] uses those of ONNX.

/// The codec of the services.
pub mod codec;
mod sizes;

/// `qedgix.v1`.
#[allow(missing_docs, clippy::all, clippy::pedantic, reason = "generated")]
pub mod v1 {
    tonic::include_proto!("qedgix.v1");
}

/// `inference`, the Open Inference Protocol.
#[allow(missing_docs, clippy::all, clippy::pedantic, reason = "generated")]
pub mod oip {
    tonic::include_proto!("inference");
}

/// Packages of dm_env_rpc, with the package that they refer to.
#[allow(missing_docs, clippy::all, clippy::pedantic, reason = "generated")]
pub mod dm {
    pub mod dm_env_rpc {
        pub mod v1 {
            tonic::include_proto!("dm_env_rpc.v1");

            pub mod extensions {
                pub mod properties {
                    tonic::include_proto!("dm_env_rpc.v1.extensions.properties");
                }
            }
        }
    }

    pub mod google {
        pub mod rpc {
            tonic::include_proto!("google.rpc");
        }
    }
}

/// ONNX models.
#[allow(missing_docs, clippy::all, clippy::pedantic, reason = "generated")]
pub mod onnx {
    include!(concat!(env!("OUT_DIR"), "/onnx.rs"));
}

/// All protocol files as a `FileDescriptorSet`, for reflection.
pub const DESCRIPTORS: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/descriptors.bin"));
