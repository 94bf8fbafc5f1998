//! Converts wire types to domain types and back. Every check of a request that does not depend on the policy is made here and reports
//! the path of the field.

pub mod decentral;
pub mod environments;
pub mod flight;
pub mod jobs;
pub mod request;
pub mod response;
pub mod scene_graph;
pub mod structs;
pub mod tensors;
