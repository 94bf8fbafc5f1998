//! `random`: every UAV draws a heading in every slot.

use rand::RngExt;

use super::{EnvParams, RequiredInput, Rule, SEED_LEN, slot_rng, store_seed};
use crate::policy::Slot;

#[derive(Default)]
pub(super) struct Random;

impl Rule for Random {
    const NAME: &'static str = "random";
    const TEXT: &'static str = "Every UAV draws a heading in every slot.";
    const NEEDS: RequiredInput = RequiredInput::Detections;

    fn memory_len(&self, _uavs: usize, _users: usize) -> usize {
        SEED_LEN
    }

    fn start(&self, seed: u64, memory: &mut [f32]) {
        store_seed(seed, memory);
    }

    fn fly(&self, world: &EnvParams, _slot: &Slot, step: u64, memory: &mut [f32], headings: &mut [u8]) {
        let mut rng = slot_rng(memory, "random", step);
        for h in headings {
            *h = rng.random_range(0..world.headings as u8);
        }
    }
}
