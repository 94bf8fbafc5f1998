//! The input of a policy for one fleet in one slot: what each node detects, the users' AoI, and positions where they are known
//! (docs/model.md, "Observations").

use super::Sight;
use super::neighbor_search::{Detection, NeighborSearch};
use crate::env::{Point, Ranges};

/// What all nodes of a fleet detect in one slot, as lists of detections. Nodes 0..M are UAVs, nodes M..M+N are users. No node is
/// in its own list.
#[derive(Clone, Debug, Default)]
pub struct FleetGraph {
    uavs: usize,
    users: usize,
    /// `offsets[i]..offsets[i + 1]` are node i's detections.
    offsets: Vec<u32>,
    detections: Vec<Detection>,
    aoi: Vec<f32>,
    uav_positions: Option<Vec<Point>>,
    user_positions: Option<Vec<Point>>,
    /// Buffers of `set_scene`.
    points: Vec<Point>,
    search: NeighborSearch,
}

impl PartialEq for FleetGraph {
    fn eq(&self, other: &Self) -> bool {
        let parts = |s: &Self| (s.uavs, s.users);
        parts(self) == parts(other)
            && self.offsets == other.offsets
            && self.detections == other.detections
            && self.aoi == other.aoi
            && self.uav_positions == other.uav_positions
            && self.user_positions == other.user_positions
    }
}

impl FleetGraph {
    /// The graph of a scene: nodes within range (distance^2 <= range^2, in f64) detect each other.
    ///
    /// Work and memory grow with the nodes and the detections, not with the square of the nodes.
    ///
    /// # Panics
    /// When `aoi` does not have one entry per user.
    pub fn from_scene(uavs: &[Point], users: &[Point], aoi: &[f32], ranges: impl Into<Ranges>) -> Self {
        let mut graph = Self::default();
        graph.set_scene(uavs, users, aoi, ranges.into());
        graph
    }

    /// The graph with these detections. `detections[i]` is the list of node i, in ascending order of target. The caller has checked
    /// that targets exist, differ from i and do not repeat. The AoI of a user that no node detects has no effect; set it to 0.
    ///
    /// # Panics
    /// When the lengths do not fit together.
    pub fn from_detections(uav_positions: Option<Vec<Point>>, uavs: usize, aoi: Vec<f32>, detections: &[Vec<Detection>]) -> Self {
        let mut offsets = Vec::with_capacity(detections.len() + 1);
        offsets.push(0);
        let mut flat = Vec::with_capacity(detections.iter().map(Vec::len).sum());
        for list in detections {
            flat.extend_from_slice(list);
            offsets.push(flat.len() as u32);
        }
        Self::from_flat_detections(uav_positions, uavs, aoi, offsets, flat)
    }

    /// As [`FleetGraph::from_scene`], but only nodes 0..`observers` have detections, and `None` if there are more than
    /// `max_detections`. Work and memory are bounded by the number of nodes and by `max_detections`. `limits`: observers,
    /// `max_detections`.
    ///
    /// # Panics
    /// When `aoi` does not have one entry per user.
    pub fn from_scene_within(
        uavs: &[Point],
        users: &[Point],
        aoi: &[f32],
        ranges: impl Into<Ranges>,
        limits: (usize, usize),
    ) -> Option<Self> {
        let mut graph = Self::default();
        graph.rebuild(uavs, users, aoi, ranges.into(), limits).then_some(graph)
    }

    /// As [`FleetGraph::from_detections`], from all lists in one vector: the list of node i is
    /// `detections[offsets[i]..offsets[i + 1]]`.
    ///
    /// # Panics
    /// When the lengths do not fit together.
    pub fn from_flat_detections(
        uav_positions: Option<Vec<Point>>,
        uavs: usize,
        aoi: Vec<f32>,
        offsets: Vec<u32>,
        detections: Vec<Detection>,
    ) -> Self {
        let users = aoi.len();
        assert_eq!(offsets.len(), uavs + users + 1, "one list of detections per node");
        assert_eq!(
            offsets.last().map(|&end| end as usize),
            Some(detections.len()),
            "the last list ends at the end of the vector"
        );
        Self { uavs, users, offsets, detections, aoi, uav_positions, ..Self::default() }
    }

