//! `persistent`: every UAV keeps a random heading and draws another where the next move would leave the square.

use super::search::cruise;
use super::{Needs, Rule, SEED_LEN, World, own_positions, slot_rng, store_seed};
use crate::policy::Slot;

/// Memory: the seed, then each UAV's course.
pub(super) struct Persistent;

impl Rule for Persistent {
    const NAME: &'static str = "persistent";
    const TEXT: &'static str = "Every UAV keeps a random heading and turns at the border.";
    const NEEDS: Needs = Needs::OwnPositions;

    fn memory_len(&self, uavs: usize, _users: usize) -> usize {
        SEED_LEN + uavs
    }

    fn start(&self, seed: u64, memory: &mut [f32]) {
        store_seed(seed, memory);
    }

    fn fly(&self, world: &World, slot: &Slot, step: u64, memory: &mut [f32], headings: &mut [u8]) {
        let mut rng = slot_rng(memory, "persistent", step);
        for ((course, heading), &at) in memory[SEED_LEN..].iter_mut().zip(headings).zip(own_positions(slot)) {
            *heading = cruise(world, &mut rng, at, course);
        }
    }
}
