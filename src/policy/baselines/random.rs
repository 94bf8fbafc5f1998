//! `random`: every UAV draws a heading in every slot.

use rand::RngExt;

use super::rule::{Rule, SEED_LEN, Slot, slot_rng, store_seed};
use crate::policy::{Carry, Reach, RequiredInput};

#[derive(Default)]
pub(super) struct Random;

impl Rule for Random {
    const NAME: &'static str = "random";
    const DESCRIPTION: &'static str = "Every UAV draws a heading in every slot.";
    const NEEDS: RequiredInput = RequiredInput::Detections;
    const REACH: Reach = Reach::Links(0);

    fn memory_len(&self, _uavs: usize, _users: usize) -> usize {
        SEED_LEN
    }

    fn start(&self, seed: u64, memory: &mut [f32]) {
        store_seed(seed, memory);
    }

    fn carry(&self, from: &[f32], to: &mut [f32], _carry: &Carry<'_>) {
        to.copy_from_slice(from);
    }

    fn decide(&self, slot: &Slot<'_>, memory: &mut [f32], headings: &mut [u8]) {
        let Slot { env, step, .. } = *slot;
        let mut rng = slot_rng(memory, "random", step);
        for h in headings {
            *h = rng.random_range(0..env.actions as u8);
        }
    }
}
