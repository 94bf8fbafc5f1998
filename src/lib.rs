//! Qedgix trains and serves policies that steer UAV fleets to keep data fresh (Age of Information).
//!
//! Directories are layers. A file imports only from layers below its own; `tests/architecture.rs` checks this.
//!
//! | layer | owns |
//! | --- | --- |
//! | [`cli`] | the command line |
//! | [`server`], [`config`], [`telemetry`] | listeners, background tasks, shutdown; settings; logs, metrics, traces |
//! | [`api`] | gRPC, REST, Open Inference Protocol: wire formats, access rules, error tables |
//! | [`service`] | one function per use case |
//! | [`serving`], [`jobs`] | sessions, batching and inference; scheduling and running training jobs |
//! | [`store`] | the database; the only SQL |
//! | [`experiment`] | plans of many runs, and their combined results |
//! | [`learner`] | replay, rollout, update, training, evaluation |
//! | [`onnx`] | learned policies as ONNX models |
//! | [`checkpoint`] | parameters to and from safetensors |
//! | [`train_config`] | what a training run is made of: algorithm, preset, resolved configuration |
//! | [`policy`] | observations, agents, mixers, baselines |
//! | [`plot`] | numbers to SVG |
//! | [`nn`], [`env`] | neural network layers; the simulated environment |
//! | [`clock`], [`draining`], [`inflight`] | wall and monotonic time; the shutdown flag; the budget of bytes in flight |
//! | [`invalid`], [`error_code`], [`causes`], [`rng`], [`files`], [`threads`] | errors of invalid input; error codes; errors with their causes; seeded random streams; atomic writes of files; loops on several threads |
//!
//! Reading order: `env`, `policy`, `learner`; then `service` and the layers that it calls.

pub mod api;
pub mod causes;
pub mod checkpoint;
pub mod cli;
pub mod clock;
pub mod config;
pub mod draining;
pub mod env;
pub mod error_code;
pub mod experiment;
pub mod files;
pub mod inflight;
pub mod invalid;
pub mod jobs;
pub mod learner;
pub mod nn;
pub mod onnx;
pub mod plot;
pub mod policy;
pub mod rng;
pub mod server;
pub mod service;
pub mod serving;
pub mod store;
pub mod telemetry;
pub mod threads;
pub mod train_config;
pub mod wire;
