//! Learning: replay, rollout, loss, update, training as an iterator of events, evaluation (docs/model.md, "Learner").

mod comparison;
mod disturbance;
mod episodes;
mod evaluation;
mod event;
mod explained;
mod layouts;
pub mod loss;
mod memory;
mod over_seeds;
pub mod replay;
mod rollout;
mod sizing;
mod snapshot;
mod state;
mod summary;
mod teacher;
mod trainer;
mod update;

pub use crate::env::LostUav;
pub use comparison::{Comparison, Pair, PolicyEvaluation};
pub use disturbance::Disturbance;
pub use episodes::{Episodes, Symmetry};
pub use evaluation::{TracedEvaluation, Trajectory, evaluate, evaluate_list, evaluate_traced, evaluate_until, layouts_per_part};
pub use event::{Evaluation, Event, Iteration};
pub use explained::{ExplainedSlot, explained_flight};
pub use layouts::{LAYOUT_LISTS, LayoutList, layout_list};
pub use loss::LossMetrics;
pub use memory::MemoryEstimate;
pub use over_seeds::MeanOverSeeds;
pub use rollout::Rollout;
pub use sizing::{Failure, FleetSize, Sizing, SizingTarget};
pub use snapshot::{SnapshotError, is_snapshot};
pub use summary::{Difference, Interval, Summary, difference, interval, summarize};
pub use trainer::Trainer;
pub use update::{Learner, LearnerState};

pub use crate::policy::mixer::MixerKind;
pub use crate::train_config::{Algorithm, Preset, TrainConfig, Training, Vary};
