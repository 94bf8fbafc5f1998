//! Conversion of tensors to an [`FleetInput`]: a scene, or a graph as a list of edges.
//!
//! Node indices have the order of the request: first the UAVs, then the users.

use super::{Datatype, Tensor};
use crate::env::Point;
use crate::invalid::Invalid;
use crate::serving::ids::{Ids, canonical_of_request, check_counts, check_distinct};
use crate::serving::nodes::{check_aoi, check_finite, check_point, mirror};
use crate::serving::{
    FleetIds, FleetInput, GraphForm, MAX_DETECTIONS, MAX_NODES, ReportedDetection, ReportedGraph, Scene, SceneOrGraph,
};

/// The inputs of a fleet: name, datatype in the metadata, and the meaning of each dimension.
pub const INPUTS: [(&str, Datatype, &[Dimension]); 8] = [
    ("uav_positions", Datatype::Fp32, &[Dimension::Uavs, Dimension::Two]),
    ("user_positions", Datatype::Fp32, &[Dimension::Users, Dimension::Two]),
    ("user_aoi", Datatype::Fp32, &[Dimension::Users]),
    ("edge_index", Datatype::Int64, &[Dimension::Edges, Dimension::Two]),
    ("edge_relative", Datatype::Fp32, &[Dimension::Edges, Dimension::Two]),
    ("uav_count", Datatype::Int64, &[Dimension::One]),
    ("uav_ids", Datatype::Bytes, &[Dimension::Uavs]),
    ("user_ids", Datatype::Bytes, &[Dimension::Users]),
];

/// The meaning of a dimension.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Dimension {
    /// One value.
    One,
    /// x and y, or the two nodes of an edge.
    Two,
    /// Number of UAVs.
    Uavs,
    /// Number of users.
    Users,
    /// Number of edges.
    Edges,
}

/// Number of elements according to the shapes: an estimate of the work.
pub fn element_count(tensors: &[Tensor]) -> usize {
    let elements = |tensor: &Tensor| {
        let sizes = tensor.shape.iter().map(|&size| usize::try_from(size).unwrap_or(0));
        sizes.fold(1_usize, usize::saturating_mul)
    };
    tensors.iter().map(elements).fold(0, usize::saturating_add)
}

/// Removes the inputs of the fleet from `tensors` and converts them. Names must be distinct.
///
/// # Errors
/// [`Invalid`] for a tensor that is missing, superfluous, or not accepted.
pub fn fleet_input(tensors: &mut Vec<Tensor>) -> Result<FleetInput, Invalid> {
    let mut take = |name: &str| {
        let at = tensors.iter().position(|tensor| tensor.name == name)?;
        Some(tensors.swap_remove(at))
    };
    let [uav_positions, user_positions, user_aoi, edge_index, edge_relative, uav_count, uav_ids, user_ids] =
        INPUTS.map(|(name, ..)| take(name));
    let user_aoi = user_aoi.ok_or_else(|| Invalid::missing("user_aoi", "the AoI of each user in slots, [N]"))?;
    let users = user_aoi.rows("[N]", &[], MAX_NODES)?;
    let uavs = count_uavs(uav_positions.as_ref(), uav_count.as_ref(), uav_ids.as_ref())?;
    let counted = if uav_positions.is_some() { "uav_positions" } else { "uav_ids" };
    check_counts(if uavs == 0 { counted } else { "user_aoi" }, uavs, users)?;
    let ages = user_aoi.numbers(users)?.into_iter().enumerate();
    let ages = ages.map(|(j, value)| check_aoi(|| format!("user_aoi[{j}]"), value)).collect::<Result<Vec<f32>, _>>()?;
    let mut far = None;
    let own = uav_positions.map(|tensor| points(&tensor, "[M, 2]", uavs, &mut far)).transpose()?;
    let nodes = Nodes::new(uavs, users, uav_ids.as_ref(), user_ids.as_ref())?;
    let content = match (user_positions, edge_index, edge_relative) {
        (Some(tensor), None, None) => {
            let own = own.ok_or_else(|| Invalid::missing("uav_positions", "the position of each UAV, [M, 2]"))?;
            let all = points(&tensor, "[N, 2]", users, &mut far)?;
            let uavs = nodes.uavs.iter().map(|&place| own[place as usize]).collect();
            SceneOrGraph::Scene(Scene { uavs, users: nodes.sort_users(&all), aoi: nodes.sort_users(&ages) })
        }
        (None, Some(index), Some(relative)) => SceneOrGraph::Graph(graph(&nodes, own.as_deref(), &ages, &index, &relative)?),
        (None, None, None) => {
            let expected = "the position of each user, [N, 2], or edge_index and edge_relative";
            return Err(Invalid::missing("user_positions", expected));
        }
        (None, None, Some(_)) => return Err(Invalid::missing("edge_index", "the nodes of each edge, [E, 2]")),
        (None, Some(_), None) => return Err(Invalid::missing("edge_relative", "the relative coordinates of each edge, [E, 2]")),
        (Some(_), ..) => {
            let expected = "no value beside edges, because a request has a scene or a graph";
            return Err(Invalid::new("user_positions", "a tensor", expected));
        }
    };
    let canonical_of_request = canonical_of_request(&nodes.uavs);
    Ok(FleetInput { canonical_of_request, speeds: Vec::new(), endurances: Vec::new(), far, content, fleet: nodes.fleet })
}

