//! Memories of fleets with more than [`MAX_REMEMBERED`] users. A UAV then remembers the users nearest to it, of those that it knows.
//!
//! Encoding: at most [`MAX_REMEMBERED`] entries in ascending order of user, then zeros. The state of an entry is 1 + the index of the
//! user, and negative for a user that has gone.

use super::{GRID, KNOWN, MAX_REMEMBERED, UNKNOWN, USER, search, uav_memory_len};
use crate::env::Point;
use crate::policy::Sight;

type Entry = [f32; USER];

/// The user of an entry.
fn user(entry: &Entry) -> usize {
    entry[0].abs() as usize - 1
}

/// The entries of one UAV. A caller may have sent the memory, so places without an entry can be anywhere.
fn entries(memory: &[f32], users: usize) -> impl Iterator<Item = Entry> {
    let (entries, _) = memory[GRID..].as_chunks();
    entries.iter().copied().filter(move |entry: &Entry| entry[0].abs() >= 1.0 && entry[0].abs() < (users + 1) as f32)
}

/// Writes at most [`MAX_REMEMBERED`] entries, in ascending order of user, to the memory of one UAV.
fn write<'a>(memory: &mut [f32], entries: impl ExactSizeIterator<Item = &'a Entry>) {
    let (own, rest) = memory[GRID..].split_at_mut(USER * entries.len());
    own.as_chunks_mut().0.iter_mut().zip(entries).for_each(|(own, entry)| *own = *entry);
    rest.fill(0.0);
}

/// Copies entries to the memories of another fleet, if one of both fleets has more than [`MAX_REMEMBERED`] users.
pub(super) struct Carrier {
    /// N before and after.
    users: (usize, usize),
    /// For each user before, 1 + its index after; 0 if it is not carried.
    after: Vec<u32>,
    /// For each user after, whether its entry is replaced.
    replaced: Vec<bool>,
}

impl Carrier {
    /// `pairs`: indices of users before and after.
    pub(super) fn new(users: (usize, usize), pairs: &[(u32, u32)]) -> Self {
        let (mut after, mut replaced) = (vec![0; users.0], vec![false; users.1]);
        for &(a, b) in pairs {
            after[a as usize] = b + 1;
            replaced[b as usize] = true;
        }
        Self { users, after, replaced }
    }

    /// Copies the entries of one UAV. If there is too little room, those that were observed last are kept.
    pub(super) fn carry(&self, from: &[f32], to: &mut [f32]) {
        let mut kept: Vec<Entry> = list(to, self.users.1).filter(|entry| !self.replaced[user(entry)]).collect();
        kept.extend(list(from, self.users.0).filter_map(|mut entry| {
            let after = self.after[user(&entry)] as f32;
            entry[0] = after.copysign(entry[0]);
            (after > 0.0).then_some(entry)
        }));
        if self.users.1 > MAX_REMEMBERED {
            if kept.len() > MAX_REMEMBERED {
                kept.select_nth_unstable_by(MAX_REMEMBERED, |a, b| b[4].total_cmp(&a[4]).then_with(|| user(a).cmp(&user(b))));
                kept.truncate(MAX_REMEMBERED);
            }
            kept.sort_unstable_by_key(user);
            write(to, kept.iter());
            return;
        }
        to[GRID..].fill(0.0);
        for entry in kept {
            let state = if entry[0] > 0.0 { KNOWN } else { UNKNOWN };
            to[GRID + USER * user(&entry)..][..USER].copy_from_slice(&[state, entry[1], entry[2], entry[3], entry[4]]);
        }
    }
}

/// The entries of one UAV in a fleet of any size.
fn list(memory: &[f32], users: usize) -> Box<dyn Iterator<Item = Entry> + '_> {
    if users > MAX_REMEMBERED {
        return Box::new(entries(memory, users));
    }
    let (all, _) = memory[GRID..].as_chunks();
    Box::new(all.iter().enumerate().filter(|(_, entry)| **entry != [0.0; USER]).map(
        |(j, &[state, x, y, collected, observed])| {
            let state = if state > UNKNOWN { (1 + j) as f32 } else { -((1 + j) as f32) };
            [state, x, y, collected, observed]
        },
    ))
}

/// The entries of one UAV while they change, in any order; kept between slots for its buffers.
#[derive(Clone, Debug, Default)]
pub(super) struct NearestUsers {
    entries: Vec<Entry>,
    /// For each user, 1 + the place of its entry; 0 without an entry.
    places: Vec<u32>,
    /// The entries from which the nearest are chosen.
    kept: Vec<Kept>,
}

/// An entry of which it is decided whether it is kept: first those that are near, then those of a small index.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Kept {
    apart: u64,
    user: u32,
    /// In the list of entries.
    place: u32,
}

