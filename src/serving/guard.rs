//! Guard rails: constraints of a fleet that no heading may break. After the policy has decided, every UAV gets the heading with the highest
//! Q-value among those that keep the constraints; separation is kept jointly. Where nothing keeps them, the UAV hovers or takes the
//! heading that breaks least. All lengths are in units of the square's side, all times in slots.

use crate::env::{Boundary, DIRECTIONS, EnvConfig, Point};
use crate::policy::EnvParams;

/// Hovering, which every UAV can do to keep a constraint.
pub const HOVER: u8 = EnvConfig::COMPASS as u8;
/// Number of headings, hovering included.
const HEADINGS: usize = EnvConfig::COMPASS + 1;
/// Combinations of headings that are tried for a group of UAVs that are near each other. Beyond, the best so far counts.
const MAX_TRIES: usize = 100_000;
/// Constraints are kept with this margin, because positions are rounded.
const MARGIN: f64 = 1e-9;

/// A kind of constraint.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Constraint {
    /// Zones that no UAV enters.
    NoFly,
    /// Distance between two UAVs.
    Separation,
    /// Distance from home.
    MaxDistance,
    /// Every UAV reaches home before its battery is empty.
    ReturnInTime,
}

impl Constraint {
    /// All kinds.
    pub const ALL: [Self; 4] = [Self::NoFly, Self::Separation, Self::MaxDistance, Self::ReturnInTime];

    /// The kind in requests and responses.
    pub fn name(self) -> &'static str {
        match self {
            Self::NoFly => "no_fly",
            Self::Separation => "min_separation",
            Self::MaxDistance => "max_distance",
            Self::ReturnInTime => "return_in_time",
        }
    }

    fn bit(self) -> u8 {
        1 << self as u8
    }
}

/// A zone that no UAV enters.
#[derive(Clone, Debug, PartialEq)]
pub enum Zone {
    /// The corners of a polygon, in order. It may be concave.
    Polygon(Vec<Point>),
    /// Centre and radius.
    Circle(Point, f64),
}

/// The constraints of a fleet.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Guard {
    /// Zones that no UAV enters.
    pub no_fly: Vec<Zone>,
    /// Minimum distance between two UAVs; 0: none.
    pub min_separation: f64,
    /// Where UAVs return to.
    pub home: Option<Point>,
    /// Maximum distance from home.
    pub max_distance: Option<f64>,
    /// Whether every UAV reaches home before its battery is empty.
    pub return_in_time: bool,
    /// Whether UAVs stay in the area.
    pub boundary: Boundary,
}

/// A heading of a UAV that is not the one that the policy prefers.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Overruled {
    /// Index of the UAV.
    pub uav: u32,
    /// The heading that the policy prefers.
    pub preferred: u8,
    /// What the preferred heading would break, given the headings of the others.
    pub because: Vec<Constraint>,
    /// What the heading that the UAV gets breaks, because nothing keeps all constraints.
    pub violates: Vec<Constraint>,
}

/// What a UAV can do in one slot.
struct Uav {
    from: Point,
    /// Where each heading ends.
    ends: [Point; HEADINGS],
    /// What each heading breaks by itself, and how much.
    broken: [(u8, f64); HEADINGS],
    /// How much the policy wants each heading.
    scores: [f64; HEADINGS],
}

/// One fleet in one slot.
pub struct Situation<'a> {
    /// The world.
    pub env: &'a EnvParams,
    /// Speed of each UAV per slot; empty if all have that of the world.
    pub speeds: &'a [f64],
    /// Position of each UAV.
    pub positions: &'a [Point],
    /// Slots that each UAV can still fly; infinite if it is not known.
    pub endurance: &'a [f64],
    /// A Q-values per UAV; NaN if the policy has none.
    pub q_values: &'a [f32],
}

