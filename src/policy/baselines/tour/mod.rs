//! `tour`: knows all positions and plans once. Each UAV gets a share of the users and flies a cyclic tour through them.
//! `tour` is a reference, not a bound: the plan is found by local search and flown by a simple pilot.
//!
//! This file owns the fleet's memory, which holds the plan. If a user has moved too far from its position at the time of
//! planning, the fleet plans again, from the AoI and positions of that slot.

mod order;
mod partition;
mod pilot;
mod plan;

use self::pilot::{Pilot, Problem, TourState};
use super::rule::{Rule, Slot, uav_positions, user_positions};
use crate::env::Point;
use crate::policy::flight::distance;
use crate::policy::{EnvParams, RequiredInput};

/// Memory: for each UAV, 1 + the index in its tour, and the length of the tour; the positions of users at the time of planning;
/// then all tours, one after another. All zeros before the first plan.
#[derive(Default)]
pub(super) struct Tour;

/// Share of the transmission range that a user may move before the fleet plans again.
const MAX_MOVE: f64 = 0.5;
/// A plan looks ahead as many slots as an episode has, but at least and at most these. A plan that looked to the end of the episode only
/// could leave out users that are far away; a session flies it much longer.
const SLOTS: std::ops::RangeInclusive<usize> = 20..=200;

impl Rule for Tour {
    const NAME: &'static str = "tour";
    const DESCRIPTION: &'static str =
        "Full information: assigns users to UAVs, and each UAV flies a tour through its users. A reference, not a bound.";
    const NEEDS: RequiredInput = RequiredInput::FullScene;

    fn memory_len(&self, uavs: usize, users: usize) -> usize {
        2 * uavs + 2 * users + capacity(uavs, users)
    }

    fn work(&self, uavs: usize, users: usize, _detections: usize) -> usize {
        // That of planning, which takes longer than all other slots. A plan for few users is improved by simulation.
        8 * uavs * users + 1000 * users.min(64) + 64 * (uavs + users)
    }

    fn start(&self, _seed: u64, _memory: &mut [f32]) {}

    fn decide(&self, slot: &Slot<'_>, memory: &mut [f32], headings: &mut [u8]) {
        let Slot { env, graph, .. } = *slot;
        let (uavs, users) = (uav_positions(graph), user_positions(graph));
        let mut states = read_plan(env, uavs.len(), users, memory).unwrap_or_else(|| {
            let slots = env.slots.clamp(*SLOTS.start(), *SLOTS.end());
            let problem = Problem { env, uavs, users, aoi: graph.aoi(), slots };
            let tours = plan::tours(&problem, capacity(uavs.len(), users.len()));
            write_plan(&tours, users, memory);
            tours.into_iter().map(|tour| TourState { tour, next: 0 }).collect()
        });
        for (((state, &at), heading), memory) in states.iter_mut().zip(uavs).zip(headings).zip(memory.chunks_exact_mut(2)) {
            *heading = Pilot::new(env).heading(state, at, users) as u8;
            memory[0] = (state.next + 1) as f32;
        }
    }
}

/// Maximum number of entries of all tours: every user once, and two more per UAV for users that are shared.
fn capacity(uavs: usize, users: usize) -> usize {
    users + 2 * uavs
}

/// Writes a new plan to `memory`.
fn write_plan(tours: &[Vec<u32>], users: &[Point], memory: &mut [f32]) {
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

/// The plan in `memory`, or `None` if it is missing, out of date or malformed: the memory may come from a client.
fn read_plan(env: &EnvParams, uavs: usize, users: &[Point], memory: &[f32]) -> Option<Vec<TourState>> {
    let (counts, rest) = memory.split_at(2 * uavs);
    let (places, mut entries) = rest.split_at(2 * users.len());
    let near = |(place, &user): (&[f32], &Point)| {
        distance([place[0].into(), place[1].into()], user) <= MAX_MOVE * env.transmission_range
    };
    if !places.chunks_exact(2).zip(users).all(near) {
        return None;
    }
    let mut states = Vec::with_capacity(uavs);
    for count in counts.chunks_exact(2) {
        let next = (count[0] as usize).checked_sub(1)?;
        let (tour, rest) = entries.split_at_checked(count[1] as usize)?;
        entries = rest;
        let tour: Vec<u32> = tour.iter().map(|&user| user as u32).collect();
        if tour.iter().any(|&user| user as usize >= users.len()) || next > tour.len() {
            return None;
        }
        states.push(TourState { tour, next });
    }
    Some(states)
}
