//! The goals of one UAV, quantity by quantity, so that vector units compute those of several goals at once.

use super::super::flight::{length, travel_slots};
use super::super::memory::RememberedUser;
use super::ground::Ground;
use super::{FEATURES, MAX_BLOCKS, MAX_USERS, View, ln1};
use crate::env::{DIRECTIONS, EnvConfig, Point};

/// Goals that are computed at once.
const LANES: usize = 8;
/// Vectors for the maximum number of goals of a UAV.
const VECTORS: usize = (MAX_USERS + MAX_BLOCKS).div_ceil(LANES);

/// One number per goal.
type Column = [[f64; LANES]; VECTORS];

/// First the goals of the remembered users, then those of blocks of ground.
#[derive(Clone, Debug)]
pub(super) struct Columns {
    users: usize,
    len: usize,
    x: Column,
    y: Column,
    /// Slots of flight until the goal is in range.
    slots: Column,
    /// AoI on arrival.
    age: Column,
    /// AoI on arrival per slot of flight.
    rate: Column,
    /// Of a user: the best AoI per slot that the next flight, from there, promises. Of a block: the users expected there.
    promise: Column,
    /// Of a user: the age of its last observation, as ln(1 + x). Of a block: whether it is in the UAV's own sector.
    last: Column,
    /// Of a user: slot of its last known collection.
    collected: Column,
    /// Distance from the UAV, and from the nearest other one that it detects.
    mine: Column,
    nearest: Column,
    headings: [[u8; LANES]; VECTORS],
}

impl Default for Columns {
    fn default() -> Self {
        let zeros = [[0.0; LANES]; VECTORS];
        Self {
            users: 0,
            len: 0,
            x: zeros,
            y: zeros,
            slots: zeros,
            age: zeros,
            rate: zeros,
            promise: zeros,
            last: zeros,
            collected: zeros,
            mine: zeros,
            nearest: zeros,
            headings: [[0; _]; _],
        }
    }
}

impl Columns {
    /// Takes the goals: at most [`MAX_USERS`] users, and the blocks with unsearched ground.
    pub(super) fn begin(&mut self, view: &View<'_>, users: &[RememberedUser], ground: &Ground) {
        (self.users, self.len) = (users.len(), users.len());
        let [x, y, collected, last] =
            [&mut self.x, &mut self.y, &mut self.collected, &mut self.last].map(|column| column.as_flattened_mut());
        for (g, user) in users.iter().enumerate() {
            [x[g], y[g]] = user.position;
            collected[g] = user.collected.into();
            last[g] = ln1(view.slot - f64::from(user.observed));
        }
        for block in ground.blocks() {
            (x[self.len], y[self.len]) = (ground.centers[0][block], ground.centers[1][block]);
            last[self.len] = if ground.is_owned(block, &view.sector) { 1.0 } else { 0.0 };
            self.len += 1;
        }
    }

    /// Computes all quantities. `unknown` users are expected in the ground, whose AoI grows since slot `since`; `others` are the positions
    /// of the UAVs detected.
    #[inline(always)]
    pub(super) fn compute(&mut self, view: &View<'_>, (ground, unknown, since): (&Ground, usize, f64), others: &[Point]) {
        for v in 0..self.len.div_ceil(LANES).min(VECTORS) {
            let (x, y) = (&self.x[v], &self.y[v]);
            for l in 0..LANES {
                let user = v * LANES + l < self.users;
                let range = if user { view.env.transmission_range } else { view.env.detection_range };
                self.slots[v][l] = travel_slots(view.env, view.at, [x[l], y[l]], range);
                self.mine[v][l] = length(view.at[0] - x[l], view.at[1] - y[l]);
            }
            let mut nearest = [f64::INFINITY; LANES];
            for other in others {
                for l in 0..LANES {
                    nearest[l] = nearest[l].min(length(other[0] - x[l], other[1] - y[l]));
                }
            }
            self.nearest[v] = nearest;
            self.headings[v] = headings(view, x, y);
        }
        for v in 0..self.users.div_ceil(LANES).min(VECTORS) {
            for l in 0..LANES {
                self.age[v][l] = view.slot - self.collected[v][l] + self.slots[v][l];
                self.rate[v][l] = self.age[v][l] / self.slots[v][l];
            }
        }
        for g in 0..self.users {
            self.promise[g / LANES][g % LANES] = self.next_rate(view, g);
        }
        for v in self.users / LANES..self.len.div_ceil(LANES).min(VECTORS) {
            let cells = cells_within(view.env.detection_range, ground, &self.x[v], &self.y[v]);
            for l in 0..LANES {
                if v * LANES + l >= self.users {
                    let expected = unknown as f64 * cells[l] / f64::from(ground.unsearched.max(1));
                    self.promise[v][l] = expected;
                    self.age[v][l] = view.slot - since + self.slots[v][l];
                    self.rate[v][l] = expected * self.age[v][l] / self.slots[v][l];
                }
            }
        }
    }