impl Guard {
    /// Replaces headings that break a constraint. Returns the UAVs that do not get the heading that the policy prefers, or whose heading
    /// breaks a constraint.
    pub fn apply(&self, situation: &Situation<'_>, headings: &mut [u8]) -> Vec<Overruled> {
        let preferred = headings.to_vec();
        let uavs: Vec<Uav> = (0..headings.len()).map(|i| self.uav(situation, i, headings[i])).collect();
        for (uav, heading) in uavs.iter().zip(headings.iter_mut()) {
            *heading = uav.best();
        }
        let near = self.neighbours(&uavs);
        for group in groups(&near) {
            if group.len() > 1 && group.iter().any(|&i| near[i].iter().any(|&j| self.collide(&uavs, headings, i, j))) {
                self.separate(&uavs, &group, &near, headings);
            }
        }
        let breaks = |headings: &[u8], i: usize, heading: u8| {
            let collides = near[i].iter().any(|&j| self.too_near(&uavs[i], heading, &uavs[j], headings[j]));
            uavs[i].broken[usize::from(heading)].0 | if collides { Constraint::Separation.bit() } else { 0 }
        };
        let list = |bits: u8| Constraint::ALL.into_iter().filter(|constraint| bits & constraint.bit() != 0).collect::<Vec<_>>();
        let mut overruled = Vec::new();
        for (i, &preferred) in preferred.iter().enumerate() {
            let violates = breaks(headings, i, headings[i]);
            if headings[i] != preferred || violates != 0 {
                let because = list(breaks(headings, i, preferred));
                overruled.push(Overruled { uav: i as u32, preferred, because, violates: list(violates) });
            }
        }
        overruled
    }

    fn uav(&self, situation: &Situation<'_>, i: usize, preferred: u8) -> Uav {
        let (env, from) = (situation.env, situation.positions[i]);
        let speed = situation.speeds.get(i).copied().unwrap_or(env.speed);
        let mut ends = [from; HEADINGS];
        for (end, direction) in ends.iter_mut().zip(DIRECTIONS) {
            for axis in 0..2 {
                let to = from[axis] + speed * direction[axis];
                let extent = env.extent[axis];
                end[axis] = match self.boundary {
                    Boundary::Clamp => to.clamp((1.0 - extent) / 2.0, f64::midpoint(1.0, extent)),
                    Boundary::Free => to,
                };
            }
        }
        ends[usize::from(HOVER)] = from;
        let width = situation.q_values.len() / situation.positions.len().max(1);
        let q = &situation.q_values[i * width..][..width];
        let lowest = q.iter().copied().fold(f32::INFINITY, f32::min);
        let scores = std::array::from_fn(|h| {
            if h as u8 == preferred {
                return f64::MAX;
            }
            match q.get(h) {
                Some(q) if q.is_finite() => f64::from(*q),
                // Not a heading of the policy.
                None if lowest.is_finite() => f64::from(lowest) - 1.0,
                // Without Q-values, the smallest change of direction.
                _ if h as u8 == HOVER || preferred == HOVER => -8.0,
                _ => -f64::from((h as u8).abs_diff(preferred).min(8 - (h as u8).abs_diff(preferred))),
            }
        });
        let left = situation.endurance.get(i).copied().unwrap_or(f64::INFINITY);
        let broken = ends.map(|to| self.broken(from, to, (speed, left)));
        Uav { from, ends, broken, scores }
    }

    /// What a flight from `from` to `to` breaks, and how much.
    fn broken(&self, from: Point, to: Point, (speed, left): (f64, f64)) -> (u8, f64) {
        let (mut bits, mut depth) = (0, 0.0);
        for zone in &self.no_fly {
            if zone.blocks(from, to) {
                bits |= Constraint::NoFly.bit();
                depth += zone.depth(to);
            }
        }
        if let Some(home) = self.home {
            let away = distance(to, home);
            if let Some(most) = self.max_distance.filter(|most| away > most - MARGIN) {
                bits |= Constraint::MaxDistance.bit();
                depth += away - most;
            }
            // A UAV is at home within half a move.
            let back = octile(to, home) / speed.max(1e-9) - 0.5;
            if self.return_in_time && left.is_finite() && back > left - 1.0 {
                bits |= Constraint::ReturnInTime.bit();
                depth += speed * (back - (left - 1.0));
            }
        }
        (bits, depth)
    }

    /// For each UAV, the others that it can come too near to.
    fn neighbours(&self, uavs: &[Uav]) -> Vec<Vec<usize>> {
        let mut near = vec![Vec::new(); uavs.len()];
        if self.min_separation <= 0.0 {
            return near;
        }
        let reach = |uav: &Uav| uav.ends.iter().map(|end| distance(*end, uav.from)).fold(0.0, f64::max);
        let reaches: Vec<f64> = uavs.iter().map(reach).collect();
        let longest = reaches.iter().copied().fold(0.0, f64::max);
        // Sorted by x, so that only UAVs nearby are compared.
        let mut order: Vec<usize> = (0..uavs.len()).collect();
        order.sort_by(|&a, &b| uavs[a].from[0].total_cmp(&uavs[b].from[0]).then(a.cmp(&b)));
        for (k, &i) in order.iter().enumerate() {
            for &j in &order[k + 1..] {
                if uavs[j].from[0] - uavs[i].from[0] > self.min_separation + 2.0 * longest {
                    break;
                }
                if distance(uavs[i].from, uavs[j].from) < self.min_separation + reaches[i] + reaches[j] + MARGIN {
                    near[i].push(j);
                    near[j].push(i);
                }
            }
        }
        near
    }

