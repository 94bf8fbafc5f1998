//! Separation: headings of UAVs that are near each other, chosen jointly. Small groups are searched; large ones, and those for which the
//! search takes too long, are placed one UAV after the other. Time and memory are bounded, however many UAVs are in one place.

use super::zone::{MARGIN, distance, distance_to_segment};
use crate::env::{EnvConfig, Point};

/// Hovering, which every UAV can do to keep a constraint.
pub const HOVER: u8 = EnvConfig::COMPASS as u8;
/// Number of headings, hovering included.
pub(super) const HEADINGS: usize = EnvConfig::COMPASS + 1;
/// UAVs of a group whose combinations of headings are searched. In a larger group, few would be varied before the search ends.
const MAX_GROUP: usize = 16;
/// Pairs of UAVs on two headings that the searches of one slot test: about 50 ms.
const MAX_TESTS: usize = 1 << 21;
/// Neighbours of all UAVs together that are kept, about. Each UAV keeps its share of them, and more than a group that is searched has.
const MAX_NEIGHBOURS: usize = 1 << 20;
/// How often the headings of a large group are chosen again, given those of all others.
const MAX_REPAIRS: usize = 4;
/// Fleets up to this size are looked at to estimate the cost; of larger ones the worst is assumed.
const MAX_INSPECTED: usize = 128;

/// What a UAV can do in one slot.
pub(super) struct Uav {
    pub(super) from: Point,
    /// Where each heading ends.
    pub(super) ends: [Point; HEADINGS],
    /// What each heading breaks by itself, as bits, and how much.
    pub(super) broken: [(u8, f64); HEADINGS],
    /// How much the policy wants each heading.
    pub(super) scores: [f64; HEADINGS],
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
    pub(super) fn best(&self) -> u8 {
        let score = |h: u8| self.scores[usize::from(h)];
        self.allowed().reduce(|best, h| if score(h) > score(best) { h } else { best }).unwrap_or(HOVER)
    }

    /// The score that is lost with each heading. The preferred heading counts a little more than any other.
    fn lost(&self) -> impl Fn(u8) -> f64 + '_ {
        let highest = self.scores.iter().copied().filter(|score| *score < f64::MAX).fold(-f64::from(u8::MAX), f64::max) + 1e-3;
        move |h| highest - self.scores[usize::from(h)].min(highest)
    }

    /// The allowed headings with the score that each loses, the least first.
    fn choices(&self) -> Vec<(u8, f64)> {
        let lost = self.lost();
        let mut choices: Vec<(u8, f64)> = self.allowed().map(|h| (h, lost(h))).collect();
        choices.sort_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
        choices
    }
}

/// UAVs that keep a distance.
pub(super) struct Fleet<'a> {
    uavs: &'a [Uav],
    min_separation: f64,
    /// For each UAV, others that it can come too near to.
    near: Vec<Vec<u32>>,
}

/// Collisions, and scores that are lost.
type Cost = (usize, f64);

fn is_less(a: Cost, b: Cost) -> bool {
    a.0 < b.0 || (a.0 == b.0 && a.1 < b.1)
}

impl<'a> Fleet<'a> {
    pub(super) fn new(uavs: &'a [Uav], min_separation: f64) -> Self {
        let near = if min_separation > 0.0 {
            let reach = |uav: &Uav| uav.ends.iter().map(|end| distance(*end, uav.from)).fold(0.0, f64::max);
            let (from, reaches): (Vec<Point>, Vec<f64>) = uavs.iter().map(|uav| (uav.from, reach(uav))).unzip();
            neighbours(&from, &reaches, min_separation)
        } else {
            vec![Vec::new(); uavs.len()]
        };
        Self { uavs, min_separation, near }
    }

    /// Whether UAV `i` on `heading` comes too near to another one.
    pub(super) fn collides(&self, headings: &[u8], i: usize, heading: u8) -> bool {
        self.near[i].iter().any(|&j| self.too_near(i, heading, j as usize, headings[j as usize]))
    }

    /// Changes the headings of groups in which UAVs come too near to each other.
    pub(super) fn separate(&self, headings: &mut [u8]) {
        let mut groups = groups(&self.near);
        groups.retain(|group| group.iter().any(|&i| self.collides(headings, i, headings[i])));
        let mut chosen: Vec<Option<u8>> = headings.iter().copied().map(Some).collect();
        let (mut tests, count) = (MAX_TESTS, groups.len());
        for (k, mut order) in groups.into_iter().enumerate() {
            // Those with least choice first.
            order.sort_by_key(|&i| (self.uavs[i].allowed().count(), i));
            order.iter().for_each(|&i| chosen[i] = None);
            // What a group does not need, the later ones may use.
            let share = tests / (count - k);
            let mut left = share;
            let found = (order.len() <= MAX_GROUP).then(|| self.search(&order, &mut chosen, &mut left)).flatten();
            let best = match found {
                // The search has not seen everything while UAVs collide.
                Some((cost, _)) if cost.0 > 0 && left == 0 => {
                    let placed = self.place(&order, &mut chosen, &mut left);
                    found.filter(|(cost, _)| !is_less(placed.0, *cost)).unwrap_or(placed)
                }
                Some(found) => found,
                None => self.place(&order, &mut chosen, &mut left),
            };
            assign(&order, &best.1, &mut chosen);
            tests -= share - left;
            order.iter().for_each(|&i| headings[i] = chosen[i].unwrap_or(headings[i]));
        }
    }

