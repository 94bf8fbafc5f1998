//! Serving from the outside: policies, sessions and errors over real gRPC and REST, on free ports, with a clock that the
//! tests move.

mod act;
mod batch;
mod conversion;
mod environments;
mod harness;
mod large;
mod limits;
mod load;
mod openapi;
mod policies;
mod promotion;
mod published;
mod rest;
mod server;