    fn collide(&self, uavs: &[Uav], headings: &[u8], i: usize, j: usize) -> bool {
        self.too_near(&uavs[i], headings[i], &uavs[j], headings[j])
    }

    /// Whether two UAVs come too near on these headings: at the end of the slot, or in between unless they are too near already.
    fn too_near(&self, a: &Uav, a_heading: u8, b: &Uav, b_heading: u8) -> bool {
        let (a_end, b_end) = (a.ends[usize::from(a_heading)], b.ends[usize::from(b_heading)]);
        let least = self.min_separation + MARGIN;
        if distance(a_end, b_end) < least {
            return true;
        }
        let start = [b.from[0] - a.from[0], b.from[1] - a.from[1]];
        let end = [b_end[0] - a_end[0], b_end[1] - a_end[1]];
        start[0].hypot(start[1]) >= least && distance_to_segment([0.0; 2], start, end) < least
    }

    /// Finds headings of the UAVs of `group` that keep their distance, with the largest sum of scores.
    fn separate(&self, uavs: &[Uav], group: &[usize], near: &[Vec<usize>], headings: &mut [u8]) {
        let mut search = Search {
            guard: self,
            uavs,
            near,
            // Those with least choice first.
            order: group.to_vec(),
            chosen: vec![None; uavs.len()],
            best: None,
            tries: 0,
        };
        search.order.sort_by_key(|&i| (uavs[i].allowed().count(), i));
        search.descend(0, (0, 0.0));
        if let Some((_, found)) = search.best {
            for (&i, heading) in search.order.iter().zip(found) {
                headings[i] = heading;
            }
        }
    }
}

impl Uav {
    /// The headings that break as little as possible by themselves.
    fn allowed(&self) -> impl Iterator<Item = u8> {
        let least = self.broken.iter().map(|(bits, _)| bits.count_ones()).min().unwrap_or(0);
        let depth = self.broken.iter().filter(|b| b.0.count_ones() == least).map(|b| b.1).fold(f64::INFINITY, f64::min);
        (0..HEADINGS as u8).filter(move |&h| {
            let (bits, how_much) = self.broken[usize::from(h)];
            bits.count_ones() == least && (least == 0 || how_much <= depth)
        })
    }

    /// The allowed heading with the highest score; of equal ones, the lowest.
    fn best(&self) -> u8 {
        let score = |h: u8| self.scores[usize::from(h)];
        self.allowed().reduce(|best, h| if score(h) > score(best) { h } else { best }).unwrap_or(HOVER)
    }
}

/// A search over the headings of a group, in the order of falling scores.
struct Search<'a> {
    guard: &'a Guard,
    uavs: &'a [Uav],
    near: &'a [Vec<usize>],
    order: Vec<usize>,
    chosen: Vec<Option<u8>>,
    /// Collisions and lost scores, and the headings in `order`.
    best: Option<((usize, f64), Vec<u8>)>,
    tries: usize,
}

impl Search<'_> {
    /// Chooses the headings from `at` on. `cost`: collisions and lost scores so far.
    fn descend(&mut self, at: usize, cost: (usize, f64)) {
        if self.best.as_ref().is_some_and(|(best, _)| cost.0 > best.0 || (cost.0 == best.0 && cost.1 >= best.1)) {
            return;
        }
        let Some(&i) = self.order.get(at) else {
            self.best = Some((cost, self.order.iter().filter_map(|&i| self.chosen[i]).collect()));
            return;
        };
        self.tries += 1;
        let uav = &self.uavs[i];
        let top = f64::from(u8::MAX);
        // The preferred heading counts a little more than any other.
        let highest = uav.scores.iter().copied().filter(|score| *score < f64::MAX).fold(-top, f64::max) + 1e-3;
        let lost = |h: u8| highest - uav.scores[usize::from(h)].min(highest);
        let mut headings: Vec<u8> = uav.allowed().collect();
        headings.sort_by(|&a, &b| lost(a).total_cmp(&lost(b)).then(a.cmp(&b)));
        for h in headings {
            let others = self.near[i].iter().filter_map(|&j| self.chosen[j].map(|other| (j, other)));
            let collisions = others.filter(|&(j, other)| self.guard.too_near(uav, h, &self.uavs[j], other)).count();
            // A combination without a collision is looked for much longer than a better one.
            let most = if self.best.as_ref().is_some_and(|(best, _)| best.0 > 0) { 20 * MAX_TRIES } else { MAX_TRIES };
            if self.tries > most && self.best.is_some() {
                break;
            }
            self.chosen[i] = Some(h);
            self.descend(at + 1, (cost.0 + collisions, cost.1 + lost(h)));
            self.chosen[i] = None;
        }
    }
}

