//! Constants of the checkpoint format.

/// `format` of every checkpoint.
pub const FORMAT: &str = "qedgix-checkpoint";
/// `version` of the checkpoints that are written and read.
pub const VERSION: &str = "1";
/// Maximum magnitude of a parameter: far above the parameters of a trained network, far below the overflow of sums.
pub const MAX_MAGNITUDE: f32 = 1e6;
