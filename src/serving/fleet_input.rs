//! The input of one fleet in one slot, and its conversion to the [`FleetGraph`] that a policy reads.
//!
//! `api::convert` builds a [`FleetInput`] and checks everything that does not depend on the policy. This file applies the
//! policy's detection range and needs: it computes the detections of a scene, and completes a graph.

use super::FleetIds;
use super::frame::Frame;
use crate::env::{Point, Ranges};
use crate::invalid::{Invalid, tidy};
use crate::policy::{Detection, FleetGraph, Policy, RequiredInput, estimate_detections};

/// Maximum number of nodes of one fleet.
pub const MAX_NODES: usize = 20_000;
/// Maximum number of detections of one input, including mirrored and derived ones.
pub const MAX_DETECTIONS: usize = 1 << 22;

/// Maximum number of memories that the UAVs of one input receive, times the number of users that each may hold.
const MAX_RECEIVED: usize = 1 << 31;

/// Reported distances may exceed the detection range by this factor, because sensors are not exact. Beyond, the caller uses other units or
/// another sensor than the policy was trained with.
const RANGE_TOLERANCE: f64 = 2.0;

/// Input of one fleet in one slot, in canonical order of ids.
#[derive(Clone, Debug, PartialEq)]
pub struct FleetInput {
    /// The ids of UAVs and users.
    pub fleet: FleetIds,
    /// Canonical index of each UAV in the order of the request.
    pub canonical_of_request: Vec<u32>,
    /// Speed of each UAV, in units of the caller per second, where it has one of its own; empty if none has.
    pub speeds: Vec<Option<f64>>,
    /// Time that each UAV can still fly in seconds, where known; empty if not known.
    pub endurances: Vec<Option<f64>>,
    /// The error of coordinates that are far from the unit square, unless the caller describes a frame.
    pub far: Option<Box<Invalid>>,
    /// Positions or detections.
    pub content: SceneOrGraph,
}

/// The two forms of an input.
#[derive(Clone, Debug, PartialEq)]
pub enum SceneOrGraph {
    /// Absolute positions.
    Scene(Scene),
    /// Detections.
    Graph(ReportedGraph),
}

/// Absolute positions of all nodes.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// Position of each UAV.
    pub uavs: Vec<Point>,
    /// Position of each user.
    pub users: Vec<Point>,
    /// AoI of each user in slots.
    pub aoi: Vec<f32>,
}

/// Detections of each node. Where only one of two nodes reports the other, the reverse detection is added as a mirrored one.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ReportedGraph {
    /// Own position of each UAV, where given.
    pub positions: Vec<Option<Point>>,
    /// AoI of each user in slots; 0 if it was not given.
    pub aoi: Vec<f32>,
    /// Detections of each node, UAVs first, in ascending order of target.
    pub detections: Vec<Vec<ReportedDetection>>,
    /// Whether the request has no detections of each user, so that they have to be derived.
    pub without_detections: Vec<bool>,
    /// Index of each node in the list of the request.
    pub request_of_canonical: Vec<u32>,
    /// Form of the request, for the field names in errors.
    pub form: GraphForm,
}

/// How a request describes a graph.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum GraphForm {
    /// Nodes, each with a list of detections.
    #[default]
    Nodes,
    /// One list of edges for the whole graph.
    Edges,
}

/// A detection of a request, in f64 and with its index in the request.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ReportedDetection {
    /// Canonical node index, UAVs first.
    pub target: u32,
    /// Position of the target minus position of the detecting node.
    pub rel: Point,
    /// Index of the detection among those of the node in the request, or in its list of edges.
    pub request_index: u32,
    /// Whether this detection is not in the request, but was added because the request has the reverse detection.
    pub mirrored: bool,
}

impl ReportedDetection {
    fn detection(&self) -> Detection {
        Detection { target: self.target, rel: self.rel.map(|x| x as f32) }
    }
}

impl FleetInput {
    /// M.
    pub fn uavs(&self) -> usize {
        self.fleet.uavs.len()
    }

    /// N.
    pub fn users(&self) -> usize {
        self.fleet.users.len()
    }