    /// The cost of `headings` of the UAVs in `order`, given those that are chosen outside of the group.
    fn cost(&self, order: &[usize], headings: &[u8], chosen: &mut [Option<u8>]) -> Cost {
        order.iter().for_each(|&i| chosen[i] = None);
        order.iter().zip(headings).fold((0, 0.0), |cost, (&i, &h)| {
            let collisions = self.collisions(i, h, chosen, &mut 0);
            chosen[i] = Some(h);
            (cost.0 + collisions, cost.1 + self.uavs[i].lost()(h))
        })
    }

    /// Number of UAVs with a chosen heading that UAV `i` comes too near to.
    fn collisions(&self, i: usize, heading: u8, chosen: &[Option<u8>], tests: &mut usize) -> usize {
        let others = self.near[i].iter().filter_map(|&j| chosen[j as usize].map(|other| (j as usize, other)));
        let (mut count, mut tested) = (0, 0);
        for (j, other) in others {
            tested += 1;
            count += usize::from(self.too_near(i, heading, j, other));
        }
        *tests = tests.saturating_sub(tested);
        count
    }

    /// Whether two UAVs come too near on these headings: at the end of the slot, or in between unless they are too near already.
    fn too_near(&self, i: usize, heading: u8, j: usize, other: u8) -> bool {
        let (a, b) = (&self.uavs[i], &self.uavs[j]);
        let (a_end, b_end) = (a.ends[usize::from(heading)], b.ends[usize::from(other)]);
        let least = self.min_separation + MARGIN;
        if distance(a_end, b_end) < least {
            return true;
        }
        let start = [b.from[0] - a.from[0], b.from[1] - a.from[1]];
        let end = [b_end[0] - a_end[0], b_end[1] - a_end[1]];
        start[0].hypot(start[1]) >= least && distance_to_segment([0.0; 2], start, end) < least
    }

    /// The headings of a small group that keep its UAVs apart, with the largest sum of scores, as far as `left` tests find them.
    fn search(&self, order: &[usize], chosen: &mut [Option<u8>], left: &mut usize) -> Option<(Cost, Vec<u8>)> {
        let most = *left;
        let choices = order.iter().map(|&i| self.uavs[i].choices()).collect();
        let mut search = Search { fleet: self, order, choices, chosen, best: None, left, most };
        search.descend(0, (0, 0.0));
        search.best
    }

    /// Gives one UAV after the other the heading with fewest collisions; of those, the one that loses least. Where that leaves collisions,
    /// hovering may leave fewer. Then, while tests are `left`, each chooses again.
    fn place(&self, order: &[usize], chosen: &mut [Option<u8>], left: &mut usize) -> (Cost, Vec<u8>) {
        order.iter().for_each(|&i| chosen[i] = None);
        let mut placed = Vec::with_capacity(order.len());
        for &i in order {
            let (heading, _) = self.least(i, chosen, left);
            chosen[i] = Some(heading);
            placed.push(heading);
        }
        let mut best = (self.cost(order, &placed, chosen), placed);
        if best.0.0 > 0 {
            let hover = |(&i, &h): (&usize, &u8)| if self.uavs[i].allowed().any(|h| h == HOVER) { HOVER } else { h };
            let hovering: Vec<u8> = order.iter().zip(&best.1).map(hover).collect();
            let cost = self.cost(order, &hovering, chosen);
            if is_less(cost, best.0) {
                best = (cost, hovering);
            }
        }
        assign(order, &best.1, chosen);
        for _ in 0..MAX_REPAIRS {
            let mut changed = false;
            for &i in order {
                if *left == 0 {
                    break;
                }
                let (heading, _) = self.least(i, chosen, left);
                changed |= chosen[i].replace(heading) != Some(heading);
            }
            if !changed || *left == 0 {
                break;
            }
        }
        let repaired: Vec<u8> = order.iter().filter_map(|&i| chosen[i]).collect();
        let cost = self.cost(order, &repaired, chosen);
        if is_less(cost, best.0) { (cost, repaired) } else { best }
    }

    /// The heading of UAV `i` with the least cost, given what is chosen.
    fn least(&self, i: usize, chosen: &[Option<u8>], left: &mut usize) -> (u8, Cost) {
        let mut least = (HOVER, (usize::MAX, 0.0));
        for (heading, lost) in self.uavs[i].choices() {
            let cost = (self.collisions(i, heading, chosen, left), lost);
            if is_less(cost, least.1) {
                least = (heading, cost);
            }
            if cost.0 == 0 {
                break;
            }
        }
        least
    }
}

