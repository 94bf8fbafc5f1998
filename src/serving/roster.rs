//! Who belongs to a fleet while its UAVs and users come and go. The memory of a fleet has a place for every member of its roster: those
//! of the last slot, in the canonical order of their ids, then those that are missing.
//!
//! A member that is missing keeps its memory, and a UAV its angle (`policy::Sector`), for a number of slots; then it is forgotten, and
//! begins afresh if it comes back. A new UAV takes the middle of the largest gap between the angles of the others, which keep theirs.
//!
//! A roster holds hashes of ids, so that the state that a caller keeps stays small. A fleet that never changes needs no roster: a session
//! makes one when it sees other ids for the first time.

use std::cmp::Reverse;
use std::collections::{BinaryHeap, HashMap};
use std::f64::consts::TAU;

use rand::RngExt;
use sha2::{Digest, Sha256};

use super::{FleetIds, ListedUsers, LoadedPolicy, MAX_NODES};
use crate::invalid::Invalid;
use crate::policy::{Carry, FleetProfile, Policy, Sector, UserCount};
use crate::rng;

/// Identifies an id.
type Key = u64;

/// The first 8 bytes of the SHA-256 of an id.
fn key(id: &str) -> Key {
    let digest = Sha256::digest(id);
    u64::from_le_bytes(digest[..8].try_into().expect("eight bytes of thirty-two"))
}

/// A UAV or a user.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Member {
    pub(super) key: Key,
    /// The last step in which it was listed.
    pub(super) seen: u64,
}

/// The angle of a UAV as a fraction of a turn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Turn {
    pub(super) numerator: u32,
    pub(super) denominator: u32,
}

/// Units of a turn in which gaps are compared, and in which new UAVs are placed.
const TURN: u64 = 1 << 32;
const NEW_TURN: u32 = 1 << 20;

impl Turn {
    fn of(i: usize, uavs: usize) -> Self {
        Self { numerator: i as u32, denominator: uavs as u32 }
    }

    fn units(self) -> u64 {
        u64::from(self.numerator) * TURN / u64::from(self.denominator)
    }

    /// In radians. Equal to the angle of [`Sector::of`] for UAV i of M.
    fn angle(self) -> f64 {
        TAU * f64::from(self.numerator) / f64::from(self.denominator)
    }
}

/// What a policy's memory holds about users.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum UserMemory {
    /// Nothing about single users.
    None,
    /// A plan for the users of this slot, which is dropped when they change; or the policy has a place for each user, so they cannot change.
    Plan,
    /// What is known of each user.
    Each,
}

impl UserMemory {
    /// What the memory of `policy` holds.
    pub fn of(policy: &LoadedPolicy) -> Self {
        let implementation = &*policy.implementation;
        if implementation.remembers_users() {
            Self::Each
        } else if policy.info.users.is_none() && implementation.memory_len(1, 1) == implementation.memory_len(1, 0) {
            Self::None
        } else {
            Self::Plan
        }
    }
}

/// The rules by which a roster changes.
#[derive(Clone, Copy, Debug)]
pub struct RosterRules<'a> {
    /// The policy of the fleet.
    pub policy: &'a LoadedPolicy,
    /// Slots after which a member that is missing is forgotten.
    pub absent_after: u64,
    /// Determines the random numbers of new members.
    pub seed: u64,
    /// Which users the step lists.
    pub listed: ListedUsers,
}

/// The members of a fleet.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Roster {
    pub(super) uavs: Vec<Member>,
    /// One per UAV; empty while UAV i of M has the angle 2 pi i / M.
    pub(super) turns: Vec<Turn>,
    /// None unless the memory has a place for each.
    pub(super) users: Vec<Member>,
    /// Whether users have come or gone, or only some may have been listed.
    pub(super) open: bool,
}

/// How the memory of a fleet changes before a slot and what the policy is told.
#[derive(Clone, Debug, PartialEq)]
pub struct FleetChange {
    /// (M, N) of the memory before the slot.
    pub before: (usize, usize),
    /// (M, N) of the memory after the slot. Those that are listed come first.
    pub after: (usize, usize),
    /// Number of UAVs that are listed.
    pub listed_uavs: usize,
    /// UAVs in both memories.
    uavs: Vec<(u32, u32)>,
    /// Users in both memories.
    users: Vec<(u32, u32)>,
    /// Seed of the memory of new members.
    seed: u64,
    /// What the policy is told.
    pub profile: FleetProfile,
}

impl Roster {
    /// The roster of a fleet whose first slot has `step` 0 and lists `fleet`. `open`: see [`Roster`].
    pub fn new(fleet: &FleetIds, step: u64, open: bool, memory: UserMemory) -> Self {
        let members = |ids: &[String]| ids.iter().map(|id| Member { key: key(id), seen: step }).collect();
        let users = if memory == UserMemory::None { Vec::new() } else { members(&fleet.users) };
        Self { uavs: members(&fleet.uavs), turns: Vec::new(), users, open }
    }

