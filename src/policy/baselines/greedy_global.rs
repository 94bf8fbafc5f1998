//! `greedy-global`: knows all positions and AoI, and pairs UAVs with users by AoI per slot of flight.

use super::rule::{Rule, Slot, uav_positions, user_positions};
use crate::policy::flight::{Headings, travel_slots};
use crate::policy::{FleetProfile, RequiredInput};

/// Has no memory.
#[derive(Default)]
pub(super) struct GreedyGlobal;

impl Rule for GreedyGlobal {
    const NAME: &'static str = "greedy-global";
    const DESCRIPTION: &'static str = "Full information: pairs UAVs with the users that promise most AoI per slot of flight.";
    const NEEDS: RequiredInput = RequiredInput::FullScene;

    fn memory_len(&self, _uavs: usize, _users: usize) -> usize {
        0
    }

    fn work(&self, uavs: usize, users: usize, _detections: usize) -> usize {
        // Sorts all pairs.
        2 * uavs * users + users
    }

    fn start(&self, _seed: u64, _memory: &mut [f32]) {}

    fn decide(&self, slot: &Slot<'_>, _memory: &mut [f32], headings: &mut [u8]) {
        let Slot { env, graph, .. } = *slot;
        let (uavs, users) = (uav_positions(graph), user_positions(graph));
        let mut pairs = Vec::with_capacity(uavs.len() * users.len());
        for (i, &at) in uavs.iter().enumerate() {
            let own = FleetProfile::env(slot.profile, env, i);
            for (j, &to) in users.iter().enumerate() {
                let slots = travel_slots(&own, at, to, env.transmission_range);
                let age = f64::from(graph.aoi()[j]) + slots;
                pairs.push((age / slots, i, j));
            }
        }
        // The best pair first. The indices make the order unique, and with it the result.
        pairs.sort_by(|a, b| b.0.total_cmp(&a.0).then((a.1, a.2).cmp(&(b.1, b.2))));
        let mut target = vec![None; uavs.len()];
        let mut taken = vec![false; users.len()];
        for &(_, i, j) in &pairs {
            if target[i].is_none() && !taken[j] {
                target[i] = Some(j);
                taken[j] = true;
            }
        }
        // With more UAVs than users, each remaining UAV flies to its own best user.
        for &(_, i, j) in &pairs {
            target[i].get_or_insert(j);
        }
        for (i, ((heading, &at), target)) in headings.iter_mut().zip(uavs).zip(target).enumerate() {
            let own = FleetProfile::env(slot.profile, env, i);
            *heading = target.map_or(0, |j| Headings::new(&own, at).toward(users[j]));
        }
    }
}
