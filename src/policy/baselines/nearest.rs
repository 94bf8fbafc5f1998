//! `nearest`: every UAV flies to the nearest user it sees whose data is stale; it searches where there is none.

use super::search::{Sight, Target};

#[derive(Default)]
pub(super) struct Nearest;

/// Slots after which data is stale. Lower, and a UAV stays with the first users it finds; chosen on `valid-v1`.
const STALE: f32 = 5.0;

impl Target for Nearest {
    const NAME: &'static str = "nearest";
    const TEXT: &'static str = "Every UAV flies to the nearest user it sees whose data is stale, else searches straight on.";

    fn choose(seen: impl Iterator<Item = Sight>) -> Option<Sight> {
        seen.filter(|user| user.aoi >= STALE).min_by(|a, b| a.distance.total_cmp(&b.distance))
    }
}
