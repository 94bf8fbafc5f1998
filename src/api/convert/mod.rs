//! Wire types to domain types and back. Wire types stop here; what can be wrong with a request and does not depend on the policy
//! is reported with the path of the field.

pub mod environments;
pub mod jobs;
pub mod observation;
pub mod request;
pub mod response;
pub mod structs;
pub mod tensors;
