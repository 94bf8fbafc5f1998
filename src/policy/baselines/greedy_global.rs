//! `greedy-global`: knows all positions and ages; pairs UAVs with the users that promise most AoI per slot of flight.

use super::geometry::{heading_toward, travel_slots};
use super::{EnvParams, RequiredInput, Rule, own_positions};
use crate::policy::Slot;

/// Has no memory.
#[derive(Default)]
pub(super) struct GreedyGlobal;

impl Rule for GreedyGlobal {
    const NAME: &'static str = "greedy-global";
    const TEXT: &'static str = "Full information: pairs UAVs with the users that promise most AoI per slot of flight.";
    const NEEDS: RequiredInput = RequiredInput::FullScene;

    fn memory_len(&self, _uavs: usize, _users: usize) -> usize {
        0
    }

    fn start(&self, _seed: u64, _memory: &mut [f32]) {}

    fn fly(&self, world: &EnvParams, slot: &Slot, _step: u64, _memory: &mut [f32], headings: &mut [u8]) {
        let uavs = own_positions(slot);
        let users = slot.user_positions().expect("the caller gives what `needs` asks for");
        let mut pairs = Vec::with_capacity(uavs.len() * users.len());
        for (i, &at) in uavs.iter().enumerate() {
            for (j, &to) in users.iter().enumerate() {
                let slots = travel_slots(world, at, to, world.transmission_range);
                let age = f64::from(slot.aoi()[j]) + slots;
                pairs.push((age / slots, i, j));
            }
        }
        // The best pair first; the indices make the order, and so the answer, unique.
        pairs.sort_by(|a, b| b.0.total_cmp(&a.0).then((a.1, a.2).cmp(&(b.1, b.2))));
        let mut target = vec![None; uavs.len()];
        let mut taken = vec![false; users.len()];
        for &(_, i, j) in &pairs {
            if target[i].is_none() && !taken[j] {
                target[i] = Some(j);
                taken[j] = true;
            }
        }
        // More UAVs than users: the others help where they would go themselves.
        for &(_, i, j) in &pairs {
            target[i].get_or_insert(j);
        }
        for ((heading, &at), target) in headings.iter_mut().zip(uavs).zip(target) {
            *heading = target.map_or(0, |j| heading_toward(world, at, users[j]));
        }
    }
}
