//! Flying to a point in steps of v along eight headings. Lengths are in units of the square's side.

use super::EnvParams;
use crate::env::{DIRECTIONS, EnvConfig, Point};

pub(super) fn distance(a: Point, b: Point) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// Where heading `h` leads from `from`, not held back by the border.
pub(super) fn moved(world: &EnvParams, from: Point, h: usize) -> Point {
    [from[0] + world.speed * DIRECTIONS[h][0], from[1] + world.speed * DIRECTIONS[h][1]]
}

pub(super) fn inside(p: Point) -> bool {
    p.iter().all(|x| (0.0..=1.0).contains(x))
}

/// The heading that ends nearest to `to`, without leaving the square where that can be helped; the lowest of equals.
pub(super) fn heading_toward(world: &EnvParams, from: Point, to: Point) -> u8 {
    let cost = |h: usize| {
        let end = moved(world, from, h);
        (!inside(end), distance(end, to))
    };
    let best = (0..EnvConfig::COMPASS).map(|h| (cost(h), h)).min_by(|(a, _), (b, _)| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
    best.map_or(0, |(_, h)| h as u8)
}

/// Slots of flight from `from` until `to` is within `range`, at least 1: the length of a path along the eight headings.
pub(super) fn travel_slots(world: &EnvParams, from: Point, to: Point, range: f64) -> f64 {
    let (dx, dy) = ((to[0] - from[0]).abs(), (to[1] - from[1]).abs());
    let path = dx.max(dy) + (std::f64::consts::SQRT_2 - 1.0) * dx.min(dy);
    ((path - range) / world.speed.max(1e-9)).ceil().max(1.0)
}
