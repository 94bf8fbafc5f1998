//! Reading tables field by field, so that a message names the table and the field that is wrong.

use serde::de::DeserializeOwned;
use serde_json::{Map, Value};

use crate::invalid::{Invalid, expectation};
use crate::recipe::{Algorithm, Preset, TrainConfig};

/// What the command line puts over a document.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Overrides {
    /// Seeds instead of the document's.
    pub seeds: Option<Vec<u64>>,
    /// Names of the only series to run; empty: all.
    pub series: Vec<String>,
    /// Names of the only points to run; empty: all.
    pub points: Vec<String>,
    /// Fields of `environment`.
    pub environment: Map<String, Value>,
    /// Fields of `training`.
    pub training: Map<String, Value>,
}

/// A table of the document that is being read.
pub(super) struct Table {
    /// Its name, as `series[1]`; empty for the document itself.
    path: String,
    fields: Map<String, Value>,
}

impl Table {
    /// The table, if it has no fields but these.
    pub fn new(path: &str, value: Value, known: &[&str]) -> Result<Self, Invalid> {
        let Value::Object(fields) = value else {
            return Err(Invalid::schema(path, &value, "a table"));
        };
        let table = Self { path: path.to_owned(), fields };
        match table.fields.keys().find(|key| !known.contains(&key.as_str())) {
            Some(key) => Err(Invalid::unknown_field(table.at(key), format!("one of {}", known.join(", ")))),
            None => Ok(table),
        }
    }

    /// A field with the name of the table before it.
    pub fn at(&self, field: &str) -> String {
        if self.path.is_empty() { field.to_owned() } else { format!("{}.{field}", self.path) }
    }

    pub fn optional<T: DeserializeOwned>(&mut self, field: &str) -> Result<Option<T>, Invalid> {
        let Some(value) = self.fields.remove(field) else { return Ok(None) };
        T::deserialize(&value).map(Some).map_err(|e| Invalid::schema(self.at(field), &value, expectation(&e)))
    }

    pub fn required<T: DeserializeOwned>(&mut self, field: &str, expected: &str) -> Result<T, Invalid> {
        self.optional(field)?.ok_or_else(|| Invalid::missing_field(self.at(field), expected))
    }

    /// A name that is not empty and fits a line.
    pub fn name(&mut self, field: &str) -> Result<String, Invalid> {
        let expected = "1 to 80 characters on one line";
        let name: String = self.required(field, expected)?;
        if (1..=80).contains(&name.chars().count()) && !name.chars().any(char::is_control) && !name.trim().is_empty() {
            return Ok(name);
        }
        Err(Invalid::new(self.at(field), format!("{name:?}"), expected))
    }
}

/// What a table says about the runs it is for: the same fields in `run`, in a series and in a point.
#[derive(Clone, Debug, Default)]
pub(super) struct Section {
    /// What stands before its fields in a message.
    prefix: String,
    algorithm: Option<Algorithm>,
    preset: Option<Preset>,
    environment: Map<String, Value>,
    training: Map<String, Value>,
}

impl Section {
    /// Its fields.
    pub const FIELDS: [&str; 4] = ["algorithm", "preset", "environment", "training"];

    pub fn read(table: &mut Table) -> Result<Self, Invalid> {
        Ok(Self {
            prefix: table.at(""),
            algorithm: table.optional("algorithm")?,
            preset: table.optional("preset")?,
            environment: table.optional("environment")?.unwrap_or_default(),
            training: table.optional("training")?.unwrap_or_default(),
        })
    }

    /// What the command line says.
    pub fn overrides(overrides: &Overrides) -> Self {
        let Overrides { environment, training, .. } = overrides.clone();
        Self { prefix: "on the command line, ".into(), environment, training, ..Self::default() }
    }

    /// The configuration of one run: later sections override earlier ones.
    ///
    /// The error names the section that a wrong field stands in.
    pub fn resolve(sections: &[&Self], seed: u64) -> Result<TrainConfig, Invalid> {
        let mut all = Self::default();
        for section in sections {
            all.algorithm = section.algorithm.or(all.algorithm);
            all.preset = section.preset.or(all.preset);
            all.environment.extend(section.environment.clone());
            all.training.extend(section.training.clone());
        }
        TrainConfig::resolve(
            all.algorithm.unwrap_or_default(),
            all.preset.unwrap_or_default(),
            &all.environment,
            &all.training,
            seed,
        )
        .map_err(|mut wrong| {
            let field = wrong.field.split(['.', '[']).collect::<Vec<_>>();
            let holds = |section: &&&Self| match field[..] {
                ["environment", name, ..] => section.environment.contains_key(name),
                ["training", name, ..] => section.training.contains_key(name),
                _ => false,
            };
            // Where no section has the field, it is the whole that does not fit together.
            if let Some(section) = sections.iter().rev().find(holds) {
                wrong.field = format!("{}{}", section.prefix, wrong.field);
            }
            wrong
        })
    }
}
