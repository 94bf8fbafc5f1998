//! Finds what nodes detect: pairs of nodes with distance^2 <= range^2, computed in f64 (docs/model.md, "Observations"). The range
//! between two UAVs is the communication range, otherwise it is the detection range.
//!
//! Up to [`ALL_PAIRS`] nodes, all pairs are compared. More nodes are sorted into square cells at least as wide as the range, so
//! that work and memory grow with the nodes and the detections. Both ways give the same detections in the same order.

use crate::env::{Point, Ranges};

/// Maximum number of nodes for which all pairs are compared.
const ALL_PAIRS: usize = 48;

/// Node `target` detected at relative position `rel` = position of the target - position of the detecting node.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Detection {
    /// Node index: UAVs first, then users.
    pub target: u32,
    /// Computed in f64, rounded once.
    pub rel: [f32; 2],
}

/// Buffers of the search, kept from call to call.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct NeighborSearch {
    /// Cell of each node.
    cell: Vec<u32>,
    /// The nodes of cell c are `nodes[starts[c]..starts[c + 1]]`.
    starts: Vec<u32>,
    nodes: Vec<u32>,
}

/// A square grid over all points.
struct Grid {
    low: Point,
    size: f64,
    side: usize,
}

impl Grid {
    fn new(points: &[Point], range: f64) -> Self {
        let fold = |axis: usize, f: fn(f64, f64) -> f64| points.iter().map(|p| p[axis]).fold(points[0][axis], f);
        let low = [fold(0, f64::min), fold(1, f64::min)];
        let extent = (fold(0, f64::max) - low[0]).max(fold(1, f64::max) - low[1]);
        // At most a few cells per node. Cells are slightly wider than the range, so that rounding cannot put a pair within
        // range two cells apart.
        let max_cells = (points.len() as f64).sqrt().ceil() * 2.0;
        let size = (range * (1.0 + 1e-9)).max(extent / max_cells).max(f64::MIN_POSITIVE);
        Self { low, size, side: (extent / size) as usize + 1 }
    }

    /// Column and row of the cell of `p`.
    fn cell(&self, p: Point) -> [usize; 2] {
        [0, 1].map(|axis| (((p[axis] - self.low[axis]) / self.size) as usize).min(self.side - 1))
    }
}

impl NeighborSearch {
    /// Appends what nodes 0..`observers` detect among all `points`, of which the first `uavs` are UAVs, each list in ascending order of target and without the node
    /// itself, and the end of each list to `offsets`. Stops and returns false when `detections` is longer than `max_detections`.
    pub(super) fn append_detections(
        &mut self,
        (points, uavs): (&[Point], usize),
        observers: usize,
        ranges: Ranges,
        (offsets, detections): (&mut Vec<u32>, &mut Vec<Detection>),
        max_detections: usize,
    ) -> bool {
        if points.len() <= ALL_PAIRS {
            for (i, &from) in points[..observers].iter().enumerate() {
                detections
                    .extend(points.iter().enumerate().filter_map(|(j, &to)| detect(i, from, j, to, ranges.between(i, j, uavs))));
                offsets.push(detections.len() as u32);
            }
            return detections.len() <= max_detections;
        }
        let grid = Grid::new(points, ranges.max());
        self.sort_into_cells(points, &grid);
        for (i, &from) in points[..observers].iter().enumerate() {
            let first = detections.len();
            let [x, y] = grid.cell(from);
            for row in y.saturating_sub(1)..=(y + 1).min(grid.side - 1) {
                let (left, right) = (x.saturating_sub(1), (x + 1).min(grid.side - 1));
                let cells = self.starts[row * grid.side + left] as usize..self.starts[row * grid.side + right + 1] as usize;
                let near = self.nodes[cells].iter().map(|&j| j as usize);
                detections.extend(near.filter_map(|j| detect(i, from, j, points[j], ranges.between(i, j, uavs))));
            }
            detections[first..].sort_unstable_by_key(|d| d.target);
            offsets.push(detections.len() as u32);
            if detections.len() > max_detections {
                return false;
            }
        }
        true
    }

    /// Counting sort of the nodes by cell.
    fn sort_into_cells(&mut self, points: &[Point], grid: &Grid) {
        self.cell.clear();
        self.cell.extend(points.iter().map(|&p| {
            let [x, y] = grid.cell(p);
            (y * grid.side + x) as u32
        }));
        self.starts.clear();
        self.starts.resize(grid.side * grid.side + 2, 0);
        // Counts are stored two places further, so that filling the cells moves each start to its final value.
        for &c in &self.cell {
            self.starts[c as usize + 2] += 1;
        }
        for c in 2..self.starts.len() {
            self.starts[c] += self.starts[c - 1];
        }
        self.nodes.resize(points.len(), 0);
        for (i, &c) in self.cell.iter().enumerate() {
            let place = &mut self.starts[c as usize + 1];
            self.nodes[*place as usize] = i as u32;
            *place += 1;
        }
    }
}

#[inline(always)]
fn detect(i: usize, from: Point, j: usize, to: Point, range: f64) -> Option<Detection> {
    let (dx, dy) = (to[0] - from[0], to[1] - from[1]);
    (dx * dx + dy * dy <= range * range && i != j).then_some(Detection { target: j as u32, rel: [dx as f32, dy as f32] })
}

#[cfg(test)]
mod tests {
    use rand::RngExt;

    use super::*;

    fn pairs(points: &[Point], uavs: usize, ranges: Ranges) -> (Vec<u32>, Vec<Detection>) {
        let (mut offsets, mut detections) = (vec![0], Vec::new());
        for (i, &from) in points.iter().enumerate() {
            let detect = |(j, &to)| detect(i, from, j, to, ranges.between(i, j, uavs));
            detections.extend(points.iter().enumerate().filter_map(detect));
            offsets.push(detections.len() as u32);
        }
        (offsets, detections)
    }

    #[test]
    fn grid_finds_the_same_detections_as_comparing_all_pairs() {
        for (n, range, spread) in
            [(49, 0.28, 1.0), (300, 0.04, 1.0), (500, 0.1, 30.0), (200, 1e-6, 1.0), (100, 2.0, 1.0), (60, 0.25, 0.0)]
        {
            let mut rng = crate::rng::stream(7, "neighbor search", n);
            // A lattice with a spacing of a quarter of the range puts many pairs exactly at the range.
            let mut coordinate = |i: u64| {
                let x = spread * (rng.random::<f64>() - 0.3);
                if i.is_multiple_of(2) { x } else { (x / range * 4.0).round() * range / 4.0 }
            };
            let points: Vec<Point> = (0..n).map(|i| [coordinate(i), coordinate(i)]).collect();
            let (mut offsets, mut detections) = (vec![0], Vec::new());
            for communication in [range, 0.3 * range, 2.5 * range] {
                let ranges = Ranges { detection: range, communication };
                let uavs = points.len() / 3;
                offsets.truncate(1);
                detections.clear();
                assert!(NeighborSearch::default().append_detections(
                    (&points, uavs),
                    points.len(),
                    ranges,
                    (&mut offsets, &mut detections),
                    usize::MAX
                ));
                assert_eq!(
                    (&offsets, &detections),
                    (&pairs(&points, uavs, ranges).0, &pairs(&points, uavs, ranges).1),
                    "{n} nodes, {ranges:?}"
                );
            }
        }
    }
}