/// The number of UAVs. All inputs that imply it must agree.
fn count_uavs(positions: Option<&Tensor>, count: Option<&Tensor>, ids: Option<&Tensor>) -> Result<usize, Invalid> {
    let count_of = |tensor: &Tensor| -> Result<usize, Invalid> {
        tensor.rows("[1]", &[], 1)?;
        let value = tensor.integers(1)?[0];
        let fits = usize::try_from(value).ok().filter(|value| (1..=MAX_NODES).contains(value));
        fits.ok_or_else(|| Invalid::new("uav_count", value, format!("a number from 1 to {MAX_NODES}")))
    };
    let counts = [
        positions.map(|tensor| Ok(("uav_positions", tensor.rows("[M, 2]", &[2], MAX_NODES)?))).transpose()?,
        count.map(|tensor| Ok(("uav_count", count_of(tensor)?))).transpose()?,
        ids.map(|tensor| Ok(("uav_ids", tensor.rows("[M]", &[], MAX_NODES)?))).transpose()?,
    ];
    let mut counts = counts.into_iter().flatten();
    let Some((first, uavs)) = counts.next() else {
        return Err(Invalid::missing("uav_positions", "the position of each UAV, [M, 2], or uav_count or uav_ids"));
    };
    match counts.find(|&(_, other)| other != uavs) {
        Some((name, other)) => Err(Invalid::new(name, format!("{other} UAVs"), format!("{uavs}, the number in {first}"))),
        None => Ok(uavs),
    }
}

fn points(tensor: &Tensor, expected: &str, count: usize, far: &mut Option<Box<Invalid>>) -> Result<Vec<Point>, Invalid> {
    if tensor.rows(expected, &[2], MAX_NODES)? != count {
        return Err(tensor.invalid_shape(&format!("[{count}, 2]")));
    }
    let values = tensor.numbers(2 * count)?;
    let pairs = values.chunks_exact(2).enumerate();
    pairs.map(|(i, pair)| check_point(|| format!("{}[{i}]", tensor.name), [pair[0], pair[1]], far)).collect()
}

/// The ids of the fleet, and the order of the request.
struct Nodes {
    fleet: FleetIds,
    /// Index in the request of each UAV, in canonical order.
    uavs: Vec<u32>,
    /// Index in the request of each user, in canonical order.
    users: Vec<u32>,
}

impl Nodes {
    fn new(uavs: usize, users: usize, uav_ids: Option<&Tensor>, user_ids: Option<&Tensor>) -> Result<Self, Invalid> {
        let (uav_ids, uavs) = ids(uav_ids, uavs, "[M]", "uav")?;
        let (user_ids, users) = ids(user_ids, users, "[N]", "user")?;
        check_distinct((&uav_ids, &uavs), (&user_ids, &users), |is_uav, place| {
            format!("{}[{place}]", if is_uav { "uav_ids" } else { "user_ids" })
        })?;
        Ok(Self { fleet: FleetIds { uavs: uav_ids, users: user_ids }, uavs, users })
    }

