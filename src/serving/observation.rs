//! What a caller says a fleet sees in one slot, ids resolved and brought into canonical order; from it the [`Slot`] that
//! a policy reads.
//!
//! `api::convert` builds an [`Observation`] and checks everything that does not depend on the policy. Here the policy's
//! detection range and needs come in: a scene is turned into detections, a graph is completed.

use super::Fleet;
use crate::env::Point;
use crate::invalid::Invalid;
use crate::policy::{Detection, Policy, RequiredInput, Slot};

/// Most nodes of one observation.
pub const MAX_NODES: usize = 20_000;
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
    /// How the request is made, for what is said about it.
    pub form: GraphForm,
}

/// How a caller writes a graph down.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum GraphForm {
    /// Nodes, each with a list of detections.
    #[default]
    Nodes,
    /// A list of edges; the place of a detection is in that list.
    Edges,
}

/// Node `target` seen at `rel`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sighting {
    /// Canonical node index, UAVs first.
    pub target: u32,
    /// Target position - own position.
    pub rel: Point,
    /// Place in the request's list of detections of the node that reported it, or in its list of edges.
    pub place: u32,
    /// Whether it was reported by the target and mirrored.
    pub mirrored: bool,
}

impl Sighting {
    fn detection(&self) -> Detection {
        Detection { target: self.target, rel: self.rel.map(|x| x as f32) }
    }
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
        let size = (self.uavs(), self.users());
        self.seen.into_slot(size, policy)
    }
}

impl Seen {
    /// As [`Observation::into_slot`], for a fleet of `(uavs, users)`.
    ///
    /// # Errors
    /// As [`Observation::into_slot`].
    pub fn into_slot(self, (uavs, users): (usize, usize), policy: &dyn Policy) -> Result<Slot, Invalid> {
        policy.check_fleet(uavs, users)?;
        let range = policy.detection_range();
        match self {
            Self::Scene { uavs, users, aoi } => {
                Slot::from_scene_within(&uavs, &users, &aoi, range, MAX_DETECTIONS).ok_or_else(|| too_many_detections("scene"))
            }
            Self::Graph(graph) => graph.into_slot(policy.needs(), range),
        }
    }
}

fn too_many_detections(field: &str) -> Invalid {
    let value = format!("more than {MAX_DETECTIONS} detections");
    Invalid::new(field, value, format!("at most {MAX_DETECTIONS} detections per request"))
}

fn within(rel: &Point, range: f64) -> bool {
    rel[0] * rel[0] + rel[1] * rel[1] <= range * range
}

impl Graph {
    fn into_slot(self, needs: RequiredInput, range: f64) -> Result<Slot, Invalid> {
        if needs == RequiredInput::FullScene {
            return Err(Invalid::missing("scene", "a scene instead of a graph, because this policy needs all positions"));
        }
        let uavs = self.positions.len();
        if needs == RequiredInput::OwnPositions
            && let Some(i) = self.positions.iter().position(Option::is_none)
        {
            let field = match self.form {
                GraphForm::Nodes => format!("graph.nodes[{}].position", self.places[i]),
                GraphForm::Edges => "uav_positions".into(),
            };
            return Err(Invalid::missing(field, "the position of the UAV, which this policy needs"));
        }
        self.check_range(range)?;
        let derived = self.derive(range)?;
        let mut offsets = Vec::with_capacity(self.detections.len() + 1);
        offsets.push(0);
        let mut detections = Vec::with_capacity(self.detections.iter().map(Vec::len).chain(derived.iter().map(Vec::len)).sum());
        for (node, list) in self.detections.iter().enumerate() {
            let begin = detections.len();
            detections.extend(list.iter().map(Sighting::detection));
            if let Some(user) = node.checked_sub(uavs) {
                detections.extend_from_slice(&derived[user]);
                // Most users said nothing and detect UAVs, then what was derived: that is in order already.
                if !detections[begin..].is_sorted_by_key(|d| d.target) {
                    detections[begin..].sort_unstable_by_key(|d| d.target);
                }
            }
            offsets.push(detections.len() as u32);
        }
        // All or none: a policy that can use positions reads them of every UAV.
        let positions = self.positions.into_iter().collect::<Option<Vec<Point>>>();
        Ok(Slot::from_flat_detections(positions, uavs, self.aoi, offsets, detections))
    }

    /// What the relative coordinates of a detection of `node` are called.
    pub fn rel_field(&self, node: usize, place: u32) -> String {
        match self.form {
            GraphForm::Nodes => format!("graph.nodes[{}].detections[{place}].rel", self.places[node]),
            GraphForm::Edges => format!("edge_relative[{place}]"),
        }
    }

