//! Converts nodes and scenes of all transports to a [`FleetInput`]: resolves ids, collects the AoI of users, and mirrors detections that
//! one side reports.
//!
//! Every measurement is that of one node, with an error of its own. Two nodes may report different positions of each other, and each
//! policy input is what the node itself reports. Of several reports of a user's AoI, the user's own counts, then the smallest: the latest
//! collection that anybody knows of.

use std::collections::HashMap;

use super::flight::is_far;
use super::ids::{Ids, canonical_of_request, check_counts, check_distinct, check_nodes, node_indices};
use super::{FleetIds, FleetInput, GraphForm, ReportedDetection, ReportedGraph, Scene, SceneOrGraph};
use crate::env::Point;
use crate::invalid::{Invalid, in_range};

/// Maximum coordinate of an absolute position, in units of the square's side or of a frame.
const MAX_COORDINATE: f64 = 1e9;
/// Maximum speed and endurance of a UAV.
const MAX_UAV_NUMBER: f64 = 1e9;
/// Maximum AoI, in slots.
const MAX_AOI: f64 = 1e6;

/// A node of a graph, with an iterator of its detections.
#[derive(Clone, Debug)]
pub struct Node<D> {
    /// Id.
    pub id: String,
    /// Whether it is a UAV; otherwise it is a user.
    pub is_uav: bool,
    /// What it detects.
    pub detections: D,
    /// Own position of a UAV, where known.
    pub position: Option<Point>,
    /// Own AoI of a user in slots, where known.
    pub aoi: Option<f64>,
    /// Speed of a UAV, where it has one of its own.
    pub speed: Option<f64>,
    /// Time that a UAV can still fly in seconds, where known.
    pub endurance: Option<f64>,
}

/// A detection of the node `target_id`.
#[derive(Clone, Debug)]
pub struct NodeDetection {
    /// The node.
    pub target_id: String,
    /// Target position - own position.
    pub rel: Point,
    /// AoI of a user in slots; none for a UAV.
    pub aoi: Option<f64>,
}

/// Checks a number.
pub(crate) fn check_finite(field: impl FnOnce() -> String, value: f64) -> Result<f64, Invalid> {
    if value.is_finite() { Ok(value) } else { Err(Invalid::new(field(), value, "a finite number")) }
}

/// Checks an absolute position. `far` gets the error of the first one that is not near the unit square.
pub(crate) fn check_point(field: impl Fn() -> String, [x, y]: Point, far: &mut Option<Box<Invalid>>) -> Result<Point, Invalid> {
    if !is_far([x, y]) {
        return Ok([x, y]);
    }
    for (axis, value) in [("x", x), ("y", y)] {
        check_finite(|| format!("{}.{axis}", field()), value)?;
        in_range(&format!("{}.{axis}", field()), value, -MAX_COORDINATE..=MAX_COORDINATE)?;
    }
    if far.is_none() {
        let (axis, value) = if is_far([x, 0.0]) { ("x", x) } else { ("y", y) };
        let expected = "a coordinate near the unit square (-10 to 10); for metres or other units, describe the area by a frame, in \
                        OpenSession or, without a session, in the request";
        *far = Some(Box::new(Invalid::new(format!("{}.{axis}", field()), value, expected)));
    }
    Ok([x, y])
}

/// A UAV of a scene.
#[derive(Clone, Debug)]
pub struct SceneUav {
    /// Id.
    pub id: String,
    /// Position.
    pub position: Point,
    /// Speed, where it has one of its own.
    pub speed: Option<f64>,
    /// Time that it can still fly in seconds, where known.
    pub endurance: Option<f64>,
}

/// Numbers of those UAVs that have one, by index in the request.
#[derive(Default)]
struct UavNumbers(Vec<(u32, f64)>);

impl UavNumbers {
    fn push(&mut self, place: usize, value: Option<f64>, field: impl Fn() -> String) -> Result<(), Invalid> {
        let Some(value) = value else { return Ok(()) };
        check_finite(&field, value)?;
        in_range(&field(), value, 0.0..=MAX_UAV_NUMBER)?;
        self.0.push((place as u32, value));
        Ok(())
    }

    /// The number of each UAV in canonical order; empty if none has one.
    fn sorted(self, request_of_canonical: &[u32]) -> Vec<Option<f64>> {
        if self.0.is_empty() {
            return Vec::new();
        }
        let of = |place: &u32| self.0.binary_search_by_key(place, |(place, _)| *place).ok().map(|at| self.0[at].1);
        request_of_canonical.iter().map(of).collect()
    }
}

/// Checks an AoI.
pub(crate) fn check_aoi(field: impl Fn() -> String, value: f64) -> Result<f32, Invalid> {
    if !(0.0..=MAX_AOI).contains(&value) {
        check_finite(&field, value)?;
        in_range(&field(), value, 0.0..=MAX_AOI)?;
    }
    Ok(value as f32)
}

