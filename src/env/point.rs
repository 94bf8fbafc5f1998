//! Points of the plane, in units of the square's side.

/// A point (x, y).
pub type Point = [f64; 2];

/// The points of `xy`: x, y of the first, x, y of the second, and so on.
pub fn points(xy: &[f32]) -> impl Iterator<Item = Point> + '_ {
    xy.as_chunks().0.iter().map(|&[x, y]| [f64::from(x), f64::from(y)])
}