    /// The best AoI per slot of flight from user `g` to another user.
    #[inline(always)]
    fn next_rate(&self, view: &View<'_>, g: usize) -> f64 {
        let (v, l) = (g / LANES, g % LANES);
        let (from, slots) = ([self.x[v][l], self.y[v][l]], self.slots[v][l]);
        let mut best = [0.0_f64; LANES];
        for v in 0..self.users.div_ceil(LANES).min(VECTORS) {
            for l in 0..LANES {
                let onward = travel_slots(view.env, from, [self.x[v][l], self.y[v][l]], view.env.transmission_range);
                let rate = (view.slot - self.collected[v][l] + (slots + onward)) / onward;
                let other = v * LANES + l != g && v * LANES + l < self.users;
                best[l] = best[l].max(if other { rate } else { 0.0 });
            }
        }
        best.iter().fold(0.0, |best: f64, &rate| best.max(rate))
    }

    /// The heading of each goal.
    pub(super) fn headings(&self) -> &[u8] {
        &self.headings.as_flattened()[..self.len]
    }

    /// The features of each goal. Four are `common` to all.
    pub(super) fn features<'a>(&'a self, view: &'a View<'_>, common: [f64; 4]) -> impl Iterator<Item = [f32; FEATURES]> + 'a {
        let range = view.env.detection_range;
        let [a, b, c, d] = common;
        (0..self.len).map(move |g| {
            let (v, l) = (g / LANES, g % LANES);
            let (slots, last, mine, nearest) = (self.slots[v][l], self.last[v][l], self.mine[v][l], self.nearest[v][l]);
            let [age, rate, promise] = [&self.age, &self.rate, &self.promise].map(|column| ln1(column[v][l]));
            let flag = |is: bool| if is { 1.0 } else { 0.0 };
            // How much nearer this UAV is than the nearest other one that it detects, in units of d.
            let lead = ((nearest - mine) / range).clamp(-1.0, 1.0);
            let far = ((mine / range) - 1.0).clamp(-1.0, 1.0);
            let (user, contested, onward) = (flag(g < self.users), flag(nearest < mine), flag(self.headings[v][l] == view.last));
            [user, ln1(slots), 1.0 / slots, age, rate, promise, last, a, b, c, d, lead, contested, onward, far, 1.0]
                .map(|x| x as f32)
        })
    }
}

/// The headings toward goals, as [`super::super::flight::Headings::toward`] chooses them.
#[inline(always)]
fn headings(view: &View<'_>, x: &[f64; LANES], y: &[f64; LANES]) -> [u8; LANES] {
    let mut most = [f64::NAN; LANES];
    let mut headings = [0.0; LANES];
    for (h, direction) in DIRECTIONS.iter().enumerate().take(EnvConfig::COMPASS) {
        if view.headings.allows(h) {
            for l in 0..LANES {
                let progress = (x[l] - view.at[0]) * direction[0] + (y[l] - view.at[1]) * direction[1];
                let more = !(progress <= most[l]);
                most[l] = if more { progress } else { most[l] };
                headings[l] = if more { h as f64 } else { headings[l] };
            }
        }
    }
    headings.map(|h| h as u8)
}

/// Unsearched cells of the blocks whose centre is within `range` of each of these places.
#[inline(always)]
fn cells_within(range: f64, ground: &Ground, x: &[f64; LANES], y: &[f64; LANES]) -> [f64; LANES] {
    let square = range * range;
    let mut sums = [0.0; LANES];
    for block in 0..MAX_BLOCKS {
        let (center, cells) = ([ground.centers[0][block], ground.centers[1][block]], f64::from(ground.cells[block]));
        for l in 0..LANES {
            let (dx, dy) = (center[0] - x[l], center[1] - y[l]);
            sums[l] += if dx * dx + dy * dy <= square { cells } else { 0.0 };
        }
    }
    sums
}
