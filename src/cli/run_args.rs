//! The flags that describe a training run, shared by `train`, `jobs submit` and `bench`.

use anyhow::{Context, bail};
use clap::Args;
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value};

use crate::invalid::Invalid;
use crate::learner::{Algorithm, Preset, TrainConfig};
use crate::train_config::floats_to_integers;

/// The training run; values that are not given come from the preset.
#[derive(Args, Clone, Debug)]
pub struct RunArgs {
    /// qedgix, qmix, vdn, iql, agggnn or rgcn [default: qedgix]
    #[arg(long, env = "QEDGIX_ALGORITHM", value_parser = named::<Algorithm>)]
    pub algorithm: Option<Algorithm>,
    /// practical, paper or authors [default: practical]
    #[arg(long, env = "QEDGIX_PRESET", value_parser = named::<Preset>)]
    pub preset: Option<Preset>,
    /// Number of UAVs [preset: 3]
    #[arg(long, env = "QEDGIX_UAVS")]
    pub uavs: Option<usize>,
    /// Number of users [preset: 5]
    #[arg(long, env = "QEDGIX_USERS")]
    pub users: Option<usize>,
    /// Slots per episode [preset: 80]
    #[arg(long, env = "QEDGIX_SLOTS")]
    pub slots: Option<usize>,
    /// Environment steps to train for, as 400000, 400_000 or 4e5; rounded up to whole iterations of all environments, as 2000 to 2560
    /// with 8 environments of 80 slots [preset: 2050000]
    #[arg(long, env = "QEDGIX_STEPS", value_parser = count)]
    pub steps: Option<u64>,
    /// Seed of every random stream [default: 1]
    #[arg(long, env = "QEDGIX_SEED")]
    pub seed: Option<u64>,
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
        let (algorithm, preset) = (self.algorithm.unwrap_or_default(), self.preset.unwrap_or_default());
        Ok(TrainConfig::resolve(algorithm, preset, &environment, &training, self.seed.unwrap_or(1))?)
    }

    /// Checks that no flag contradicts the configuration of a snapshot.
    ///
    /// # Errors
    /// [`Invalid`] with the field, its value on the command line and its value in the snapshot.
    pub fn agree_with(&self, config: &TrainConfig) -> anyhow::Result<()> {
        let (environment, training) = self.sections()?;
        let wanted = TrainConfig {
            algorithm: self.algorithm.unwrap_or(config.algorithm),
            preset: self.preset.unwrap_or(config.preset),
            seed: self.seed.unwrap_or(config.seed),
            ..config.with_fields(&environment, &training)?
        };
        let fields = |config: &TrainConfig| serde_json::to_value(config).expect("a configuration is plain data");
        match first_difference("", &fields(&wanted), &fields(config)) {
            None => Ok(()),
            Some((field, wanted, had)) => {
                Err(Invalid::new(field, wanted, format!("{had}, the value of the run that is resumed, or no value")).into())
            }
        }
    }

    /// Writes what the flags say into the body of a request that submits a job. What they do not say is left to the server.
    ///
    /// # Errors
    /// As [`RunArgs::sections`]; or a section of `job` is not an object.
    pub fn write_into(&self, job: &mut Map<String, Value>) -> anyhow::Result<()> {
        let (environment, training) = self.sections()?;
        for (name, fields) in [("environment", environment), ("training", training)] {
            if !fields.is_empty() {
                let section = job.entry(name).or_insert_with(|| Map::new().into());
                section.as_object_mut().with_context(|| format!("{name}: expected an object"))?.extend(fields);
            }
        }
        insert(job, "algorithm", self.algorithm);
        insert(job, "preset", self.preset);
        insert(job, "seed", self.seed);
        Ok(())
    }
}

/// Inserts a value that is given.
pub fn insert(fields: &mut Map<String, Value>, name: &str, value: Option<impl Serialize>) {
    if let Some(value) = value {
        fields.insert(name.to_owned(), serde_json::to_value(value).expect("a flag is plain data"));
    }
}

/// The first field in which two documents of the same form differ: its path and both values.
fn first_difference<'a>(path: &str, one: &'a Value, other: &'a Value) -> Option<(String, &'a Value, &'a Value)> {
    match (one, other) {
        (Value::Object(fields), Value::Object(others)) => fields.iter().find_map(|(name, value)| {
            let dot = if path.is_empty() { "" } else { "." };
            first_difference(&format!("{path}{dot}{name}"), value, others.get(name).unwrap_or(&Value::Null))
        }),
        _ => (one != other).then(|| (path.to_owned(), one, other)),
    }
}

