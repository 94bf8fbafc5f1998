//! Memories of fleets with at most [`super::MAX_REMEMBERED`] users: the exchange of memories that have an entry for every user.

use super::{GRID, KNOWN, USER, search, uav_memory_len};
use crate::nn::simd;
use crate::policy::Sight;

/// The exchange of memories in one slot; kept between slots for its buffers.
///
/// Of two entries for a user, the newer one wins. Most entries that a UAV hears of are not newer than its own, so the times of all
/// entries are compared first, in a matrix of their own.
#[derive(Clone, Debug, Default)]
pub(super) struct AllUsers {
    /// (M, N, filled up to whole vectors) when each entry was observed, plus 1; 0 if nothing is known.
    times: Vec<f32>,
    /// (M, [`GRID`]) the ground that the UAVs knew before.
    ground: Vec<f32>,
    /// For each user, the newest time that one UAV hears of.
    newest: Vec<f32>,
    /// Whose entry that is, or [`OWN`].
    source: Vec<u32>,
    /// Where the entries that change are in the memories, and what they become.
    received: Vec<(usize, [f32; USER])>,
}

/// Entries that are compared at once.
const LANES: usize = 16;
/// The source of an entry that does not change.
const OWN: u32 = u32::MAX;

impl AllUsers {
    /// Lets all UAVs of a fleet receive the memories of the UAVs that they detect.
    pub(super) fn exchange(&mut self, sight: &Sight<'_>, memories: &mut [f32]) {
        let len = uav_memory_len(sight.users());
        self.list_times(sight.users(), memories);
        self.received.clear();
        for i in 0..sight.uavs() {
            let others = sight.detected_uavs(i).map(|(j, _)| j);
            for j in others.clone() {
                search::merge(&self.ground[j * GRID..][..GRID], &mut memories[i * len..][..GRID]);
            }
            self.choose_sources(i, sight.users(), others);
            for (user, &j) in self.source.iter().enumerate().filter(|(_, j)| **j != OWN) {
                let [from, to] = [j as usize, i].map(|uav| uav * len + GRID + user * USER);
                let entry = std::array::from_fn(|k| memories[from + k]);
                self.received.push((to, entry));
            }
        }
        for (at, entry) in &self.received {
            memories[*at..][..USER].copy_from_slice(entry);
        }
    }

    /// Fills `times` and `ground`.
    fn list_times(&mut self, users: usize, memories: &[f32]) {
        self.times.clear();
        self.ground.clear();
        for memory in memories.chunks_exact(uav_memory_len(users)) {
            let (ground, entries) = memory.split_at(GRID);
            self.ground.extend_from_slice(ground);
            let time = |user: &[f32]| if user[0] == KNOWN || user[4] > 0.0 { user[4] + 1.0 } else { 0.0 };
            self.times.extend(entries.chunks_exact(USER).map(time));
            self.times.resize(self.times.len().next_multiple_of(LANES), 0.0);
        }
    }

    /// Fills `source` for UAV `i`.
    fn choose_sources(&mut self, i: usize, users: usize, others: impl Iterator<Item = usize>) {
        let width = users.next_multiple_of(LANES);
        self.newest.clear();
        self.newest.extend_from_slice(&self.times[i * width..][..width]);
        self.source.clear();
        self.source.resize(width, OWN);
        let (newest, sources) = (self.newest.as_chunks_mut::<LANES>().0, self.source.as_chunks_mut::<LANES>().0);
        for j in others {
            let times = self.times[j * width..][..width].as_chunks::<LANES>().0;
            simd(
                #[inline(always)]
                || {
                    for ((newest, source), times) in newest.iter_mut().zip(&mut *sources).zip(times) {
                        let mut newer = false;
                        for l in 0..LANES {
                            newer |= times[l] > newest[l];
                        }
                        if newer {
                            for l in 0..LANES {
                                let newer = times[l] > newest[l];
                                newest[l] = if newer { times[l] } else { newest[l] };
                                source[l] = if newer { j as u32 } else { source[l] };
                            }
                        }
                    }
                },
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::UNKNOWN;
    use super::*;
    use crate::env::Point;
    use crate::policy::FleetGraph;

    /// The exchange as docs/model.md defines it, entry by entry.
    fn exchange_one_by_one(sight: &Sight<'_>, before: &[f32]) -> Vec<f32> {
        let len = uav_memory_len(sight.users());
        let mut after = before.to_vec();
        for (i, memory) in after.chunks_exact_mut(len).enumerate() {
            for (j, _) in sight.detected_uavs(i) {
                let (ground, users) = memory.split_at_mut(GRID);
                let (other_ground, others) = before[j * len..][..len].split_at(GRID);
                search::merge(other_ground, ground);
                for (user, other) in users.chunks_exact_mut(USER).zip(others.chunks_exact(USER)) {
                    let nothing = user[0] == UNKNOWN && user[4] == 0.0;
                    if other[4] > user[4] || (nothing && other[0] == KNOWN) {
                        user.copy_from_slice(other);
                    }
                }
            }
        }
        after
    }

    #[test]
    fn exchanges_of_many_users_are_those_of_single_entries() {
        use rand::RngExt;
        let mut rng = crate::rng::stream(7, "exchange", 0);
        let mut exchange = AllUsers::default();
        for users in [1, 15, 16, 17, 40] {
            let uavs: Vec<Point> = (0..6).map(|_| [rng.random(), rng.random()]).collect();
            let graph = FleetGraph::from_scene(&uavs, &vec![[0.5, 0.5]; users], &vec![1.0; users], 0.5);
            let sight = graph.sight().unwrap();
            let mut memory = vec![0.0; uavs.len() * uav_memory_len(users)];
            for uav in memory.chunks_exact_mut(uav_memory_len(users)) {
                search::begin(rng.random_range(0..3), &mut uav[..GRID]);
                search::mark(&std::array::from_fn(|_| rng.random_range(0..1 << GRID)), &mut uav[..GRID]);
                for user in uav[GRID..].chunks_exact_mut(USER) {
                    if rng.random_bool(0.4) {
                        continue;
                    }
                    let observed = rng.random_range(0..6) as f32;
                    // Slot 0 leaves nothing but users that were seen in it.
                    let state = if observed == 0.0 || rng.random_bool(0.8) { KNOWN } else { UNKNOWN };
                    user.copy_from_slice(&[state, rng.random(), rng.random(), observed - 2.0, observed]);
                }
            }
            let expected = exchange_one_by_one(&sight, &memory);
            assert_ne!(expected, memory, "something is received");
            exchange.exchange(&sight, &mut memory);
            assert_eq!(memory, expected, "{users} users");
        }
    }
}
