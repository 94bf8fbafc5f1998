//! `nearest`: every UAV flies to the nearest detected user with stale data, and searches if there is none.

use super::search::{DetectedUser, TargetChoice};

#[derive(Default)]
pub(super) struct Nearest;

/// AoI, in slots, from which data is stale. With a lower limit, a UAV stays with the first users it finds. Chosen on `valid-v1`.
const STALE: f32 = 5.0;

impl TargetChoice for Nearest {
    const NAME: &'static str = "nearest";
    const DESCRIPTION: &'static str =
        "Every UAV flies to the nearest detected user with stale data, and searches if there is none.";

    fn choose(detected: impl Iterator<Item = DetectedUser>) -> Option<DetectedUser> {
        detected.filter(|user| user.aoi >= STALE).min_by(|a, b| a.distance.total_cmp(&b.distance))
    }
}
