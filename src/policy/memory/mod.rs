//! What UAVs remember of an episode (docs/model.md, "Memory"): the users that each UAV knows of, and the ground that it has searched.
//!
//! A UAV's memory follows from what it detected itself, and, if memories are shared, from the memories of the UAVs in communication
//! range: in every slot, all UAVs detect first and then exchange their memories once. Of two entries for a user, the newer one wins.
//! The memory has a fixed size, whatever the number of slots, and its content does not fade.
//!
//! Encoding of one UAV: [`GRID`] rows of the ground (`search`); then per user [`USER`] numbers. All are integers or f32 positions, which
//! f32 holds exactly. With more than [`MAX_REMEMBERED`] users, the memory has entries of some of them (`nearest`).

mod all_users;
mod nearest;
mod search;

use self::all_users::AllUsers;
use self::nearest::{Carrier, NearestUsers};
use super::{Carry, EnvParams, Sight, UserCount};
use crate::env::Point;
use crate::nn::simd;
use crate::threads;

/// Cells along each side of the unit square. A row of cells is an integer below 2^GRID, which f32 holds exactly.
pub const GRID: usize = 20;
/// Numbers per user: state, x, y, slot of the last known collection, slot of the observation.
const USER: usize = 5;
/// Cells of the square.
const CELLS: usize = GRID * GRID;

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
    /// The memory in `numbers`, of length [`uav_memory_len`]`(users)`.
    pub fn new(numbers: &'a [f32], users: usize) -> Self {
        let (ground, entries) = numbers.split_at(GRID);
        Self { ground, entries, users }
    }

    /// The cells of row `row` that were searched since the present search began: bit c stands for the cell in column c.
    pub fn searched(&self, row: usize) -> u32 {
        search::cells(self.ground[row])
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

    /// Number of users that are not known. If their number is unknown, those that have gone may have left; before all ground was searched,
    /// the number is estimated from the known users per searched ground, and afterwards one is expected to be new.
    pub fn unknown_users(&self, count: UserCount) -> usize {
        let (known, left_out) = (self.users().flatten().count(), self.users_left_out());
        let unknown = match count {
            UserCount::Fixed => return self.users - known - left_out,
            UserCount::Listed(listed) if self.users <= MAX_REMEMBERED => {
                return self.users().take(listed).filter(Option::is_none).count();
            }
            UserCount::Listed(listed) => return listed.saturating_sub(known + left_out),
            UserCount::Unknown => (self.users - known - left_out).saturating_sub(self.users_gone()),
        };
        let searched = search::count(self.ground);
        if searched == CELLS {
            return unknown;
        }
        if search::began(self.ground) > 0 {
            return unknown.max(1);
        }
        let expected = (known + left_out + 1) as f64 * (CELLS - searched) as f64 / searched.max(1) as f64;
        unknown.max(expected.ceil() as usize)
    }

    /// Number of users that were known and have gone.
    fn users_gone(&self) -> usize {
        self.entries.chunks_exact(USER).filter(|user| user[0] <= UNKNOWN && user[4] > 0.0).count()
    }

    /// Slot from which the AoI of users that are not known is counted: 0, or, if users come and go, the slot in which the present search
    /// began.
    pub fn unknown_since(&self, count: UserCount) -> f64 {
        if count == UserCount::Fixed { 0.0 } else { f64::from(search::began(self.ground)) }
    }

    /// Number of known users that the memory has no room for, if the users are spread evenly; 0 for at most [`MAX_REMEMBERED`] users.
    pub fn users_left_out(&self) -> usize {
        if self.users <= MAX_REMEMBERED {
            return 0;
        }
        let searched = if search::began(self.ground) > 0 { CELLS } else { search::count(self.ground) };
        (self.users * searched / CELLS).saturating_sub(self.users().flatten().count())
    }

    /// Whether the ground has to be searched again in slot `slot`.
    fn begins_search(&self, count: UserCount, slot: u64) -> bool {
        let has_reason = || match count {
            UserCount::Fixed => slot >= SEARCH_AGAIN_FROM && self.unknown_users(count) > 0,
            UserCount::Listed(_) => self.unknown_users(count) > 0,
            UserCount::Unknown => true,
        };
        search::is_complete(self.ground) && has_reason()
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

/// Whether UAVs exchange memories.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sharing {
    /// Every UAV has only what it detected itself.
    Own,
    /// UAVs in communication range exchange their memories in every slot.
    Shared,
}

/// From this slot on, a UAV of a fixed fleet that has searched all ground and does not know all of N users searches the ground again: users
/// move, and a user may be out of range while the centre of its cell is in range. Training has shorter episodes.
pub const SEARCH_AGAIN_FROM: u64 = 200;

/// Buffers for the memories of a fleet, kept between slots.
#[derive(Clone, Debug, Default)]
pub struct Exchange {
    all: AllUsers,
    /// One per part of a fleet.
    nearest: Vec<NearestUsers>,
    /// The memories before the UAVs receive those of others.
    before: Vec<f32>,
}

/// Advances the memories of a fleet, one after another in `memories`, to slot `slot`. `count`: how many users there are.
pub fn remember(
    (env, sight, slot): (&EnvParams, &Sight<'_>, u64),
    (sharing, count): (Sharing, UserCount),
    memories: &mut [f32],
    exchange: &mut Exchange,
) {
    let Exchange { all, nearest, before } = exchange;
    let (len, range, outside) = (uav_memory_len(sight.users()), env.detection_range, search::cells_outside(env));
    let listed = sight.users() > MAX_REMEMBERED;
    // A user that should be detected and is not has moved away. The margin allows for rounding.
    let near = 0.99 * range;
    let part = threads::part(sight.uavs());
    nearest.resize_with(sight.uavs().div_ceil(part), NearestUsers::default);
    let parts = nearest.iter_mut().zip(memories.chunks_mut(part * len)).enumerate();
    threads::for_each(parts, |(k, (nearest, memories))| {
        for (i, memory) in (k * part..).zip(memories.chunks_exact_mut(len)) {
            if UavMemory::new(memory, sight.users()).begins_search(count, slot) {
                search::begin(slot, &mut memory[..GRID]);
            }
            let ground = &mut memory[..GRID];
            search::mark(&outside, ground);
            simd(
                #[inline(always)]
                || search::search(sight.positions[i], range, ground),
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
            let env = EnvParams { detection_range: ranges.detection, ..EnvParams::default() };
            remember((&env, &graph.sight().unwrap(), slot), (sharing, UserCount::Fixed), &mut self.memory, &mut self.exchange);
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

    /// The slot in which the search began, after slots 0 to `slot` in which all ground was in range, and one user at `user`.
    fn search_began(slot: u64, user: Point, count: UserCount) -> f64 {
        let env = EnvParams { detection_range: 2.0, ..EnvParams::default() };
        let graph = FleetGraph::from_scene(&[[0.5, 0.5]], &[user], &[1.0], RANGES);
        let mut fleet = Fleet::new(1, 1);
        for slot in 0..=slot {
            let sight = graph.sight().unwrap();
            remember((&env, &sight, slot), (Sharing::Shared, count), &mut fleet.memory, &mut fleet.exchange);
        }
        fleet.of(0).unknown_since(UserCount::Unknown)
    }

    #[test]
    fn the_ground_is_searched_again_for_users_that_are_missing_or_may_be_new() {
        let (found, missed) = ([0.5, 0.6], [0.9, 0.9]);
        let late = SEARCH_AGAIN_FROM;
        assert_eq!([late - 1, late, late + 7].map(|slot| search_began(slot, missed, UserCount::Fixed)), [0.0, 200.0, 207.0]);
        assert_eq!(search_began(late + 7, found, UserCount::Fixed), 0.0);
        for count in [UserCount::Unknown, UserCount::Listed(1)] {
            assert_eq!([0, 1, 7].map(|slot| search_began(slot, missed, count)), [0.0, 1.0, 7.0]);
        }
        assert_eq!(search_began(7, found, UserCount::Unknown), 7.0);
        assert_eq!(search_began(late + 7, found, UserCount::Listed(1)), 0.0);
    }

    #[test]
    fn unknown_users_are_the_rest_of_n_or_an_estimate() {
        let (users, at) = ([[0.5, 0.6], [0.9, 0.9], [0.1, 0.9]], [0.5, 0.5]);
        let mut fleet = Fleet::new(1, 3);
        fleet.see(0, &[at], &users, &[1.0; 3], Sharing::Own, RANGES);
        let cells: u32 = (0..GRID).map(|row| fleet.of(0).searched(row).count_ones()).sum();
        let share = f64::from(cells) / 400.0;
        assert_eq!((fleet.of(0).unknown_users(UserCount::Fixed), fleet.of(0).unknown_since(UserCount::Fixed)), (2, 0.0));
        assert_eq!(fleet.of(0).unknown_users(UserCount::Unknown), (2.0 * (1.0 - share) / share).ceil() as usize);
        search::begin(30, &mut fleet.memory[..GRID]);
        fleet.see(31, &[at], &users[..1].repeat(3), &[1.0; 3], Sharing::Own, RANGES);
        assert_eq!((fleet.of(0).unknown_users(UserCount::Fixed), fleet.of(0).unknown_users(UserCount::Unknown)), (0, 1));
        assert_eq!((fleet.of(0).unknown_since(UserCount::Fixed), fleet.of(0).unknown_since(UserCount::Unknown)), (0.0, 30.0));
        search::search(at, 2.0, &mut fleet.memory[..GRID]);
        assert_eq!(fleet.of(0).unknown_users(UserCount::Unknown), 0);
        // Two of them move away: in an open fleet, they may have left.
        fleet.see(32, &[at], &[users[0], users[1], users[1]], &[1.0; 3], Sharing::Own, RANGES);
        assert_eq!((fleet.of(0).unknown_users(UserCount::Fixed), fleet.of(0).unknown_users(UserCount::Unknown)), (2, 0));
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
