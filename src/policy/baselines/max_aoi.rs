//! `max-aoi`: every UAV flies to the detected user with the oldest data, and searches if all detected data is fresh.

use super::search::{DetectedUser, TargetChoice};

#[derive(Default)]
pub(super) struct MaxAoi;

/// AoI, in slots, from which data is stale. With a lower limit, a UAV stays with the first users it finds. Chosen on `valid-v1`.
const STALE: f32 = 5.0;

impl TargetChoice for MaxAoi {
    const NAME: &'static str = "max-aoi";
    const DESCRIPTION: &'static str =
        "Every UAV flies to the detected user with the oldest data, and searches if all detected data is fresh.";

    fn choose(detected: impl Iterator<Item = DetectedUser>) -> Option<DetectedUser> {
        // Of equal AoI, as users have that were never visited, the nearest: otherwise a UAV could switch between targets.
        let older = |a: &DetectedUser, b: &DetectedUser| b.aoi.total_cmp(&a.aoi).then(a.distance.total_cmp(&b.distance));
        detected.filter(|user| user.aoi >= STALE).min_by(older)
    }
}
