//! The outside: gRPC, REST, conversions between wire and domain, one table of errors.

mod errors;

pub use errors::{Problem, retry_after_seconds};
