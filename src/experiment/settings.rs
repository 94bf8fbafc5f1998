//! Reads the tables of a document field by field, so that errors name the table and the field.

use serde::de::DeserializeOwned;
use serde_json::{Map, Value};

use crate::invalid::{Invalid, expectation};
use crate::train_config::{Algorithm, Preset, TrainConfig, field_name};

/// Settings that override the document.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Overrides {
    /// Seeds that replace those of the document.
    pub seeds: Option<Vec<u64>>,
    /// Number of seeds: the first of the document, and beyond them the next numbers.
    pub num_seeds: Option<usize>,
    /// Names of the series to run; empty: all.
    pub series: Vec<String>,
    /// Names of the points to run; empty: all.
    pub points: Vec<String>,
    /// Fields of `environment`.
    pub environment: Map<String, Value>,
    /// Fields of `training`.
    pub training: Map<String, Value>,
    /// Prefix of these fields in errors.
    pub origin: String,
}

/// A table of the document; fields are removed as they are read.
pub(super) struct TableReader {
    /// Its name, as `series[1]`; empty for the document itself.
    path: String,
    fields: Map<String, Value>,
}

impl TableReader {
    /// The table `value`.
    ///
    /// # Errors
    /// It is no table, or has other fields than `known`.
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

    /// The path of a field, as `series[1].name`.
    pub fn at(&self, field: &str) -> String {
        if self.path.is_empty() { field.to_owned() } else { format!("{}.{field}", self.path) }
    }

    /// The value of a field, if it is there.
    ///
    /// # Errors
    /// It has another type.
    pub fn optional<T: DeserializeOwned>(&mut self, field: &str) -> Result<Option<T>, Invalid> {
        let Some(value) = self.fields.remove(field) else { return Ok(None) };
        T::deserialize(&value).map(Some).map_err(|e| Invalid::schema(self.at(field), &value, expectation(&e)))
    }

    /// The value of a field; `expected` says what is missing without it.
    ///
    /// # Errors
    /// It is missing, or has another type.
    pub fn required<T: DeserializeOwned>(&mut self, field: &str, expected: &str) -> Result<T, Invalid> {
        self.optional(field)?.ok_or_else(|| Invalid::missing_field(self.at(field), expected))
    }

    /// A name: not empty, on one line.
    ///
    /// # Errors
    /// It is missing, empty, longer than 80 characters or has several lines.
    pub fn name(&mut self, field: &str) -> Result<String, Invalid> {
        let expected = "1 to 80 characters on one line";
        let name: String = self.required(field, expected)?;
        if (1..=80).contains(&name.chars().count()) && !name.chars().any(char::is_control) && !name.trim().is_empty() {
            return Ok(name);
        }
        Err(Invalid::new(self.at(field), format!("{name:?}"), expected))
    }
}

/// Settings of runs; the same fields occur in `run`, in a series and in a point.
#[derive(Clone, Debug, Default)]
pub(super) struct RunSettings {
    /// Prefix of its fields in errors.
    prefix: String,
    algorithm: Option<Algorithm>,
    preset: Option<Preset>,
    environment: Map<String, Value>,
    training: Map<String, Value>,
}

impl RunSettings {
    /// Its fields.
    pub const FIELDS: [&str; 4] = ["algorithm", "preset", "environment", "training"];

    /// The settings of a table.
    ///
    /// # Errors
    /// A field has another type.
    pub fn read(table: &mut TableReader) -> Result<Self, Invalid> {
        Ok(Self {
            prefix: table.at(""),
            algorithm: table.optional("algorithm")?,
            preset: table.optional("preset")?,
            environment: table.optional("environment")?.unwrap_or_default(),
            training: table.optional("training")?.unwrap_or_default(),
        })
    }

    /// The settings that override the document.
    pub fn overrides(overrides: &Overrides) -> Self {
        let Overrides { environment, training, origin: prefix, .. } = overrides.clone();
        Self { prefix, environment, training, ..Self::default() }
    }

    /// The prefix of its fields in errors.
    pub fn prefix(&self) -> &str {
        &self.prefix
    }

    /// The first field that `other` sets, too, with the value of `other`: `training.gamma`.
    pub fn field_in_common<'a>(&self, other: &'a Self) -> Option<(String, &'a Value)> {
        let sections = [("environment", &self.environment, &other.environment), ("training", &self.training, &other.training)];
        sections.into_iter().find_map(|(section, mine, theirs)| {
            let also = |key: &String| mine.keys().any(|own| field_name(own) == field_name(key));
            theirs.iter().find(|(key, _)| also(key)).map(|(key, value)| (format!("{section}.{key}"), value))
        })
    }

    /// The configuration of one run; later sections override earlier ones.
    ///
    /// # Errors
    /// The first field that is unknown, of the wrong type or out of range, with the name of its section.
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
        .map_err(|mut invalid| {
            let field = invalid.field.split(['.', '[']).collect::<Vec<_>>();
            let holds = |section: &&&Self| match field[..] {
                ["environment", name, ..] => section.environment.contains_key(name),
                ["training", name, ..] => section.training.contains_key(name),
                _ => false,
            };
            // If no section has the field, the combination of the fields is invalid.
            if let Some(section) = sections.iter().rev().find(holds) {
                invalid.field = format!("{}{}", section.prefix, invalid.field);
            }
            invalid
        })
    }
}
