//! `max-aoi`: every UAV flies to the user it sees whose data is oldest; it searches where all it sees is fresh.

use super::search::{Sight, Target};

#[derive(Default)]
pub(super) struct MaxAoi;

/// Slots after which data is stale. Lower, and a UAV stays with the first users it finds; chosen on `valid-v1`.
const STALE: f32 = 5.0;

impl Target for MaxAoi {
    const NAME: &'static str = "max-aoi";
    const TEXT: &'static str = "Every UAV flies to the user it sees whose data is oldest, else searches straight on.";

    fn choose(seen: impl Iterator<Item = Sight>) -> Option<Sight> {
        // Equally old, as all are that nobody has visited: the nearer one, so that a UAV does not waver between them.
        let older = |a: &Sight, b: &Sight| b.aoi.total_cmp(&a.aoi).then(a.distance.total_cmp(&b.distance));
        seen.filter(|user| user.aoi >= STALE).min_by(older)
    }
}
