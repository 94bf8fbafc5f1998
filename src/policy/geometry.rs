//! Who sees whom (spec 2, 2.5), for a batch of fleets at once; fleets may differ in size.
//!
//! Sparse throughout: lists of detections, never V x V tables. Computed once per batch and shared by all networks and
//! layers. Visibility is decided in f64 from the positions given (pairs are often exactly d apart), and relative
//! coordinates are rounded once. What networks compute are *rows*: all UAVs in the order they were given, then the users
//! that a graph of L layers can hear of, ordered by hops to the nearest UAV. The rest is never computed.

use super::slot::{Detection, Slot};
use super::vision::Vision;
use crate::env::Point;
use crate::nn::Graph;

/// A user that no row stands for.
const NO_ROW: u32 = u32::MAX;

/// One fleet's part of a geometry.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fleet {
    /// M.
    pub uavs: usize,
    /// N.
    pub users: usize,
    /// Row of its first UAV.
    pub first_uav: usize,
    /// Place of its first node among all nodes.
    first_node: usize,
    /// Place of its first user among all users.
    first_user: usize,
}

/// A row of the networks' batches.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Row {
    fleet: u32,
    /// Node within the fleet: UAVs, then users.
    node: u32,
}

/// What a row's node sees.
#[derive(Clone, Copy, Debug)]
pub struct View<'a> {
    /// The fleet it belongs to.
    pub fleet: &'a Fleet,
    /// Its place in the fleet: UAVs 0..M, then users M..M + N.
    pub node: usize,
    /// What it detects, in ascending order, itself left out.
    pub detections: &'a [Detection],
    /// AoI / K of the fleet's users.
    pub aoi: &'a [f32],
}

/// The sparse geometry of a batch. Rebuilding it keeps its allocations.
#[derive(Debug, Default)]
pub struct Geometry {
    fleets: Vec<Fleet>,
    offsets: Vec<u32>,
    detections: Vec<Detection>,
    aoi: Vec<f32>,
    rows: Vec<Row>,
    row_of: Vec<u32>,
    graph: Graph,
    vision: Vision,
    points: Vec<Point>,
    further: Further,
}

/// Scratch of [`Geometry::look_further`].
#[derive(Debug, Default)]
struct Further {
    offsets: Vec<u32>,
    detections: Vec<Detection>,
    reached: Vec<bool>,
}

/// How a geometry is built.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GeometryConfig {
    /// d.
    pub range: f64,
    /// K, what AoI is divided by.
    pub slots: usize,
    /// Graph layers; 0 without a graph.
    pub layers: usize,
    /// Whether a node is its own neighbour.
    pub self_loops: bool,
    /// Links over which UAVs observe. More than 1 without a graph only: a UAV then sees what it could hear of.
    pub hops: usize,
}

impl GeometryConfig {
    /// How many of a fleet's nodes must look around: all where anybody asks what users see.
    fn observers(&self, uavs: usize, users: usize) -> usize {
        if self.layers == 0 && self.hops <= 1 { uavs } else { uavs + users }
    }
}

impl Geometry {
    /// Forgets all fleets.
    pub fn clear(&mut self) {
        self.fleets.clear();
        self.offsets.clear();
        self.offsets.push(0);
        self.detections.clear();
        self.aoi.clear();
        self.row_of.clear();
    }

    fn open(&mut self, uavs: usize, users: usize) {
        let first_uav = self.fleets.last().map_or(0, |f| f.first_uav + f.uavs);
        self.fleets.push(Fleet { uavs, users, first_uav, first_node: self.row_of.len(), first_user: self.aoi.len() });
        self.row_of.resize(self.row_of.len() + uavs + users, NO_ROW);
    }

    /// Adds a fleet from positions (x, y, x, y ...); `aoi` in slots.
    pub fn push_scene(&mut self, config: &GeometryConfig, uav_xy: &[f32], user_xy: &[f32], aoi: &[f32]) {
        let (uavs, users) = (uav_xy.len() / 2, user_xy.len() / 2);
        self.open(uavs, users);
        self.points.clear();
        let all = uav_xy.chunks_exact(2).chain(user_xy.chunks_exact(2));
        self.points.extend(all.map(|p| [f64::from(p[0]), f64::from(p[1])]));
        let observers = config.observers(uavs, users);
        self.vision.look(&self.points, observers, config.range, (&mut self.offsets, &mut self.detections), usize::MAX);
        self.offsets.resize(self.row_of.len() + 1, self.detections.len() as u32);
        self.aoi.extend(aoi.iter().map(|a| a / config.slots as f32));
    }

