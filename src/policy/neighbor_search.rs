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

/// How many detections a scene has, from the numbers of nodes in square cells.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DetectionEstimate {
    /// The scene has at least so many.
    pub at_least: usize,
    /// The scene has about so many.
    pub about: usize,
}

/// Cells per range of an estimate.
const CELLS_PER_RANGE: f64 = 8.0;

/// Estimates how many detections nodes 0..`observers` have among `uavs` and `users`, in a time that is proportional to the nodes.
pub fn estimate_detections(uavs: &[Point], users: &[Point], observers: usize, ranges: Ranges) -> DetectionEstimate {
    let nodes = uavs.len() + users.len();
    if observers == 0 || nodes == 0 {
        return DetectionEstimate { at_least: 0, about: 0 };
    }
    let points = || uavs.iter().chain(users);
    let fold = |axis: usize, f: fn(f64, f64) -> f64| points().map(|p| p[axis]).reduce(f).unwrap_or(0.0);
    let low = [fold(0, f64::min), fold(1, f64::min)];
    let extent = (fold(0, f64::max) - low[0]).max(fold(1, f64::max) - low[1]);
    let range = ranges.detection;
    // Not more cells than nodes, about.
    let size = (range / CELLS_PER_RANGE).max(extent / (nodes as f64).sqrt()).max(f64::MIN_POSITIVE);
    let side = (extent / size) as usize + 1;
    // Number of observers in each cell, and number of nodes in the cells before each cell of its row.
    let (mut observed, mut before) = (vec![0_usize; side * side], vec![0_usize; side * (side + 1)]);
    for (i, p) in points().enumerate() {
        let [x, y] = [0, 1].map(|axis| (((p[axis] - low[axis]) / size) as usize).min(side - 1));
        observed[y * side + x] += usize::from(i < observers);
        before[y * (side + 1) + x + 1] += 1;
    }
    for row in before.chunks_exact_mut(side + 1) {
        (1..row.len()).for_each(|x| row[x] += row[x - 1]);
    }
    // For each number of rows between two cells, the number of columns up to which about half of the pairs of nodes are within range, and
    // up to which all are. The factor allows for rounding.
    let cells = range / size;
    let reach = (cells as usize).min(side);
    let about_columns = |dy: usize| (cells * cells - (dy * dy) as f64).max(0.0).sqrt() as usize;
    let all_columns = |dy: usize| {
        let columns = (cells * cells * (1.0 - 1e-9) - ((dy + 1) * (dy + 1)) as f64).sqrt() - 1.0;
        (columns >= 0.0).then_some(columns as usize)
    };
    let columns: Vec<_> = (0..=reach).map(|dy| (about_columns(dy), all_columns(dy))).collect();
    let (mut at_least, mut about) = (0, 0);
    for (cell, &observed) in observed.iter().enumerate().filter(|(_, observed)| **observed > 0) {
        let (x, y) = (cell % side, cell / side);
        for other_y in y.saturating_sub(reach)..=(y + reach).min(side - 1) {
            let row = &before[other_y * (side + 1)..][..=side];
            let nodes = |columns: usize| row[(x + columns + 1).min(side)] - row[x.saturating_sub(columns)];
            let (about_columns, all_columns) = columns[y.abs_diff(other_y)];
            about += observed * nodes(about_columns);
            at_least += observed * all_columns.map_or(0, nodes);
        }
    }
    // No node detects itself, and UAVs detect each other within another range.
    let uncertain = observers + if ranges.communication < range { uavs.len().pow(2) } else { 0 };
    DetectionEstimate { at_least: at_least.saturating_sub(uncertain), about }
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

    #[test]
    fn estimate_never_exceeds_the_detections_and_is_close_for_dense_scenes() {
        let scenes =
            [(50, 500, 0.28, 1.0), (10, 300, 0.04, 1.0), (99, 2000, 0.28, 1.0), (200, 200, 0.1, 30.0), (5, 60, 0.25, 0.0)];
        for (uavs, users, range, spread) in scenes {
            let mut rng = crate::rng::stream(7, "estimate", users);
            let mut draw = |n: u64| (0..n).map(|_| [0, 1].map(|_| spread * rng.random::<f64>())).collect::<Vec<Point>>();
            let (own, all) = (draw(uavs), draw(users));
            let (aoi, nodes) = (vec![0.0; all.len()], own.len() + all.len());
            for (communication, observers) in [(range, nodes), (0.0, nodes), (range, own.len()), (range, 0)] {
                let ranges = Ranges { detection: range, communication };
                let graph = crate::policy::FleetGraph::from_scene_within(&own, &all, &aoi, ranges, (observers, usize::MAX));
                let count = graph.unwrap().detection_count();
                let DetectionEstimate { at_least, about } = estimate_detections(&own, &all, observers, ranges);
                assert!(at_least <= count, "{at_least} of {count}");
                if range == 0.28 && communication == range && observers == nodes {
                    assert!(
                        2 * at_least > count && about * 3 > count * 2 && about * 2 < count * 3,
                        "{at_least}, {about}, {count}"
                    );
                }
            }
        }
    }
}