    /// Rebuilds this graph from a scene, keeping its allocations (see [`FleetGraph::from_scene`]).
    ///
    /// # Panics
    /// When `aoi` does not have one entry per user.
    pub fn set_scene(&mut self, uavs: &[Point], users: &[Point], aoi: &[f32], ranges: impl Into<Ranges>) {
        self.rebuild(uavs, users, aoi, ranges.into(), (usize::MAX, usize::MAX));
    }

    /// Returns false and leaves the graph incomplete if there are more than `max_detections` detections.
    fn rebuild(
        &mut self,
        uavs: &[Point],
        users: &[Point],
        aoi: &[f32],
        ranges: Ranges,
        (observers, max_detections): (usize, usize),
    ) -> bool {
        assert_eq!(aoi.len(), users.len(), "one AoI per user");
        self.uavs = uavs.len();
        self.users = users.len();
        self.aoi.clear();
        self.aoi.extend_from_slice(aoi);
        let own = self.uav_positions.get_or_insert_default();
        own.clear();
        own.extend_from_slice(uavs);
        let all = self.user_positions.get_or_insert_default();
        all.clear();
        all.extend_from_slice(users);
        self.offsets.clear();
        self.offsets.push(0);
        self.detections.clear();
        self.points.clear();
        self.points.extend_from_slice(uavs);
        self.points.extend_from_slice(users);
        let observers = observers.min(self.points.len());
        let lists = (&mut self.offsets, &mut self.detections);
        let complete = self.search.append_detections((&self.points, uavs.len()), observers, ranges, lists, max_detections);
        self.offsets.resize(self.points.len() + 1, self.detections.len() as u32);
        complete
    }

    /// The same graph with those detections for which `keep(node, target)` is true.
    pub fn filtered(&self, keep: impl Fn(usize, usize) -> bool) -> Self {
        let mut filtered = Self { offsets: vec![0], detections: Vec::with_capacity(self.detections.len()), ..self.clone() };
        for node in 0..self.offsets.len() - 1 {
            filtered.detections.extend(self.detections(node).iter().filter(|d| keep(node, d.target as usize)));
            filtered.offsets.push(filtered.detections.len() as u32);
        }
        filtered
    }

    /// Moves UAV `uav` to where UAV `to` is, if their positions are known. The detections remain.
    pub fn place_uav(&mut self, uav: usize, to: usize) {
        if let Some(positions) = &mut self.uav_positions {
            positions[uav] = positions[to];
        }
    }

    /// Adds users that no node detects, until there are `users`.
    pub fn add_undetected_users(&mut self, users: usize) {
        if users > self.users {
            self.users = users;
            self.aoi.resize(users, 0.0);
            self.offsets.resize(self.uavs + users + 1, self.detections.len() as u32);
            // Their positions are not known.
            self.user_positions = None;
        }
    }

    /// M.
    pub fn uavs(&self) -> usize {
        self.uavs
    }

    /// N.
    pub fn users(&self) -> usize {
        self.users
    }

    /// What node `i` detects, in ascending order of target (UAVs before users).
    pub fn detections(&self, i: usize) -> &[Detection] {
        &self.detections[self.offsets[i] as usize..self.offsets[i + 1] as usize]
    }

    /// What the UAVs detect; `None` if their positions are not known.
    pub fn sight(&self) -> Option<Sight<'_>> {
        let positions = self.uav_positions.as_deref()?;
        Some(Sight { positions, aoi: &self.aoi, offsets: &self.offsets, detections: &self.detections })
    }

    /// Number of detections of all nodes.
    pub fn detection_count(&self) -> usize {
        self.detections.len()
    }

    /// AoI of each user, in slots.
    pub fn aoi(&self) -> &[f32] {
        &self.aoi
    }

    /// Position of each UAV, where known.
    pub fn uav_positions(&self) -> Option<&[Point]> {
        self.uav_positions.as_deref()
    }

    /// Position of each user, known for a scene only.
    pub fn user_positions(&self) -> Option<&[Point]> {
        self.user_positions.as_deref()
    }
}