    /// Adds a fleet from what its nodes detect.
    pub fn push_slot(&mut self, config: &GeometryConfig, slot: &Slot) {
        self.open(slot.uavs(), slot.users());
        let observers = config.observers(slot.uavs(), slot.users());
        for i in 0..observers {
            self.detections.extend_from_slice(slot.detections(i));
            self.offsets.push(self.detections.len() as u32);
        }
        self.offsets.resize(self.row_of.len() + 1, self.detections.len() as u32);
        self.aoi.extend(slot.aoi().iter().map(|a| a / config.slots as f32));
    }

    /// Orders the rows and builds the graph; call it after the last fleet.
    pub fn finish(&mut self, config: &GeometryConfig) {
        if config.hops > 1 {
            self.look_further(config.hops);
        }
        let Self { fleets, offsets, detections, rows, row_of, graph, .. } = self;
        rows.clear();
        for (f, fleet) in fleets.iter().enumerate() {
            for i in 0..fleet.uavs {
                row_of[fleet.first_node + i] = rows.len() as u32;
                rows.push(Row { fleet: f as u32, node: i as u32 });
            }
        }
        graph.reach.clear();
        graph.reach.push(rows.len());
        graph.offsets.clear();
        graph.offsets.push(0);
        graph.targets.clear();
        // A breadth-first walk, all fleets together: the rows are its queue, the graph its record.
        let mut next = 0;
        for _ in 0..config.layers {
            let end = rows.len();
            for r in next..end {
                let Row { fleet: f, node } = rows[r];
                let fleet = &fleets[f as usize];
                let at = fleet.first_node + node as usize;
                if config.self_loops {
                    graph.targets.push(r as u32);
                }
                for d in &detections[offsets[at] as usize..offsets[at + 1] as usize] {
                    let row = &mut row_of[fleet.first_node + d.target as usize];
                    if *row == NO_ROW {
                        *row = rows.len() as u32;
                        rows.push(Row { fleet: f, node: d.target });
                    }
                    graph.targets.push(*row);
                }
                graph.offsets.push(graph.targets.len() as u32);
            }
            next = end;
            graph.reach.push(rows.len());
        }
    }

    /// Replaces what UAVs detect by what they could hear of over `hops` links, each seen along the shortest way, and what
    /// users detect by nothing.
    fn look_further(&mut self, hops: usize) {
        let Self { fleets, offsets, detections, further, .. } = self;
        further.offsets.clear();
        further.offsets.push(0);
        further.detections.clear();
        for fleet in fleets.iter() {
            let nodes = fleet.uavs + fleet.users;
            for node in 0..fleet.uavs {
                let from = further.detections.len();
                further.reached.clear();
                further.reached.resize(nodes, false);
                further.reached[node] = true;
                // A breadth-first walk; what is found is its own queue, in which the UAV itself stands first for a while.
                further.detections.push(Detection { target: node as u32, rel: [0.0; 2] });
                let mut next = from;
                for _ in 0..hops {
                    let end = further.detections.len();
                    for i in next..end {
                        let via = further.detections[i];
                        let at = fleet.first_node + via.target as usize;
                        for d in &detections[offsets[at] as usize..offsets[at + 1] as usize] {
                            if !std::mem::replace(&mut further.reached[d.target as usize], true) {
                                let rel = [via.rel[0] + d.rel[0], via.rel[1] + d.rel[1]];
                                further.detections.push(Detection { target: d.target, rel });
                            }
                        }
                    }
                    next = end;
                }
                further.detections.swap_remove(from);
                further.detections[from..].sort_unstable_by_key(|d| d.target);
                further.offsets.push(further.detections.len() as u32);
            }
            further.offsets.resize(fleet.first_node + nodes + 1, further.detections.len() as u32);
        }
        std::mem::swap(offsets, &mut further.offsets);
        std::mem::swap(detections, &mut further.detections);
    }

    /// The fleets, in the order given.
    pub fn fleets(&self) -> &[Fleet] {
        &self.fleets
    }

    /// Rows of UAVs; they come first.
    pub fn uav_rows(&self) -> usize {
        self.graph.first_kind()
    }

    /// All rows.
    pub fn rows(&self) -> usize {
        self.rows.len()
    }

    /// The graph over rows.
    pub fn graph(&self) -> &Graph {
        &self.graph
    }

    /// What the node of row `r` sees.
    #[inline(always)]
    pub fn view(&self, r: usize) -> View<'_> {
        let Row { fleet, node } = self.rows[r];
        self.node(fleet as usize, node as usize)
    }

    /// What node `node` of fleet number `fleet` sees, whether it has a row or not.
    #[inline(always)]
    pub fn node(&self, fleet: usize, node: usize) -> View<'_> {
        let fleet = &self.fleets[fleet];
        let at = fleet.first_node + node;
        View {
            fleet,
            node,
            detections: &self.detections[self.offsets[at] as usize..self.offsets[at + 1] as usize],
            aoi: &self.aoi[fleet.first_user..][..fleet.users],
        }
    }
}
