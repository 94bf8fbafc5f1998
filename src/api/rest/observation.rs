//! Graphs and scenes as JSON, in both directions: what an environment shows is what `/v1/act` reads.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::schemas;
use crate::wire::v1;

/// What each node detects. Edges follow from detections, in both directions: what one side alone reports is mirrored; what both
/// report has to agree.
#[derive(Debug, Deserialize, Serialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct Graph {
    #[schema(min_items = 1, max_items = 20000)]
    nodes: Vec<Node>,
}

#[derive(Debug, Deserialize, Serialize, ToSchema)]
#[serde(deny_unknown_fields)]
struct Node {
    /// Unique in the graph, the same for the same entity in every slot.
    #[schema(min_length = 1, max_length = 128)]
    id: String,
    #[schema(value_type = schemas::NodeKind)]
    kind: Kind,
    /// What is within this node's detection range. For users it may be left out: it is then derived from the UAVs'.
    #[serde(default)]
    detections: Vec<Detection>,
    /// A UAV's own position, needed by policies that say so.
    #[serde(skip_serializing_if = "Option::is_none")]
    position: Option<Position>,
    /// A user's own AoI, in slots; where left out, it is taken from who detects the user.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 0, maximum = 1e6)]
    aoi: Option<f64>,
}

#[derive(Clone, Copy, Debug, Deserialize, Serialize)]
enum Kind {
    #[serde(rename = "NODE_KIND_UAV", alias = "uav")]
    Uav,
    #[serde(rename = "NODE_KIND_USER", alias = "user")]
    User,
}

#[derive(Debug, Deserialize, Serialize, ToSchema)]
#[serde(deny_unknown_fields)]
struct Detection {
    target_id: String,
    /// Target position minus own position, in units of the square's side.
    rel_x: f64,
    rel_y: f64,
    /// AoI in slots; required if the target is a user, absent if it is a UAV.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 0, maximum = 1e6)]
    aoi: Option<f64>,
}

/// A position in units of the square's side.
#[derive(Debug, Deserialize, Serialize, ToSchema)]
#[serde(deny_unknown_fields)]
struct Position {
    #[schema(minimum = -1e4, maximum = 1e4)]
    x: f64,
    #[schema(minimum = -1e4, maximum = 1e4)]
    y: f64,
}

/// Everything at absolute positions; the server derives who sees whom.
#[derive(Debug, Deserialize, Serialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct Scene {
    #[schema(min_items = 1, max_items = 20000)]
    uavs: Vec<Uav>,
    #[serde(default)]
    #[schema(max_items = 20000)]
    users: Vec<User>,
}

#[derive(Debug, Deserialize, Serialize, ToSchema)]
#[serde(deny_unknown_fields)]
struct Uav {
    #[schema(min_length = 1, max_length = 128)]
    id: String,
    #[schema(minimum = -1e4, maximum = 1e4)]
    x: f64,
    #[schema(minimum = -1e4, maximum = 1e4)]
    y: f64,
}

#[derive(Debug, Deserialize, Serialize, ToSchema)]
#[serde(deny_unknown_fields)]
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

impl From<Graph> for v1::Graph {
    fn from(graph: Graph) -> Self {
        let nodes = graph.nodes.into_iter().map(|node| v1::Node {
            id: node.id,
            kind: match node.kind {
                Kind::Uav => v1::NodeKind::Uav.into(),
                Kind::User => v1::NodeKind::User.into(),
            },
            detections: node.detections.into_iter().map(Into::into).collect(),
            position: node.position.map(|p| v1::Position { x: p.x, y: p.y }),
            aoi: node.aoi,
        });
        Self { nodes: nodes.collect() }
    }
}

impl From<v1::Graph> for Graph {
    fn from(graph: v1::Graph) -> Self {
        let nodes = graph.nodes.into_iter().map(|node| Node {
            kind: if node.kind() == v1::NodeKind::Uav { Kind::Uav } else { Kind::User },
            id: node.id,
            detections: node.detections.into_iter().map(Into::into).collect(),
            position: node.position.map(|p| Position { x: p.x, y: p.y }),
            aoi: node.aoi,
        });
        Self { nodes: nodes.collect() }
    }
}

impl From<Detection> for v1::Detection {
    fn from(d: Detection) -> Self {
        Self { target_id: d.target_id, rel_x: d.rel_x, rel_y: d.rel_y, aoi: d.aoi }
    }
}

impl From<v1::Detection> for Detection {
    fn from(d: v1::Detection) -> Self {
        Self { target_id: d.target_id, rel_x: d.rel_x, rel_y: d.rel_y, aoi: d.aoi }
    }
}

impl From<Scene> for v1::Scene {
    fn from(scene: Scene) -> Self {
        Self {
            uavs: scene.uavs.into_iter().map(|u| v1::SceneUav { id: u.id, x: u.x, y: u.y }).collect(),
            users: scene.users.into_iter().map(|u| v1::SceneUser { id: u.id, x: u.x, y: u.y, aoi: u.aoi }).collect(),
        }
    }
}

impl From<v1::Scene> for Scene {
    fn from(scene: v1::Scene) -> Self {
        Self {
            uavs: scene.uavs.into_iter().map(|u| Uav { id: u.id, x: u.x, y: u.y }).collect(),
            users: scene.users.into_iter().map(|u| User { id: u.id, x: u.x, y: u.y, aoi: u.aoi }).collect(),
        }
    }
}