    /// The input of `policy`. Work is bounded by [`MAX_NODES`] and [`MAX_DETECTIONS`].
    ///
    /// # Errors
    /// [`Invalid`] if the fleet does not fit the policy, if something that the policy needs is missing, if a
    /// detection lies beyond its range, or if there are too many detections.
    pub fn into_fleet_graph(self, policy: &dyn Policy) -> Result<FleetGraph, Invalid> {
        let size = (self.uavs(), self.users());
        self.content.into_fleet_graph(size, policy, Sensing::of(policy))
    }
}

impl SceneOrGraph {
    /// As [`FleetInput::into_fleet_graph`], for a fleet of `(uavs, users)`.
    ///
    /// # Errors
    /// As [`FleetInput::into_fleet_graph`].
    pub fn into_fleet_graph(
        self,
        (uavs, users): (usize, usize),
        policy: &dyn Policy,
        sensing: Sensing,
    ) -> Result<FleetGraph, Invalid> {
        policy.check_fleet(uavs, users)?;
        let observers = policy.observers(uavs, users);
        match self {
            Self::Scene(Scene { uavs, users, aoi }) => {
                let limits = (observers, MAX_DETECTIONS);
                FleetGraph::from_scene_within(&uavs, &users, &aoi, sensing.ranges, limits)
                    .ok_or_else(|| too_many_detections("scene"))
            }
            Self::Graph(graph) => graph.into_fleet_graph(policy.needs(), observers, sensing),
        }
    }

    /// The input of a task of `policy`, for a fleet of `(uavs, users)`. Small inputs are converted here. Large ones are checked as far as
    /// that takes time in proportion to the nodes, and converted by the engine.
    ///
    /// # Errors
    /// As [`FleetInput::into_fleet_graph`]; for large inputs, only what can be found out quickly.
    pub fn into_task_input(self, size: (usize, usize), policy: &dyn Policy, sensing: Sensing) -> Result<TaskInput, Invalid> {
        let (uavs, users) = size;
        if uavs + users < LARGE_NODES {
            return self.into_fleet_graph(size, policy, sensing).map(TaskInput::Graph);
        }
        policy.check_fleet(uavs, users)?;
        let detections = match &self {
            Self::Scene(Scene { uavs: own, users: all, .. }) => {
                let estimate = estimate_detections(own, all, policy.observers(uavs, users), sensing.ranges);
                if estimate.at_least > MAX_DETECTIONS {
                    return Err(too_many_detections("scene"));
                }
                estimate.about.min(MAX_DETECTIONS)
            }
            // Users detect each other about as often as UAVs detect users.
            Self::Graph(graph) => 2 * graph.detections.iter().map(Vec::len).sum::<usize>(),
        };
        if policy.remembers_users() && self.links(uavs, sensing).saturating_mul(users) > MAX_RECEIVED {
            let value = format!("{uavs} UAVs in communication range of many others, and {users} users");
            let expected =
                "fewer UAVs or users, or a shorter communication range: the UAVs exchange what they remember of each user";
            return Err(Invalid::new(self.field(), value, expected));
        }
        Ok(TaskInput::Large { content: Box::new(self), size, sensing, detections })
    }

    /// Number of UAVs that other UAVs receive messages from, about.
    fn links(&self, count: usize, sensing: Sensing) -> usize {
        match self {
            Self::Scene(Scene { uavs, .. }) => {
                let ranges = Ranges { detection: sensing.ranges.communication, ..sensing.ranges };
                estimate_detections(uavs, &[], uavs.len(), ranges).about
            }
            Self::Graph(graph) => {
                let of_uavs = graph.detections.iter().take(count).flatten();
                2 * of_uavs.filter(|detection| (detection.target as usize) < count).count()
            }
        }
    }

