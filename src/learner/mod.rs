//! Learning (spec 5): replay, rollout, targets, the update, training as an iterator of events, evaluation.

mod episodes;
mod evaluation;
mod event;
pub mod objective;
mod update;

pub use episodes::Episodes;
pub use evaluation::{Difference, Interval, LAYOUTS, Summary, difference, evaluate, layouts, summarize};
pub use event::{Event, Iteration};
pub use update::{Learner, LearnerState, Update};

pub use crate::recipe::{Algorithm, MixerKind, Preset, TrainConfig, Training};
