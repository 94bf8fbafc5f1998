//! What UAVs remember of an episode (docs/model.md, "Memory"): the users that each UAV knows of, and the ground that it has searched.
//!
//! A UAV's memory follows from what it detected itself, and, if memories are shared, from the memories of the UAVs in communication
//! range: in every slot, all UAVs detect first and then exchange their memories once. Of two entries for a user, the newer one wins.
//! The memory has a fixed size, whatever the number of slots, and its content does not fade.
//!
//! Encoding of one UAV: [`GRID`] rows of the ground, each an integer with one bit per cell; then per user [`USER`] numbers. All are
//! integers or f32 positions, which f32 holds exactly.

use super::{Carry, EnvParams, Sight};
use crate::env::Point;
use crate::nn::simd;

/// Cells along each side of the unit square. A row of cells is an integer below 2^GRID, which f32 holds exactly.
pub const GRID: usize = 20;
/// Numbers per user: state, x, y, slot of the last known collection, slot of the observation.
const USER: usize = 5;

/// Values of a user's state.
const UNKNOWN: f32 = 0.0;
const KNOWN: f32 = 1.0;

/// Length of the memory of one UAV that may know `users` users.
pub const fn uav_memory_len(users: usize) -> usize {
    GRID + USER * users
}

/// A user that a UAV remembers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RememberedUser {
    /// Position when it was last observed.
    pub position: Point,
    /// Slot in which its data was last collected, as far as known.
    pub collected: f32,
    /// Slot in which it was last observed, by this UAV or by one whose memory it received.
    pub observed: f32,
}

/// The memory of one UAV.
#[derive(Clone, Copy, Debug)]
pub struct UavMemory<'a> {
    ground: &'a [f32],
    users: &'a [f32],
}

impl<'a> UavMemory<'a> {
    /// The memory of a UAV that knows nothing.
    pub const EMPTY: UavMemory<'static> = UavMemory { ground: &[0.0; GRID], users: &[] };

    /// The memory in `numbers`, of length [`uav_memory_len`].
    pub fn new(numbers: &'a [f32]) -> Self {
        let (ground, users) = numbers.split_at(GRID);
        Self { ground, users }
    }

    /// The cells of row `row` that were searched: bit c stands for the cell in column c.
    pub fn searched(&self, row: usize) -> u32 {
        self.ground[row] as u32 & ALL
    }

    /// The users, with `None` for those that are not known.
    pub fn users(&self) -> impl ExactSizeIterator<Item = Option<RememberedUser>> + 'a {
        self.users.chunks_exact(USER).map(|user| {
            (user[0] == KNOWN).then(|| RememberedUser {
                position: [user[1].into(), user[2].into()],
                collected: user[3],
                observed: user[4],
            })
        })
    }
}

impl UavMemory<'_> {
    /// Number of users that the UAV does not know. `open`: there may be more users than the memory has room for; their number is
    /// estimated from the known users per searched ground.
    pub fn unknown_users(&self, open: bool) -> usize {
        let listed = self.users().filter(Option::is_none).count();
        if !open {
            return listed;
        }
        let searched: u32 = (0..GRID).map(|row| self.searched(row).count_ones()).sum();
        let left = (GRID * GRID) as u32 - searched;
        let known = self.users().flatten().count();
        let expected = (known + 1) as f64 * f64::from(left) / f64::from(searched.max(1));
        listed.max(expected.round() as usize)
    }
}

/// Copies the memories of UAVs to those of another fleet (see `Policy::carry`).
pub fn carry(from: &[f32], to: &mut [f32], carry: &Carry<'_>) {
    let (len_from, len_to) = (uav_memory_len(carry.from.1), uav_memory_len(carry.to.1));
    for &(a, b) in carry.uavs {
        let (from, to) = (&from[a as usize * len_from..][..len_from], &mut to[b as usize * len_to..][..len_to]);
        to[..GRID].copy_from_slice(&from[..GRID]);
        for &(a, b) in carry.users {
            to[GRID + b as usize * USER..][..USER].copy_from_slice(&from[GRID + a as usize * USER..][..USER]);
        }
    }
}