/// Parses a number of things: `400000`, `400_000` or `4e5`.
///
/// # Errors
/// The text is not a whole number from 0 to 2^64 - 1.
pub fn count(text: &str) -> Result<u64, String> {
    const LARGEST: f64 = (1_u64 << 53) as f64;
    let plain = without_separators(text);
    let float: Option<f64> = plain.parse().ok();
    let whole = float.filter(|x| x.fract() == 0.0 && (0.0..=LARGEST).contains(x));
    plain.parse().ok().or_else(|| whole.map(|x| x as u64)).ok_or_else(|| {
        let limit = match float {
            Some(x) if x < 0.0 => ", 0 or more",
            Some(x) if x > LARGEST => " of at most 2^53, about 9e15",
            _ => "",
        };
        format!("expected a whole number{limit}, as 400000, 400_000 or 4e5")
    })
}

/// A number without the underscores between its digits; other text as it is.
fn without_separators(text: &str) -> String {
    let number = text.starts_with(|c: char| c.is_ascii_digit() || c == '-')
        && text.ends_with(|c: char| c.is_ascii_digit())
        && text.chars().all(|c| c.is_ascii_digit() || matches!(c, '_' | '.' | '-' | '+' | 'e' | 'E'))
        && !text.contains("__");
    if number { text.replace('_', "") } else { text.to_owned() }
}

/// Inserts items `environment.FIELD=VALUE` and `training.FIELD=VALUE` into the sections.
///
/// # Errors
/// An item is neither of these.
pub fn set(items: &[String], environment: &mut Map<String, Value>, training: &mut Map<String, Value>) -> anyhow::Result<()> {
    for item in items {
        let (path, text) = item.split_once('=').with_context(|| format!("--set {item}: expected SECTION.FIELD=VALUE"))?;
        // Text that is not JSON is a string, so that `training.mixer=qmix` needs no quotes.
        let mut value = serde_json::from_str(&without_separators(text)).unwrap_or_else(|_| Value::String(text.to_owned()));
        floats_to_integers(&mut value);
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
    serde_json::from_value(Value::String(text.to_owned())).map_err(|e| {
        let invalid = Invalid::from_parser("", &e);
        let meant = invalid.suggestion().map_or_else(String::new, |word| format!("; did you mean {word}?"));
        format!("expected {}{meant}", invalid.expected)
    })
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
    fn counts_are_written_as_people_write_them() {
        for (text, value) in [("0", 0), ("400000", 400_000), ("1_000_000", 1_000_000), ("1e6", 1_000_000), ("2.5e3", 2500)] {
            assert_eq!(count(text), Ok(value), "{text}");
            let config = parse(&["--set", &format!("training.eval_every={text}"), "--steps", text]).unwrap();
            assert_eq!(config.sections().unwrap().1["steps"], value, "{text}");
            assert_eq!(config.sections().unwrap().1["eval_every"], value, "{text}");
        }
        assert_eq!(count(&u64::MAX.to_string()), Ok(u64::MAX));
        for text in ["", "-1", "1.5", "1e-3", "1e300", "nan", "inf", "_1", "1_", "1__0", "1 000", "0x10", "many"] {
            assert!(count(text).is_err(), "{text}");
        }
        assert!(count("1e30").unwrap_err().contains("at most 2^53"));
        assert!(count("-5").unwrap_err().contains("0 or more"));
    }

    #[test]
    fn flags_that_contradict_a_resumed_run_are_refused() {
        let words = ["--algorithm", "qmix", "--seed", "3", "--set", "environment.M=2", "--steps", "1e3"];
        let config = parse(&words).unwrap().resolve().unwrap();
        for agreeing in [&words[..], &[], &["--uavs", "2"], &["--preset", "practical", "--set", "training.steps=1000"]] {
            parse(agreeing).unwrap().agree_with(&config).unwrap();
        }
        for (words, field, had) in [
            (["--algorithm", "vdn"], "algorithm", "\"qmix\""),
            (["--preset", "paper"], "preset", "\"practical\""),
            (["--seed", "4"], "seed", "3"),
            (["--steps", "2e3"], "training.steps", "1000"),
            (["--set", "environment.M=3"], "environment.uavs", "2"),
        ] {
            let error = parse(&words).unwrap().agree_with(&config).unwrap_err();
            let error = error.downcast::<Invalid>().unwrap();
            assert!(error.field == field && error.expected.starts_with(had), "{error}");
        }
    }

    #[test]
    fn a_job_has_what_is_given_and_no_more() {
        let mut job = Map::new();
        parse(&[]).unwrap().write_into(&mut job).unwrap();
        assert!(job.is_empty());
        job.insert("training".into(), serde_json::json!({"batch": 3, "steps": 1}));
        parse(&["--steps", "7", "--seed", "2", "--algorithm", "iql"]).unwrap().write_into(&mut job).unwrap();
        assert_eq!(Value::from(job), serde_json::json!({"training": {"batch": 3, "steps": 7}, "seed": 2, "algorithm": "iql"}));
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