    /// The field of the request.
    fn field(&self) -> &'static str {
        match self {
            Self::Scene(_) => "scene",
            Self::Graph(_) => "graph",
        }
    }

    /// The request's `field` of UAV `i`. `canonical_of_request`: see [`FleetInput`].
    pub fn uav_field(&self, i: usize, canonical_of_request: &[u32], field: &str) -> String {
        match self {
            Self::Scene(_) => {
                let place = canonical_of_request.iter().position(|&canonical| canonical as usize == i).unwrap_or(i);
                format!("scene.uavs[{place}].{field}")
            }
            Self::Graph(graph) => graph.uav_field(i, field),
        }
    }

    /// The position of each UAV, where known.
    pub fn uav_positions(&self) -> Vec<Option<Point>> {
        match self {
            Self::Scene(scene) => scene.uavs.iter().copied().map(Some).collect(),
            Self::Graph(graph) => graph.positions.clone(),
        }
    }

    /// Which users the caller lists.
    pub fn listed_users(&self) -> ListedUsers {
        match self {
            Self::Scene(scene) if scene.users.is_empty() => ListedUsers::Detected,
            Self::Scene(_) => ListedUsers::All,
            // What UAVs detect is mirrored, so the first detection of a user that is detected is that of a UAV.
            Self::Graph(graph) => {
                let uavs = graph.positions.len();
                let detected = |list: &Vec<ReportedDetection>| list.first().is_some_and(|d| (d.target as usize) < uavs);
                if graph.detections[uavs..].iter().all(detected) { ListedUsers::Detected } else { ListedUsers::Named }
            }
        }
    }
}

/// Which users an input lists.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ListedUsers {
    /// All that there are: it is a scene.
    All,
    /// Also users that no UAV detects; perhaps all.
    Named,
    /// Perhaps only those that a UAV detects: it is a graph in which every user is detected, or lists no user.
    Detected,
}

/// Which nodes detect each other.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sensing {
    /// Ranges within which nodes detect each other in a scene.
    pub ranges: Ranges,
    /// Whether, where only one of two nodes of a graph reports the other, both detect each other. What UAVs report of users holds for both in
    /// any case, unless the user reports detections itself.
    pub symmetric: bool,
    /// The frame of the caller, for errors in its units.
    pub frame: Option<Frame>,
}

impl Sensing {
    /// That of the environment of `policy`, symmetric.
    pub fn of(policy: &dyn Policy) -> Self {
        Self { ranges: policy.ranges(), symmetric: true, frame: None }
    }
}

/// Inputs with at least this many nodes are converted by the engine, not on the threads that serve connections.
pub const LARGE_NODES: usize = 256;

/// The input of a task of the engine.
#[derive(Clone, Debug)]
pub enum TaskInput {
    /// What the policy reads.
    Graph(FleetGraph),
    /// A large input that the engine converts.
    Large {
        /// Positions or detections.
        content: Box<SceneOrGraph>,
        /// M and N.
        size: (usize, usize),
        /// What detects what.
        sensing: Sensing,
        /// Estimated number of detections.
        detections: usize,
    },
}

impl TaskInput {
    /// M and N.
    pub fn size(&self) -> (usize, usize) {
        match self {
            Self::Graph(graph) => (graph.uavs(), graph.users()),
            Self::Large { size, .. } => *size,
        }
    }

    /// Number of detections, or its estimate.
    pub fn detection_count(&self) -> usize {
        match self {
            Self::Graph(graph) => graph.detection_count(),
            Self::Large { detections, .. } => *detections,
        }
    }
}

impl From<FleetGraph> for TaskInput {
    fn from(graph: FleetGraph) -> Self {
        Self::Graph(graph)
    }
}

pub(super) fn too_many_detections(field: &str) -> Invalid {
    let value = format!("more than {MAX_DETECTIONS} detections");
    Invalid::new(field, value, format!("at most {MAX_DETECTIONS} detections per request"))
}

pub(super) fn is_within(rel: &Point, range: f64) -> bool {
    rel[0] * rel[0] + rel[1] * rel[1] <= range * range
}

