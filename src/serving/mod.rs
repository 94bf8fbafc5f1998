//! Answering now: which policies there are, who flies with which memory, the engine that computes headings, and environments
//! that learners elsewhere fly.
//!
//! Knows neither wire formats nor SQL; `service` brings policies out of the store and puts answers together.

pub mod bundled;
mod engine;
mod environments;
mod error;
mod fleet;
mod memory;
mod meters;
mod observation;
mod reference;
mod registry;
mod sessions;
mod table;

pub use engine::{Engine, EngineConfig, Outcome, Room, Task, Timings};
pub use environments::{
    Blueprint, CopyState, Environment, EnvironmentInfo, Environments, EnvironmentsConfig, Finished, Flight, Progress, Reset,
    Sight, State,
};
pub use error::Error;
pub use fleet::Fleet;
pub use memory::HeldState;
pub use observation::{Graph, GraphForm, MAX_DETECTIONS, MAX_NODES, Observation, Seen, Sighting};
pub use reference::{PolicyRef, PolicySpec, Which, check_name};
pub use registry::{About, Described, Kind, LoadedPolicy, Registry};
pub use sessions::{Answered, Opened, Session, SessionInfo, Sessions, Turn};
pub use table::{Entry, LastUse, Limits, Table};
