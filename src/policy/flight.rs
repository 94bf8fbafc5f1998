//! Flight along the eight headings, v per slot. Lengths are in units of the square's side.

use super::EnvParams;
use crate::env::{DIRECTIONS, EnvConfig, Point};

pub(in crate::policy) fn distance(a: Point, b: Point) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// Position after one slot on heading `h`, without the boundary rule.
pub(in crate::policy) fn next_position(env: &EnvParams, from: Point, h: usize) -> Point {
    [from[0] + env.speed * DIRECTIONS[h][0], from[1] + env.speed * DIRECTIONS[h][1]]
}

/// The heading that ends nearest to `to`; headings that leave the area only if all do. Of equal headings, the lowest.
pub(in crate::policy) fn heading_toward(env: &EnvParams, from: Point, to: Point) -> u8 {
    let (dx, dy) = (to[0] - from[0], to[1] - from[1]);
    // All moves have the same length, so the move that ends nearest points most towards the target.
    let mut best = (false, f64::NEG_INFINITY, 0);
    for (h, direction) in DIRECTIONS.iter().enumerate().take(EnvConfig::COMPASS) {
        let progress = dx * direction[0] + dy * direction[1];
        let inside = env.contains(next_position(env, from, h));
        if (inside, progress) > (best.0, best.1) {
            best = (inside, progress, h);
        }
    }
    best.2 as u8
}

/// Slots of flight from `from` until `to` is within `range`, at least 1, along a path of the eight headings.
pub(in crate::policy) fn travel_slots(env: &EnvParams, from: Point, to: Point, range: f64) -> f64 {
    let (dx, dy) = ((to[0] - from[0]).abs(), (to[1] - from[1]).abs());
    let path = dx.max(dy) + (std::f64::consts::SQRT_2 - 1.0) * dx.min(dy);
    ((path - range) / env.speed.max(1e-9)).ceil().max(1.0)
}