    /// (M, N) of the memory.
    pub fn size(&self) -> (usize, usize) {
        (self.uavs.len(), self.users.len())
    }

    /// Bytes that the roster takes.
    pub fn bytes(&self) -> usize {
        (self.uavs.capacity() + self.users.capacity()) * size_of::<Member>() + self.turns.capacity() * size_of::<Turn>()
    }

    /// Checks that `fleet` lists the members, where `policy` has a place for each.
    ///
    /// # Errors
    /// [`Invalid`] for the UAVs or users that it cannot accept.
    pub fn check_bound(&self, fleet: &FleetIds, policy: &LoadedPolicy) -> Result<(), Invalid> {
        let same = |members: &[Member], ids: &[String]| members.iter().map(|member| member.key).eq(ids.iter().map(|id| key(id)));
        let (uavs, users) = (policy.info.uavs.is_some(), policy.info.users.is_some());
        for (bound, what, members, ids) in [(uavs, "uavs", &self.uavs, &fleet.uavs), (users, "users", &self.users, &fleet.users)]
        {
            if bound && !same(members, ids) {
                let place = "because the network of this policy has a place for each of them";
                let expected = format!("the same {} {what} as in slot 0, {place}", members.len());
                return Err(Invalid::new(what, format!("{} {what} with other ids", ids.len()), expected));
            }
        }
        Ok(())
    }

    /// The roster after `step`, whose input lists `fleet`, and how the memory follows.
    pub fn advance(&self, fleet: &FleetIds, step: u64, rules: &RosterRules<'_>) -> (Self, FleetChange) {
        let memory = UserMemory::of(rules.policy);
        let room = MAX_NODES.saturating_sub(fleet.uavs.len() + fleet.users.len());
        // A plan is for those that are listed.
        let absent_after = if memory == UserMemory::Plan { 0 } else { rules.absent_after };
        let oldest = step.saturating_sub(absent_after);
        let uavs = Merged::new(&self.uavs, &fleet.uavs, step, oldest, room);
        let room = room - (uavs.members.len() - fleet.uavs.len());
        let mut users = match memory {
            UserMemory::None => Merged::default(),
            UserMemory::Plan | UserMemory::Each => Merged::new(&self.users, &fleet.users, step, oldest, room),
        };
        if rules.policy.implementation.check_fleet(uavs.members.len(), users.members.len()).is_err() {
            users = Merged::new(&self.users, &fleet.users, step, step, 0);
        }
        let turns = self.turns_of(&uavs);
        let stayed = users.kept.iter().filter(|(_, b)| (*b as usize) < fleet.users.len()).count();
        let other_users = stayed < fleet.users.len() || stayed < self.users.len();
        let open = self.open || (memory == UserMemory::Each && other_users);
        let count = match rules.listed {
            _ if !open => UserCount::Fixed,
            ListedUsers::All => UserCount::Listed(fleet.users.len()),
            ListedUsers::Named | ListedUsers::Detected => UserCount::Unknown,
        };
        // Those that are listed share the square among them.
        let sectors = if turns.is_empty() && uavs.members.len() == fleet.uavs.len() {
            Vec::new()
        } else {
            let turn = |i: usize| turns.get(i).copied().unwrap_or(Turn::of(i, uavs.members.len()));
            Sector::at_angles(&(0..fleet.uavs.len()).map(|i| turn(i).angle()).collect::<Vec<_>>())
        };
        let change = FleetChange {
            before: self.size(),
            after: (uavs.members.len(), users.members.len()),
            listed_uavs: fleet.uavs.len(),
            uavs: uavs.kept,
            users: users.kept,
            seed: rng::stream(rules.seed, "joined", step).random(),
            profile: FleetProfile { sectors, users: count, speeds: Vec::new() },
        };
        (Self { uavs: uavs.members, turns, users: users.members, open }, change)
    }