/// The memories of a fleet in `numbers`, one per UAV.
pub fn memories(numbers: &[f32], users: usize) -> impl Iterator<Item = UavMemory<'_>> {
    numbers.chunks_exact(uav_memory_len(users)).map(UavMemory::new)
}

/// All cells of a row.
const ALL: u32 = (1 << GRID) - 1;

/// Whether UAVs exchange memories.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sharing {
    /// Every UAV has only what it detected itself.
    Own,
    /// UAVs in communication range exchange their memories in every slot.
    Shared,
}

/// Marks the ground outside the area as searched, in the memories of a fleet: nothing is there.
pub fn exclude_outside(env: &EnvParams, users: usize, memories: &mut [f32]) {
    if env.extent == [1.0; 2] {
        return;
    }
    let center = |k: usize| (k as f64 + 0.5) / GRID as f64;
    let outside = |row: usize| {
        (0..GRID).filter(|&column| !env.contains([center(column), center(row)])).fold(0, |bits, c| bits | 1_u32 << c)
    };
    let outside: [u32; GRID] = std::array::from_fn(outside);
    for memory in memories.chunks_exact_mut(uav_memory_len(users)) {
        for (bits, outside) in memory.iter_mut().zip(outside) {
            *bits = ((*bits as u32 & ALL) | outside) as f32;
        }
    }
}

/// Advances the memories of a fleet, one after another in `memories`, to slot `slot`.
pub fn remember(sight: &Sight<'_>, range: f64, slot: u64, sharing: Sharing, memories: &mut [f32], exchange: &mut Exchange) {
    let len = uav_memory_len(sight.users());
    for (i, memory) in memories.chunks_exact_mut(len).enumerate() {
        observe(sight, i, range, slot as f32, memory);
    }
    if sharing == Sharing::Shared && sight.uavs() > 1 {
        exchange.run(sight, memories);
    }
}

/// Writes what UAV `i` detects into its memory.
fn observe(sight: &Sight<'_>, i: usize, range: f64, slot: f32, memory: &mut [f32]) {
    let at = sight.positions[i];
    let (ground, users) = memory.split_at_mut(GRID);
    simd(
        #[inline(always)]
        || search(at, range, ground),
    );
    // A user that should be detected and is not has moved away. The margin allows for rounding.
    let near = (0.99 * range).powi(2);
    for user in users.chunks_exact_mut(USER).filter(|user| user[0] == KNOWN) {
        if (f64::from(user[1]) - at[0]).powi(2) + (f64::from(user[2]) - at[1]).powi(2) < near {
            (user[0], user[4]) = (UNKNOWN, slot);
        }
    }
    for (j, [x, y]) in sight.detected_users(i) {
        users[j * USER..][..USER].copy_from_slice(&[KNOWN, x as f32, y as f32, slot - sight.aoi[j], slot]);
    }
}

/// Marks the cells whose centres are within `range` of `at` as searched.
#[inline(always)]
fn search(at: Point, range: f64, ground: &mut [f32]) {
    let cells = GRID as f64;
    let first = ((at[1] - range) * cells - 0.5).ceil().max(0.0) as usize;
    let end = ((at[1] + range) * cells + 0.5).floor().clamp(0.0, cells) as usize;
    for (row, bits) in ground.iter_mut().enumerate().take(end).skip(first) {
        let dy = (row as f64 + 0.5) / cells - at[1];
        let half = (range * range - dy * dy).max(0.0).sqrt();
        let left = ((at[0] - half) * cells - 0.5).ceil().clamp(0.0, cells) as u32;
        let right = ((at[0] + half) * cells + 0.5).floor().clamp(0.0, cells) as u32;
        if left < right {
            let seen = (ALL >> (GRID as u32 - (right - left))) << left;
            *bits = ((*bits as u32 & ALL) | seen) as f32;
        }
    }
}

