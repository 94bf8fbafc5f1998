//! Detections between users, where a graph has only those of UAVs.

use std::ops::Range;
use std::sync::atomic::{AtomicUsize, Ordering};

use super::fleet_input::{MAX_DETECTIONS, ReportedDetection, ReportedGraph, is_within, too_many_detections};
use crate::env::Point;
use crate::invalid::Invalid;
use crate::policy::Detection;
use crate::threads;

impl ReportedGraph {
    /// Derives detections between users for users whose detections the request leaves out. If UAV i detects users j and k,
    /// then j detects k at `rel_ik - rel_ij`, provided that this is within the range; if several UAVs detect both, the first
    /// one in canonical order determines the coordinates. Returns one unsorted list per user.
    ///
    /// Example: UAV 0 detects users 1 and 2 at (0.1, 0) and (0.3, 0). With a range of 0.25, user 1 detects user 2 at (0.2, 0),
    /// and user 2 detects user 1 at (-0.2, 0).
    pub(super) fn derive_user_detections(&self, range: f64) -> Result<Vec<Vec<Detection>>, Invalid> {
        let (uavs, users) = (self.positions.len(), self.aoi.len());
        let total = AtomicUsize::new(self.detections.iter().map(Vec::len).sum());
        let check = || if total.load(Ordering::Relaxed) > MAX_DETECTIONS { Err(too_many_detections("graph")) } else { Ok(()) };
        check()?;
        let mut derived = vec![Vec::new(); users];
        if !self.without_detections.contains(&true) {
            return Ok(derived);
        }
        // Bit set of the users without detections.
        let mut all_without = vec![0_u64; users.div_ceil(64)];
        for j in (0..users).filter(|&j| self.without_detections[j]) {
            all_without[j / 64] |= 1 << (j % 64);
        }
        let by_uav: Vec<DetectedUsers> =
            self.detections[..uavs].iter().map(|list| DetectedUsers::new(list, uavs, users)).collect();
        let part = threads::part(users);
        let mut parts = vec![Vec::new(); users.div_ceil(part)];
        threads::for_each(parts.iter_mut().enumerate(), |(k, pairs)| {
            self.derive_pairs(k * part..users.min((k + 1) * part), (&all_without, &by_uav), (range, &total), pairs);
        });
        check()?;
        let node = |user: u32| uavs as u32 + user;
        for UserPair { users: [j, k], rel } in parts.into_iter().flatten() {
            derived[j as usize].push(Detection { target: node(k), rel });
            derived[k as usize].push(Detection { target: node(j), rel: rel.map(|x| 0.0 - x) });
        }
        Ok(derived)
    }

    /// Adds the pairs of users of which the first, among `first_users`, is one without detections. A pair of two such users is found
    /// once, for the first of the two. Stops when `total`, the number of detections, is more than [`MAX_DETECTIONS`].
    fn derive_pairs(
        &self,
        first_users: Range<usize>,
        (all_without, by_uav): (&[u64], &[DetectedUsers]),
        (range, total): (f64, &AtomicUsize),
        pairs: &mut Vec<UserPair>,
    ) {
        let (uavs, users) = (self.positions.len(), self.aoi.len());
        // Bit sets of users, for each user j: those that need not be examined, and those that j detects.
        let mut skip = vec![0_u64; users.div_ceil(64)];
        let mut detected = vec![0_u64; skip.len()];
        let mut rels = vec![[0.0_f32; 2]; users];
        for j in first_users.filter(|&j| self.without_detections[j]) {
            let reported = &self.detections[uavs + j];
            skip.fill(0);
            detected.fill(0);
            let others = reported.iter().filter_map(|d| (d.target as usize).checked_sub(uavs));
            for user in others.chain([j]) {
                skip[user / 64] |= 1 << (user % 64);
            }
            for (skip, all_without) in skip.iter_mut().zip(&all_without[..j / 64]) {
                *skip |= all_without;
            }
            skip[j / 64] |= all_without[j / 64] & ((1 << (j % 64)) - 1);
            for to_uav in reported.iter().take_while(|d| (d.target as usize) < uavs) {
                let DetectedUsers { bits, first, rel: list } = &by_uav[to_uav.target as usize];
                for (word, (skip, &bits)) in skip.iter_mut().zip(bits).enumerate() {
                    // A pair of users that several UAVs detect is examined once.
                    let mut candidates = bits & !*skip;
                    *skip |= bits;
                    while candidates != 0 {
                        let bit = candidates.trailing_zeros();
                        candidates &= candidates - 1;
                        let index = first[word] as usize + (bits & ((1 << bit) - 1)).count_ones() as usize;
                        let rel = [list[index][0] + to_uav.rel[0], list[index][1] + to_uav.rel[1]];
                        detected[word] |= u64::from(is_within(&rel, range)) << bit;
                        rels[word * 64 + bit as usize] = rel.map(|x| x as f32);
                    }
                }
            }
            let before = pairs.len();
            for (word, &detected) in detected.iter().enumerate() {
                let mut rest = detected;
                while rest != 0 {
                    let k = word * 64 + rest.trailing_zeros() as usize;
                    rest &= rest - 1;
                    pairs.push(UserPair { users: [j as u32, k as u32], rel: rels[k] });
                }
            }
            let added = 2 * (pairs.len() - before);
            if total.fetch_add(added, Ordering::Relaxed) + added > MAX_DETECTIONS {
                return;
            }
        }
    }
}

/// Two users that detect each other.
#[derive(Clone, Copy, Debug)]
struct UserPair {
    users: [u32; 2],
    /// Position of the second, relative to the first.
    rel: [f32; 2],
}

/// The users that one UAV detects, as a bit set with coordinates.
struct DetectedUsers {
    /// One bit per user of the fleet.
    bits: Vec<u64>,
    /// For each word of `bits`, the index in `rel` of its first user.
    first: Vec<u32>,
    /// Relative coordinates of the detected users, in ascending order of user.
    rel: Vec<Point>,
}

impl DetectedUsers {
    fn new(list: &[ReportedDetection], uavs: usize, users: usize) -> Self {
        let words = users.div_ceil(64);
        let mut detected = Self { bits: vec![0; words], first: vec![0; words], rel: Vec::new() };
        for detection in list {
            let Some(user) = (detection.target as usize).checked_sub(uavs) else { continue };
            let bits = &mut detected.bits[user / 64];
            if *bits == 0 {
                detected.first[user / 64] = detected.rel.len() as u32;
            }
            *bits |= 1 << (user % 64);
            detected.rel.push(detection.rel);
        }
        detected
    }
}
