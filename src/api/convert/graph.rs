//! `Graph` to [`Observation`]: ids resolved, AoI gathered, detections made symmetric.
//!
//! A is symmetric (spec 2.5), so a detection reported by one side only is mirrored; reported by both, the two have to be
//! each other's negation.

use std::collections::HashMap;

use super::fleet::{check_counts, check_nodes, distinct, index, request_order};
use super::{Ids, aoi, finite, point};
use crate::invalid::Invalid;
use crate::serving::{Fleet, Graph, GraphForm, Observation, ReportedDetection, SceneOrGraph};
use crate::wire::v1;

/// Two reports of one pair may differ by this much: callers may compute in f32.
const AGREEMENT: f64 = 1e-5;

impl TryFrom<v1::Graph> for Observation {
    type Error = Invalid;

    fn try_from(graph: v1::Graph) -> Result<Self, Invalid> {
        let mut nodes = graph.nodes;
        check_nodes("graph.nodes", nodes.len())?;
        let mut ids = [Ids::default(), Ids::default()];
        for (place, node) in nodes.iter_mut().enumerate() {
            let of_kind = match v1::NodeKind::try_from(node.kind) {
                Ok(v1::NodeKind::Uav) => 0,
                Ok(v1::NodeKind::User) => 1,
                _ => {
                    let field = format!("graph.nodes[{place}].kind");
                    return Err(Invalid::new(field, node.kind, "NODE_KIND_UAV (1) or NODE_KIND_USER (2)"));
                }
            };
            ids[of_kind].push(|| format!("graph.nodes[{place}].id"), std::mem::take(&mut node.id), place)?;
        }
        let [(uavs, uav_places), (users, user_places)] = ids.map(Ids::sorted);
        check_counts("graph.nodes", uavs.len(), users.len())?;
        distinct((&uavs, &uav_places), (&users, &user_places), |_, place| format!("graph.nodes[{place}].id"))?;
        let by_id = index(&uavs, &users);
        let mut builder = Builder::new(uavs.len(), users.len());
        for (node, &place) in uav_places.iter().chain(&user_places).enumerate() {
            builder.node(node, place as usize, std::mem::take(&mut nodes[place as usize]), &by_id)?;
        }
        let graph = mirror(builder.graph)?;
        Ok(Self { uav_order: request_order(&uav_places), content: SceneOrGraph::Graph(graph), fleet: Fleet { uavs, users } })
    }
}

struct Builder {
    graph: Graph,
    /// Whether somebody said the AoI of a user.
    told: Vec<bool>,
}

impl Builder {
    fn new(uavs: usize, users: usize) -> Self {
        let graph = Graph {
            positions: vec![None; uavs],
            aoi: vec![0.0; users],
            detections: Vec::with_capacity(uavs + users),
            left_out: vec![false; users],
            places: Vec::with_capacity(uavs + users),
            form: GraphForm::Nodes,
        };
        Self { graph, told: vec![false; users] }
    }

    /// Nodes come in canonical order.
    fn node(&mut self, node: usize, place: usize, sent: v1::Node, by_id: &HashMap<&str, u32>) -> Result<(), Invalid> {
        self.graph.places.push(place as u32);
        let uavs = self.graph.positions.len();
        let at = || format!("graph.nodes[{place}]");
        if let Some(user) = node.checked_sub(uavs) {
            if let Some(value) = sent.aoi {
                self.tell_aoi(user, value, || format!("{}.aoi", at()))?;
            }
            if sent.position.is_some() {
                return Err(Invalid::new(
                    format!("{}.position", at()),
                    "a position",
                    "no value, because only UAVs have positions in a graph",
                ));
            }
            self.graph.left_out[user] = sent.detections.is_empty();
        } else {
            if let Some(value) = sent.aoi {
                return Err(Invalid::new(format!("{}.aoi", at()), value, "no value, because only users have an AoI"));
            }
            if let Some(p) = sent.position {
                self.graph.positions[node] = Some(point(|| format!("{}.position", at()), p.x, p.y)?);
            }
        }
        let mut list = Vec::with_capacity(sent.detections.len());
        for (i, detection) in sent.detections.into_iter().enumerate() {
            let field = |name: &str| format!("{}.detections[{i}].{name}", at());
            let Some(&target) = by_id.get(detection.target_id.as_str()) else {
                return Err(Invalid::new(
                    field("target_id"),
                    format!("{:?}", detection.target_id),
                    "the id of a node in the graph",
                ));
            };
            if target as usize == node {
                return Err(Invalid::new(field("target_id"), format!("{:?}", detection.target_id), "the id of another node"));
            }
            let rel = [finite(|| field("rel_x"), detection.rel_x)?, finite(|| field("rel_y"), detection.rel_y)?];
            match ((target as usize).checked_sub(uavs), detection.aoi) {
                (Some(user), Some(value)) => self.tell_aoi(user, value, || field("aoi"))?,
                (Some(_), None) => return Err(Invalid::missing(field("aoi"), "the AoI of the user in slots")),
                (None, Some(value)) => return Err(Invalid::new(field("aoi"), value, "no value, because the target is a UAV")),
                (None, None) => {}
            }
            list.push(ReportedDetection { target, rel, place: i as u32, mirrored: false });
        }
        list.sort_by_key(|s| s.target);
        if let Some(pair) = list.windows(2).find(|pair| pair[0].target == pair[1].target) {
            let field = format!("{}.detections[{}].target_id", at(), pair[1].place);
            let target = format!("node {} twice", pair[1].target);
            return Err(Invalid::new(field, target, "one detection per target"));
        }
        self.graph.detections.push(list);
        Ok(())
    }

    fn tell_aoi(&mut self, user: usize, value: f64, field: impl Fn() -> String) -> Result<(), Invalid> {
        let value = aoi(&field, value)?;
        let known = self.graph.aoi[user];
        if self.told[user] && known.to_bits() != value.to_bits() {
            return Err(Invalid::new(field(), value, format!("{known}, the AoI of the same user elsewhere in the graph")));
        }
        self.graph.aoi[user] = value;
        self.told[user] = true;
        Ok(())
    }
}

/// Mirrors what one side reports, and compares what both do. Lists come in ascending order of target.
pub(super) fn mirror(mut graph: Graph) -> Result<Graph, Invalid> {
    let mut mirrored = Vec::new();
    for (node, list) in graph.detections.iter().enumerate() {
        for detection in list {
            let back = [-detection.rel[0], -detection.rel[1]];
            let other = &graph.detections[detection.target as usize];
            let Ok(at) = other.binary_search_by_key(&(node as u32), |s| s.target) else {
                let back = ReportedDetection { target: node as u32, rel: back, place: 0, mirrored: true };
                mirrored.push((detection.target as usize, back));
                continue;
            };
            let [x, y] = other[at].rel;
            if (x - back[0]).abs() > AGREEMENT || (y - back[1]).abs() > AGREEMENT {
                let field = graph.rel_field(detection.target as usize, other[at].place);
                let expected =
                    format!("about ({}, {}), the negation of the position that the other node reports", back[0], back[1]);
                return Err(Invalid::new(field, format!("({x}, {y})"), expected));
            }
        }
    }
    for (node, detection) in mirrored {
        graph.detections[node].push(detection);
    }
    for list in &mut graph.detections {
        list.sort_by_key(|s| s.target);
    }
    Ok(graph)
}
