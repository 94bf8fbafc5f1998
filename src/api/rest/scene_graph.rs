//! Graphs and scenes in requests and responses. `/v1/act` accepts those of an environment unchanged.

use serde::{Deserialize, Serialize};
use serde_json::json;
use utoipa::ToSchema;
use utoipa::openapi::RefOr;
use utoipa::openapi::schema::Schema;

use crate::api::config_schemas::schema;
use crate::api::convert::scene_graph::{nodes, uavs, users};
use crate::api::json::objects_only;
use crate::env::Point;
use crate::invalid::Invalid;
use crate::serving::{self, CopyObservation, FleetInput};

/// The detections of all nodes. Every measurement is that of its node, with an error of its own; two nodes need not agree.
/// If only one of two nodes reports the other, the server adds the reverse detection (see `symmetric`).
#[derive(Debug, Deserialize, Serialize, ToSchema)]
#[serde(deny_unknown_fields, remote = "Self")]
pub(super) struct Graph {
    #[schema(min_items = 1, max_items = 20000)]
    nodes: Vec<Node>,
}

#[derive(Debug, Deserialize, Serialize, ToSchema)]
#[serde(deny_unknown_fields, remote = "Self")]
pub(super) struct Node {
    /// Unique in the graph, the same for the same node in every slot.
    #[schema(min_length = 1, max_length = 128)]
    id: String,
    #[schema(schema_with = node_kind)]
    kind: NodeKind,
    /// The nodes within the detection range of this node. Empty for a user: the server derives them from the detections of the
    /// UAVs.
    #[serde(default)]
    detections: Vec<Detection>,
    /// Position of a UAV. Required by policies with `NEEDS_OWN_POSITIONS`.
    #[serde(skip_serializing_if = "Option::is_none")]
    position: Option<Position>,
    /// AoI of a user in slots. Default: the smallest AoI in the detections of the user, or 0 if no node detects the user.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 0, maximum = 1e6)]
    aoi: Option<f64>,
    /// Speed of a UAV, per second. Default: that of the world.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 0)]
    speed: Option<f64>,
    /// Time that the UAV can still fly, in seconds; for the constraint `return_in_time`.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 0)]
    endurance_seconds: Option<f64>,
}

#[derive(Clone, Copy, Debug, Deserialize, Serialize)]
enum NodeKind {
    #[serde(rename = "NODE_KIND_UAV", alias = "uav")]
    Uav,
    #[serde(rename = "NODE_KIND_USER", alias = "user")]
    User,
}

fn node_kind() -> RefOr<Schema> {
    schema(json!({"type": "string", "enum": ["NODE_KIND_UAV", "NODE_KIND_USER", "uav", "user"]}))
}

#[derive(Debug, Deserialize, Serialize, ToSchema)]
#[serde(deny_unknown_fields, remote = "Self")]
struct Detection {
    target_id: String,
    /// Position of the target minus position of the node, in units of the side of the square or of the frame.
    rel_x: f64,
    rel_y: f64,
    /// Height difference. Ignored: policies fly in the plane.
    #[serde(skip_serializing_if = "Option::is_none")]
    rel_z: Option<f64>,
    /// AoI in slots; required if the target is a user, absent if it is a UAV.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 0, maximum = 1e6)]
    aoi: Option<f64>,
}

/// A position, in units of the square's side or in the coordinates of the frame.
#[derive(Debug, Deserialize, Serialize, ToSchema)]
#[serde(deny_unknown_fields, remote = "Self")]
struct Position {
    #[schema(minimum = -1e9, maximum = 1e9)]
    x: f64,
    #[schema(minimum = -1e9, maximum = 1e9)]
    y: f64,
    /// Altitude. Ignored: policies fly in the plane.
    #[serde(skip_serializing_if = "Option::is_none")]
    z: Option<f64>,
}

/// The absolute positions of all UAVs and users. The server derives the detections.
#[derive(Debug, Deserialize, Serialize, ToSchema)]
#[serde(deny_unknown_fields, remote = "Self")]
pub(super) struct Scene {
    #[schema(min_items = 1, max_items = 20000)]
    uavs: Vec<Uav>,
    #[serde(default)]
    #[schema(max_items = 20000)]
    users: Vec<User>,
}

