//! Search without a plan: fly straight on, take another heading at the border. Rules of this kind differ in the detected user
//! that they choose as a target, their [`TargetChoice`]; the rest is shared.

use std::marker::PhantomData;

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::rule::{Rule, SEED_LEN, Slot, slot_rng, store_seed, uav_positions};
use crate::env::{EnvConfig, Point};
use crate::policy::flight::{Headings, next_position};
use crate::policy::{Carry, EnvParams, FleetGraph, FleetProfile, RequiredInput};

/// A user that a UAV detects.
#[derive(Clone, Copy, Debug)]
pub(super) struct DetectedUser {
    pub(super) position: Point,
    /// Distance from the UAV.
    pub(super) distance: f64,
    /// AoI in slots.
    pub(super) aoi: f32,
}

/// Which detected user a UAV flies to.
pub(super) trait TargetChoice: Default + Send + Sync {
    const NAME: &'static str;
    const DESCRIPTION: &'static str;

    /// The target, or `None` to search.
    fn choose(detected: impl Iterator<Item = DetectedUser>) -> Option<DetectedUser>;
}

/// Flies to the target if there is one, else straight on. Memory: the seed, then the course of each UAV (see [`cruise`]).
#[derive(Default)]
pub(super) struct Search<T>(PhantomData<T>);

impl<T: TargetChoice> Rule for Search<T> {
    const NAME: &'static str = T::NAME;
    const DESCRIPTION: &'static str = T::DESCRIPTION;
    const NEEDS: RequiredInput = RequiredInput::OwnPositions;

    fn memory_len(&self, uavs: usize, _users: usize) -> usize {
        SEED_LEN + uavs
    }

    fn start(&self, seed: u64, memory: &mut [f32]) {
        store_seed(seed, memory);
    }

    fn carry(&self, from: &[f32], to: &mut [f32], carry: &Carry<'_>) {
        to[..SEED_LEN].copy_from_slice(&from[..SEED_LEN]);
        carry.uav_rows(1, &from[SEED_LEN..], &mut to[SEED_LEN..]);
    }

    fn decide(&self, slot: &Slot<'_>, memory: &mut [f32], headings: &mut [u8]) {
        let Slot { graph, step, .. } = *slot;
        let mut rng = slot_rng(memory, T::NAME, step);
        for (i, (course, heading)) in memory[SEED_LEN..].iter_mut().zip(headings).enumerate() {
            let at = uav_positions(graph)[i];
            let env = &FleetProfile::env(slot.profile, slot.env, i);
            // Always called, so that the random numbers of other UAVs do not depend on what this UAV detects.
            *heading = cruise(env, &mut rng, at, course);
            if let Some(user) = T::choose(detected_users(graph, i, at)) {
                *heading = Headings::new(env, at).toward(user.position);
                // The search continues in the direction of the last target.
                *course = f32::from(*heading) + 1.0;
            }
        }
    }
}

/// The users that UAV `i` at `at` detects.
fn detected_users(graph: &FleetGraph, i: usize, at: Point) -> impl Iterator<Item = DetectedUser> {
    graph.detections(i).iter().filter_map(move |detection| {
        let user = (detection.target as usize).checked_sub(graph.uavs())?;
        let rel = detection.rel.map(f64::from);
        let position = [at[0] + rel[0], at[1] + rel[1]];
        let distance = (position[0] - at[0]).hypot(position[1] - at[1]);
        Some(DetectedUser { position, distance, aoi: graph.aoi()[user] })
    })
}

/// The heading of a UAV that flies straight on. `course` is 1 + the heading, 0 before the first. Where the move would leave
/// the area, draws among the headings that do not, or among all headings if all do.
fn cruise(env: &EnvParams, rng: &mut ChaCha8Rng, at: Point, course: &mut f32) -> u8 {
    let stays = |h: usize| env.contains(next_position(env, at, h));
    let heading = *course as usize;
    if !(1..=EnvConfig::COMPASS).contains(&heading) || !stays(heading - 1) {
        let open = (0..EnvConfig::COMPASS).filter(|&h| stays(h)).count();
        let draw = rng.random_range(0..if open == 0 { EnvConfig::COMPASS } else { open });
        let chosen = (0..EnvConfig::COMPASS).filter(|&h| open == 0 || stays(h)).nth(draw).unwrap_or(0);
        *course = (chosen + 1) as f32;
    }
    *course as u8 - 1
}
