//! `tour`: plans once, with all positions known: users are shared out among UAVs and each UAV flies round its own for ever.
//! A reference, not a bound: the plan is found by local search and flown by a simple pilot.
//!
//! The memory is the plan, so that the policy has no other state. Where users walk, the fleet plans again, from the ages and
//! positions of that slot, when a user has left the place that the plan was made for. This file owns the memory.

mod flight;
mod order;
mod partition;
mod plan;

use self::flight::{Leg, Pilot, Scene};
use super::geometry::distance;
use super::{EnvParams, RequiredInput, Rule, own_positions};
use crate::env::Point;
use crate::policy::Slot;

/// Memory: per UAV, 1 + the position in its tour and the length of the tour; where users were at planning; then the tours,
/// one after the other. All zeros before the first plan.
#[derive(Default)]
pub(super) struct Tour;

/// Part of the transmission range that a user may walk before the fleet plans again.
const STRAY: f64 = 0.5;
/// The farthest that a plan looks ahead, in slots, however long the episode.
const FARTHEST: usize = 200;
/// The least, near the end of an episode or beyond it.
const SHORTEST: usize = 20;

impl Rule for Tour {
    const NAME: &'static str = "tour";
    const TEXT: &'static str =
        "Full information: shares users out among UAVs and flies round each UAV's own. A reference, not a bound.";
    const NEEDS: RequiredInput = RequiredInput::FullScene;

    fn memory_len(&self, uavs: usize, users: usize) -> usize {
        2 * uavs + 2 * users + capacity(uavs, users)
    }

    fn start(&self, _seed: u64, _memory: &mut [f32]) {}

    fn fly(&self, world: &EnvParams, slot: &Slot, step: u64, memory: &mut [f32], headings: &mut [u8]) {
        let uavs = own_positions(slot);
        let users = slot.user_positions().expect("the caller gives what `needs` asks for");
        let mut legs = recall(world, uavs.len(), users, memory).unwrap_or_else(|| {
            let left = world.slots.saturating_sub(usize::try_from(step).unwrap_or(usize::MAX));
            let slots = left.clamp(SHORTEST, FARTHEST);
            let scene = Scene { world, uavs, users, aoi: slot.aoi(), slots };
            let tours = plan::tours(&scene, capacity(uavs.len(), users.len()));
            remember(&tours, users, memory);
            tours.into_iter().map(|tour| Leg { tour, next: 0 }).collect()
        });
        for (((leg, &at), heading), memory) in legs.iter_mut().zip(uavs).zip(headings).zip(memory.chunks_exact_mut(2)) {
            *heading = Pilot::new(world).heading(leg, at, users) as u8;
            memory[0] = (leg.next + 1) as f32;
        }
    }
}

/// Most entries of all tours together: every user once, and two more per UAV for users that are shared.
fn capacity(uavs: usize, users: usize) -> usize {
    users + 2 * uavs
}

/// Writes a plan at its beginning.
fn remember(tours: &[Vec<u32>], users: &[Point], memory: &mut [f32]) {
    let (counts, rest) = memory.split_at_mut(2 * tours.len());
    let (places, entries) = rest.split_at_mut(2 * users.len());
    for (count, tour) in counts.chunks_exact_mut(2).zip(tours) {
        count.copy_from_slice(&[1.0, tour.len() as f32]);
    }
    for (place, user) in places.chunks_exact_mut(2).zip(users) {
        place.copy_from_slice(&user.map(|x| x as f32));
    }
    for (entry, &user) in entries.iter_mut().zip(tours.iter().flatten()) {
        *entry = user as f32;
    }
}

/// The plan in `memory`, where it still holds. Callers may keep the memory themselves, so nothing in it is taken on trust.
fn recall(world: &EnvParams, uavs: usize, users: &[Point], memory: &[f32]) -> Option<Vec<Leg>> {
    let (counts, rest) = memory.split_at(2 * uavs);
    let (places, mut entries) = rest.split_at(2 * users.len());
    let near =
        |(place, &user): (&[f32], &Point)| distance([place[0].into(), place[1].into()], user) <= STRAY * world.transmission_range;
    if !places.chunks_exact(2).zip(users).all(near) {
        return None;
    }
    let mut legs = Vec::with_capacity(uavs);
    for count in counts.chunks_exact(2) {
        let next = (count[0] as usize).checked_sub(1)?;
        let (tour, rest) = entries.split_at_checked(count[1] as usize)?;
        entries = rest;
        let tour: Vec<u32> = tour.iter().map(|&user| user as u32).collect();
        if tour.iter().any(|&user| user as usize >= users.len()) || next > tour.len() {
            return None;
        }
        legs.push(Leg { tour, next });
    }
    Some(legs)
}
