//! The transports: gRPC, REST and the Open Inference Protocol over both, with their authorization, logging and errors.

pub mod access;
mod auth;
pub mod body;
mod browser;
mod compression;
mod config_schemas;
pub mod convert;
mod errors;
mod flight;
pub mod grpc;
pub(crate) mod json;
mod media_type;
mod oip;
mod request_log;
pub mod rest;

pub use browser::AllowedHosts;
pub use errors::{Problem, retry_after_seconds};

use tokio_util::task::AbortOnDropHandle;

use crate::service::Error;

/// Whether a path is a probe, by which supervisors and balancers decide whether the server is alive or ready.
fn is_probe(path: &str) -> bool {
    const PROBES: &[&str] = &[
        "/livez",
        "/readyz",
        "/v2/health/live",
        "/v2/health/ready",
        "/grpc.health.v1.Health/Check",
        "/inference.GRPCInferenceService/ServerLive",
        "/inference.GRPCInferenceService/ServerReady",
    ];
    PROBES.contains(&path)
}

/// Runs `work` here, or, if it is `large`, on a thread of its own: threads of connections serve many callers. Work that has not
/// begun when the caller goes away is dropped.
async fn offload<T: Send + 'static>(large: bool, work: impl FnOnce() -> T + Send + 'static) -> Result<T, Error> {
    if !large {
        return Ok(work());
    }
    AbortOnDropHandle::new(tokio::task::spawn_blocking(work)).await.map_err(Error::internal)
}
