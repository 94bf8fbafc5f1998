//! Configuration of the environment: fields, units, defaults and limits (docs/model.md, "Environment").

use serde::{Deserialize, Serialize};

use super::point::Point;
use crate::invalid::{Invalid, in_range};

/// Rule at the border of the unit square.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Boundary {
    /// Each coordinate is clamped to [0, 1].
    #[default]
    Clamp,
    /// UAVs can leave the square.
    Free,
}

impl Boundary {
    /// Where a UAV that flies from `from` to `to` along one axis ends, in an area of length `extent` in the middle of [0, 1]. A UAV that is
    /// outside of the area does not jump back: it gets no further away.
    pub fn limit(self, from: f64, to: f64, extent: f64) -> f64 {
        match self {
            Self::Clamp => to.clamp(from.min((1.0 - extent) / 2.0), from.max(f64::midpoint(1.0, extent))),
            Self::Free => to,
        }
    }
}

/// Positions of the UAVs in slot 0.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Start {
    /// All at (0.5, 0.5).
    #[default]
    Center,
    /// Uniform in the square, from the episode's seed.
    Random,
    /// These positions, one per UAV.
    Given(Vec<Point>),
}

/// Positions of the users in slot 0.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Layout {
    /// Uniform in the square, from the episode's seed.
    #[default]
    Random,
    /// These positions, one per user.
    Given(Vec<Point>),
}

/// Ranges within which nodes detect each other, in units of the square's side.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ranges {
    /// Between a user and any node.
    pub detection: f64,
    /// Between two UAVs.
    pub communication: f64,
}

impl From<f64> for Ranges {
    /// One range for all nodes.
    fn from(range: f64) -> Self {
        Self { detection: range, communication: range }
    }
}

impl Ranges {
    /// The range between nodes `i` and `j` of a fleet with `uavs` UAVs, which come first.
    #[inline(always)]
    pub fn between(&self, i: usize, j: usize, uavs: usize) -> f64 {
        if i.max(j) < uavs { self.communication } else { self.detection }
    }

    /// The larger range.
    pub fn max(&self) -> f64 {
        self.detection.max(self.communication)
    }
}

/// A UAV that is lost: from `slot` on, it does not move, collect or detect, and is not detected; its actions have no effect.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LostUav {
    /// Index of the UAV, from 0.
    pub uav: usize,
    /// The first slot in which it is lost.
    pub slot: usize,
}

/// The slots in which a user is there. Before, and from `until` on, it is not detected and its AoI does not count; its AoI begins at 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct UserSlots {
    /// Index of the user, from 0.
    pub user: usize,
    /// The first slot.
    #[serde(default)]
    pub from: usize,
    /// The first slot after; absent: it stays to the end.
    #[serde(default)]
    pub until: Option<usize>,
}

impl UserSlots {
    pub(super) fn contains(&self, slot: usize) -> bool {
        self.from <= slot && self.until.is_none_or(|until| slot < until)
    }
}

/// Everything that determines an environment except the episode's seed. Lengths are in units of the square's side.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EnvConfig {
    /// M, the number of UAVs.
    pub uavs: usize,
    /// N, the number of users.
    pub users: usize,
    /// K, slots per episode.
    pub slots: usize,
    /// v, distance flown per slot.
    pub speed: f64,
    /// t, range within which a user's data is collected.
    pub transmission_range: f64,
    /// d, range within which nodes detect each other; at least t.
    pub detection_range: f64,
    /// Range within which UAVs exchange messages and learn each other's positions; absent: d. In the paper it is d.
    pub communication_range: Option<f64>,
    /// Adds a ninth action that stays in place.
    pub hover: bool,
    /// Rule at the border.
    pub boundary: Boundary,
    /// Factor of the reward -`reward_scale` * mean AoI; absent: 1/K.
    pub reward_scale: Option<f64>,
    /// UAV positions in slot 0.
    pub start: Start,
    /// User positions in slot 0.
    pub layout: Layout,
    /// Weight of each user in the reward and in the mean AoI, scaled to mean 1. Absent: equal weights.
    pub weights: Option<Vec<f64>>,
    /// Distance that a user moves per slot, in a direction that changes slightly in each slot. 0: users do not move.
    pub user_speed: f64,
    /// A UAV that is lost during the episode. Not for training.
    pub lose_uav: Option<LostUav>,
    /// The slots of users that come and go, at most one entry per user; all others are always there. Not for training.
    pub user_slots: Vec<UserSlots>,
}

impl Default for EnvConfig {
    fn default() -> Self {
        Self {
            uavs: 3,
            users: 5,
            slots: 80,
            speed: 0.04,
            transmission_range: 0.12,
            detection_range: 0.28,
            communication_range: None,
            hover: false,
            boundary: Boundary::Clamp,
            reward_scale: None,
            start: Start::Center,
            layout: Layout::Random,
            weights: None,
            user_speed: 0.0,
            lose_uav: None,
            user_slots: Vec::new(),
        }
    }
}

impl EnvConfig {
    /// Number of headings spaced by 45 degrees.
    pub const COMPASS: usize = 8;

