//! Flight along the eight headings, v per slot. Lengths are in units of the square's side.

use crate::env::{DIRECTIONS, EnvConfig, Point};
use crate::policy::EnvParams;

pub(super) fn distance(a: Point, b: Point) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// Position after one slot on heading `h`, without the boundary rule.
pub(super) fn next_position(env: &EnvParams, from: Point, h: usize) -> Point {
    [from[0] + env.speed * DIRECTIONS[h][0], from[1] + env.speed * DIRECTIONS[h][1]]
}

/// Whether `p` is in the unit square.
pub(super) fn in_square(p: Point) -> bool {
    p.iter().all(|x| (0.0..=1.0).contains(x))
}

/// The heading that ends nearest to `to`; headings that leave the square only if all do. Of equal headings, the lowest.
pub(super) fn heading_toward(env: &EnvParams, from: Point, to: Point) -> u8 {
    let cost = |h: usize| {
        let end = next_position(env, from, h);
        (!in_square(end), distance(end, to))
    };
    let best = (0..EnvConfig::COMPASS).map(|h| (cost(h), h)).min_by(|(a, _), (b, _)| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
    best.map_or(0, |(_, h)| h as u8)
}

/// Slots of flight from `from` until `to` is within `range`, at least 1, along a path of the eight headings.
pub(super) fn travel_slots(env: &EnvParams, from: Point, to: Point, range: f64) -> f64 {
    let (dx, dy) = ((to[0] - from[0]).abs(), (to[1] - from[1]).abs());
    let path = dx.max(dy) + (std::f64::consts::SQRT_2 - 1.0) * dx.min(dy);
    ((path - range) / env.speed.max(1e-9)).ceil().max(1.0)
}
