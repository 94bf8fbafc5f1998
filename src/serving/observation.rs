//! What a caller says a fleet sees in one slot, ids resolved and brought into canonical order; from it the [`Slot`] that
//! a policy reads.
//!
//! `api::convert` builds an [`Observation`] and checks everything that does not depend on the policy. Here the policy's
//! detection range and needs come in: a scene is turned into detections, a graph is completed.

use super::Fleet;
use crate::env::Point;
use crate::invalid::Invalid;
use crate::policy::{Detection, Needs, Policy, Slot};

/// Most nodes of one observation.
pub const MAX_NODES: usize = 4096;
/// Most detections of one observation, mirrored and derived ones included.
pub const MAX_DETECTIONS: usize = 1 << 22;

/// Relative coordinates may exceed the detection range by this factor, for callers that compute in f32.
const RANGE_TOLERANCE: f64 = 1.0 + 1e-5;

/// One slot of one fleet, in canonical order of ids.
#[derive(Clone, Debug, PartialEq)]
pub struct Observation {
    /// The ids.
    pub fleet: Fleet,
    /// Canonical index of each UAV in the order of the request.
    pub uav_order: Vec<u32>,
    /// What is known of the slot.
    pub seen: Seen,
}

/// The two ways to describe a slot.
#[derive(Clone, Debug, PartialEq)]
pub enum Seen {
    /// Absolute positions.
    Scene {
        /// Position of each UAV.
        uavs: Vec<Point>,
        /// Position of each user.
        users: Vec<Point>,
        /// AoI of each user in slots.
        aoi: Vec<f32>,
    },
    /// What nodes detect.
    Graph(Graph),
}

/// Detections of each node, symmetric: where i detects j, j detects i at the negated coordinates.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Graph {
    /// Own position of each UAV, where given.
    pub positions: Vec<Option<Point>>,
    /// AoI of each user in slots; 0 where nobody said it.
    pub aoi: Vec<f32>,
    /// What each node detects, UAVs first, in ascending order of target.
    pub detections: Vec<Vec<Sighting>>,
    /// Users whose detections of other users were left out.
    pub left_out: Vec<bool>,
    /// Place of each node in the request's list.
    pub places: Vec<u32>,
}

/// Node `target` seen at `rel`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sighting {
    /// Canonical node index, UAVs first.
    pub target: u32,
    /// Target position - own position.
    pub rel: Point,
    /// Place in the request's list of detections of the node that reported it.
    pub place: u32,
    /// Whether it was reported by the target and mirrored.
    pub mirrored: bool,
}

impl Observation {
    /// M.
    pub fn uavs(&self) -> usize {
        self.fleet.uavs.len()
    }

    /// N.
    pub fn users(&self) -> usize {
        self.fleet.users.len()
    }

    /// The slot as `policy` sees it. Work is bounded by [`MAX_NODES`] and [`MAX_DETECTIONS`].
    ///
    /// # Errors
    /// The fleet does not fit the policy, something it needs is missing, a detection lies beyond its range, or there are
    /// too many detections.
    pub fn into_slot(self, policy: &dyn Policy) -> Result<Slot, Invalid> {
        policy.check_fleet(self.uavs(), self.users())?;
        let range = policy.detection_range();
        match self.seen {
            Seen::Scene { uavs, users, aoi } => {
                check_crowd(&uavs, &users, range)?;
                Ok(Slot::from_scene(&uavs, &users, &aoi, range))
            }
            Seen::Graph(graph) => graph.into_slot(policy.needs(), range),
        }
    }
}

/// Refuses scenes in which so many nodes see each other that a slot would fill the memory.
fn check_crowd(uavs: &[Point], users: &[Point], range: f64) -> Result<(), Invalid> {
    let nodes = uavs.len() + users.len();
    if nodes * nodes <= MAX_DETECTIONS {
        return Ok(());
    }
    let points: Vec<Point> = uavs.iter().chain(users).copied().collect();
    let mut detections = 0;
    for (i, a) in points.iter().enumerate() {
        detections += 2 * points[i + 1..].iter().filter(|b| within(&[b[0] - a[0], b[1] - a[1]], range)).count();
        if detections > MAX_DETECTIONS {
            return Err(crowded("scene"));
        }
    }
    Ok(())
}

fn crowded(field: &str) -> Invalid {
    Invalid::new(field, "a crowd", format!("at most {MAX_DETECTIONS} pairs of nodes that detect each other"))
}

fn within(rel: &Point, range: f64) -> bool {
    rel[0] * rel[0] + rel[1] * rel[1] <= range * range
}

