//! The policies that flags name: files, bundled policies and baselines, and whether the world fits what they were trained in.

use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, bail};
use serde_json::{Map, Value};

use super::files::read_if_exists;
use super::output::errln;
use super::world_args::World;
use crate::checkpoint::Checkpoint;
use crate::env::EnvConfig;
use crate::invalid::Invalid;
use crate::learner::is_snapshot;
use crate::policy::{Policy, baselines};
use crate::serving::bundled;
use crate::train_config::TrainConfig;

/// Longest value that a warning contains; positions of many users are longer.
const MAX_VALUE: usize = 60;

/// A policy, and how it was trained; a baseline was not.
pub struct OpenedPolicy {
    /// The policy.
    pub policy: Arc<dyn Policy>,
    trained: Option<TrainConfig>,
}

/// The policy with this name on the command line: a file, a bundled policy or a baseline.
///
/// # Errors
/// The name is none of these, or the file is not a checkpoint.
pub fn open(name: &str, env: &EnvConfig) -> anyhow::Result<OpenedPolicy> {
    if let Some(policy) = baselines::by_name(name, env.into()) {
        return Ok(OpenedPolicy { policy, trained: None });
    }
    let bytes = match bundled::BUNDLED.iter().find(|(bundled, _)| *bundled == name) {
        Some((_, bytes)) => bytes.to_vec(),
        None => read_if_exists(Path::new(name))?.ok_or_else(|| unknown(name))?,
    };
    let checkpoint = read_checkpoint(name, &bytes)?;
    Ok(OpenedPolicy { policy: Arc::new(checkpoint.policy()), trained: Some(checkpoint.config().clone()) })
}

/// The checkpoint in the file `name`.
///
/// # Errors
/// The bytes are not a checkpoint; of a snapshot, the error says what it is for.
pub fn read_checkpoint(name: &str, bytes: &[u8]) -> anyhow::Result<Checkpoint> {
    if is_snapshot(bytes) {
        bail!("{name} is a snapshot of a run, not a policy; continue the run with `qedgix train --resume {name}`");
    }
    Checkpoint::from_bytes(bytes).with_context(|| format!("{name} is not a checkpoint"))
}

/// The error for a name that is neither known nor a file.
fn unknown(name: &str) -> Invalid {
    if name.contains(['/', '\\', '.']) {
        return Invalid::new("--policy", format!("{name:?}"), "a file that exists");
    }
    let known = baselines::LIST.iter().map(|b| b.name).chain(bundled::BUNDLED.iter().map(|(name, _)| *name));
    let known = known.collect::<Vec<_>>().join(", ");
    Invalid::new("--policy", format!("{name:?}"), format!("a checkpoint file, or one of {known}"))
}

impl OpenedPolicy {
    /// The environment of this world in which the policy flies: it hovers if the policy does.
    ///
    /// # Errors
    /// A flag forbids hovering to a policy that was trained to hover.
    pub fn environment(&self, name: &str, world: &World) -> anyhow::Result<EnvConfig> {
        let hover = self.policy.actions() > EnvConfig::COMPASS;
        if hover && !world.env.hover && world.is_given("hover") {
            let expected = format!("true, because {name} was trained to hover");
            return Err(Invalid::new("--set environment.hover", "false", expected).into());
        }
        Ok(EnvConfig { hover, ..world.env.clone() })
    }

    /// Warns on standard error of each field in which the world differs from that of training, unless a flag sets the field, or
    /// `drawn` or training draws it.
    pub fn warn_of_other_world(&self, name: &str, world: &World, drawn: &[&str]) {
        for warning in self.trained.iter().flat_map(|trained| warnings(name, trained, world, drawn)) {
            errln!("warning: {warning}");
        }
    }
}

fn warnings(name: &str, trained: &TrainConfig, world: &World, drawn: &[&str]) -> Vec<String> {
    let fields = |env: &EnvConfig| {
        let mut fields = object(env);
        // Without a value of its own it is the detection range, about which one warning is enough.
        if trained.environment.communication_range.is_some() || world.env.communication_range.is_some() {
            fields.insert("communication_range".into(), env.ranges().communication.into());
        }
        fields
    };
    let varied = object(&trained.training.vary);
    let of_training = fields(&trained.environment);
    let differs = |(field, flown): (String, Value)| {
        let value = of_training.get(&field)?;
        // The scale of rewards does not change a flight, and hovering follows the policy.
        let free = ["hover", "reward_scale"].contains(&field.as_str())
            || drawn.contains(&field.as_str())
            || varied.get(&field).is_some_and(|range| !range.is_null())
            || world.is_given(&field);
        (!free && *value != flown).then(|| sentence(name, &field, value, &flown))
    };
    fields(&world.env).into_iter().filter_map(differs).collect()
}