    /// The angles of the members `after`: those that stay keep theirs, new ones take the middles of the largest gaps. Empty if UAV i of M
    /// has the angle 2 pi i / M.
    fn turns_of(&self, after: &Merged) -> Vec<Turn> {
        let former = |i: u32| self.turns.get(i as usize).copied().unwrap_or_else(|| Turn::of(i as usize, self.uavs.len()));
        let mut turns: Vec<Option<Turn>> = vec![None; after.members.len()];
        for &(a, b) in &after.kept {
            turns[b as usize] = Some(former(a));
        }
        let mut taken: Vec<u64> = turns.iter().flatten().map(|turn| turn.units()).collect();
        if taken.is_empty() {
            return Vec::new();
        }
        taken.sort_unstable();
        let ends = taken.iter().skip(1).copied().chain([taken[0] + TURN]);
        let mut gaps: BinaryHeap<(u64, Reverse<u64>)> =
            taken.iter().zip(ends).map(|(&start, end)| (end - start, Reverse(start))).collect();
        for turn in turns.iter_mut().filter(|turn| turn.is_none()) {
            let Some((gap, Reverse(start))) = gaps.pop() else { break };
            let middle = (start + gap / 2) % TURN * u64::from(NEW_TURN) / TURN;
            gaps.push((gap / 2, Reverse(start)));
            gaps.push((gap - gap / 2, Reverse(start + gap / 2)));
            *turn = Some(Turn { numerator: middle as u32, denominator: NEW_TURN });
        }
        let turns: Vec<Turn> = turns.into_iter().map(|turn| turn.unwrap_or(Turn::of(0, 1))).collect();
        let regular = turns.iter().enumerate().all(|(i, turn)| *turn == Turn::of(i, turns.len()));
        if regular { Vec::new() } else { turns }
    }
}

/// Members that are listed, then those that are remembered.
#[derive(Default)]
struct Merged {
    members: Vec<Member>,
    /// Indices before and after of those that stay.
    kept: Vec<(u32, u32)>,
}

impl Merged {
    /// `room`: maximum number of members that are missing; those that were seen last stay.
    fn new(before: &[Member], listed: &[String], step: u64, oldest: u64, room: usize) -> Self {
        let keys: Vec<Key> = listed.iter().map(|id| key(id)).collect();
        if before.iter().map(|member| member.key).eq(keys.iter().copied()) {
            let members = keys.into_iter().map(|key| Member { key, seen: step }).collect();
            return Self { members, kept: (0..listed.len() as u32).map(|i| (i, i)).collect() };
        }
        let mut places: HashMap<Key, u32> = before.iter().zip(0..).map(|(member, i)| (member.key, i)).collect();
        let mut merged = Self { members: Vec::with_capacity(listed.len()), kept: Vec::with_capacity(listed.len()) };
        for (key, i) in keys.into_iter().zip(0..) {
            merged.members.push(Member { key, seen: step });
            merged.kept.extend(places.remove(&key).map(|former| (former, i)));
        }
        let mut missing: Vec<u32> = places.into_values().filter(|&i| before[i as usize].seen >= oldest).collect();
        missing.sort_unstable_by_key(|&i| (Reverse(before[i as usize].seen), i));
        missing.truncate(room);
        missing.sort_unstable();
        for i in missing {
            merged.kept.push((i, merged.members.len() as u32));
            merged.members.push(before[i as usize]);
        }
        merged
    }
}

impl FleetChange {
    /// (M, N) of the memory that the policy works on.
    pub fn working_size(&self) -> (usize, usize) {
        (self.listed_uavs, self.after.1)
    }

    /// The memory before the slot, `numbers`, as the memory that the policy works on, and the memory of all members if that differs.
    pub fn apply(&self, policy: &dyn Policy, numbers: Vec<f32>) -> (Vec<f32>, Option<Vec<f32>>) {
        let identity = |pairs: &[(u32, u32)], count: usize| pairs.len() == count && pairs.iter().all(|(a, b)| a == b);
        let same = self.before == self.after && identity(&self.uavs, self.after.0) && identity(&self.users, self.after.1);
        let all = if same {
            numbers
        } else {
            let mut all = fresh(policy, self.after, self.seed);
            let carry = Carry { from: self.before, to: self.after, uavs: &self.uavs, users: &self.users };
            policy.carry(&numbers, &mut all, &carry);
            all
        };
        if self.listed_uavs == self.after.0 {
            return (all, None);
        }
        let mut working = fresh(policy, self.working_size(), self.seed);
        self.carry_listed(policy, (&all, self.after), (&mut working, self.working_size()));
        (working, Some(all))
    }

    /// Writes the memory `working` after the slot back to that of all members.
    pub fn restore(&self, policy: &dyn Policy, working: &[f32], all: &mut [f32]) {
        self.carry_listed(policy, (working, self.working_size()), (all, self.after));
    }

    fn carry_listed(&self, policy: &dyn Policy, from: (&[f32], (usize, usize)), to: (&mut [f32], (usize, usize))) {
        let same = |count: usize| -> Vec<(u32, u32)> { (0..count as u32).map(|i| (i, i)).collect() };
        let (uavs, users) = (same(self.listed_uavs), same(self.after.1));
        policy.carry(from.0, to.0, &Carry { from: from.1, to: to.1, uavs: &uavs, users: &users });
    }
}

/// The memory of slot 0.
fn fresh(policy: &dyn Policy, (uavs, users): (usize, usize), seed: u64) -> Vec<f32> {
    let mut numbers = vec![0.0; policy.memory_len(uavs, users)];
    policy.start(uavs, users, seed, &mut numbers);
    numbers
}
