//! How a tour is flown, and what comes of it: the pilot, and where it leads.
//!
//! The pilot flies to the next user of its tour by a shortest path along the eight headings, and of the shortest ones takes
//! that which comes nearest to the user after. A user is reached as soon as it is in range, so discs are toured, not points.

use super::super::EnvParams;
use super::super::geometry::{distance, inside, moved};
use crate::env::{EnvConfig, Point};

/// A fleet among users, and the number of slots to plan for.
#[derive(Clone, Copy)]
pub struct Scene<'a> {
    pub world: &'a EnvParams,
    pub uavs: &'a [Point],
    pub users: &'a [Point],
    pub aoi: &'a [f32],
    pub slots: usize,
}

/// A tour, flown round and round, and the place in it.
#[derive(Clone, Debug)]
pub struct Leg {
    pub tour: Vec<u32>,
    pub next: usize,
}

/// The part of the range that a pilot counts on: positions are rounded to f32 as they are flown.
const SURE: f64 = 1.0 - 1e-6;

/// The pilot.
pub struct Pilot<'a> {
    world: &'a EnvParams,
    range: f64,
}

impl<'a> Pilot<'a> {
    pub fn new(world: &'a EnvParams) -> Self {
        Self { world, range: world.transmission_range * SURE }
    }

    /// Passes over the users of the tour that are in range of `at` now, and steers to the next one.
    pub fn heading(&self, leg: &mut Leg, at: Point, users: &[Point]) -> usize {
        let user = |i: usize| users[leg.tour[i % leg.tour.len()] as usize];
        if leg.tour.is_empty() {
            return self.toward(at, [0.5, 0.5], [0.5, 0.5]);
        }
        for _ in 0..leg.tour.len() {
            if distance(at, user(leg.next)) > self.range {
                break;
            }
            leg.next = (leg.next + 1) % leg.tour.len();
        }
        self.toward(at, user(leg.next), user(leg.next + 1))
    }

    /// The heading on a shortest way to the disc around `to` that ends nearest to `after`; the lowest of equals.
    fn toward(&self, at: Point, to: Point, after: Point) -> usize {
        let mut best = (true, f64::INFINITY, f64::INFINITY, 0);
        for h in 0..EnvConfig::COMPASS {
            let end = moved(self.world, at, h);
            let beyond = (end[0] - after[0]).powi(2) + (end[1] - after[1]).powi(2);
            let cost = (!inside(end), self.slots(end, to), beyond);
            if cost < (best.0, best.1, best.2) {
                best = (cost.0, cost.1, cost.2, h);
            }
        }
        best.3
    }

    /// Slots of flight along the eight headings until `to` is in range, 0 where it is: the distance to a disc in the norm
    /// whose unit ball is the octagon, maximised over the normals (1, s) of its sides and corners.
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
        // Where both bounds are below 0 the UAV is in range or within rounding of it.
        if gap <= 0.0 && dx * dx + dy * dy <= r * r { 0.0 } else { (gap / self.world.speed.max(1e-9)).ceil().max(1.0) }
    }

    /// Where UAV `uav` of the scene is after each slot of flying round `tour`.
    pub fn path(&self, scene: &Scene<'a>, uav: usize, tour: Vec<u32>) -> impl Iterator<Item = Point> {
        let (mut at, mut leg, users) = (scene.uavs[uav], Leg { tour, next: 0 }, scene.users);
        (0..scene.slots).map(move |_| {
            at = moved(self.world, at, self.heading(&mut leg, at, users));
            at
        })
    }

    /// Whether data is collected from `user` by a UAV at `at`.
    pub fn collects(&self, at: Point, user: Point) -> bool {
        (at[0] - user[0]).powi(2) + (at[1] - user[1]).powi(2) <= self.range * self.range
    }
}
