//! Environments that are drawn anew for each group of episodes (docs/model.md, "Varied environments"), so that one policy learns to
//! fly fleets of many sizes.

use rand::{Rng, RngExt};
use serde::{Deserialize, Deserializer, Serialize, de::Error};
use serde_json::{Map, Value};

use crate::env::{EnvConfig, Layout, Start};
use crate::invalid::Invalid;

/// Ranges, both ends included, from which fields of the environment are drawn. A field without a range has the value of
/// `environment`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Vary {
    /// M, the number of UAVs.
    pub uavs: Option<[usize; 2]>,
    /// N, the number of users.
    pub users: Option<[usize; 2]>,
    /// K, slots per episode.
    pub slots: Option<[usize; 2]>,
    /// t, the transmission range.
    pub transmission_range: Option<[f64; 2]>,
    /// d, the detection range.
    pub detection_range: Option<[f64; 2]>,
    /// Range within which UAVs exchange messages. A drawn value below d counts as d: radios reach at least as far as cameras.
    pub communication_range: Option<[f64; 2]>,
}

/// Reads an object; a list of the fields' values, which serde would accept as well, is refused.
pub(super) fn from_object<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vary, D::Error> {
    let fields = Map::<String, Value>::deserialize(deserializer)?;
    Vary::deserialize(Value::Object(fields)).map_err(D::Error::custom)
}

impl Vary {
    /// Whether no field has a range.
    pub fn is_none(&self) -> bool {
        *self == Self::default()
    }

    /// An environment with the fields of `base` that have no range, and drawn values of the others. Rewards grow with M: mean AoI falls
    /// with M, and updates would otherwise care little about large fleets.
    pub fn draw(&self, base: &EnvConfig, rng: &mut impl Rng) -> EnvConfig {
        let mut env = base.clone();
        for (field, range) in [(&mut env.uavs, self.uavs), (&mut env.users, self.users), (&mut env.slots, self.slots)] {
            if let Some([low, high]) = range {
                *field = rng.random_range(low..=high);
            }
        }
        let mut real = |range: Option<[f64; 2]>| range.map(|[low, high]| rng.random_range(low..=high));
        env.transmission_range = real(self.transmission_range).unwrap_or(env.transmission_range);
        env.detection_range = real(self.detection_range).unwrap_or(env.detection_range);
        let communication = real(self.communication_range).map(|range| range.max(env.detection_range));
        env.communication_range = communication.or(env.communication_range);
        if self.uavs.is_some() {
            env.reward_scale = Some(base.effective_reward_scale() * env.uavs as f64 / base.uavs as f64);
        }
        env
    }

    /// The environment with the largest value of every field.
    pub fn largest(&self, base: &EnvConfig) -> EnvConfig {
        self.end(base, 1)
    }

    /// The environment with the lower (0) or upper (1) ends of all ranges.
    fn end(&self, base: &EnvConfig, end: usize) -> EnvConfig {
        EnvConfig {
            uavs: self.uavs.map_or(base.uavs, |range| range[end]),
            users: self.users.map_or(base.users, |range| range[end]),
            slots: self.slots.map_or(base.slots, |range| range[end]),
            transmission_range: self.transmission_range.map_or(base.transmission_range, |range| range[end]),
            detection_range: self.detection_range.map_or(base.detection_range, |range| range[end]),
            communication_range: self.communication_range.map(|range| range[end]).or(base.communication_range),
            ..base.clone()
        }
    }

    /// Checks the ranges together with the fields of `base`.
    ///
    /// # Errors
    /// [`Invalid`] for the first range whose ends are out of order, or that permits an invalid environment.
    pub fn validate(&self, base: &EnvConfig) -> Result<(), Invalid> {
        let count = |range: [usize; 2]| (range[0] <= range[1], format!("{range:?}"));
        let real = |range: [f64; 2]| (range[0] <= range[1], format!("{range:?}"));
        for (field, range) in [
            ("uavs", self.uavs.map(count)),
            ("users", self.users.map(count)),
            ("slots", self.slots.map(count)),
            ("transmission_range", self.transmission_range.map(real)),
            ("detection_range", self.detection_range.map(real)),
            ("communication_range", self.communication_range.map(real)),
        ] {
            if let Some((false, text)) = range {
                return Err(Invalid::new(field, text, "[lowest, highest]"));
            }
        }
        if self.uavs.is_some() && matches!(base.start, Start::Given(_)) {
            return Err(Invalid::new("uavs", "a range", "no value, because environment.start gives positions"));
        }
        if self.users.is_some() && (matches!(base.layout, Layout::Given(_)) || base.weights.is_some()) {
            return Err(Invalid::new("users", "a range", "no value, because environment.layout or environment.weights is given"));
        }
        let (low, high) = (self.end(base, 0), self.end(base, 1));
        low.validate()?;
        high.validate()?;
        // The largest transmission range must fit the smallest detection range.
        EnvConfig { transmission_range: high.transmission_range, ..low }.validate()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng;

    #[test]
    fn every_drawn_environment_is_valid_and_all_values_occur() {
        let base = EnvConfig::default();
        let vary = Vary { uavs: Some([2, 4]), users: Some([4, 20]), detection_range: Some([0.2, 0.36]), ..Vary::default() };
        vary.validate(&base).unwrap();
        let drawn: Vec<_> = (0..200).map(|group| vary.draw(&base, &mut rng::stream(1, "vary", group))).collect();
        assert!(drawn.iter().all(|env| env.validate().is_ok() && env.slots == 80 && (4..=20).contains(&env.users)));
        for uavs in 2..=4 {
            assert!(drawn.iter().any(|env| env.uavs == uavs));
        }
        assert!(drawn.iter().all(|env| (0.2..=0.36).contains(&env.detection_range)));
        assert!(drawn.iter().any(|env| env.detection_range < 0.22) && drawn.iter().any(|env| env.detection_range > 0.34));
        assert_eq!(Vary::default().draw(&base, &mut rng::stream(1, "vary", 0)), base);
    }

    #[test]
    fn ranges_that_permit_an_invalid_environment_are_refused() {
        let base = EnvConfig::default();
        let field = |vary: Vary| vary.validate(&base).unwrap_err().field;
        assert_eq!(field(Vary { uavs: Some([4, 2]), ..Vary::default() }), "uavs");
        assert_eq!(field(Vary { users: Some([0, 2]), ..Vary::default() }), "users");
        assert_eq!(field(Vary { detection_range: Some([0.1, 0.3]), ..Vary::default() }), "detection_range");
        let base = EnvConfig { layout: Layout::Given(vec![[0.5, 0.5]; 5]), ..base };
        assert!(Vary { users: Some([2, 4]), ..Vary::default() }.validate(&base).is_err());
    }
}
