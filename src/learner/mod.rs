//! Learning (spec 5): replay, rollout, targets, the update, training as an iterator of events, evaluation.

mod config;
mod episodes;
mod evaluation;
mod event;

pub use config::{Algorithm, MixerKind, Preset, TrainConfig, Training};
pub use episodes::Episodes;
pub use evaluation::{Difference, Interval, LAYOUTS, Summary, difference, evaluate, layouts, summarize};
pub use event::{Event, Iteration};
