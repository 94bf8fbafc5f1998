//! The graphs of a batch of fleets, in sparse form (docs/model.md, "Graph"). Fleets may differ in size.
//!
//! Holds lists of detections, never V x V tables. A geometry is computed once per batch and shared by all networks and layers.
//! Networks compute *rows*: first all UAVs in the order given, then the users within L links of a UAV, ordered by the number
//! of links to the nearest UAV, for L graph layers. Other users have no row and are never computed.

use super::fleet_graph::FleetGraph;
use super::hop_search::HopSearch;
use super::neighbor_search::{Detection, NeighborSearch};
use super::{Sector, Sight};
use crate::env::{Point, Ranges, points};
use crate::nn::Graph;

/// Marks a node without a row.
const NO_ROW: u32 = u32::MAX;

/// Where one fleet lies in a geometry.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FleetSpan {
    /// M.
    pub uavs: usize,
    /// N.
    pub users: usize,
    /// 1 / d, the factor of relative positions in observations.
    pub scale: f64,
    /// Row of the first UAV.
    pub first_uav: usize,
    /// Index of the first node among all nodes.
    first_node: usize,
    /// Index of the first user among all users.
    first_user: usize,
    /// Index of the sector of the first UAV, if sectors are not those of slot 0.
    first_sector: Option<usize>,
}

/// The node that a row stands for.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Row {
    fleet: u32,
    /// Node within the fleet: UAVs, then users.
    node: u32,
}

/// What one node observes.
#[derive(Clone, Copy, Debug)]
pub struct NodeView<'a> {
    /// The node's fleet.
    pub fleet: &'a FleetSpan,
    /// The node within the fleet: UAVs 0..M, then users M..M + N.
    pub node: usize,
    /// What the node detects, in ascending order of target, without the node itself.
    pub detections: &'a [Detection],
    /// AoI / K of the fleet's users.
    pub aoi_scaled: &'a [f32],
}

/// The graphs of a batch. Rebuilding a geometry keeps its allocations.
#[derive(Debug, Default)]
pub struct Geometry {
    fleets: Vec<FleetSpan>,
    /// The detections of node i (over all fleets) are `detections[offsets[i]..offsets[i + 1]]`.
    offsets: Vec<u32>,
    detections: Vec<Detection>,
    /// AoI / K of all users.
    aoi_scaled: Vec<f32>,
    /// Sectors of the UAVs of fleets that have changed.
    sectors: Vec<Sector>,
    rows: Vec<Row>,
    row_of: Vec<u32>,
    graph: Graph,
    hops: usize,
    search: NeighborSearch,
    points: Vec<Point>,
}

/// How a geometry is built. The ranges may differ between the fleets of a geometry.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GeometryConfig {
    /// Ranges within which nodes detect each other.
    pub ranges: Ranges,
    /// K, the slots of an episode, by which AoI is divided.
    pub episode_slots: usize,
    /// Number of graph layers; 0 without a graph.
    pub layers: usize,
    /// Whether a node is its own neighbour.
    pub self_loops: bool,
    /// Number of links over which UAVs observe. More than 1 only without a graph.
    pub hops: usize,
}

impl GeometryConfig {
    /// Number of nodes of a fleet whose detections are needed.
    pub(super) fn observers(&self, uavs: usize, users: usize) -> usize {
        if self.layers == 0 && self.hops <= 1 { uavs } else { uavs + users }
    }
}

impl Geometry {
    /// Removes all fleets.
    pub fn clear(&mut self) {
        self.fleets.clear();
        self.offsets.clear();
        self.offsets.push(0);
        self.detections.clear();
        self.aoi_scaled.clear();
        self.sectors.clear();
        self.row_of.clear();
    }

    fn add_fleet(&mut self, config: &GeometryConfig, uavs: usize, users: usize) {
        let first_uav = self.fleets.last().map_or(0, |f| f.first_uav + f.uavs);
        let (first_node, first_user) = (self.row_of.len(), self.aoi_scaled.len());
        let scale = 1.0 / config.ranges.detection;
        self.fleets.push(FleetSpan { uavs, users, scale, first_uav, first_node, first_user, first_sector: None });
        self.row_of.resize(self.row_of.len() + uavs + users, NO_ROW);
    }

    /// Adds a fleet from positions (x, y, x, y ...); `aoi` in slots.
    pub fn push_scene(&mut self, config: &GeometryConfig, uav_xy: &[f32], user_xy: &[f32], aoi: &[f32]) {
        let (uavs, users) = (uav_xy.len() / 2, user_xy.len() / 2);
        self.add_fleet(config, uavs, users);
        self.points.clear();
        self.points.extend(points(uav_xy).chain(points(user_xy)));
        let observers = config.observers(uavs, users);
        let lists = (&mut self.offsets, &mut self.detections);
        self.search.append_detections((&self.points, uavs), observers, config.ranges, lists, usize::MAX);
        self.offsets.resize(self.row_of.len() + 1, self.detections.len() as u32);
        self.aoi_scaled.extend(aoi.iter().map(|a| a / config.episode_slots as f32));
    }

