//! The outside: gRPC, REST, conversions between wire and domain, one table of errors.

pub mod access;
pub mod convert;
mod errors;
pub mod grpc;
mod observe;
pub mod rest;

pub use errors::{Problem, retry_after_seconds};
