//! What UAVs remember of an episode (docs/model.md, "Memory"): the users that each UAV knows of, and the ground that it has searched.
//!
//! A UAV's memory follows from what it detected itself, and, if memories are shared, from the memories of the UAVs in communication
//! range: in every slot, all UAVs detect first and then exchange their memories once. Of two entries for a user, the newer one wins.
//! The memory has a fixed size, whatever the number of slots, and its content does not fade.
//!
//! Encoding of one UAV: [`GRID`] rows of the ground, each an integer with one bit per cell; then per user [`USER`] numbers. All are
//! integers or f32 positions, which f32 holds exactly. With more than [`MAX_REMEMBERED`] users, the memory has entries of some of them
//! (`nearest`).

mod all_users;
mod nearest;

use self::all_users::AllUsers;
use self::nearest::{Carrier, NearestUsers};
use super::{Carry, EnvParams, Sight};
use crate::env::Point;
use crate::nn::simd;
use crate::threads;

/// Cells along each side of the unit square. A row of cells is an integer below 2^GRID, which f32 holds exactly.
pub const GRID: usize = 20;
/// Numbers per user: state, x, y, slot of the last known collection, slot of the observation.
const USER: usize = 5;

/// Users that a UAV remembers at most: of more, those nearest to it.
pub const MAX_REMEMBERED: usize = 256;

/// Values of a user's state.
const UNKNOWN: f32 = 0.0;
const KNOWN: f32 = 1.0;

/// Length of the memory of one UAV that may know `users` users.
pub const fn uav_memory_len(users: usize) -> usize {
    GRID + USER * if users < MAX_REMEMBERED { users } else { MAX_REMEMBERED }
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
    entries: &'a [f32],
    /// N.
    users: usize,
}

impl<'a> UavMemory<'a> {
    /// The memory of a UAV that knows nothing.
    pub const EMPTY: UavMemory<'static> = UavMemory { ground: &[0.0; GRID], entries: &[], users: 0 };

    /// The memory in `numbers`, of length [`uav_memory_len`]`(users)`.
    pub fn new(numbers: &'a [f32], users: usize) -> Self {
        let (ground, entries) = numbers.split_at(GRID);
        Self { ground, entries, users }
    }

    /// The cells of row `row` that were searched: bit c stands for the cell in column c.
    pub fn searched(&self, row: usize) -> u32 {
        self.ground[row] as u32 & ALL
    }

    /// The users that the memory has room for, with `None` for those that are not known.
    pub fn users(&self) -> impl ExactSizeIterator<Item = Option<RememberedUser>> + 'a {
        self.entries.chunks_exact(USER).map(|user| {
            (user[0] > UNKNOWN).then(|| RememberedUser {
                position: [user[1].into(), user[2].into()],
                collected: user[3],
                observed: user[4],
            })
        })
    }

    /// Number of users that are not known. `open`: there may be more users than N; their number is estimated from the known users per
    /// searched ground.
    pub fn unknown_users(&self, open: bool) -> usize {
        let (known, left_out) = (self.users().flatten().count(), self.users_left_out());
        let unknown = self.users - known - left_out;
        if !open {
            return unknown;
        }
        let searched = self.searched_cells();
        let left = (GRID * GRID) as u32 - searched;
        let expected = (known + left_out + 1) as f64 * f64::from(left) / f64::from(searched.max(1));
        unknown.max(expected.round() as usize)
    }

    /// Number of known users that the memory has no room for, if the users are spread evenly; 0 for at most [`MAX_REMEMBERED`] users.
    pub fn users_left_out(&self) -> usize {
        if self.users <= MAX_REMEMBERED {
            return 0;
        }
        let known = self.users * self.searched_cells() as usize / (GRID * GRID);
        known.saturating_sub(self.users().flatten().count())
    }

    fn searched_cells(&self) -> u32 {
        (0..GRID).map(|row| self.searched(row).count_ones()).sum()
    }
}