    /// What the UAVs of the last fleet detect, which was added by [`Geometry::push_scene`] with this AoI.
    pub fn last_sight<'a>(&'a self, aoi: &'a [f32]) -> Sight<'a> {
        let fleet = self.fleets.last().expect("a fleet was added");
        let (positions, offsets) = (&self.points[..fleet.uavs], &self.offsets[fleet.first_node..]);
        Sight { positions, aoi, offsets, detections: &self.detections }
    }

    /// Adds a fleet from what its nodes detect.
    pub fn push_graph(&mut self, config: &GeometryConfig, graph: &FleetGraph) {
        self.add_fleet(config, graph.uavs(), graph.users());
        let observers = config.observers(graph.uavs(), graph.users());
        for i in 0..observers {
            self.detections.extend_from_slice(graph.detections(i));
            self.offsets.push(self.detections.len() as u32);
        }
        self.offsets.resize(self.row_of.len() + 1, self.detections.len() as u32);
        self.aoi_scaled.extend(graph.aoi().iter().map(|a| a / config.episode_slots as f32));
    }

    /// Sets the sectors of the UAVs of the last fleet, one per UAV; none: those of UAVs that fly together from slot 0.
    pub fn set_sectors(&mut self, sectors: &[Sector]) {
        if let Some(fleet) = self.fleets.last_mut().filter(|fleet| fleet.uavs == sectors.len()) {
            fleet.first_sector = Some(self.sectors.len());
            self.sectors.extend_from_slice(sectors);
        }
    }

    /// The sector of UAV `uav` of `fleet`.
    pub fn sector(&self, fleet: &FleetSpan, uav: usize) -> Sector {
        fleet.first_sector.map_or_else(|| Sector::of(uav, fleet.uavs), |first| self.sectors[first + uav])
    }

    /// Orders the rows and builds the graph; call it after the last fleet.
    pub fn finish(&mut self, config: &GeometryConfig) {
        self.hops = config.hops;
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
        // A breadth-first search over all fleets at once. The rows are its queue.
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

    /// The fleets, in the order given.
    pub fn fleets(&self) -> &[FleetSpan] {
        &self.fleets
    }

    /// Number of UAV rows, which come first.
    pub fn uav_rows(&self) -> usize {
        self.graph.first_kind_count()
    }

    /// Number of rows.
    pub fn rows(&self) -> usize {
        self.rows.len()
    }

    /// The graph over rows.
    pub fn graph(&self) -> &Graph {
        &self.graph
    }

    /// Number of detections held: those within the detection range, whatever `hops` is.
    pub fn detection_count(&self) -> usize {
        self.detections.len()
    }

    /// Fleet of row `r`, and the node within the fleet.
    #[inline(always)]
    pub fn node_of_row(&self, r: usize) -> (&FleetSpan, usize) {
        let Row { fleet, node } = self.rows[r];
        (&self.fleets[fleet as usize], node as usize)
    }

    /// What the node of row `r` observes.
    #[inline(always)]
    pub fn view_of_row<'a>(&'a self, r: usize, search: &'a mut HopSearch) -> NodeView<'a> {
        let (fleet, node) = self.node_of_row(r);
        self.view_in(fleet, node, search)
    }

    /// What node `node` of fleet number `fleet` observes, whether the node has a row or not.
    pub fn view_of_node<'a>(&'a self, fleet: usize, node: usize, search: &'a mut HopSearch) -> NodeView<'a> {
        self.view_in(&self.fleets[fleet], node, search)
    }

    /// With `hops` > 1 the view is searched for anew each time: kept for all UAVs, the views could hold M x V detections.
    #[inline(always)]
    fn view_in<'a>(&'a self, fleet: &'a FleetSpan, node: usize, search: &'a mut HopSearch) -> NodeView<'a> {
        let aoi_scaled = &self.aoi_scaled[fleet.first_user..][..fleet.users];
        let offsets = &self.offsets[fleet.first_node..][..=fleet.uavs + fleet.users];
        let detections = if self.hops > 1 {
            search.find(node, self.hops, offsets, &self.detections)
        } else {
            &self.detections[offsets[node] as usize..offsets[node + 1] as usize]
        };
        NodeView { fleet, node, detections, aoi_scaled }
    }
}
