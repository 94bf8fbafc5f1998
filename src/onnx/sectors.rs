//! The sectors of UAVs (docs/model.md, "Identity" and "Goals") as tables that a graph looks up: ONNX has no arc tangent of two numbers.

use std::f64::consts::{FRAC_PI_4, PI};

use super::graph::{Graph, Tensor};
use crate::env::Point;
use crate::policy::Sector;

/// Maximum size of a fleet in the tables.
pub(super) const MAX_UAVS: usize = 64;

/// Row of UAV `i` of `uavs` in the tables.
fn rows() -> impl Iterator<Item = (usize, usize)> {
    (1..=MAX_UAVS).flat_map(|uavs| (0..uavs).map(move |i| (i, uavs)))
}

/// The row in the tables of each of `places`: a UAV's number and the size of its fleet, (M, 2).
pub(super) fn row(g: &mut Graph, places: &Tensor) -> Tensor {
    let (i, uavs) = (g.column(places, 0), g.column(places, 1));
    let (one, two) = (g.integer(1), g.integer(2));
    let before = g.with("Sub", &uavs, &one);
    let pairs = g.with("Mul", &uavs, &before);
    let first = g.with("Div", &pairs, &two);
    g.with("Add", &first, &i)
}

/// cos and sin of the angle of each UAV, (M, 2), f32.
pub(super) fn phases(g: &mut Graph, row: &Tensor) -> Tensor {
    let values: Vec<f32> = rows()
        .flat_map(|(i, uavs)| {
            let angle = Sector::of(i, uavs).angle;
            [angle.cos() as f32, angle.sin() as f32]
        })
        .collect();
    let table = g.floats(&[values.len() as i64 / 2, 2], &values);
    g.gather(&table, row)
}

/// The bounds of each UAV's sector, (M, 6), f64: the directions of its middle, its end and its start.
pub(super) fn bounds(g: &mut Graph, row: &Tensor) -> Tensor {
    let values: Vec<f64> = rows().flat_map(|(i, uavs)| bounds_of(i, uavs)).collect();
    let table = g.doubles(&[values.len() as i64 / 6, 6], &values);
    g.gather(&table, row)
}

/// Whether each of `points` is in the sector of each UAV, (M, points).
pub(super) fn owners(g: &mut Graph, row: &Tensor, points: &[Point]) -> Tensor {
    let owns = |(i, uavs)| {
        let sector = Sector::of(i, uavs);
        points.iter().map(move |&p| sector.owns(p))
    };
    let values: Vec<bool> = rows().flat_map(owns).collect();
    let width = points.len() as i64;
    let table = g.bools(&[values.len() as i64 / width, width], &values);
    g.gather(&table, row)
}

fn bounds_of(i: usize, uavs: usize) -> [f64; 6] {
    let sector = Sector::of(i, uavs);
    let (sin, cos) = sector.angle.sin_cos();
    // One UAV owns everything: no direction is beyond these bounds.
    if uavs == 1 {
        return [cos, sin, 0.0, 0.0, 0.0, 0.0];
    }
    let half = PI / uavs as f64;
    let [end, start] = [half, -half].map(|half| bound(&sector, sector.angle + half, half));
    [cos, sin, end[0], end[1], start[0], start[1]]
}

/// The direction of a bound of a sector. Where it is an axis or a diagonal, points of the ground lie exactly on it: the bound is exact if
/// the sector contains them, and otherwise just before them.
fn bound(sector: &Sector, angle: f64, half: f64) -> [f64; 2] {
    let eighth = (angle / FRAC_PI_4).round();
    if (angle / FRAC_PI_4 - eighth).abs() > 1e-9 {
        return [angle.cos(), angle.sin()];
    }
    let exact = [[1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [-1.0, 1.0], [-1.0, 0.0], [-1.0, -1.0], [0.0, -1.0], [1.0, -1.0]];
    let exact: [f64; 2] = exact[eighth.rem_euclid(8.0) as usize];
    if sector.owns([0.5 + 0.25 * exact[0], 0.5 + 0.25 * exact[1]]) {
        return exact;
    }
    let inside = angle - half.signum() * 1e-12;
    [inside.cos(), inside.sin()]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What the graph computes.
    fn owns(bounds: [f64; 6], p: [f64; 2]) -> bool {
        let [x, y] = if p == [0.5; 2] { [1.0, 0.0] } else { [p[0] - 0.5, p[1] - 0.5] };
        let cross = |part: usize| bounds[2 * part] * y - bounds[2 * part + 1] * x;
        if cross(0) >= 0.0 { cross(1) <= 0.0 } else { cross(2) >= 0.0 }
    }

    #[test]
    fn bounds_own_what_sectors_own() {
        // Centres of blocks of ground, of which all cells, or those of some rows and columns, were not searched.
        let line: Vec<f64> = (0..39).map(|k| (f64::from(k) / 2.0 + 0.5) / 20.0).collect();
        for uavs in 1..=MAX_UAVS {
            for i in 0..uavs {
                let (sector, bounds) = (Sector::of(i, uavs), bounds_of(i, uavs));
                for (&x, &y) in line.iter().flat_map(|x| line.iter().map(move |y| (x, y))) {
                    // Rounding decides about diagonals of which both coordinates are rounded.
                    if uavs % 4 == 0 && x != y && ((x - 0.5).abs() - (y - 0.5).abs()).abs() < 1e-9 || uavs % 4 == 0 && x == y {
                        continue;
                    }
                    assert_eq!(owns(bounds, [x, y]), sector.owns([x, y]), "UAV {i} of {uavs}, {x}, {y}");
                }
            }
        }
    }
}
