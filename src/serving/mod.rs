//! Serving: the registry of policies, sessions and their memory, the engine that runs policies, and hosted environments.
//!
//! This layer has no wire formats and no SQL: `service` loads policies from the store and assembles responses.

pub mod bundled;
pub mod decentral;
mod engine;
mod environments;
mod error;
mod fleet_ids;
mod fleet_input;
mod fleet_memory;
pub mod flight;
mod frame;
mod guard;
pub(crate) mod ids;
mod memory_budget;
pub(crate) mod nodes;
mod owner;
mod recurrent_state;
mod reference;
mod registry;
mod roster;
mod sessions;
mod statistics;
mod table;
mod user_detections;

pub use engine::{Decision, Engine, EngineConfig, NamedInfluence, OutputBuffers, Task, TaskOutput, Timings};
pub use environments::{
    CopyObservation, CopyState, Environment, EnvironmentInfo, EnvironmentReset, EnvironmentSpec, EnvironmentState,
    EnvironmentStep, Environments, EpisodeCursor, FinishedEpisode,
};
pub use error::{Error, not_found_message};
pub use fleet_ids::FleetIds;
pub use fleet_input::{
    FleetInput, GraphForm, LARGE_NODES, ListedUsers, MAX_DETECTIONS, MAX_NODES, ReportedDetection, ReportedGraph, Scene,
    SceneOrGraph, Sensing, TaskInput,
};
pub use fleet_memory::FleetMemory;
pub use flight::{ConstraintOptions, Flight, FlightOptions, Warning, WorldOptions};
pub use frame::{Frame, FrameOptions};
pub use guard::{Constraint, Guard, Overruled, Situation, Zone};
pub use nodes::{Node, NodeDetection, SceneUav};
pub use owner::Owner;
pub use recurrent_state::{Members, RecurrentState};
pub use reference::{PolicyRef, PolicySpec, VersionSelector, check_name};
pub use registry::{
    DEFAULT_MEMORY, LoadedPolicy, MAX_SIBLINGS, MemoryShare, PolicyInfo, PolicyKind, Registry, RemovedVersions, Resolved,
    VersionDetails, VersionState,
};
pub use roster::{FleetChange, Roster, RosterRules, UserMemory};
pub use sessions::{Listed, PendingStep, Session, SessionInfo, SessionOptions, Sessions, StepStart};
pub use statistics::{ComputeCounts, ComputeTimes, Statistics, StatisticsTable, TimedCount, VersionStatistics};
pub use table::{LastUse, Limits, Table, TableEntry};
