//! Graphs and scenes in requests and responses. `/v1/act` accepts those of an environment unchanged.

use serde::{Deserialize, Serialize};
use serde_json::json;
use utoipa::ToSchema;
use utoipa::openapi::RefOr;
use utoipa::openapi::schema::Schema;

use super::config_schemas::schema;
use super::json::objects_only;
use crate::api::convert::scene_graph::{nodes, uavs, users};
use crate::env::Point;
use crate::invalid::Invalid;
use crate::policy::FleetGraph;
use crate::serving::{self, FleetInput};

/// The detections of all nodes. If only one of two nodes reports a detection, the server adds the reverse detection. If both
/// report one, the relative position of one must be the negation of the other, within 1e-5.
#[derive(Debug, Deserialize, Serialize, ToSchema)]
#[serde(deny_unknown_fields, remote = "Self")]
pub(super) struct Graph {
    #[schema(min_items = 1, max_items = 20000)]
    nodes: Vec<Node>,
}

#[derive(Debug, Deserialize, Serialize, ToSchema)]
#[serde(deny_unknown_fields, remote = "Self")]
struct Node {
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
    /// AoI of a user in slots. Default: the AoI in a detection of the user, or 0 if no node detects the user.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 0, maximum = 1e6)]
    aoi: Option<f64>,
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
    /// Position of the target minus position of the node, in units of the side of the square.
    rel_x: f64,
    rel_y: f64,
    /// AoI in slots; required if the target is a user, absent if it is a UAV.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 0, maximum = 1e6)]
    aoi: Option<f64>,
}

/// A position in units of the square's side.
#[derive(Debug, Deserialize, Serialize, ToSchema)]
#[serde(deny_unknown_fields, remote = "Self")]
struct Position {
    #[schema(minimum = -1e4, maximum = 1e4)]
    x: f64,
    #[schema(minimum = -1e4, maximum = 1e4)]
    y: f64,
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
    #[schema(minimum = -1e4, maximum = 1e4)]
    x: f64,
    #[schema(minimum = -1e4, maximum = 1e4)]
    y: f64,
}

#[derive(Debug, Deserialize, Serialize, ToSchema)]
#[serde(deny_unknown_fields, remote = "Self")]
struct User {
    #[schema(min_length = 1, max_length = 128)]
    id: String,
    #[schema(minimum = -1e4, maximum = 1e4)]
    x: f64,
    #[schema(minimum = -1e4, maximum = 1e4)]
    y: f64,
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
        let node = |node: Node| serving::Node {
            id: node.id,
            is_uav: matches!(node.kind, NodeKind::Uav),
            detections: node.detections.into_iter().map(|d| serving::NodeDetection {
                target_id: d.target_id,
                rel: [d.rel_x, d.rel_y],
                aoi: d.aoi,
            }),
            position: node.position.map(|p| [p.x, p.y]),
            aoi: node.aoi,
        };
        Self::from_nodes(graph.nodes.into_iter().map(node).collect())
    }
}

impl From<&FleetGraph> for Graph {
    fn from(graph: &FleetGraph) -> Self {
        let detection = |d: serving::NodeDetection| {
            let [rel_x, rel_y] = d.rel;
            Detection { target_id: d.target_id, rel_x, rel_y, aoi: d.aoi }
        };
        let nodes = nodes(graph).map(|node| Node {
            id: node.id,
            kind: if node.is_uav { NodeKind::Uav } else { NodeKind::User },
            detections: node.detections.map(detection).collect(),
            position: node.position.map(|[x, y]| Position { x, y }),
            aoi: node.aoi,
        });
        Self { nodes: nodes.collect() }
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
        let uavs = scene.uavs.into_iter().map(|u| (u.id, [u.x, u.y]));
        let users = scene.users.into_iter().map(|u| (u.id, [u.x, u.y], u.aoi));
        Self::from_scene(uavs, users)
    }
}

impl From<&serving::Scene> for Scene {
    fn from(scene: &serving::Scene) -> Self {
        let uav = |(id, [x, y]): (String, Point)| Uav { id, x, y };
        let user = |(id, [x, y], aoi): (String, Point, f64)| User { id, x, y, aoi };
        Self { uavs: uavs(scene).map(uav).collect(), users: users(scene).map(user).collect() }
    }
}