    /// A detection beyond the range is a mistake in units, or a sensor that the policy was not trained with.
    fn check_range(&self, range: f64) -> Result<(), Invalid> {
        for (node, list) in self.detections.iter().enumerate() {
            for sighting in list.iter().filter(|s| !s.mirrored) {
                if !within(&sighting.rel, range * RANGE_TOLERANCE) {
                    let [x, y] = sighting.rel;
                    let field = self.rel_field(node, sighting.place);
                    let expected = format!("a position within the detection range of the policy ({range})");
                    return Err(Invalid::new(field, format!("({x}, {y})"), expected));
                }
            }
        }
        Ok(())
    }

    /// What users whose detections were left out detect beside what is mirrored: the other users that some UAV sees together
    /// with them. Where UAV i sees both, user j sees user k at `rel_ik - rel_ij`; the first UAV in canonical order tells.
    /// One list per user, in no order.
    fn derive(&self, range: f64) -> Result<Vec<Vec<Detection>>, Invalid> {
        let (uavs, users) = (self.positions.len(), self.aoi.len());
        let mut total: usize = self.detections.iter().map(Vec::len).sum();
        if total > MAX_DETECTIONS {
            return Err(too_many_detections("graph"));
        }
        let mut derived = vec![Vec::new(); users];
        if !self.left_out.contains(&true) {
            return Ok(derived);
        }
        // A pair of users that both left out their lists is looked at once, from the one that comes first.
        let mut silent = vec![0_u64; users.div_ceil(64)];
        for j in (0..users).filter(|&j| self.left_out[j]) {
            silent[j / 64] |= 1 << (j % 64);
        }
        let views: Vec<View> = self.detections[..uavs].iter().map(|list| View::of(list, uavs, users)).collect();
        let mut known = vec![0_u64; users.div_ceil(64)];
        let mut found = vec![0_u64; known.len()];
        let mut rels = vec![[0.0_f32; 2]; users];
        for j in (0..users).filter(|&j| self.left_out[j]) {
            let seen = &self.detections[uavs + j];
            known.fill(0);
            found.fill(0);
            let others = seen.iter().filter_map(|s| (s.target as usize).checked_sub(uavs));
            for user in others.chain([j]) {
                known[user / 64] |= 1 << (user % 64);
            }
            for (known, silent) in known.iter_mut().zip(&silent[..j / 64]) {
                *known |= silent;
            }
            known[j / 64] |= silent[j / 64] & ((1 << (j % 64)) - 1);
            for to_uav in seen.iter().take_while(|s| (s.target as usize) < uavs) {
                let View { bits, first, rel: list } = &views[to_uav.target as usize];
                for (word, (known, &bits)) in known.iter_mut().zip(bits).enumerate() {
                    // A pair of users seen by many UAVs is looked at once.
                    let mut fresh = bits & !*known;
                    *known |= bits;
                    while fresh != 0 {
                        let bit = fresh.trailing_zeros();
                        fresh &= fresh - 1;
                        let place = first[word] as usize + (bits & ((1 << bit) - 1)).count_ones() as usize;
                        let rel = [list[place][0] + to_uav.rel[0], list[place][1] + to_uav.rel[1]];
                        found[word] |= u64::from(within(&rel, range)) << bit;
                        rels[word * 64 + bit as usize] = rel.map(|x| x as f32);
                    }
                }
            }
            for (word, &found) in found.iter().enumerate() {
                let mut rest = found;
                while rest != 0 {
                    let k = word * 64 + rest.trailing_zeros() as usize;
                    rest &= rest - 1;
                    derived[j].push(Detection { target: (uavs + k) as u32, rel: rels[k] });
                    derived[k].push(Detection { target: (uavs + j) as u32, rel: rels[k].map(|x| 0.0 - x) });
                    total += 2;
                }
            }
            if total > MAX_DETECTIONS {
                return Err(too_many_detections("graph"));
            }
        }
        Ok(derived)
    }
}

/// The users that a UAV detects.
struct View {
    /// A bit for each.
    bits: Vec<u64>,
    /// Place in `rel` of the first of each word.
    first: Vec<u32>,
    /// Where they are, in ascending order.
    rel: Vec<Point>,
}

impl View {
    fn of(list: &[Sighting], uavs: usize, users: usize) -> Self {
        let words = users.div_ceil(64);
        let mut view = Self { bits: vec![0; words], first: vec![0; words], rel: Vec::new() };
        for sighting in list {
            let Some(user) = (sighting.target as usize).checked_sub(uavs) else { continue };
            let bits = &mut view.bits[user / 64];
            if *bits == 0 {
                view.first[user / 64] = view.rel.len() as u32;
            }
            *bits |= 1 << (user % 64);
            view.rel.push(sighting.rel);
        }
        view
    }
}
