//! Documents: the fields of a section over those of a preset, with errors that name the field.

use serde::{Serialize, de::DeserializeOwned};
use serde_json::{Map, Value};

use crate::env::EnvConfig;
use crate::invalid::{Invalid, expectation};

/// Symbols and abbreviations of the paper, accepted as names of fields.
const PAPER_SYMBOLS: [(&str, &str); 9] = [
    ("M", "uavs"),
    ("N", "users"),
    ("K", "slots"),
    ("v", "speed"),
    ("t", "transmission_range"),
    ("d", "detection_range"),
    ("lr", "learning_rate"),
    ("eps_end", "epsilon_end"),
    ("anneal", "epsilon_anneal"),
];

/// The environment of a document: the defaults with its fields overridden.
///
/// # Errors
/// [`Invalid`] for the first field that is unknown, of the wrong type or out of range, named as `environment.uavs`.
pub fn parse_environment(mut document: Value) -> Result<EnvConfig, Invalid> {
    floats_to_integers(&mut document);
    let Value::Object(fields) = &document else {
        return Err(Invalid::schema("environment", &document, "an object"));
    };
    let mut config = overridden("environment", &EnvConfig::default(), fields)?;
    config.validate().map_err(|e| e.with_prefix("environment"))?;
    config.reward_scale = Some(config.effective_reward_scale());
    Ok(config)
}

/// `base` with the fields of a document overridden. Ranges are not checked.
///
/// # Errors
/// [`Invalid`] for the first field that is unknown or of the wrong type, named as `environment.uavs`.
pub fn environment_with(base: &EnvConfig, fields: &Map<String, Value>) -> Result<EnvConfig, Invalid> {
    overridden("environment", base, fields)
}

/// Largest integer that all JSON readers and `google.protobuf.Struct` represent exactly.
pub const MAX_EXACT_INTEGER: u64 = (1 << 53) - 1;

/// Converts whole numbers to integers, because `google.protobuf.Struct` has no integers.
pub fn floats_to_integers(value: &mut Value) {
    match value {
        Value::Number(number) => {
            let float = number.as_f64().filter(|x| number.is_f64() && x.fract() == 0.0 && x.abs() <= MAX_EXACT_INTEGER as f64);
            if let Some(float) = float {
                *value = Value::from(float as i64);
            }
        }
        Value::Array(items) => items.iter_mut().for_each(floats_to_integers),
        Value::Object(fields) => fields.values_mut().for_each(floats_to_integers),
        Value::Null | Value::Bool(_) | Value::String(_) => {}
    }
}

/// The name of a field that a document may call by its symbol.
pub fn field_name(key: &str) -> &str {
    PAPER_SYMBOLS.iter().find(|(symbol, _)| *symbol == key).map_or(key, |(_, name)| name)
}

/// `base` with the fields of `patch` overridden, one at a time, so that an error names the invalid field.
pub(super) fn overridden<T: Serialize + DeserializeOwned>(
    section: &str,
    base: &T,
    patch: &Map<String, Value>,
) -> Result<T, Invalid> {
    let mut fields = serde_json::to_value(base).expect("a configuration is plain data");
    let known: Vec<String> = fields.as_object().into_iter().flatten().map(|(name, _)| name.clone()).collect();
    for (key, value) in patch {
        let name = field_name(key);
        if !known.iter().any(|k| k == name) {
            return Err(Invalid::unknown_field(format!("{section}.{key}"), format!("one of {}", known.join(", "))));
        }
        if name != key && patch.contains_key(name) {
            return Err(Invalid::new(format!("{section}.{key}"), value, format!("no value, because {name} is set, too")));
        }
        fields[name] = value.clone();
        if let Err(e) = T::deserialize(&fields) {
            return Err(Invalid::schema(format!("{section}.{key}"), value, expectation(&e)));
        }
    }
    Ok(serde_json::from_value(fields).expect("checked field by field"))
}
