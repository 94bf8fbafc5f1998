//! Converts graphs and scenes from and to messages. In graphs and scenes of the server, ids are `uav-0`, ..., `user-0`, ...

use crate::env::Point;
use crate::invalid::Invalid;
use crate::serving::{CopyObservation, FleetInput, Node, NodeDetection, SceneUav};
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
            let detections = node.detections.into_iter().map(detection);
            Ok(Node {
                id: node.id,
                is_uav,
                detections,
                position,
                aoi: node.aoi,
                speed: node.speed,
                endurance: node.endurance_seconds,
            })
        };
        Self::from_nodes(graph.nodes.into_iter().enumerate().map(node).collect::<Result<_, _>>()?)
    }
}

impl TryFrom<v1::Scene> for FleetInput {
    type Error = Invalid;

    fn try_from(scene: v1::Scene) -> Result<Self, Invalid> {
        let uavs = scene.uavs.into_iter().map(|u| SceneUav {
            id: u.id,
            position: [u.x, u.y],
            speed: u.speed,
            endurance: u.endurance_seconds,
        });
        let users = scene.users.into_iter().map(|u| (u.id, [u.x, u.y], u.aoi));
        Self::from_scene(uavs, users)
    }
}

fn uav_id(i: u32) -> String {
    format!("uav-{i}")
}

fn user_id(j: u32) -> String {
    format!("user-{j}")
}

/// The UAVs of an observation.
pub fn uavs(observation: &CopyObservation) -> impl Iterator<Item = (String, Point)> {
    observation.scene.uavs.iter().zip(&observation.numbers.0).map(|(&position, &i)| (uav_id(i), position))
}

/// The users of an observation with their AoI.
pub fn users(observation: &CopyObservation) -> impl Iterator<Item = (String, Point, f64)> {
    let users = observation.scene.users.iter().zip(&observation.scene.aoi).zip(&observation.numbers.1);
    users.map(|((&position, &aoi), &j)| (user_id(j), position, f64::from(aoi)))
}

/// The nodes of an observation with their detections; `None` if it has no graph.
pub fn nodes(observation: &CopyObservation) -> Option<impl Iterator<Item = Node<impl Iterator<Item = NodeDetection>>>> {
    let (graph, (uav_numbers, user_numbers)) = (observation.graph.as_ref()?, &observation.numbers);
    let uavs = graph.uavs();
    let id = move |node: usize| node.checked_sub(uavs).map_or_else(|| uav_id(uav_numbers[node]), |j| user_id(user_numbers[j]));
    let aoi = move |node: usize| node.checked_sub(uavs).map(|user| f64::from(graph.aoi()[user]));
    Some((0..uavs + graph.users()).map(move |node| Node {
        id: id(node),
        is_uav: node < uavs,
        detections: graph.detections(node).iter().map(move |detection| {
            let target = detection.target as usize;
            NodeDetection { target_id: id(target), rel: detection.rel.map(f64::from), aoi: aoi(target) }
        }),
        position: graph.uav_positions().and_then(|positions| positions.get(node)).copied(),
        aoi: aoi(node),
        speed: None,
        endurance: None,
    }))
}

impl From<&CopyObservation> for v1::Scene {
    fn from(observation: &CopyObservation) -> Self {
        let uav = |(id, [x, y]): (String, Point)| v1::SceneUav { id, x, y, ..Default::default() };
        let user = |(id, [x, y], aoi): (String, Point, f64)| v1::SceneUser { id, x, y, aoi, z: None };
        Self { uavs: uavs(observation).map(uav).collect(), users: users(observation).map(user).collect() }
    }
}

/// The graph of an observation, if it has one.
pub fn graph(observation: &CopyObservation) -> Option<v1::Graph> {
    let detection =
        |d: NodeDetection| v1::Detection { target_id: d.target_id, rel_x: d.rel[0], rel_y: d.rel[1], aoi: d.aoi, rel_z: None };
    let nodes = nodes(observation)?.map(|node| v1::Node {
        id: node.id,
        kind: if node.is_uav { v1::NodeKind::Uav } else { v1::NodeKind::User }.into(),
        detections: node.detections.map(detection).collect(),
        position: node.position.map(|[x, y]| v1::Position { x, y, z: None }),
        aoi: node.aoi,
        speed: None,
        endurance_seconds: None,
    });
    Some(v1::Graph { nodes: nodes.collect() })
}