    /// Values of the users in canonical order.
    fn sort_users<T: Copy>(&self, all: &[T]) -> Vec<T> {
        self.users.iter().map(|&place| all[place as usize]).collect()
    }

    /// Canonical index of each node in the order of the request.
    fn canonical(&self) -> Vec<u32> {
        let uavs = self.uavs.len() as u32;
        let users = canonical_of_request(&self.users).into_iter().map(|user| uavs + user);
        canonical_of_request(&self.uavs).into_iter().chain(users).collect()
    }
}

/// Ids in canonical order, with their indices in the request. Default ids: `KIND-0`, `KIND-1`, ...
fn ids(tensor: Option<&Tensor>, count: usize, expected: &str, kind: &str) -> Result<(Vec<String>, Vec<u32>), Invalid> {
    let Some(tensor) = tensor else {
        return Ok((0..count as u32).map(|i| (format!("{kind}-{i}"), i)).unzip());
    };
    if tensor.rows(expected, &[], MAX_NODES)? != count {
        return Err(tensor.invalid_shape(&format!("[{count}]")));
    }
    let mut ids = Ids::with_capacity(count);
    for (place, bytes) in tensor.byte_strings(count)?.into_iter().enumerate() {
        let field = || format!("{}[{place}]", tensor.name);
        let value = || format!("{:?}", String::from_utf8_lossy(&bytes));
        let id = std::str::from_utf8(&bytes).map_err(|_| Invalid::new(field(), value(), "text in UTF-8"))?;
        ids.push(field, id.to_owned(), place)?;
    }
    Ok(ids.sorted())
}

fn graph(
    nodes: &Nodes,
    own: Option<&[Point]>,
    ages: &[f32],
    index: &Tensor,
    relative: &Tensor,
) -> Result<ReportedGraph, Invalid> {
    let (uavs, users) = (nodes.uavs.len(), nodes.users.len());
    let edges = index.rows("[E, 2]", &[2], MAX_DETECTIONS)?;
    if relative.rows("[E, 2]", &[2], MAX_DETECTIONS)? != edges {
        return Err(relative.invalid_shape(&format!("[{edges}, 2], as edge_index")));
    }
    let ends = index.integers(2 * edges)?;
    let relative = relative.numbers(2 * edges)?;
    let canonical = nodes.canonical();
    let node = |e: usize, value: i64| {
        let known = usize::try_from(value).ok().and_then(|node| canonical.get(node)).copied();
        let expected = || format!("nodes from 0 to {}: {uavs} UAVs, then {users} users", uavs + users - 1);
        known.ok_or_else(|| Invalid::new(format!("edge_index[{e}]"), value, expected()))
    };
    let mut detections = vec![Vec::new(); uavs + users];
    for (e, (ends, rel)) in ends.chunks_exact(2).zip(relative.chunks_exact(2)).enumerate() {
        let (from, target) = (node(e, ends[0])?, node(e, ends[1])?);
        if from == target {
            return Err(Invalid::new(format!("edge_index[{e}]"), format!("{ends:?}"), "two different nodes"));
        }
        let part = |axis: usize| check_finite(|| format!("edge_relative[{e}][{axis}]"), rel[axis]);
        let detection = ReportedDetection { target, rel: [part(0)?, part(1)?], request_index: e as u32, mirrored: false };
        detections[from as usize].push(detection);
    }
    for list in &mut detections {
        list.sort_by_key(|detection| detection.target);
        if let Some(pair) = list.windows(2).find(|pair| pair[0].target == pair[1].target) {
            let (first, again) = (pair[0].request_index, pair[1].request_index as usize);
            let ends = format!("{:?}", &ends[2 * again..2 * again + 2]);
            return Err(Invalid::new(format!("edge_index[{again}]"), ends, format!("an edge that differs from edge {first}")));
        }
    }
    Ok(mirror(ReportedGraph {
        positions: match own {
            Some(own) => nodes.uavs.iter().map(|&place| Some(own[place as usize])).collect(),
            None => vec![None; uavs],
        },
        aoi: nodes.sort_users(ages),
        without_detections: detections[uavs..].iter().map(Vec::is_empty).collect(),
        detections,
        // Errors about edges name the index of the edge, so no node indices are needed.
        request_of_canonical: Vec::new(),
        form: GraphForm::Edges,
    }))
}
