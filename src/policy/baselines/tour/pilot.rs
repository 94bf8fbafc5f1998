//! How a UAV flies a tour, and the path that results.
//!
//! The pilot flies to the next user of the tour on a shortest path along the eight headings. Of several shortest paths it takes
//! the one that ends nearest to the user after the next. A user is reached as soon as it is in range.

use crate::env::{EnvConfig, Point};
use crate::policy::EnvParams;
use crate::policy::flight::{distance, next_position};

/// A fleet, its users, and the number of slots to plan for.
#[derive(Clone, Copy)]
pub struct Problem<'a> {
    pub env: &'a EnvParams,
    pub uavs: &'a [Point],
    pub users: &'a [Point],
    pub aoi: &'a [f32],
    pub slots: usize,
}

/// A cyclic tour and the index of the next user in it.
#[derive(Clone, Debug)]
pub struct TourState {
    pub tour: Vec<u32>,
    pub next: usize,
}

/// The pilot uses slightly less than the transmission range, because positions are rounded to f32.
const MARGIN: f64 = 1.0 - 1e-6;

/// Chooses headings along a tour.
pub struct Pilot<'a> {
    env: &'a EnvParams,
    range: f64,
}

impl<'a> Pilot<'a> {
    pub fn new(env: &'a EnvParams) -> Self {
        Self { env, range: env.transmission_range * MARGIN }
    }

    /// Skips the users of the tour that are in range of `at`, and returns the heading to the next one.
    pub fn heading(&self, state: &mut TourState, at: Point, users: &[Point]) -> usize {
        let user = |i: usize| users[state.tour[i % state.tour.len()] as usize];
        if state.tour.is_empty() {
            return self.toward(at, [0.5, 0.5], [0.5, 0.5]);
        }
        for _ in 0..state.tour.len() {
            if distance(at, user(state.next)) > self.range {
                break;
            }
            state.next = (state.next + 1) % state.tour.len();
        }
        self.toward(at, user(state.next), user(state.next + 1))
    }

    /// The heading on a shortest path to the range of `to` that ends nearest to `after`. Of equal headings, the lowest.
    fn toward(&self, at: Point, to: Point, after: Point) -> usize {
        let mut best = (true, f64::INFINITY, f64::INFINITY, 0);
        for h in 0..EnvConfig::COMPASS {
            let end = next_position(self.env, at, h);
            let beyond = (end[0] - after[0]).powi(2) + (end[1] - after[1]).powi(2);
            let cost = (!self.env.contains(end), self.slots(end, to), beyond);
            if cost < (best.0, best.1, best.2) {
                best = (cost.0, cost.1, cost.2, h);
            }
        }
        best.3
    }

    /// Slots of flight along the eight headings until `to` is in range; 0 if it is in range. This is the distance to a disc in
    /// the norm whose unit ball is the regular octagon, maximised over the normals (1, s) of its sides and corners.
    fn slots(&self, at: Point, to: Point) -> f64 {
        /// tan and sin of 22.5 degrees.
        const SLOPE: f64 = std::f64::consts::SQRT_2 - 1.0;
        const SINE: f64 = 0.382_683_432_365_089_8;
        let (dx, dy) = ((to[0] - at[0]).abs(), (to[1] - at[1]).abs());
        let (along, across) = if dx > dy { (dx, dy) } else { (dy, dx) };
        let r = self.range;
        let gap = if across < SINE * r {
            along - (r * r - across * across).sqrt()
        } else {
            along + SLOPE * across - r * (1.0 + SLOPE * SLOPE).sqrt()
        };
        // Up to rounding, the UAV is in range if the gap is not positive.
        if gap <= 0.0 && dx * dx + dy * dy <= r * r { 0.0 } else { (gap / self.env.speed.max(1e-9)).ceil().max(1.0) }
    }

    /// Position of UAV `uav` after each slot of flying `tour`.
    pub fn path(&self, problem: &Problem<'a>, uav: usize, tour: Vec<u32>) -> impl Iterator<Item = Point> {
        let (mut at, mut state, users) = (problem.uavs[uav], TourState { tour, next: 0 }, problem.users);
        (0..problem.slots).map(move |_| {
            at = next_position(self.env, at, self.heading(&mut state, at, users));
            at
        })
    }

    /// Whether a UAV at `at` collects the data of `user`.
    pub fn collects(&self, at: Point, user: Point) -> bool {
        (at[0] - user[0]).powi(2) + (at[1] - user[1]).powi(2) <= self.range * self.range
    }
}