impl NearestUsers {
    /// Writes what UAV `i` detects into its memory. Users remembered within `near` that it does not detect have gone.
    pub(super) fn observe(&mut self, sight: &Sight<'_>, i: usize, near: f64, slot: f32, memory: &mut [f32]) {
        let (at, near) = (sight.positions[i], near.powi(2).to_bits());
        self.add(memory, sight.users());
        for entry in self.entries.iter_mut().filter(|entry| entry[0] > 0.0 && apart(entry, at) < near) {
            (entry[0], entry[4]) = (-entry[0], slot);
        }
        for (j, [x, y]) in sight.detected_users(i) {
            self.set([(1 + j) as f32, x as f32, y as f32, slot - sight.aoi[j], slot]);
        }
        self.keep_nearest(at, memory);
    }

    /// Lets UAV `i` receive the memories of the UAVs that it detects, from `before`, the memories of all. Of two entries for a user, the
    /// newer one wins.
    pub(super) fn receive(&mut self, sight: &Sight<'_>, i: usize, before: &[f32], memory: &mut [f32]) {
        let len = uav_memory_len(sight.users());
        self.add(memory, sight.users());
        for (j, _) in sight.detected_uavs(i) {
            let other = &before[j * len..][..len];
            search::merge(&other[..GRID], &mut memory[..GRID]);
            self.add(other, sight.users());
        }
        self.keep_nearest(sight.positions[i], memory);
    }

    /// Adds the entries of a memory, except those that are not newer than the entry of the same user.
    fn add(&mut self, memory: &[f32], users: usize) {
        self.places.resize(users, 0);
        for entry in entries(memory, users) {
            let place = self.places[user(&entry)] as usize;
            if place == 0 || entry[4] > self.entries[place - 1][4] {
                self.set(entry);
            }
        }
    }

    /// Adds an entry. It replaces the entry of the same user.
    fn set(&mut self, entry: Entry) {
        let place = &mut self.places[user(&entry)];
        if *place == 0 {
            self.entries.push(entry);
            *place = self.entries.len() as u32;
        } else {
            self.entries[*place as usize - 1] = entry;
        }
    }

    /// Moves the entries nearest to `at` to the memory of a UAV.
    fn keep_nearest(&mut self, at: Point, memory: &mut [f32]) {
        self.entries.iter().for_each(|entry| self.places[user(entry)] = 0);
        self.kept.clear();
        self.kept.extend(self.entries.iter().zip(0..).map(|(entry, place)| Kept {
            apart: apart(entry, at),
            user: user(entry) as u32,
            place,
        }));
        if self.kept.len() > MAX_REMEMBERED {
            self.kept.select_nth_unstable(MAX_REMEMBERED);
            self.kept.truncate(MAX_REMEMBERED);
        }
        self.kept.sort_unstable_by_key(|kept| kept.user);
        write(memory, self.kept.iter().map(|kept| &self.entries[kept.place as usize]));
        self.entries.clear();
    }
}

