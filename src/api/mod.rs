//! The outside: gRPC, REST, the Open Inference Protocol over both, conversions between wire and domain, one table of errors.

pub mod convert;
mod errors;
pub mod grpc;
mod observe;
mod oip;
pub mod rest;

pub use errors::{Problem, retry_after_seconds};
