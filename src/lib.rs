//! Qedgix: trains and serves policies that fly UAV fleets for fresh data.
//!
//! Folders are layers; a file imports only from layers below it (`tests/architecture.rs` checks this).
//!
//! | layer | owns |
//! | --- | --- |
//! | [`cli`] | the command line |
//! | [`server`], [`config`], [`telemetry`] | listeners, background work, shutdown; settings; logs and metrics |
//! | [`api`] | gRPC, REST, wire formats, the table of errors |
//! | [`service`] | one function per use case |
//! | [`serving`], [`jobs`] | answering now; running work later |
//! | [`store`] | the only SQL |
//! | [`experiment`] | many runs and what they say together |
//! | [`learner`] | replay, rollout, update, training, evaluation |
//! | [`checkpoint`] | parameters to and from safetensors |
//! | [`train_config`] | what a training run is made of: algorithm, preset, resolved configuration |
//! | [`policy`] | observations, agents, mixers, baselines |
//! | [`plot`] | numbers to SVG |
//! | [`nn`], [`env`] | mathematics; physics |
//! | [`clock`], [`draining`] | wall and monotonic time; the flag of shutdown |
//! | [`invalid`], [`error_code`], [`rng`], [`files`] | errors of input; codes of errors; random streams; atomic writes of files |
//!
//! Read `env`, then `policy`, then `learner`; then `service` and what it calls.

pub mod api;
pub mod checkpoint;
pub mod cli;
pub mod clock;
pub mod config;
pub mod draining;
pub mod env;
pub mod error_code;
pub mod experiment;
pub mod files;
pub mod invalid;
pub mod jobs;
pub mod learner;
pub mod nn;
pub mod plot;
pub mod policy;
pub mod rng;
pub mod server;
pub mod service;
pub mod serving;
pub mod store;
pub mod telemetry;
pub mod train_config;
pub mod wire;
