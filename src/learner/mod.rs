//! Learning (spec 5): replay, rollout, targets, the update, training as an iterator of events, evaluation.

mod disturbance;
mod episodes;
mod evaluation;
mod event;
mod flight;
pub mod objective;
pub mod replay;
mod rollout;
mod snapshot;
mod trainer;
mod update;

pub use disturbance::{Disturbance, Loss};
pub use episodes::{Episodes, Symmetry};
pub use evaluation::{Difference, Interval, LAYOUTS, Layouts, Summary, difference, layouts, summarize};
pub use event::{Event, Iteration};
pub use flight::{Survey, Track, evaluate, survey};
pub use rollout::Rollout;
pub use snapshot::SnapshotError;
pub use trainer::{Evaluated, Trainer};
pub use update::{Learner, LearnerState, Update};

pub use crate::policy::mixer::MixerKind;
pub use crate::recipe::{Algorithm, Preset, TrainConfig, Training};
