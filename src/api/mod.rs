//! The transports: gRPC, REST and the Open Inference Protocol over both, with their authorization, logging and errors.

pub mod access;
mod auth;
pub mod convert;
mod errors;
pub mod grpc;
mod observe;
mod oip;
pub mod rest;

pub use errors::{Problem, retry_after_seconds};