/// A search over the headings of a group, in the order of falling scores. It is no deeper than [`MAX_GROUP`].
struct Search<'a> {
    fleet: &'a Fleet<'a>,
    order: &'a [usize],
    /// Those of each UAV in `order`.
    choices: Vec<Vec<(u8, f64)>>,
    /// The headings of all UAVs; none for those of the group that have no heading yet.
    chosen: &'a mut [Option<u8>],
    /// The cost, and the headings in `order`.
    best: Option<(Cost, Vec<u8>)>,
    /// Tests that are left, of `most`.
    left: &'a mut usize,
    most: usize,
}

impl Search<'_> {
    /// Chooses the headings from `at` on. `cost`: that of the headings before.
    fn descend(&mut self, at: usize, cost: Cost) {
        if self.best.as_ref().is_some_and(|(best, _)| !is_less(cost, *best)) {
            return;
        }
        let Some(&i) = self.order.get(at) else {
            self.best = Some((cost, self.order.iter().filter_map(|&i| self.chosen[i]).collect()));
            return;
        };
        for k in 0..self.choices[at].len() {
            let (heading, lost) = self.choices[at][k];
            // A combination without a collision is looked for much longer than a better one.
            let reserve = if self.best.as_ref().is_some_and(|(best, _)| best.0 > 0) { 0 } else { self.most / 4 * 3 };
            if *self.left <= reserve && self.best.is_some() {
                break;
            }
            let collisions = self.fleet.collisions(i, heading, self.chosen, self.left);
            self.chosen[i] = Some(heading);
            self.descend(at + 1, (cost.0 + collisions, cost.1 + lost));
            self.chosen[i] = None;
        }
    }
}

/// For each UAV, others that it can come too near to: all, or of very many those that are next to it along x.
fn neighbours(from: &[Point], reaches: &[f64], min_separation: f64) -> Vec<Vec<u32>> {
    let mut near = vec![Vec::new(); from.len()];
    let most = (MAX_NEIGHBOURS / from.len().max(1)).max(2 * MAX_GROUP);
    let longest = reaches.iter().copied().fold(0.0, f64::max);
    // Sorted by x, so that only UAVs nearby are compared.
    let mut order: Vec<usize> = (0..from.len()).collect();
    order.sort_by(|&a, &b| from[a][0].total_cmp(&from[b][0]).then(a.cmp(&b)));
    for (k, &i) in order.iter().enumerate() {
        for &j in &order[k + 1..] {
            let (dx, dy) = (from[j][0] - from[i][0], from[j][1] - from[i][1]);
            if dx > min_separation + 2.0 * longest {
                break;
            }
            let reach = min_separation + reaches[i] + reaches[j] + MARGIN;
            if dx * dx + dy * dy < reach * reach {
                for (one, other) in [(i, j), (j, i)] {
                    if near[one].len() < most {
                        near[one].push(other as u32);
                    }
                }
            }
        }
    }
    near
}

/// Chooses `headings` for the UAVs in `order`.
fn assign(order: &[usize], headings: &[u8], chosen: &mut [Option<u8>]) {
    order.iter().zip(headings).for_each(|(&i, &h)| chosen[i] = Some(h));
}

/// The connected groups of UAVs that can come too near to each other.
fn groups(near: &[Vec<u32>]) -> Vec<Vec<usize>> {
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
                if !std::mem::replace(&mut seen[j as usize], true) {
                    group.push(j as usize);
                }
            }
        }
        group.sort_unstable();
        groups.push(group);
    }
    groups
}

/// Estimated cost of keeping UAVs apart, see [`Guard::work`](super::Guard::work).
pub(super) fn work(positions: Option<&[Point]>, uavs: usize, min_separation: f64, speed: f64) -> usize {
    /// Tests per unit, and pairs that are compared per unit.
    const TESTS: usize = 5;
    const COMPARED: usize = 64;
    if min_separation <= 0.0 {
        return 0;
    }
    let of_group = |size: usize| {
        let combinations = (0..size.min(MAX_GROUP)).fold(1, |all: usize, _| (all * HEADINGS).min(MAX_TESTS));
        let placed = size.saturating_mul(size.min(MAX_NEIGHBOURS / uavs.max(1))).saturating_mul(HEADINGS);
        (combinations * size.min(MAX_GROUP)).min(MAX_TESTS) + if size > MAX_GROUP { placed } else { 0 }
    };
    let tests = match positions.filter(|positions| positions.len() <= MAX_INSPECTED) {
        Some(positions) => {
            let near = neighbours(positions, &vec![speed; positions.len()], min_separation);
            groups(&near).iter().map(|group| of_group(group.len())).sum()
        }
        None => of_group(uavs),
    };
    tests / TESTS + uavs * uavs / COMPARED
}