    /// A, the number of actions: 8 headings, and hovering if `hover` is set.
    pub fn actions(&self) -> usize {
        Self::COMPASS + usize::from(self.hover)
    }

    /// V = M + N.
    pub fn nodes(&self) -> usize {
        self.uavs + self.users
    }

    /// Ranges within which nodes detect each other.
    pub fn ranges(&self) -> Ranges {
        let detection = self.detection_range;
        Ranges { detection, communication: self.communication_range.unwrap_or(detection) }
    }

    /// `reward_scale`, or its default 1/K.
    pub fn effective_reward_scale(&self) -> f64 {
        self.reward_scale.unwrap_or(1.0 / self.slots as f64)
    }

    /// Whether UAV `i` flies in `slot`.
    pub fn flies(&self, i: usize, slot: usize) -> bool {
        self.lose_uav.is_none_or(|lost| lost.uav != i || slot < lost.slot)
    }

    /// Whether user `j` is there in `slot`.
    pub fn is_there(&self, j: usize, slot: usize) -> bool {
        self.user_slots.iter().find(|user| user.user == j).is_none_or(|user| user.contains(slot))
    }

    /// Whether UAVs or users change during an episode.
    pub fn changes(&self) -> bool {
        self.lose_uav.is_some() || !self.user_slots.is_empty()
    }

    /// The weight of each user, scaled to mean 1.
    pub fn user_weights(&self) -> Vec<f64> {
        let Some(weights) = &self.weights else { return vec![1.0; self.users] };
        let mean = weights.iter().sum::<f64>() / self.users as f64;
        weights.iter().map(|w| w / mean).collect()
    }

    /// Checks every field.
    ///
    /// # Errors
    /// [`Invalid`] for the first field that is out of range.
    pub fn validate(&self) -> Result<(), Invalid> {
        in_range("uavs", self.uavs, 1..=4096)?;
        in_range("users", self.users, 1..=65_536)?;
        in_range("slots", self.slots, 1..=10_000)?;
        in_range("speed", self.speed, 0.0..=1.0)?;
        in_range("transmission_range", self.transmission_range, 0.0..=2.0)?;
        in_range("detection_range", self.detection_range, 1e-6..=2.0)?;
        in_range("user_speed", self.user_speed, 0.0..=1.0)?;
        if self.detection_range < self.transmission_range {
            let expected = format!("at least transmission_range ({})", self.transmission_range);
            return Err(Invalid::new("detection_range", self.detection_range, expected));
        }
        if let Some(range) = self.communication_range {
            in_range("communication_range", range, 0.0..=10.0)?;
        }
        if let Some(scale) = self.reward_scale {
            in_range("reward_scale", scale, 1e-9..=1e9)?;
        }
        if let Start::Given(points) = &self.start {
            check_points("start.given", points, self.uavs, "UAV")?;
        }
        if let Layout::Given(points) = &self.layout {
            check_points("layout.given", points, self.users, "user")?;
        }
        self.validate_changes()?;
        let Some(weights) = &self.weights else { return Ok(()) };
        if weights.len() != self.users {
            return Err(Invalid::new(
                "weights",
                format!("{} values", weights.len()),
                format!("{} values, one per user", self.users),
            ));
        }
        for (i, &w) in weights.iter().enumerate() {
            in_range(&format!("weights[{i}]"), w, 0.0..=1e6)?;
        }
        if weights.iter().sum::<f64>() <= 0.0 {
            return Err(Invalid::new("weights", "only zeros", "at least one positive weight"));
        }
        Ok(())
    }

    fn validate_changes(&self) -> Result<(), Invalid> {
        if let Some(lost) = self.lose_uav {
            in_range("lose_uav.uav", lost.uav, 0..=self.uavs - 1)?;
            in_range("lose_uav.slot", lost.slot, 0..=self.slots - 1)?;
        }
        if self.user_slots.len() > self.users {
            let expected = format!("at most {} entries, one per user", self.users);
            return Err(Invalid::new("user_slots", format!("{} entries", self.user_slots.len()), expected));
        }
        let mut listed = vec![false; self.users];
        for (i, &UserSlots { user, from, until }) in self.user_slots.iter().enumerate() {
            let field = |name: &str| format!("user_slots[{i}].{name}");
            in_range(&field("user"), user, 0..=self.users - 1)?;
            in_range(&field("from"), from, 0..=self.slots)?;
            if let Some(until) = until {
                in_range(&field("until"), until, from..=self.slots)?;
            }
            if std::mem::replace(&mut listed[user], true) {
                return Err(Invalid::new(field("user"), user, "a user without another entry"));
            }
        }
        Ok(())
    }
}

fn check_points(field: &str, points: &[Point], expected: usize, what: &str) -> Result<(), Invalid> {
    if points.len() != expected {
        return Err(Invalid::new(field, format!("{} positions", points.len()), format!("{expected} positions, one per {what}")));
    }
    for (i, p) in points.iter().enumerate() {
        in_range(&format!("{field}[{i}].x"), p[0], 0.0..=1.0)?;
        in_range(&format!("{field}[{i}].y"), p[1], 0.0..=1.0)?;
    }
    Ok(())
}
