//! Zones that no UAV enters, and the geometry of flights. All lengths are in units of the square's side.

use crate::env::Point;

/// Constraints are kept with this margin, because positions are rounded.
pub(super) const MARGIN: f64 = 1e-9;

/// A zone that no UAV enters.
#[derive(Clone, Debug, PartialEq)]
pub enum Zone {
    /// The corners of a polygon, in order. It may be concave.
    Polygon(Vec<Point>),
    /// Centre and radius.
    Circle(Point, f64),
}

impl Zone {
    /// Whether a flight ends in the zone, or crosses it from outside.
    pub(super) fn blocks(&self, from: Point, to: Point) -> bool {
        self.contains(to) || (!self.contains(from) && self.crosses(from, to))
    }

    /// Number of its corners; a circle counts as one.
    pub(super) fn corners(&self) -> usize {
        match self {
            Self::Circle(..) => 1,
            Self::Polygon(corners) => corners.len(),
        }
    }

    fn contains(&self, p: Point) -> bool {
        match self {
            Self::Circle(center, radius) => distance(p, *center) < radius + MARGIN,
            Self::Polygon(corners) => {
                let mut inside = false;
                for (a, b) in edges(corners) {
                    if (a[1] > p[1]) != (b[1] > p[1]) && p[0] < (b[0] - a[0]) * (p[1] - a[1]) / (b[1] - a[1]) + a[0] {
                        inside = !inside;
                    }
                }
                inside || edges(corners).any(|(a, b)| distance_to_segment(p, a, b) < MARGIN)
            }
        }
    }

    fn crosses(&self, from: Point, to: Point) -> bool {
        match self {
            Self::Circle(center, radius) => distance_to_segment(*center, from, to) < radius + MARGIN,
            Self::Polygon(corners) => edges(corners).any(|(a, b)| segments_meet(from, to, a, b)),
        }
    }

    /// How far `p` is in the zone.
    pub(super) fn depth(&self, p: Point) -> f64 {
        match self {
            _ if !self.contains(p) => 0.0,
            Self::Circle(center, radius) => radius - distance(p, *center),
            Self::Polygon(corners) => edges(corners).map(|(a, b)| distance_to_segment(p, a, b)).fold(f64::INFINITY, f64::min),
        }
    }
}

fn edges(corners: &[Point]) -> impl Iterator<Item = (Point, Point)> {
    corners.iter().copied().zip(corners.iter().copied().cycle().skip(1))
}

pub(super) fn distance(a: Point, b: Point) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// Length of the shortest path along the eight headings.
pub(super) fn octile(a: Point, b: Point) -> f64 {
    let (dx, dy) = ((a[0] - b[0]).abs(), (a[1] - b[1]).abs());
    dx.max(dy) + (std::f64::consts::SQRT_2 - 1.0) * dx.min(dy)
}

pub(super) fn distance_to_segment(p: Point, a: Point, b: Point) -> f64 {
    let (dx, dy) = (b[0] - a[0], b[1] - a[1]);
    let length = dx * dx + dy * dy;
    let t = if length > 0.0 { (((p[0] - a[0]) * dx + (p[1] - a[1]) * dy) / length).clamp(0.0, 1.0) } else { 0.0 };
    distance(p, [a[0] + t * dx, a[1] + t * dy])
}

fn segments_meet(a: Point, b: Point, c: Point, d: Point) -> bool {
    let side = |p: Point, q: Point, r: Point| (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0]);
    let apart = |x: f64, y: f64| (x > 0.0) == (y > 0.0) && x != 0.0 && y != 0.0;
    if apart(side(a, b, c), side(a, b, d)) || apart(side(c, d, a), side(c, d, b)) {
        return false;
    }
    let (ends, other) = ([(a, c, d), (b, c, d)], [(c, a, b), (d, a, b)]);
    let touches = ends.iter().chain(&other).any(|&(p, q, r)| distance_to_segment(p, q, r) < MARGIN);
    touches || (side(a, b, c) * side(a, b, d) < 0.0 && side(c, d, a) * side(c, d, b) < 0.0)
}