#[derive(Debug, Deserialize, Serialize, ToSchema)]
#[serde(deny_unknown_fields, remote = "Self")]
struct Uav {
    #[schema(min_length = 1, max_length = 128)]
    id: String,
    #[schema(minimum = -1e9, maximum = 1e9)]
    x: f64,
    #[schema(minimum = -1e9, maximum = 1e9)]
    y: f64,
    /// Altitude. Ignored: policies fly in the plane.
    #[serde(skip_serializing_if = "Option::is_none")]
    z: Option<f64>,
    /// Speed per second. Default: that of the world.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 0)]
    speed: Option<f64>,
    /// Time that the UAV can still fly, in seconds; for the constraint `return_in_time`.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 0)]
    endurance_seconds: Option<f64>,
}

#[derive(Debug, Deserialize, Serialize, ToSchema)]
#[serde(deny_unknown_fields, remote = "Self")]
struct User {
    #[schema(min_length = 1, max_length = 128)]
    id: String,
    #[schema(minimum = -1e9, maximum = 1e9)]
    x: f64,
    #[schema(minimum = -1e9, maximum = 1e9)]
    y: f64,
    /// Altitude. Ignored: policies fly in the plane.
    #[serde(skip_serializing_if = "Option::is_none")]
    z: Option<f64>,
    /// AoI in slots.
    #[schema(minimum = 0, maximum = 1e6)]
    aoi: f64,
}

objects_only!(Serialize + Graph, Node, Detection, Position, Scene, Uav, User);

impl Graph {
    /// Numbers of nodes and detections.
    pub(super) fn len(&self) -> (usize, usize) {
        (self.nodes.len(), self.nodes.iter().map(|node| node.detections.len()).sum())
    }
}

impl TryFrom<Graph> for FleetInput {
    type Error = Invalid;

    fn try_from(graph: Graph) -> Result<Self, Invalid> {
        let node = |node: Node| {
            let serving::Node { id, is_uav, detections, position, aoi, speed, endurance } = node.into_domain();
            serving::Node { id, is_uav, detections: detections.into_iter(), position, aoi, speed, endurance }
        };
        Self::from_nodes(graph.nodes.into_iter().map(node).collect())
    }
}

impl Node {
    /// The node, not checked yet.
    pub(super) fn into_domain(self) -> serving::Node<Vec<serving::NodeDetection>> {
        let detection = |d: Detection| serving::NodeDetection { target_id: d.target_id, rel: [d.rel_x, d.rel_y], aoi: d.aoi };
        serving::Node {
            id: self.id,
            is_uav: matches!(self.kind, NodeKind::Uav),
            detections: self.detections.into_iter().map(detection).collect(),
            position: self.position.map(|p| [p.x, p.y]),
            aoi: self.aoi,
            speed: self.speed,
            endurance: self.endurance_seconds,
        }
    }
}

impl Graph {
    /// The graph of an observation, if it has one.
    pub(super) fn of(observation: &CopyObservation) -> Option<Self> {
        let detection = |d: serving::NodeDetection| {
            let [rel_x, rel_y] = d.rel;
            Detection { target_id: d.target_id, rel_x, rel_y, rel_z: None, aoi: d.aoi }
        };
        let nodes = nodes(observation)?.map(|node| Node {
            id: node.id,
            kind: if node.is_uav { NodeKind::Uav } else { NodeKind::User },
            detections: node.detections.map(detection).collect(),
            position: node.position.map(|[x, y]| Position { x, y, z: None }),
            aoi: node.aoi,
            speed: None,
            endurance_seconds: None,
        });
        Some(Self { nodes: nodes.collect() })
    }
}

impl Scene {
    /// Number of UAVs and users.
    pub(super) fn len(&self) -> usize {
        self.uavs.len() + self.users.len()
    }
}

impl TryFrom<Scene> for FleetInput {
    type Error = Invalid;

    fn try_from(scene: Scene) -> Result<Self, Invalid> {
        let uavs = scene.uavs.into_iter().map(|u| serving::SceneUav {
            id: u.id,
            position: [u.x, u.y],
            speed: u.speed,
            endurance: u.endurance_seconds,
        });
        let users = scene.users.into_iter().map(|u| (u.id, [u.x, u.y], u.aoi));
        Self::from_scene(uavs, users)
    }
}

impl From<&CopyObservation> for Scene {
    fn from(observation: &CopyObservation) -> Self {
        let uav = |(id, [x, y]): (String, Point)| Uav { id, x, y, z: None, speed: None, endurance_seconds: None };
        let user = |(id, [x, y], aoi): (String, Point, f64)| User { id, x, y, z: None, aoi };
        Self { uavs: uavs(observation).map(uav).collect(), users: users(observation).map(user).collect() }
    }
}
