//! Guard rails: constraints of a fleet that no heading may break. After the policy has decided, every UAV gets the heading with the highest
//! Q-value among those that keep the constraints; separation is kept jointly. Where nothing keeps them, the UAV hovers or takes the
//! heading that breaks least. All lengths are in units of the square's side, all times in slots.

mod separation;
mod zone;

pub use separation::HOVER;
pub use zone::Zone;

use separation::{Fleet, HEADINGS, Uav};
use zone::{MARGIN, distance, octile};

use crate::env::{Boundary, DIRECTIONS, Point};
use crate::policy::EnvParams;

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
        let fleet = Fleet::new(&uavs, self.min_separation);
        fleet.separate(headings);
        let breaks = |headings: &[u8], i: usize, heading: u8| {
            let collides = fleet.collides(headings, i, heading);
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

    /// Estimated cost of [`Guard::apply`] in the unit of [`Policy::work`](crate::policy::Policy::work), for UAVs at `positions` that fly at
    /// most `speed` per slot. `positions`: none if they are not known yet, then the costliest of `uavs` UAVs count.
    pub fn work(&self, positions: Option<&[Point]>, uavs: usize, speed: f64) -> usize {
        let corners: usize = self.no_fly.iter().map(Zone::corners).sum();
        4 * uavs * (1 + corners) + separation::work(positions, uavs, self.min_separation, speed)
    }

    fn uav(&self, situation: &Situation<'_>, i: usize, preferred: u8) -> Uav {
        let (env, from) = (situation.env, situation.positions[i]);
        let speed = situation.speeds.get(i).copied().unwrap_or(env.speed);
        let mut ends = [from; HEADINGS];
        for (end, direction) in ends.iter_mut().zip(DIRECTIONS) {
            for axis in 0..2 {
                let to = from[axis] + speed * direction[axis];
                end[axis] = self.boundary.limit(from[axis], to, env.extent[axis]);
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
}