/// The exchange of memories in one slot; kept between slots for its buffers.
///
/// Of two entries for a user, the newer one wins. Most entries that a UAV hears of are not newer than its own, so the times of all
/// entries are compared first, in a matrix of their own.
#[derive(Clone, Debug, Default)]
pub struct Exchange {
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

impl Exchange {
    /// Lets all UAVs of a fleet receive the memories of the UAVs that they detect.
    fn run(&mut self, sight: &Sight<'_>, memories: &mut [f32]) {
        let len = uav_memory_len(sight.users());
        self.list_times(sight.users(), memories);
        self.received.clear();
        for i in 0..sight.uavs() {
            let others = sight.detected_uavs(i).map(|(j, _)| j);
            for j in others.clone() {
                for (bits, &other) in memories[i * len..][..GRID].iter_mut().zip(&self.ground[j * GRID..]) {
                    *bits = ((*bits as u32 | other as u32) & ALL) as f32;
                }
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
    use super::super::FleetGraph;
    use super::*;
    use crate::env::Ranges;

    const RANGES: Ranges = Ranges { detection: 0.28, communication: 0.28 };

    struct Fleet {
        memory: Vec<f32>,
        exchange: Exchange,
        users: usize,
    }

    impl Fleet {
        fn new(uavs: usize, users: usize) -> Self {
            Self { memory: vec![0.0; uavs * uav_memory_len(users)], exchange: Exchange::default(), users }
        }

        fn see(&mut self, slot: u64, uavs: &[Point], users: &[Point], aoi: &[f32], sharing: Sharing, ranges: Ranges) {
            let graph = FleetGraph::from_scene(uavs, users, aoi, ranges);
            remember(&graph.sight().unwrap(), ranges.detection, slot, sharing, &mut self.memory, &mut self.exchange);
        }

        fn of(&self, uav: usize) -> UavMemory<'_> {
            let len = uav_memory_len(self.users);
            UavMemory::new(&self.memory[uav * len..][..len])
        }

        fn user(&self, uav: usize, j: usize) -> Option<RememberedUser> {
            self.of(uav).users().nth(j).unwrap()
        }
    }

    #[test]
    fn cells_are_searched_when_their_centres_are_in_range() {
        for (at, range) in [
            ([0.5, 0.5], 0.28),
            ([0.0, 1.0], 0.28),
            ([0.013, 0.77], 0.05),
            ([0.3, 0.3], 0.01),
            ([0.4, 0.9], 2.0),
            ([-0.5, 0.5], 0.2),
        ] {
            let mut ground = [0.0; GRID];
            search(at, range, &mut ground);
            for (row, &bits) in ground.iter().enumerate() {
                for column in 0..GRID {
                    let center = [column, row].map(|c| (c as f64 + 0.5) / GRID as f64);
                    let inside = (center[0] - at[0]).powi(2) + (center[1] - at[1]).powi(2) <= range * range;
                    assert_eq!(bits as u32 >> column & 1 == 1, inside, "{at:?}, {range}, cell {column}, {row}");
                }
            }
        }
    }

    #[test]
    fn a_user_is_remembered_where_it_was_seen_and_forgotten_when_it_is_gone() {
        let mut fleet = Fleet::new(1, 2);
        let users = [[0.6, 0.5], [0.9, 0.9]];
        fleet.see(3, &[[0.5, 0.5]], &users, &[2.0, 3.0], Sharing::Own, RANGES);
        let seen = fleet.user(0, 0).unwrap();
        assert_eq!((seen.collected, seen.observed), (1.0, 3.0));
        assert!((seen.position[0] - 0.6).abs() < 1e-6);
        assert_eq!(fleet.user(0, 1), None);
        // Out of range it is remembered; in range and not detected it has gone.
        fleet.see(4, &[[0.1, 0.1]], &users, &[3.0, 4.0], Sharing::Own, RANGES);
        assert_eq!(fleet.user(0, 0), Some(seen));
        fleet.see(5, &[[0.5, 0.5]], &[[0.1, 0.9], [0.9, 0.9]], &[4.0, 5.0], Sharing::Own, RANGES);
        assert_eq!(fleet.user(0, 0), None);
    }

    #[test]
    fn memories_pass_one_link_per_slot_and_the_newest_entry_wins() {
        let users = [[0.05, 0.1], [0.1, 0.95]];
        let uavs = [[0.1, 0.2], [0.35, 0.2], [0.6, 0.2]];
        let mut fleet = Fleet::new(3, 2);
        fleet.see(1, &uavs, &users, &[1.0, 1.0], Sharing::Shared, RANGES);
        assert!(fleet.user(1, 0).is_some(), "received over one link");
        assert_eq!(fleet.user(2, 0), None);
        fleet.see(2, &uavs, &users, &[2.0, 2.0], Sharing::Shared, RANGES);
        let old = fleet.user(2, 0).unwrap();
        assert_eq!((old.collected, old.observed), (0.0, 1.0), "what was known one slot ago");
        assert_eq!(fleet.of(2).searched(0) & 1, 1, "searched by UAV 0");
        // UAV 0 collects; the news replaces what the others knew.
        fleet.see(3, &uavs, &users, &[0.0, 3.0], Sharing::Shared, RANGES);
        assert_eq!(fleet.user(1, 0).unwrap().collected, 3.0);
        // That a user has gone is news, too.
        fleet.see(4, &uavs, &[[0.1, 0.95]; 2], &[1.0, 4.0], Sharing::Shared, RANGES);
        assert_eq!((fleet.user(0, 0), fleet.user(1, 0)), (None, None));
        assert!(fleet.user(2, 0).is_some());
    }

    #[test]
    fn communication_range_decides_who_receives() {
        let users = [[0.1, 0.1]];
        let uavs = [[0.1, 0.2], [0.9, 0.9]];
        for (communication, received) in [(0.0, false), (0.28, false), (1.2, true)] {
            let mut fleet = Fleet::new(2, 1);
            fleet.see(1, &uavs, &users, &[1.0], Sharing::Shared, Ranges { communication, ..RANGES });
            assert_eq!(fleet.user(1, 0).is_some(), received, "{communication}");
        }
        let mut fleet = Fleet::new(2, 1);
        fleet.see(1, &uavs, &users, &[1.0], Sharing::Own, Ranges { communication: 2.0, ..RANGES });
        assert_eq!(fleet.user(1, 0), None);
    }

    /// The exchange as docs/model.md defines it, entry by entry.
    fn exchange_one_by_one(sight: &Sight<'_>, before: &[f32]) -> Vec<f32> {
        let len = uav_memory_len(sight.users());
        let mut after = before.to_vec();
        for (i, memory) in after.chunks_exact_mut(len).enumerate() {
            for (j, _) in sight.detected_uavs(i) {
                let (ground, users) = memory.split_at_mut(GRID);
                let (other_ground, others) = before[j * len..][..len].split_at(GRID);
                ground.iter_mut().zip(other_ground).for_each(|(bits, &other)| *bits = (*bits as u32 | other as u32) as f32);
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
        let mut exchange = Exchange::default();
        for users in [1, 15, 16, 17, 40] {
            let uavs: Vec<Point> = (0..6).map(|_| [rng.random(), rng.random()]).collect();
            let graph = FleetGraph::from_scene(&uavs, &vec![[0.5, 0.5]; users], &vec![1.0; users], 0.5);
            let sight = graph.sight().unwrap();
            let mut memory = vec![0.0; uavs.len() * uav_memory_len(users)];
            for uav in memory.chunks_exact_mut(uav_memory_len(users)) {
                uav[..GRID].fill_with(|| rng.random_range(0..1 << GRID) as f32);
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
            exchange.run(&sight, &mut memory);
            assert_eq!(memory, expected, "{users} users");
        }
    }
}
