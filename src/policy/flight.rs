//! Flight along the eight headings, v per slot. Lengths are in units of the square's side.

use super::EnvParams;
use crate::env::{DIRECTIONS, EnvConfig, Point};

#[inline(always)]
pub(in crate::policy) fn distance(a: Point, b: Point) -> f64 {
    length(a[0] - b[0], a[1] - b[1])
}

/// As `dx.hypot(dy)`, for lengths whose squares are numbers; a vector unit can compute it (Borges, An Improved Algorithm for
/// hypot(a, b), 2019). The correction after the root matters: UAVs may be almost equally far from a goal, and then rounding decides
/// which is nearer.
#[inline(always)]
pub(in crate::policy) fn length(dx: f64, dy: f64) -> f64 {
    let (dx, dy) = (dx.abs(), dy.abs());
    let (long, short) = if dx < dy { (dy, dx) } else { (dx, dy) };
    let h = (long * long + short * short).sqrt();
    // What h^2 is too large by, without cancellation: from h - short where the sides are alike, else from h - long.
    let (a, b) = (h - short, h - long);
    let alike = long * (2.0 * a - long) + (a - 2.0 * (long - short)) * a;
    let different = 2.0 * b * (long - 2.0 * short) + ((4.0 * b - short) * short + b * b);
    let excess = if h <= 2.0 * short { alike } else { different };
    h - excess / (2.0 * h).max(f64::MIN_POSITIVE)
}

/// Position after one slot on heading `h`, without the boundary rule.
pub(in crate::policy) fn next_position(env: &EnvParams, from: Point, h: usize) -> Point {
    [from[0] + env.speed * DIRECTIONS[h][0], from[1] + env.speed * DIRECTIONS[h][1]]
}

/// The eight headings from one position.
pub(in crate::policy) struct Headings {
    from: Point,
    /// Whether each heading may be taken: those that stay in the area; all if none does.
    allowed: [bool; EnvConfig::COMPASS],
}

impl Headings {
    pub(in crate::policy) fn new(env: &EnvParams, from: Point) -> Self {
        let inside = std::array::from_fn(|h| env.contains(next_position(env, from, h)));
        Self { from, allowed: if inside.contains(&true) { inside } else { [true; _] } }
    }

    /// Whether heading `h` may be taken.
    #[inline(always)]
    pub(in crate::policy) fn allows(&self, h: usize) -> bool {
        self.allowed[h]
    }

    /// The heading that ends nearest to `to`. Of equal headings, the lowest.
    pub(in crate::policy) fn toward(&self, to: Point) -> u8 {
        let (dx, dy) = (to[0] - self.from[0], to[1] - self.from[1]);
        // All moves have the same length, so the move that ends nearest points most towards the target.
        let mut best = None;
        for (h, direction) in DIRECTIONS.iter().enumerate().take(EnvConfig::COMPASS).filter(|(h, _)| self.allowed[*h]) {
            let progress = dx * direction[0] + dy * direction[1];
            if best.is_none_or(|(most, _)| progress > most) {
                best = Some((progress, h));
            }
        }
        best.expect("a heading is allowed").1 as u8
    }
}

/// Slots of flight from `from` until `to` is within `range`, at least 1, along a path of the eight headings.
#[inline(always)]
pub(in crate::policy) fn travel_slots(env: &EnvParams, from: Point, to: Point, range: f64) -> f64 {
    let (dx, dy) = ((to[0] - from[0]).abs(), (to[1] - from[1]).abs());
    let path = dx.max(dy) + (std::f64::consts::SQRT_2 - 1.0) * dx.min(dy);
    ((path - range) / env.speed.max(1e-9)).ceil().max(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn lengths_are_rounded_to_the_nearest_number_or_its_neighbour(x in -2.0..2.0_f64, y in -2.0..2.0_f64, small in 0..60_i32) {
            for (x, y) in [(x, y), (x, x), (x, x * 2.0_f64.powi(-small)), (x * 2.0_f64.powi(-small), y), (0.0, y), (0.0, 0.0)] {
                let (ours, exact) = (length(x, y), x.hypot(y));
                prop_assert!(ours.to_bits().abs_diff(exact.to_bits()) <= 1, "{x}, {y}: {ours}, {exact}");
            }
        }
    }
}
