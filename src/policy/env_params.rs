//! The parameters of the environment that a policy may know.

use crate::env::{EnvConfig, Point, Ranges};

/// The parameters of the environment that a policy flies in. Lengths are in units of the square's side.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EnvParams {
    /// v, distance per slot.
    pub speed: f64,
    /// t, range within which data is collected.
    pub transmission_range: f64,
    /// d, range within which nodes detect each other.
    pub detection_range: f64,
    /// Range within which UAVs exchange messages and learn each other's positions.
    pub communication_range: f64,
    /// A, the number of actions.
    pub actions: usize,
    /// K, slots per episode: how far policies that plan look ahead.
    pub slots: usize,
    /// Width and height of the area, in the middle of the unit square: [1, 1] if it is the square.
    pub extent: [f64; 2],
}

impl From<&EnvConfig> for EnvParams {
    fn from(env: &EnvConfig) -> Self {
        Self {
            speed: env.speed,
            transmission_range: env.transmission_range,
            detection_range: env.detection_range,
            communication_range: env.ranges().communication,
            actions: env.actions(),
            slots: env.slots,
            extent: [1.0; 2],
        }
    }
}

impl EnvParams {
    /// Whether `p` is in the area.
    pub fn contains(&self, p: Point) -> bool {
        p.iter().zip(self.extent).all(|(x, extent)| ((1.0 - extent) / 2.0..=f64::midpoint(1.0, extent)).contains(x))
    }

    /// Ranges within which nodes detect each other.
    pub fn ranges(&self) -> Ranges {
        Ranges { detection: self.detection_range, communication: self.communication_range }
    }
}

impl Default for EnvParams {
    fn default() -> Self {
        Self::from(&EnvConfig::default())
    }
}