/// The connected groups of UAVs that can come too near to each other.
fn groups(near: &[Vec<usize>]) -> Vec<Vec<usize>> {
    let mut seen = vec![false; near.len()];
    let mut groups = Vec::new();
    for first in 0..near.len() {
        if near[first].is_empty() || std::mem::replace(&mut seen[first], true) {
            continue;
        }
        let mut group = vec![first];
        let mut next = 0;
        while let Some(&i) = group.get(next) {
            next += 1;
            for &j in &near[i] {
                if !std::mem::replace(&mut seen[j], true) {
                    group.push(j);
                }
            }
        }
        group.sort_unstable();
        groups.push(group);
    }
    groups
}

impl Zone {
    /// Whether a flight ends in the zone, or crosses it from outside.
    fn blocks(&self, from: Point, to: Point) -> bool {
        self.contains(to) || (!self.contains(from) && self.crosses(from, to))
    }

    fn contains(&self, p: Point) -> bool {
        match self {
            Self::Circle(center, radius) => distance(p, *center) < radius + MARGIN,
            Self::Polygon(corners) => {
                let mut inside = false;
                for (a, b) in edges(corners) {
                    if (a[1] > p[1]) != (b[1] > p[1]) && p[0] < (b[0] - a[0]) * (p[1] - a[1]) / (b[1] - a[1]) + a[0] {
                        inside = !inside;
                    }
                }
                inside || edges(corners).any(|(a, b)| distance_to_segment(p, a, b) < MARGIN)
            }
        }
    }

    fn crosses(&self, from: Point, to: Point) -> bool {
        match self {
            Self::Circle(center, radius) => distance_to_segment(*center, from, to) < radius + MARGIN,
            Self::Polygon(corners) => edges(corners).any(|(a, b)| segments_meet(from, to, a, b)),
        }
    }

    /// How far `p` is in the zone.
    fn depth(&self, p: Point) -> f64 {
        match self {
            _ if !self.contains(p) => 0.0,
            Self::Circle(center, radius) => radius - distance(p, *center),
            Self::Polygon(corners) => edges(corners).map(|(a, b)| distance_to_segment(p, a, b)).fold(f64::INFINITY, f64::min),
        }
    }
}

fn edges(corners: &[Point]) -> impl Iterator<Item = (Point, Point)> {
    corners.iter().copied().zip(corners.iter().copied().cycle().skip(1))
}

fn distance(a: Point, b: Point) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// Length of the shortest path along the eight headings.
fn octile(a: Point, b: Point) -> f64 {
    let (dx, dy) = ((a[0] - b[0]).abs(), (a[1] - b[1]).abs());
    dx.max(dy) + (std::f64::consts::SQRT_2 - 1.0) * dx.min(dy)
}

fn distance_to_segment(p: Point, a: Point, b: Point) -> f64 {
    let (dx, dy) = (b[0] - a[0], b[1] - a[1]);
    let length = dx * dx + dy * dy;
    let t = if length > 0.0 { (((p[0] - a[0]) * dx + (p[1] - a[1]) * dy) / length).clamp(0.0, 1.0) } else { 0.0 };
    distance(p, [a[0] + t * dx, a[1] + t * dy])
}

fn segments_meet(a: Point, b: Point, c: Point, d: Point) -> bool {
    let side = |p: Point, q: Point, r: Point| (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0]);
    let apart = |x: f64, y: f64| (x > 0.0) == (y > 0.0) && x != 0.0 && y != 0.0;
    if apart(side(a, b, c), side(a, b, d)) || apart(side(c, d, a), side(c, d, b)) {
        return false;
    }
    let (ends, other) = ([(a, c, d), (b, c, d)], [(c, a, b), (d, a, b)]);
    let touches = ends.iter().chain(&other).any(|&(p, q, r)| distance_to_segment(p, q, r) < MARGIN);
    touches || (side(a, b, c) * side(a, b, d) < 0.0 && side(c, d, a) * side(c, d, b) < 0.0)
}
