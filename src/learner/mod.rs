//! Learning (spec 5): replay, rollout, targets, the update, training as an iterator of events, evaluation.

mod episodes;
mod evaluation;
mod event;
pub mod objective;
pub mod replay;
mod rollout;
mod snapshot;
mod trainer;
mod update;

pub use episodes::{Episodes, Symmetry};
pub use evaluation::{Difference, Interval, LAYOUTS, Summary, difference, evaluate, layouts, summarize};
pub use event::{Event, Iteration};
pub use rollout::Rollout;
pub use snapshot::SnapshotError;
pub use trainer::{Evaluated, Trainer};
pub use update::{Learner, LearnerState, Update};

pub use crate::recipe::{Algorithm, MixerKind, Preset, TrainConfig, Training};
