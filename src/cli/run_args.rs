//! The flags that describe a training run, shared by `train` and `bench`.

use anyhow::{Context, bail};
use clap::Args;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value, json};

use crate::learner::{Algorithm, Preset, TrainConfig};

/// The training run; values that are not given come from the preset.
#[derive(Args, Clone, Debug)]
pub struct RunArgs {
    /// qedgix, qmix, vdn, iql, agggnn or rgcn
    #[arg(long, env = "QEDGIX_ALGORITHM", default_value = "qedgix", value_parser = named::<Algorithm>)]
    pub algorithm: Algorithm,
    /// practical, paper or authors
    #[arg(long, env = "QEDGIX_PRESET", default_value = "practical", value_parser = named::<Preset>)]
    pub preset: Preset,
    /// Number of UAVs [preset: 3]
    #[arg(long, env = "QEDGIX_UAVS")]
    pub uavs: Option<usize>,
    /// Number of users [preset: 5]
    #[arg(long, env = "QEDGIX_USERS")]
    pub users: Option<usize>,
    /// Slots per episode [preset: 80]
    #[arg(long, env = "QEDGIX_SLOTS")]
    pub slots: Option<usize>,
    /// Environment steps to train for [preset: 2050000]
    #[arg(long, env = "QEDGIX_STEPS")]
    pub steps: Option<u64>,
    /// Seed of every random stream
    #[arg(long, env = "QEDGIX_SEED", default_value_t = 1)]
    pub seed: u64,
    /// Overrides one field of the configuration; may be repeated
    #[arg(long = "set", value_name = "SECTION.FIELD=VALUE")]
    pub set: Vec<String>,
}

impl RunArgs {
    /// The sections `environment` and `training` with the fields that flags override.
    ///
    /// # Errors
    /// A `--set` is neither `environment.FIELD=VALUE` nor `training.FIELD=VALUE`.
    pub fn sections(&self) -> anyhow::Result<(Map<String, Value>, Map<String, Value>)> {
        let mut environment = Map::new();
        let mut training = Map::new();
        for (name, value) in [("uavs", self.uavs), ("users", self.users), ("slots", self.slots)] {
            if let Some(value) = value {
                environment.insert(name.into(), value.into());
            }
        }
        if let Some(steps) = self.steps {
            training.insert("steps".into(), steps.into());
        }
        set(&self.set, &mut environment, &mut training)?;
        Ok((environment, training))
    }

    /// The resolved configuration.
    ///
    /// # Errors
    /// A field is unknown, of the wrong type or out of range.
    pub fn resolve(&self) -> anyhow::Result<TrainConfig> {
        let (environment, training) = self.sections()?;
        Ok(TrainConfig::resolve(self.algorithm, self.preset, &environment, &training, self.seed)?)
    }

    /// The body of a request that submits this run as a job.
    ///
    /// # Errors
    /// As [`RunArgs::sections`].
    pub fn job(&self, threads: usize, name: Option<&str>) -> anyhow::Result<Value> {
        let (environment, training) = self.sections()?;
        let mut job = json!({
            "kind": "train",
            "algorithm": self.algorithm,
            "preset": self.preset,
            "environment": environment,
            "training": training,
            "threads": threads,
            "seed": self.seed,
        });
        if let Some(name) = name {
            job["name"] = name.into();
        }
        Ok(job)
    }
}

/// Inserts items `environment.FIELD=VALUE` and `training.FIELD=VALUE` into the sections.
///
/// # Errors
/// An item is neither of these.
pub fn set(items: &[String], environment: &mut Map<String, Value>, training: &mut Map<String, Value>) -> anyhow::Result<()> {
    for item in items {
        let (path, text) = item.split_once('=').with_context(|| format!("--set {item}: expected SECTION.FIELD=VALUE"))?;
        // Text that is not JSON is a string, so that `training.mixer=qmix` needs no quotes.
        let value = serde_json::from_str(text).unwrap_or_else(|_| Value::String(text.to_owned()));
        match path.split_once('.') {
            Some(("environment", field)) => environment.insert(field.to_owned(), value),
            Some(("training", field)) => training.insert(field.to_owned(), value),
            _ => bail!("--set {item}: {path} is not a field; expected environment.FIELD or training.FIELD"),
        };
    }
    Ok(())
}

/// Parses a name as configuration files spell it.
///
/// # Errors
/// The name is unknown; the error lists the known names.
pub fn named<T: DeserializeOwned>(text: &str) -> Result<T, String> {
    serde_json::from_value(Value::String(text.to_owned())).map_err(|e| e.to_string())
}

/// The default number of threads: all cores.
pub fn all_cores() -> usize {
    std::thread::available_parallelism().map_or(1, std::num::NonZero::get)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(clap::Parser)]
    struct Line {
        #[command(flatten)]
        run: RunArgs,
    }

    fn parse(words: &[&str]) -> Result<RunArgs, clap::Error> {
        use clap::Parser;
        Line::try_parse_from(std::iter::once(&"x").chain(words)).map(|line| line.run)
    }

    #[test]
    fn flags_override_the_preset() {
        let args =
            parse(&["--algorithm", "qmix", "--steps", "1000", "--set", "training.mixer=qmix", "--set", "environment.hover=true"]);
        let config = args.expect("flags parse").resolve().expect("valid");
        assert_eq!(config.algorithm, Algorithm::Qmix);
        assert_eq!(config.training.steps, 1000);
        assert_eq!(config.training.mixer, crate::learner::MixerKind::Qmix);
        assert!(config.environment.hover);
        assert_eq!(config.training.batch, 32, "untouched fields keep the preset's value");
    }

    #[test]
    fn errors_name_the_field() {
        for (words, hint) in [
            (vec!["--set", "training.batch"], "SECTION.FIELD=VALUE"),
            (vec!["--set", "learning.batch=3"], "learning.batch"),
            (vec!["--set", "training.bach=3"], "training.bach"),
            (vec!["--set", "training.batch=0"], "training.batch"),
            (vec!["--set", "training.gamma=nan"], "training.gamma"),
            (vec!["--uavs", "0"], "environment.uavs"),
        ] {
            let error = parse(&words).expect("clap accepts it").resolve().expect_err("must be refused").to_string();
            assert!(error.contains(hint), "{words:?}: {error}");
        }
        assert!(parse(&["--algorithm", "ppo"]).expect_err("unknown").to_string().contains("qedgix"));
    }
}