fn sentence(name: &str, field: &str, trained: &Value, flown: &Value) -> String {
    let text = |value: &Value| value.as_str().map_or_else(|| value.to_string(), str::to_owned);
    let (trained, flown) = (text(trained), text(flown));
    if trained.len().max(flown.len()) > MAX_VALUE {
        return format!("{name} was trained with another {field} than these layouts fly with (--set environment.{field}=...)");
    }
    let quote = if trained.contains(['{', '[', '"']) { "'" } else { "" };
    format!(
        "{name} was trained with {field} {trained}; these layouts fly with {flown} (--set {quote}environment.{field}={trained}{quote})"
    )
}

fn object(value: &impl serde::Serialize) -> Map<String, Value> {
    match serde_json::to_value(value) {
        Ok(Value::Object(fields)) => fields,
        _ => unreachable!("a configuration is an object of plain data"),
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser;
    use serde_json::json;

    use super::*;
    use crate::cli::world_args::WorldArgs;
    use crate::train_config::{Algorithm, Preset};

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        world: WorldArgs,
    }

    fn world(words: &[&str]) -> World {
        let line = Line::try_parse_from(std::iter::once(&"x").chain(words)).unwrap();
        line.world.world(EnvConfig::default(), &[]).unwrap()
    }

    fn trained(environment: &Value, training: &Value) -> TrainConfig {
        let fields = |value: &Value| value.as_object().unwrap().clone();
        TrainConfig::resolve(Algorithm::Vdn, Preset::Practical, &fields(environment), &fields(training), 1).unwrap()
    }

    #[test]
    fn a_world_that_differs_from_training_is_pointed_out_until_a_flag_sets_it() {
        let fast = trained(&json!({"speed": 0.08, "detection_range": 0.4, "hover": true}), &json!({}));
        let all = warnings("fast.safetensors", &fast, &world(&[]), &[]);
        let expected = "fast.safetensors was trained with speed 0.08; these layouts fly with 0.04 (--set environment.speed=0.08)";
        assert!(all.len() == 2 && all.iter().any(|warning| warning == expected), "{all:?}");
        for (words, left) in [
            (&["--set", "environment.speed=0.08"][..], 1),
            (&["--set", "environment.v=0.05", "--detection-range", "0.28"], 0),
            (&["--set", "environment.boundary=free"], 2),
        ] {
            assert_eq!(warnings("p", &fast, &world(words), &[]).len(), left, "{words:?}");
        }
        assert_eq!(warnings("p", &fast, &world(&[]), &["detection_range"]).len(), 1);
        let vary = json!({"vary": {"users": [4, 6], "detection_range": [0.2, 0.5]}});
        assert!(warnings("p", &trained(&json!({"detection_range": 0.4}), &vary), &world(&[]), &[]).is_empty());
        let far = trained(&json!({"communication_range": 1.5}), &json!({}));
        let all = warnings("p", &far, &world(&[]), &[]);
        assert!(all.len() == 1 && all[0].contains("communication_range 1.5; these layouts fly with 0.28"), "{all:?}");
        let given = trained(&json!({"start": {"given": vec![[0.5, 0.5]; 3]}}), &json!({}));
        assert_eq!(warnings("p", &given, &world(&[]), &[]).len(), 1);
    }

    #[test]
    fn bundled_policies_fly_the_default_world_without_a_warning() {
        for (name, bytes) in bundled::BUNDLED {
            let checkpoint = read_checkpoint(name, bytes).unwrap();
            assert_eq!(warnings(name, checkpoint.config(), &world(&[]), &[]), Vec::<String>::new());
        }
    }

    #[test]
    fn what_is_no_policy_is_named() {
        let error = |name: &str| open(name, &EnvConfig::default()).err().unwrap().to_string();
        assert_eq!(error("nofile.safetensors"), "--policy: got \"nofile.safetensors\", expected a file that exists");
        assert!(error("swep").contains("did you mean sweep?"));
        let error = read_checkpoint("a.snapshot", b"qedgixss\x03\0\0\0").unwrap_err().to_string();
        assert!(error.contains("`qedgix train --resume a.snapshot`"), "{error}");
    }

    #[test]
    fn a_policy_that_hovers_is_not_kept_from_it() {
        let env = EnvConfig { hover: true, ..EnvConfig::default() };
        let random = open("random", &env).unwrap();
        let not = world(&["--set", "environment.hover=false"]);
        assert!(random.environment("p", &not).unwrap_err().to_string().contains("environment.hover"));
        assert!(random.environment("p", &world(&[])).unwrap().hover);
    }
}
