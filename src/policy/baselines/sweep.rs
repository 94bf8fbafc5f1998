//! `sweep`: no prior knowledge. UAVs fan out over the square, search it, and serve the users they have found. `sweep-shared`: the same,
//! and UAVs in communication range exchange their memories.
//!
//! A UAV knows the square, its place among the UAVs, and what it remembers (`policy::memory`). `policy::sweep_plan` is where it flies.

use super::rule::{Rule, Slot};
use crate::policy::memory::{self, Exchange, MAX_REMEMBERED, Sharing, memories, remember, uav_memory_len};
use crate::policy::sweep_plan::sweep_headings;
use crate::policy::{Carry, FleetProfile, Reach, RequiredInput};

/// With or without shared memories. The memory is that of `policy::memory`.
#[derive(Default)]
pub(super) struct Sweep<const SHARED: bool>;

impl<const SHARED: bool> Rule for Sweep<SHARED> {
    const NAME: &'static str = if SHARED { "sweep-shared" } else { "sweep" };
    const DESCRIPTION: &'static str = if SHARED {
        "No prior knowledge: as sweep, and UAVs in communication range exchange what they remember."
    } else {
        "No prior knowledge: UAVs fan out, search, and serve the users that each found itself."
    };
    const NEEDS: RequiredInput = RequiredInput::OwnPositions;
    const REACH: Reach = Reach::Links(if SHARED { 1 } else { 0 });

    fn memory_len(&self, uavs: usize, users: usize) -> usize {
        uavs * uav_memory_len(users)
    }

    fn work(&self, uavs: usize, users: usize, detections: usize) -> usize {
        // Each UAV compares its blocks of ground with each other and looks at every user that it remembers; then it may receive as many
        // memories.
        let remembered = users.min(MAX_REMEMBERED);
        let received = if SHARED { detections * uavs / (uavs + users) } else { 0 };
        uavs * (256 + remembered / 4) + detections + received * remembered / 8
    }

    fn start(&self, _seed: u64, _memory: &mut [f32]) {}

    fn carry(&self, from: &[f32], to: &mut [f32], carry: &Carry<'_>) {
        memory::carry(from, to, carry);
    }

    fn remembers_users(&self) -> bool {
        true
    }

    fn decide(&self, slot: &Slot<'_>, memory: &mut [f32], headings: &mut [u8]) {
        let Slot { env, graph, step, profile } = *slot;
        let sight = graph.sight().expect("the caller provides what `needs` requires");
        let sharing = if SHARED { Sharing::Shared } else { Sharing::Own };
        remember((env, &sight, step), (sharing, FleetProfile::users(profile)), memory, &mut Exchange::default());
        sweep_headings((env, &sight, step), memories(memory, graph.users()), profile, headings);
    }
}
