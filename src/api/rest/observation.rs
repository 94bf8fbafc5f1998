//! Graphs and scenes as JSON, in both directions: what an environment shows is what `/v1/act` reads.

use serde::{Deserialize, Serialize};

use crate::wire::v1;

#[derive(Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Graph {
    nodes: Vec<Node>,
}

#[derive(Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
struct Node {
    id: String,
    kind: Kind,
    #[serde(default)]
    detections: Vec<Detection>,
    #[serde(skip_serializing_if = "Option::is_none")]
    position: Option<Position>,
    #[serde(skip_serializing_if = "Option::is_none")]
    aoi: Option<f64>,
}

#[derive(Clone, Copy, Debug, Deserialize, Serialize)]
enum Kind {
    #[serde(rename = "NODE_KIND_UAV", alias = "uav")]
    Uav,
    #[serde(rename = "NODE_KIND_USER", alias = "user")]
    User,
}

#[derive(Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
struct Detection {
    target_id: String,
    rel_x: f64,
    rel_y: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    aoi: Option<f64>,
}

#[derive(Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
struct Position {
    x: f64,
    y: f64,
}

#[derive(Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Scene {
    uavs: Vec<Uav>,
    #[serde(default)]
    users: Vec<User>,
}

#[derive(Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
struct Uav {
    id: String,
    x: f64,
    y: f64,
}

#[derive(Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
struct User {
    id: String,
    x: f64,
    y: f64,
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