impl ReportedGraph {
    fn into_fleet_graph(mut self, needs: RequiredInput, observers: usize, sensing: Sensing) -> Result<FleetGraph, Invalid> {
        let ranges = sensing.ranges;
        if needs == RequiredInput::FullScene {
            return Err(Invalid::missing("scene", "a scene instead of a graph, because this policy needs all positions"));
        }
        let uavs = self.positions.len();
        if needs == RequiredInput::OwnPositions
            && let Some(i) = self.positions.iter().position(Option::is_none)
        {
            let field = self.uav_field(i, "position");
            return Err(Invalid::missing(field, "the position of the UAV, which this policy needs"));
        }
        self.check_ranges(sensing)?;
        if !sensing.symmetric {
            self.remove_mirrored();
        }
        // What users detect matters to a policy only if it observes them.
        let users = observers > uavs;
        let derived = if users { self.derive_user_detections(ranges.detection)? } else { Vec::new() };
        let mut offsets = Vec::with_capacity(self.detections.len() + 1);
        offsets.push(0);
        let reported = &self.detections[..observers];
        let mut detections = Vec::with_capacity(reported.iter().map(Vec::len).chain(derived.iter().map(Vec::len)).sum());
        for (node, list) in reported.iter().enumerate() {
            let begin = detections.len();
            detections.extend(list.iter().map(ReportedDetection::detection));
            if let Some(user) = node.checked_sub(uavs) {
                detections.extend_from_slice(&derived[user]);
                // The list of most users is sorted already: mirrored detections of UAVs, then derived ones of users.
                if !detections[begin..].is_sorted_by_key(|d| d.target) {
                    detections[begin..].sort_unstable_by_key(|d| d.target);
                }
            }
            offsets.push(detections.len() as u32);
        }
        offsets.resize(self.detections.len() + 1, detections.len() as u32);
        // All or none: a policy that uses positions needs the position of every UAV.
        let positions = self.positions.into_iter().collect::<Option<Vec<Point>>>();
        Ok(FleetGraph::from_flat_detections(positions, uavs, self.aoi, offsets, detections))
    }

    /// The request's `field` of UAV `i`. Edges have no other than their position.
    fn uav_field(&self, i: usize, field: &str) -> String {
        match self.form {
            GraphForm::Nodes => format!("graph.nodes[{}].{field}", self.request_of_canonical[i]),
            GraphForm::Edges => "uav_positions".into(),
        }
    }

    /// The request's field that holds the relative coordinate x (`axis` 0) or y (1) of detection `place` of `node`.
    pub fn rel_field(&self, node: usize, place: u32, axis: usize) -> String {
        match self.form {
            GraphForm::Nodes => {
                format!("graph.nodes[{}].detections[{place}].rel_{}", self.request_of_canonical[node], ["x", "y"][axis])
            }
            GraphForm::Edges => format!("edge_relative[{place}]"),
        }
    }

    /// Removes the reverse detections of nodes that report detections themselves.
    fn remove_mirrored(&mut self) {
        let uavs = self.positions.len();
        for (node, list) in self.detections.iter_mut().enumerate() {
            let senses = node.checked_sub(uavs).is_none_or(|user| !self.without_detections[user]);
            if senses {
                list.retain(|detection| !detection.mirrored);
            }
        }
    }

    /// Rejects detections far beyond the range: the caller uses other units, or a sensor that the policy was not trained with.
    pub(super) fn check_ranges(&self, Sensing { ranges, frame, .. }: Sensing) -> Result<(), Invalid> {
        let uavs = self.positions.len();
        for (node, list) in self.detections.iter().enumerate() {
            for detection in list.iter().filter(|d| !d.mirrored) {
                let range = ranges.between(node, detection.target as usize, uavs);
                if !is_within(&detection.rel, range * RANGE_TOLERANCE) {
                    let [x, y] = frame.map_or(detection.rel, |frame| frame.vector_out(detection.rel)).map(tidy);
                    let field = self.rel_field(node, detection.request_index, usize::from(y.abs() > x.abs()));
                    let expected = match frame {
                        Some(frame) => format!(
                            "a position within about the detection range ({}); for another sensor describe a world",
                            tidy(frame.length_out(range))
                        ),
                        None => format!(
                            "a position within about the range of the policy ({range} sides of the square); for other units describe the \
                             area by a frame, for another sensor a world"
                        ),
                    };
                    return Err(Invalid::new(field, format!("({x}, {y})"), expected));
                }
            }
        }
        Ok(())
    }
}
