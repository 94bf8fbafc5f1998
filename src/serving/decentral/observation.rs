//! What one UAV observes itself in one slot, in the unit square.

use crate::env::Point;
use crate::invalid::Invalid;
use crate::serving::nodes::{Node, NodeDetection};
use crate::serving::{FleetIds, FleetInput, Flight, SceneOrGraph, ids};

/// What a UAV observes itself.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Observation {
    /// Its position, where known.
    pub position: Option<Point>,
    /// Its speed per slot, if it has one of its own.
    pub speed: Option<f64>,
    /// What it detects, in ascending order of target.
    pub detections: Vec<OwnDetection>,
}

/// A node that a UAV detects.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OwnDetection {
    /// Canonical index of the node, UAVs first.
    pub target: u32,
    /// Position of the node minus position of the UAV.
    pub rel: Point,
    /// AoI of a user in slots; 0 for a UAV.
    pub aoi: f32,
}

impl Observation {
    /// The observation in `node` of UAV `node.id`, and the index of that UAV in `ids`.
    ///
    /// # Errors
    /// [`Invalid`] for a field that is not valid, named as in `observation.detections[2].rel_x`.
    pub fn new(node: Node<Vec<NodeDetection>>, ids: &FleetIds, flight: &Flight) -> Result<(u32, Self), Invalid> {
        if !node.is_uav {
            return Err(Invalid::new("observation.kind", "a user", "NODE_KIND_UAV (1)"));
        }
        let Ok(uav) = ids.uavs.binary_search_by(|id| FleetIds::order(id, &node.id)) else {
            return Err(Invalid::new("observation.id", format!("{:?}", node.id), "one of uav_ids"));
        };
        let known = |id: &str| {
            let find = |ids: &[String]| ids.binary_search_by(|other| FleetIds::order(other, id)).is_ok();
            find(&ids.uavs) || find(&ids.users)
        };
        if let Some((i, unknown)) = node.detections.iter().enumerate().find(|(_, d)| !known(&d.target_id)) {
            let field = format!("observation.detections[{i}].target_id");
            return Err(Invalid::new(field, format!("{:?}", unknown.target_id), "one of the uav_ids and user_ids of slot 0"));
        }
        // The checks are those of graphs: node 0 is the UAV, the others are only named.
        let others = ids.uavs.iter().enumerate().filter(|(i, _)| *i != uav).map(|(_, id)| (id, true));
        let others = others.chain(ids.users.iter().map(|id| (id, false)));
        let named = |(id, is_uav): (&String, bool)| Node {
            id: id.clone(),
            is_uav,
            detections: Vec::new().into_iter(),
            position: None,
            aoi: None,
            speed: None,
            endurance: None,
        };
        let Node { id, is_uav, detections, position, aoi, speed, endurance } = node;
        let own = Node { id, is_uav, detections: detections.into_iter(), position, aoi, speed, endurance };
        let input = FleetInput::from_nodes(std::iter::once(own).chain(others.map(named)).collect()).map_err(in_request)?;
        let FleetInput { speeds, far, mut content, .. } = input;
        flight.translate(&mut content, far.map(|far| Box::new(in_request(*far))))?;
        let speed =
            if speeds.is_empty() { None } else { flight.speeds(&speeds, |_| "observation.speed".to_owned())?.get(uav).copied() };
        let SceneOrGraph::Graph(graph) = content else { unreachable!("made of nodes") };
        graph.check_ranges(flight.sensing()).map_err(in_request)?;
        let aoi = |target: u32| (target as usize).checked_sub(ids.uavs.len()).map_or(0.0, |user| graph.aoi[user]);
        let detections =
            graph.detections[uav].iter().map(|d| OwnDetection { target: d.target, rel: d.rel, aoi: aoi(d.target) }).collect();
        Ok((uav as u32, Self { position: graph.positions[uav], speed, detections }))
    }
}

/// An error of a graph whose node 0 is the observation.
fn in_request(mut error: Invalid) -> Invalid {
    if let Some(rest) = error.field.strip_prefix("graph.nodes[0]") {
        error.field = format!("observation{rest}");
    }
    error
}

impl FleetIds {
    /// The ids of a fleet in canonical order, from lists in any order.
    ///
    /// # Errors
    /// [`Invalid`] for an id that is not valid or not distinct, named as in `uav_ids[2]`.
    pub fn new(uav_ids: Vec<String>, user_ids: Vec<String>) -> Result<Self, Invalid> {
        ids::check_counts("uav_ids", uav_ids.len(), user_ids.len())?;
        let sort = |name: &str, list: Vec<String>| {
            let mut sorted = ids::Ids::with_capacity(list.len());
            for (i, id) in list.into_iter().enumerate() {
                sorted.push(|| format!("{name}[{i}]"), id, i)?;
            }
            Ok(sorted.sorted())
        };
        let ((uavs, uav_places), (users, user_places)) = (sort("uav_ids", uav_ids)?, sort("user_ids", user_ids)?);
        ids::check_distinct((&uavs, &uav_places), (&users, &user_places), |is_uav, place| {
            format!("{}[{place}]", if is_uav { "uav_ids" } else { "user_ids" })
        })?;
        Ok(Self { uavs, users })
    }
}
