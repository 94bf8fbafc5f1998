//! The flags that describe the world in which policies are evaluated, shared by `evaluate`, `plan` and `audit`.

use anyhow::bail;
use clap::Args;
use serde_json::{Map, Value};

use super::run_args;
use crate::env::EnvConfig;
use crate::invalid::Invalid;
use crate::train_config::{environment_with, field_name};

/// Users, slots and ranges.
#[derive(Args, Clone, Debug)]
pub struct WorldArgs {
    /// Number of users [default: 5]
    #[arg(long, env = "QEDGIX_USERS")]
    pub users: Option<usize>,
    /// Slots per episode [default: 80]
    #[arg(long, env = "QEDGIX_SLOTS")]
    pub slots: Option<usize>,
    /// Detection range, in units of the square's side [default: 0.28]
    #[arg(long, env = "QEDGIX_DETECTION_RANGE")]
    pub detection_range: Option<f64>,
    /// Range within which UAVs exchange messages, in units of the square's side [default: the detection range]
    #[arg(long, env = "QEDGIX_COMMUNICATION_RANGE")]
    pub communication_range: Option<f64>,
    /// Transmission range, in units of the square's side [default: 0.12]
    #[arg(long, env = "QEDGIX_TRANSMISSION_RANGE")]
    pub transmission_range: Option<f64>,
    /// Overrides one field of the environment, as in training: environment.speed=0.08; may be repeated
    #[arg(long = "set", value_name = "environment.FIELD=VALUE")]
    pub set: Vec<String>,
}

/// An environment, and the fields of it that somebody asked for.
#[derive(Clone, Debug)]
pub struct World {
    /// The environment.
    pub env: EnvConfig,
    given: Vec<String>,
}

impl World {
    /// Whether a flag sets this field.
    pub fn is_given(&self, field: &str) -> bool {
        self.given.iter().any(|given| given == field)
    }
}

impl WorldArgs {
    /// `base` with what these flags say; `--set` comes last. `given` are the fields of `base` that other flags set.
    ///
    /// # Errors
    /// A `--set` is no field of the environment, or a field is out of range; the error names its flag.
    pub fn world(&self, base: EnvConfig, given: &[&str]) -> anyhow::Result<World> {
        let fields = self.fields()?;
        let flags = EnvConfig {
            users: self.users.unwrap_or(base.users),
            slots: self.slots.unwrap_or(base.slots),
            detection_range: self.detection_range.unwrap_or(base.detection_range),
            communication_range: self.communication_range.or(base.communication_range),
            transmission_range: self.transmission_range.unwrap_or(base.transmission_range),
            ..base
        };
        let env = environment_with(&flags, &fields).map_err(|mut e| {
            e.field = format!("--set {}", e.field);
            e
        })?;
        env.validate().map_err(|e| named_by_flag(e, &fields))?;
        let own = [
            ("users", self.users.is_some()),
            ("slots", self.slots.is_some()),
            ("detection_range", self.detection_range.is_some()),
            ("communication_range", self.communication_range.is_some()),
            ("transmission_range", self.transmission_range.is_some()),
        ];
        let own = own.iter().filter(|(_, given)| *given).map(|(field, _)| *field);
        let set = fields.keys().map(|key| field_name(key));
        Ok(World { env, given: given.iter().copied().chain(own).chain(set).map(str::to_owned).collect() })
    }

    fn fields(&self) -> anyhow::Result<Map<String, Value>> {
        let (mut environment, mut training) = (Map::new(), Map::new());
        run_args::set(&self.set, &mut environment, &mut training)?;
        if let Some(field) = training.keys().next() {
            bail!("--set training.{field}: nothing is trained here; expected environment.FIELD=VALUE");
        }
        Ok(environment)
    }
}

/// The error with the flag of its field: `--lose-uav, slot` for `lose_uav.slot`, or `--set environment.speed` if `set` has the field.
pub fn named_by_flag(mut invalid: Invalid, set: &Map<String, Value>) -> Invalid {
    let field = &invalid.field;
    let (name, rest) = field.split_at(field.find(['.', '[']).unwrap_or(field.len()));
    let part = rest.rsplit('.').next().filter(|part| !part.is_empty() && rest.contains('.'));
    invalid.field = if set.keys().any(|key| field_name(key) == name) {
        format!("--set environment.{field}")
    } else {
        // A disturbance calls it `lose`.
        let flag = if name == "lose" { "lose-uav".to_owned() } else { name.replace('_', "-") };
        part.map_or_else(|| format!("--{flag}"), |part| format!("--{flag}, {part}"))
    };
    invalid
}
