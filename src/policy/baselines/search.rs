//! Looking for users without a plan: straight on, another way at the border. What such a rule does with the users it sees is
//! its [`Target`]; seed, course and flight are shared.

use std::marker::PhantomData;

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::geometry::{heading_toward, inside, moved};
use super::{EnvParams, RequiredInput, Rule, SEED_LEN, own_positions, slot_rng, store_seed};
use crate::env::{EnvConfig, Point};
use crate::policy::Slot;

/// A user in sight.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sight {
    /// Position of the user.
    pub at: Point,
    /// Distance from the UAV.
    pub distance: f64,
    /// AoI in slots.
    pub aoi: f32,
}

/// Which of the users in sight a UAV flies to.
pub(super) trait Target: Default + Send + Sync {
    const NAME: &'static str;
    const TEXT: &'static str;

    /// The chosen one; none: the UAV searches.
    fn choose(seen: impl Iterator<Item = Sight>) -> Option<Sight>;
}

/// Flies to a target where there is one, else straight on. Memory: the seed, then each UAV's course while it searches.
#[derive(Default)]
pub(super) struct Search<T>(PhantomData<T>);

impl<T: Target> Rule for Search<T> {
    const NAME: &'static str = T::NAME;
    const TEXT: &'static str = T::TEXT;
    const NEEDS: RequiredInput = RequiredInput::OwnPositions;

    fn memory_len(&self, uavs: usize, _users: usize) -> usize {
        SEED_LEN + uavs
    }

    fn start(&self, seed: u64, memory: &mut [f32]) {
        store_seed(seed, memory);
    }

    fn fly(&self, world: &EnvParams, slot: &Slot, step: u64, memory: &mut [f32], headings: &mut [u8]) {
        let mut rng = slot_rng(memory, T::NAME, step);
        for (i, (course, heading)) in memory[SEED_LEN..].iter_mut().zip(headings).enumerate() {
            let at = own_positions(slot)[i];
            // Drawn in every slot, so that what a UAV sees does not shift the numbers of the others.
            *heading = cruise(world, &mut rng, at, course);
            if let Some(user) = T::choose(sights(slot, i, at)) {
                *heading = heading_toward(world, at, user.at);
                // The search goes on in the direction in which the last user was served.
                *course = f32::from(*heading) + 1.0;
            }
        }
    }
}

/// The users that UAV `i` at `at` detects.
fn sights(slot: &Slot, i: usize, at: Point) -> impl Iterator<Item = Sight> {
    slot.detections(i).iter().filter_map(move |seen| {
        let user = (seen.target as usize).checked_sub(slot.uavs())?;
        let rel = seen.rel.map(f64::from);
        let to = [at[0] + rel[0], at[1] + rel[1]];
        Some(Sight { at: to, distance: (to[0] - at[0]).hypot(to[1] - at[1]), aoi: slot.aoi()[user] })
    })
}

/// The heading of a UAV that flies straight on. `course` is 1 + its heading, 0 before it has one. Where the move would leave
/// the square it draws among the headings that do not, or among all if none does.
fn cruise(world: &EnvParams, rng: &mut ChaCha8Rng, at: Point, course: &mut f32) -> u8 {
    let stays = |h: usize| inside(moved(world, at, h));
    let heading = *course as usize;
    if !(1..=EnvConfig::COMPASS).contains(&heading) || !stays(heading - 1) {
        let open = (0..EnvConfig::COMPASS).filter(|&h| stays(h)).count();
        let draw = rng.random_range(0..if open == 0 { EnvConfig::COMPASS } else { open });
        let chosen = (0..EnvConfig::COMPASS).filter(|&h| open == 0 || stays(h)).nth(draw).unwrap_or(0);
        *course = (chosen + 1) as f32;
    }
    *course as u8 - 1
}
