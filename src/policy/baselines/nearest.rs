//! `nearest`: every UAV flies to the nearest user it sees whose data is stale; it searches where there is none.

use super::geometry::{distance, heading_toward};
use super::search::cruise;
use super::{Needs, Rule, SEED_LEN, World, own_positions, slot_rng, store_seed};
use crate::policy::Slot;

/// Memory: the seed, then each UAV's course while it searches.
pub(super) struct Nearest;

/// Slots after which data is stale. Lower, and a UAV stays with the first users it finds; chosen on `valid-v1`.
const STALE: f32 = 5.0;

impl Rule for Nearest {
    const NAME: &'static str = "nearest";
    const TEXT: &'static str = "Every UAV flies to the nearest user it sees whose data is stale, else searches straight on.";
    const NEEDS: Needs = Needs::OwnPositions;

    fn memory_len(&self, uavs: usize, _users: usize) -> usize {
        SEED_LEN + uavs
    }

    fn start(&self, seed: u64, memory: &mut [f32]) {
        store_seed(seed, memory);
    }

    fn fly(&self, world: &World, slot: &Slot, step: u64, memory: &mut [f32], headings: &mut [u8]) {
        let mut rng = slot_rng(memory, "nearest", step);
        for (i, (course, heading)) in memory[SEED_LEN..].iter_mut().zip(headings).enumerate() {
            let at = own_positions(slot)[i];
            let searching = cruise(world, &mut rng, at, course);
            let stale = slot.detections(i).iter().filter_map(|seen| {
                let user = (seen.target as usize).checked_sub(slot.uavs())?;
                (slot.aoi()[user] >= STALE).then(|| [0, 1].map(|k| at[k] + f64::from(seen.rel[k])))
            });
            *heading = searching;
            if let Some(to) = stale.min_by(|a, b| distance(at, *a).total_cmp(&distance(at, *b))) {
                *heading = heading_toward(world, at, to);
                // The search goes on in the direction in which the last user was served.
                *course = f32::from(*heading) + 1.0;
            }
        }
    }
}