impl FleetInput {
    /// The input of a scene: id, position and speed of each UAV; id, position and AoI of each user.
    ///
    /// # Errors
    /// A field that is not valid, named as `scene.users[2].aoi`.
    pub fn from_scene(
        uavs: impl ExactSizeIterator<Item = SceneUav>,
        users: impl ExactSizeIterator<Item = (String, Point, f64)>,
    ) -> Result<Self, Invalid> {
        check_counts("scene", uavs.len(), users.len())?;
        let mut positions = Vec::with_capacity(uavs.len());
        let mut ids = Ids::with_capacity(uavs.len());
        let (mut speeds, mut endurances, mut far) = (UavNumbers::default(), UavNumbers::default(), None);
        for (i, SceneUav { id, position, speed, endurance }) in uavs.enumerate() {
            positions.push(check_point(|| format!("scene.uavs[{i}]"), position, &mut far)?);
            speeds.push(i, speed, || format!("scene.uavs[{i}].speed"))?;
            endurances.push(i, endurance, || format!("scene.uavs[{i}].endurance_seconds"))?;
            ids.push(|| format!("scene.uavs[{i}].id"), id, i)?;
        }
        let (uav_ids, uav_places) = ids.sorted();
        let mut states = Vec::with_capacity(users.len());
        let mut ids = Ids::with_capacity(users.len());
        for (i, (id, position, age)) in users.enumerate() {
            let position = check_point(|| format!("scene.users[{i}]"), position, &mut far)?;
            states.push((position, check_aoi(|| format!("scene.users[{i}].aoi"), age)?));
            ids.push(|| format!("scene.users[{i}].id"), id, i)?;
        }
        let (user_ids, user_places) = ids.sorted();
        check_distinct((&uav_ids, &uav_places), (&user_ids, &user_places), |is_uav, place| {
            format!("scene.{}[{place}].id", if is_uav { "uavs" } else { "users" })
        })?;
        Ok(Self {
            canonical_of_request: canonical_of_request(&uav_places),
            speeds: speeds.sorted(&uav_places),
            endurances: endurances.sorted(&uav_places),
            far,
            content: SceneOrGraph::Scene(Scene {
                uavs: uav_places.iter().map(|&place| positions[place as usize]).collect(),
                users: user_places.iter().map(|&place| states[place as usize].0).collect(),
                aoi: user_places.iter().map(|&place| states[place as usize].1).collect(),
            }),
            fleet: FleetIds { uavs: uav_ids, users: user_ids },
        })
    }

    /// The input of a graph.
    ///
    /// # Errors
    /// A field that is not valid, named as `graph.nodes[2].id`.
    pub fn from_nodes<D: ExactSizeIterator<Item = NodeDetection>>(nodes: Vec<Node<D>>) -> Result<Self, Invalid> {
        check_nodes("graph.nodes", nodes.len())?;
        let mut nodes: Vec<Option<Node<D>>> = nodes.into_iter().map(Some).collect();
        let (mut uavs, mut users) = (Ids::default(), Ids::default());
        let (mut speeds, mut endurances) = (UavNumbers::default(), UavNumbers::default());
        for (place, node) in nodes.iter_mut().flatten().enumerate() {
            for (name, value, numbers) in
                [("speed", node.speed, &mut speeds), ("endurance_seconds", node.endurance, &mut endurances)]
            {
                if let Some(value) = value.filter(|_| !node.is_uav) {
                    return Err(Invalid::new(
                        format!("graph.nodes[{place}].{name}"),
                        value,
                        "no value, because the node is a user",
                    ));
                }
                numbers.push(place, value, || format!("graph.nodes[{place}].{name}"))?;
            }
            let ids = if node.is_uav { &mut uavs } else { &mut users };
            ids.push(|| format!("graph.nodes[{place}].id"), std::mem::take(&mut node.id), place)?;
        }
        let ((uavs, uav_places), (users, user_places)) = (uavs.sorted(), users.sorted());
        check_counts("graph.nodes", uavs.len(), users.len())?;
        check_distinct((&uavs, &uav_places), (&users, &user_places), |_, place| format!("graph.nodes[{place}].id"))?;
        let indices = node_indices(&uavs, &users);
        let mut builder = Builder::new(uavs.len(), users.len());
        for (index, &place) in uav_places.iter().chain(&user_places).enumerate() {
            if let Some(node) = nodes[place as usize].take() {
                builder.push(index, place, node, &indices)?;
            }
        }
        let graph = mirror(builder.graph);
        Ok(Self {
            canonical_of_request: canonical_of_request(&uav_places),
            speeds: speeds.sorted(&uav_places),
            endurances: endurances.sorted(&uav_places),
            far: builder.far,
            content: SceneOrGraph::Graph(graph),
            fleet: FleetIds { uavs, users },
        })
    }
}

struct Builder {
    graph: ReportedGraph,
    /// Who reported the AoI of each user.
    reported_by: Vec<Reporter>,
    /// The first position that is far from the unit square.
    far: Option<Box<Invalid>>,
}