/// Copies the memories of UAVs to those of another fleet (see `Policy::carry`).
pub fn carry(from: &[f32], to: &mut [f32], carry: &Carry<'_>) {
    let (users_from, users_to) = (carry.from.1, carry.to.1);
    let (len_from, len_to) = (uav_memory_len(users_from), uav_memory_len(users_to));
    let carrier = (users_from.max(users_to) > MAX_REMEMBERED).then(|| Carrier::new((users_from, users_to), carry.users));
    for &(a, b) in carry.uavs {
        let (from, to) = (&from[a as usize * len_from..][..len_from], &mut to[b as usize * len_to..][..len_to]);
        to[..GRID].copy_from_slice(&from[..GRID]);
        if let Some(carrier) = &carrier {
            carrier.carry(from, to);
            continue;
        }
        for &(a, b) in carry.users {
            to[GRID + b as usize * USER..][..USER].copy_from_slice(&from[GRID + a as usize * USER..][..USER]);
        }
    }
}

/// The memories of a fleet in `numbers`, one per UAV.
pub fn memories(numbers: &[f32], users: usize) -> impl Iterator<Item = UavMemory<'_>> + Clone {
    numbers.chunks_exact(uav_memory_len(users)).map(move |numbers| UavMemory::new(numbers, users))
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

/// Buffers for the memories of a fleet, kept between slots.
#[derive(Clone, Debug, Default)]
pub struct Exchange {
    all: AllUsers,
    /// One per part of a fleet.
    nearest: Vec<NearestUsers>,
    /// The memories before the UAVs receive those of others.
    before: Vec<f32>,
}

/// Advances the memories of a fleet, one after another in `memories`, to slot `slot`.
pub fn remember(sight: &Sight<'_>, range: f64, slot: u64, sharing: Sharing, memories: &mut [f32], exchange: &mut Exchange) {
    let Exchange { all, nearest, before } = exchange;
    let len = uav_memory_len(sight.users());
    let listed = sight.users() > MAX_REMEMBERED;
    // A user that should be detected and is not has moved away. The margin allows for rounding.
    let near = 0.99 * range;
    let part = threads::part(sight.uavs());
    nearest.resize_with(sight.uavs().div_ceil(part), NearestUsers::default);
    let parts = nearest.iter_mut().zip(memories.chunks_mut(part * len)).enumerate();
    threads::for_each(parts, |(k, (nearest, memories))| {
        for (i, memory) in (k * part..).zip(memories.chunks_exact_mut(len)) {
            simd(
                #[inline(always)]
                || search(sight.positions[i], range, &mut memory[..GRID]),
            );
            if listed {
                nearest.observe(sight, i, near, slot as f32, memory);
            } else {
                observe(sight, i, near, slot as f32, memory);
            }
        }
    });
    if sharing == Sharing::Own || sight.uavs() == 1 {
        return;
    }
    if !listed {
        all.exchange(sight, memories);
        return;
    }
    before.clear();
    before.extend_from_slice(memories);
    let parts = nearest.iter_mut().zip(memories.chunks_mut(part * len)).enumerate();
    threads::for_each(parts, |(k, (nearest, memories))| {
        for (i, memory) in (k * part..).zip(memories.chunks_exact_mut(len)) {
            nearest.receive(sight, i, before, memory);
        }
    });
}

/// Writes the users that UAV `i` detects into its memory, which has an entry for every user. Users remembered within `near` that it does
/// not detect have gone.
fn observe(sight: &Sight<'_>, i: usize, near: f64, slot: f32, memory: &mut [f32]) {
    let at = sight.positions[i];
    let users = &mut memory[GRID..];
    for user in users.chunks_exact_mut(USER).filter(|user| user[0] == KNOWN) {
        if (f64::from(user[1]) - at[0]).powi(2) + (f64::from(user[2]) - at[1]).powi(2) < near.powi(2) {
            (user[0], user[4]) = (UNKNOWN, slot);
        }
    }
    for (j, [x, y]) in sight.detected_users(i) {
        users[j * USER..][..USER].copy_from_slice(&[KNOWN, x as f32, y as f32, slot - sight.aoi[j], slot]);
    }
}

/// Adds the ground of another memory to that of `memory`.
fn merge_ground(memory: &mut [f32], other: &[f32]) {
    for (bits, &other) in memory[..GRID].iter_mut().zip(other) {
        *bits = ((*bits as u32 | other as u32) & ALL) as f32;
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
            UavMemory::new(&self.memory[uav * len..][..len], self.users)
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
}