impl Graph {
    fn into_slot(mut self, needs: Needs, range: f64) -> Result<Slot, Invalid> {
        if needs == Needs::FullScene {
            return Err(Invalid::new("graph", "a graph", "a scene: this policy needs the positions of all UAVs and users"));
        }
        let uavs = self.positions.len();
        if needs == Needs::OwnPositions
            && let Some(i) = self.positions.iter().position(Option::is_none)
        {
            let field = format!("graph.nodes[{}].position", self.places[i]);
            return Err(Invalid::new(field, "nothing", "the UAV's own position, which this policy needs"));
        }
        self.check_range(range)?;
        self.derive(range)?;
        // All or none: a policy that can use positions reads them of every UAV.
        let positions = self.positions.into_iter().collect::<Option<Vec<Point>>>();
        let lists: Vec<Vec<Detection>> = self
            .detections
            .iter()
            .map(|list| list.iter().map(|s| Detection { target: s.target, rel: [s.rel[0] as f32, s.rel[1] as f32] }).collect())
            .collect();
        Ok(Slot::from_detections(positions, uavs, self.aoi, &lists))
    }

    /// A detection beyond the range is a mistake in units, or a sensor that the policy was not trained with.
    fn check_range(&self, range: f64) -> Result<(), Invalid> {
        for (node, list) in self.detections.iter().enumerate() {
            for sighting in list.iter().filter(|s| !s.mirrored) {
                if !within(&sighting.rel, range * RANGE_TOLERANCE) {
                    let [x, y] = sighting.rel;
                    let field = format!("graph.nodes[{}].detections[{}].rel", self.places[node], sighting.place);
                    let expected = format!("coordinates within the policy's detection range of {range}");
                    return Err(Invalid::new(field, format!("({x}, {y})"), expected));
                }
            }
        }
        Ok(())
    }

    /// Gives users whose detections were left out the other users that some UAV sees together with them: where UAV i sees
    /// both, user j sees user k at `rel_ik - rel_ij`. The first UAV in canonical order tells.
    fn derive(&mut self, range: f64) -> Result<(), Invalid> {
        let (uavs, users) = (self.positions.len(), self.aoi.len());
        if !self.left_out.contains(&true) {
            return Ok(());
        }
        // One bit per user and UAV: a pair of users seen by many UAVs is looked at once.
        let words = users.div_ceil(64);
        let mut seen_by = vec![0_u64; uavs * words];
        let mut total = 0;
        for (i, list) in self.detections.iter().enumerate() {
            total += list.len();
            for user in list.iter().filter_map(|s| (s.target as usize).checked_sub(uavs)).filter(|_| i < uavs) {
                seen_by[i * words + user / 64] |= 1 << (user % 64);
            }
        }
        let mut known = vec![0_u64; words];
        let mut found: Vec<(usize, Sighting)> = Vec::new();
        for j in (0..users).filter(|&j| self.left_out[j]) {
            known.fill(0);
            known[j / 64] |= 1 << (j % 64);
            for user in self.detections[uavs + j].iter().filter_map(|s| (s.target as usize).checked_sub(uavs)) {
                known[user / 64] |= 1 << (user % 64);
            }
            for to_uav in self.detections[uavs + j].iter().filter(|s| (s.target as usize) < uavs) {
                let i = to_uav.target as usize;
                for word in 0..words {
                    let mut fresh = seen_by[i * words + word] & !known[word];
                    known[word] |= fresh;
                    while fresh != 0 {
                        let k = word * 64 + fresh.trailing_zeros() as usize;
                        fresh &= fresh - 1;
                        let list = &self.detections[i];
                        let target = (uavs + k) as u32;
                        let at = list.binary_search_by_key(&target, |s| s.target).expect("the bit was set from this list");
                        let rel = [list[at].rel[0] + to_uav.rel[0], list[at].rel[1] + to_uav.rel[1]];
                        if !within(&rel, range) {
                            continue;
                        }
                        found.push((j, Sighting { target, rel, place: 0, mirrored: true }));
                        // k derives j by itself if its list was left out too.
                        if !self.left_out[k] {
                            let back = [-rel[0], -rel[1]];
                            found.push((k, Sighting { target: (uavs + j) as u32, rel: back, place: 0, mirrored: true }));
                        }
                        if total + found.len() > MAX_DETECTIONS {
                            return Err(crowded("graph"));
                        }
                    }
                }
            }
        }
        for (user, sighting) in found {
            self.detections[uavs + user].push(sighting);
        }
        for list in &mut self.detections[uavs..] {
            list.sort_by_key(|s| s.target);
            list.dedup_by_key(|s| s.target);
        }
        Ok(())
    }
}