/// The squared distance of an entry from a point, as an integer of the same order.
fn apart(entry: &Entry, at: Point) -> u64 {
    ((f64::from(entry[1]) - at[0]).powi(2) + (f64::from(entry[2]) - at[1]).powi(2)).to_bits()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use rand::RngExt;

    use super::super::{Exchange, Sharing, carry, memories, remember};
    use super::*;
    use crate::env::Ranges;
    use crate::policy::{Carry, EnvParams, FleetGraph, UserCount};

    /// What a UAV knows, as docs/model.md defines it: for each user its entry, of which the first number is 1 if the user is there.
    type Known = BTreeMap<usize, Entry>;

    fn nearest(known: Known, at: Point) -> Known {
        let mut all: Vec<_> = known.into_iter().collect();
        let apart = |entry: &Entry| (f64::from(entry[1]) - at[0]).hypot(f64::from(entry[2]) - at[1]);
        all.sort_by(|a, b| apart(&a.1).total_cmp(&apart(&b.1)).then(a.0.cmp(&b.0)));
        all.into_iter().take(MAX_REMEMBERED).collect()
    }

    fn next_slot(sight: &Sight<'_>, range: f64, slot: f32, fleet: &[Known]) -> Vec<Known> {
        let observed: Vec<Known> = fleet
            .iter()
            .enumerate()
            .map(|(i, known)| {
                let at = sight.positions[i];
                let mut known = known.clone();
                for entry in known.values_mut() {
                    let apart = (f64::from(entry[1]) - at[0]).hypot(f64::from(entry[2]) - at[1]);
                    if entry[0] == 1.0 && apart < 0.99 * range {
                        (entry[0], entry[4]) = (0.0, slot);
                    }
                }
                for (j, [x, y]) in sight.detected_users(i) {
                    known.insert(j, [1.0, x as f32, y as f32, slot - sight.aoi[j], slot]);
                }
                nearest(known, at)
            })
            .collect();
        let merged = |i: usize| {
            let mut known = observed[i].clone();
            for (j, _) in sight.detected_uavs(i) {
                for (&user, &entry) in &observed[j] {
                    let own = known.entry(user).or_insert(entry);
                    if entry[4] > own[4] {
                        *own = entry;
                    }
                }
            }
            nearest(known, sight.positions[i])
        };
        (0..fleet.len()).map(merged).collect()
    }

    fn known(memory: &[f32], users: usize) -> Known {
        entries(memory, users)
            .map(|entry| (user(&entry), [f32::from(u8::from(entry[0] > 0.0)), entry[1], entry[2], entry[3], entry[4]]))
            .collect()
    }

    #[test]
    fn the_nearest_known_users_are_remembered_and_news_pass_links() {
        let (uavs, users, ranges) = (4, 1000, Ranges { detection: 0.2, communication: 0.4 });
        let env = EnvParams { detection_range: ranges.detection, ..EnvParams::default() };
        let len = uav_memory_len(users);
        let mut rng = crate::rng::stream(3, "nearest", 0);
        let mut place = |count: usize| -> Vec<Point> { (0..count).map(|_| [rng.random(), rng.random()]).collect() };
        let mut memory = vec![0.0; uavs * len];
        let mut expected = vec![Known::new(); uavs];
        let mut exchange = Exchange::default();
        let mut at = place(users);
        let (mut gone, mut full) = (0, 0);
        for slot in 1..12_u64 {
            // Some users move away, so that others find them gone.
            let moved = place(50);
            at[slot as usize * 50..][..50].copy_from_slice(&moved);
            let aoi: Vec<f32> = (0..users).map(|j| (j % 7) as f32).collect();
            let graph = FleetGraph::from_scene(&place(uavs), &at, &aoi, ranges);
            let sight = graph.sight().unwrap();
            remember((&env, &sight, slot), (Sharing::Shared, UserCount::Fixed), &mut memory, &mut exchange);
            expected = next_slot(&sight, ranges.detection, slot as f32, &expected);
            for (memory, expected) in memory.chunks_exact(len).zip(&expected) {
                assert_eq!(&known(memory, users), expected, "slot {slot}");
                let listed: Vec<usize> = entries(memory, users).map(|entry| user(&entry)).collect();
                assert!(listed.is_sorted());
                gone += expected.values().filter(|entry| entry[0] == 0.0).count();
                full += usize::from(expected.len() == MAX_REMEMBERED);
            }
        }
        assert!(gone > 0 && full > 0, "{gone} entries of users that have gone, {full} full memories");
        for uav in memories(&memory, users) {
            assert_eq!(uav.users().flatten().count() + uav.users_left_out() + uav.unknown_users(UserCount::Fixed), users);
        }
    }

    #[test]
    fn entries_are_carried_to_fleets_with_fewer_and_with_more_users() {
        let user = |j: usize, seen: f32| [(1 + j) as f32, 0.5, j as f32 / 1024.0, 3.0, seen];
        let (large, small) = ((1, 1000), (2, 3));
        let mut from = vec![0.0; uav_memory_len(large.1)];
        write(&mut from, [user(7, 4.0), user(700, 5.0), user(900, 6.0)].iter());
        from[0] = 5.0;
        let mut to = vec![0.0; 2 * uav_memory_len(small.1)];
        carry(&from, &mut to, &Carry { from: large, to: small, uavs: &[(0, 1)], users: &[(900, 0), (3, 1), (7, 2)] });
        let uav = memories(&to, small.1).nth(1).unwrap();
        assert_eq!(uav.searched(0), 5);
        let seen: Vec<_> = uav.users().map(|user| user.map(|user| user.observed)).collect();
        assert_eq!(seen, [Some(6.0), None, Some(4.0)]);
        // And back, to a memory that has another user and knows that one of these has gone.
        let mut back = vec![0.0; uav_memory_len(large.1)];
        write(&mut back, [user(1, 2.0), user(5, 2.0), [-801.0, 0.0, 0.0, 1.0, 2.0]].iter());
        carry(&to, &mut back, &Carry { from: small, to: large, uavs: &[(1, 0)], users: &[(0, 800), (1, 5), (2, 2)] });
        let back: Vec<_> = entries(&back, large.1).map(|entry| (entry[0], entry[4])).collect();
        assert_eq!(back, [(2.0, 2.0), (3.0, 4.0), (801.0, 6.0)]);
    }

    #[test]
    fn any_numbers_are_a_memory() {
        let mut rng = crate::rng::stream(4, "nearest", 0);
        let (users, env) = (300, EnvParams { detection_range: 0.5, ..EnvParams::default() });
        for _ in 0..50 {
            let mut number =
                || [f32::NAN, f32::INFINITY, -1e30, -301.0, 0.5, 1.5, 300.9, 301.0, 0.0, 7.0][rng.random_range(0..10)];
            let mut memory: Vec<f32> = (0..2 * uav_memory_len(users)).map(|_| number()).collect();
            let graph = FleetGraph::from_scene(&[[0.5; 2]; 2], &vec![[0.6; 2]; users], &vec![1.0; users], 0.5);
            remember(
                (&env, &graph.sight().unwrap(), 9),
                (Sharing::Shared, UserCount::Fixed),
                &mut memory,
                &mut Exchange::default(),
            );
            for uav in memories(&memory, users) {
                uav.unknown_users(UserCount::Unknown);
                assert_eq!(uav.users().flatten().count(), MAX_REMEMBERED, "all are detected");
            }
        }
    }
}