impl Builder {
    fn new(uavs: usize, users: usize) -> Self {
        let graph = ReportedGraph {
            positions: vec![None; uavs],
            aoi: vec![0.0; users],
            detections: Vec::with_capacity(uavs + users),
            without_detections: vec![false; users],
            request_of_canonical: Vec::with_capacity(uavs + users),
            form: GraphForm::Nodes,
        };
        Self { graph, reported_by: vec![Reporter::Nobody; users], far: None }
    }

    /// Adds the node at `place` of the request. Nodes come in canonical order.
    fn push<D: ExactSizeIterator<Item = NodeDetection>>(
        &mut self,
        index: usize,
        place: u32,
        node: Node<D>,
        indices: &HashMap<&str, u32>,
    ) -> Result<(), Invalid> {
        self.graph.request_of_canonical.push(place);
        let uavs = self.graph.positions.len();
        let path = || format!("graph.nodes[{place}]");
        if let Some(user) = index.checked_sub(uavs) {
            if let Some(value) = node.aoi {
                self.set_aoi(user, value, Reporter::User, || format!("{}.aoi", path()))?;
            }
            if let Some([x, y]) = node.position {
                let expected = "no value, because only UAVs have positions in a graph";
                return Err(Invalid::new(format!("{}.position", path()), format!("({x}, {y})"), expected));
            }
            self.graph.without_detections[user] = node.detections.len() == 0;
        } else {
            if let Some(value) = node.aoi {
                return Err(Invalid::new(format!("{}.aoi", path()), value, "no value, because only users have an AoI"));
            }
            if let Some(position) = node.position {
                self.graph.positions[index] = Some(check_point(|| format!("{}.position", path()), position, &mut self.far)?);
            }
        }
        let mut list = Vec::with_capacity(node.detections.len());
        for (i, detection) in node.detections.enumerate() {
            let field = |name: &str| format!("graph.nodes[{place}].detections[{i}].{name}");
            let NodeDetection { target_id, rel, aoi } = detection;
            let Some(&target) = indices.get(target_id.as_str()) else {
                return Err(Invalid::new(field("target_id"), format!("{target_id:?}"), "the id of a node in the graph"));
            };
            if target as usize == index {
                return Err(Invalid::new(field("target_id"), format!("{target_id:?}"), "the id of another node"));
            }
            let rel = [check_finite(|| field("rel_x"), rel[0])?, check_finite(|| field("rel_y"), rel[1])?];
            match ((target as usize).checked_sub(uavs), aoi) {
                (Some(user), Some(value)) => self.set_aoi(user, value, Reporter::Other, || field("aoi"))?,
                (Some(_), None) => return Err(Invalid::missing(field("aoi"), "the AoI of the user in slots")),
                (None, Some(value)) => return Err(Invalid::new(field("aoi"), value, "no value, because the target is a UAV")),
                (None, None) => {}
            }
            list.push(ReportedDetection { target, rel, request_index: i as u32, mirrored: false });
        }
        list.sort_by_key(|s| s.target);
        if let Some(pair) = list.windows(2).find(|pair| pair[0].target == pair[1].target) {
            let field = format!("{}.detections[{}].target_id", path(), pair[1].request_index);
            let id = indices.iter().find(|(_, target)| **target == pair[1].target).map_or("", |(id, _)| id);
            return Err(Invalid::new(field, format!("{id:?}"), "one detection per target"));
        }
        self.graph.detections.push(list);
        Ok(())
    }

    fn set_aoi(&mut self, user: usize, value: f64, by: Reporter, field: impl Fn() -> String) -> Result<(), Invalid> {
        let value = check_aoi(&field, value)?;
        let (known, reported_by) = (&mut self.graph.aoi[user], &mut self.reported_by[user]);
        if by > *reported_by || (by == *reported_by && value < *known) {
            (*known, *reported_by) = (value, by);
        }
        Ok(())
    }
}

/// Who reported the AoI of a user, from the least to the most reliable.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Reporter {
    Nobody,
    /// A node that detects the user.
    Other,
    User,
}

/// Mirrors detections that one side reports. Lists are in ascending order of target.
pub(crate) fn mirror(mut graph: ReportedGraph) -> ReportedGraph {
    let mut mirrored = Vec::new();
    for (node, list) in graph.detections.iter().enumerate() {
        for detection in list {
            let other = &graph.detections[detection.target as usize];
            if other.binary_search_by_key(&(node as u32), |s| s.target).is_err() {
                let rel = [-detection.rel[0], -detection.rel[1]];
                let back = ReportedDetection { target: node as u32, rel, request_index: 0, mirrored: true };
                mirrored.push((detection.target as usize, back));
            }
        }
    }
    for (node, detection) in mirrored {
        graph.detections[node].push(detection);
    }
    for list in &mut graph.detections {
        list.sort_by_key(|s| s.target);
    }
    graph
}
