//! Tests of a whole server over gRPC and REST, on free ports, with a clock that the tests control.

mod abuse;
mod act;
mod batch;
mod binary;
#[path = "../certificates/mod.rs"]
mod certificates;
mod conversion;
mod decentral;
mod environments;
mod explain;
mod fleets;
mod follow;
mod guard;
mod harness;
mod health;
mod interleavings;
mod large;
mod limits;
mod load;
mod oip;
mod openapi;
mod operations;
mod output;
mod policies;
#[path = "../process/mod.rs"]
mod process;
mod promotion;
mod published;
mod rest;
mod security;
mod server;
mod soak;
mod uploads;
mod versions;
