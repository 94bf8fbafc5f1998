//! Converts graphs and scenes from and to messages. In graphs and scenes of the server, ids are `uav-0`, ..., `user-0`, ...

use crate::env::Point;
use crate::invalid::Invalid;
use crate::policy::FleetGraph;
use crate::serving::{FleetInput, Node, NodeDetection, Scene};
use crate::wire::v1;

impl TryFrom<v1::Graph> for FleetInput {
    type Error = Invalid;

    fn try_from(graph: v1::Graph) -> Result<Self, Invalid> {
        let node = |(place, node): (usize, v1::Node)| {
            let is_uav = match v1::NodeKind::try_from(node.kind) {
                Ok(v1::NodeKind::Uav) => true,
                Ok(v1::NodeKind::User) => false,
                _ => {
                    let field = format!("graph.nodes[{place}].kind");
                    return Err(Invalid::new(field, node.kind, "NODE_KIND_UAV (1) or NODE_KIND_USER (2)"));
                }
            };
            let detection = |d: v1::Detection| NodeDetection { target_id: d.target_id, rel: [d.rel_x, d.rel_y], aoi: d.aoi };
            let position = node.position.map(|p| [p.x, p.y]);
            Ok(Node { id: node.id, is_uav, detections: node.detections.into_iter().map(detection), position, aoi: node.aoi })
        };
        Self::from_nodes(graph.nodes.into_iter().enumerate().map(node).collect::<Result<_, _>>()?)
    }
}

impl TryFrom<v1::Scene> for FleetInput {
    type Error = Invalid;

    fn try_from(scene: v1::Scene) -> Result<Self, Invalid> {
        let uavs = scene.uavs.into_iter().map(|u| (u.id, [u.x, u.y]));
        let users = scene.users.into_iter().map(|u| (u.id, [u.x, u.y], u.aoi));
        Self::from_scene(uavs, users)
    }
}

fn uav_id(i: usize) -> String {
    format!("uav-{i}")
}

fn user_id(j: usize) -> String {
    format!("user-{j}")
}

/// The UAVs of a scene.
pub fn uavs(scene: &Scene) -> impl Iterator<Item = (String, Point)> {
    scene.uavs.iter().enumerate().map(|(i, &position)| (uav_id(i), position))
}

/// The users of a scene with their AoI.
pub fn users(scene: &Scene) -> impl Iterator<Item = (String, Point, f64)> {
    let users = scene.users.iter().zip(&scene.aoi).enumerate();
    users.map(|(j, (&position, &aoi))| (user_id(j), position, f64::from(aoi)))
}

/// The nodes of a slot with their detections.
pub fn nodes(graph: &FleetGraph) -> impl Iterator<Item = Node<impl Iterator<Item = NodeDetection>>> {
    let uavs = graph.uavs();
    let id = move |node: usize| node.checked_sub(uavs).map_or_else(|| uav_id(node), user_id);
    let aoi = move |node: usize| node.checked_sub(uavs).map(|user| f64::from(graph.aoi()[user]));
    (0..uavs + graph.users()).map(move |node| Node {
        id: id(node),
        is_uav: node < uavs,
        detections: graph.detections(node).iter().map(move |detection| {
            let target = detection.target as usize;
            NodeDetection { target_id: id(target), rel: detection.rel.map(f64::from), aoi: aoi(target) }
        }),
        position: graph.uav_positions().and_then(|positions| positions.get(node)).copied(),
        aoi: aoi(node),
    })
}

impl From<&Scene> for v1::Scene {
    fn from(scene: &Scene) -> Self {
        let uav = |(id, [x, y]): (String, Point)| v1::SceneUav { id, x, y };
        let user = |(id, [x, y], aoi): (String, Point, f64)| v1::SceneUser { id, x, y, aoi };
        Self { uavs: uavs(scene).map(uav).collect(), users: users(scene).map(user).collect() }
    }
}

impl From<&FleetGraph> for v1::Graph {
    fn from(graph: &FleetGraph) -> Self {
        let detection = |d: NodeDetection| v1::Detection { target_id: d.target_id, rel_x: d.rel[0], rel_y: d.rel[1], aoi: d.aoi };
        let nodes = nodes(graph).map(|node| v1::Node {
            id: node.id,
            kind: if node.is_uav { v1::NodeKind::Uav } else { v1::NodeKind::User }.into(),
            detections: node.detections.map(detection).collect(),
            position: node.position.map(|[x, y]| v1::Position { x, y }),
            aoi: node.aoi,
        });
        Self { nodes: nodes.collect() }
    }
}
