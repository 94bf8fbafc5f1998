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
    let defaults = fields.clone();
    let names_in = |outer: &str| -> Vec<&String> { defaults[outer].as_object().into_iter().flat_map(Map::keys).collect() };
    let unknown = |path: String, known: &[&String]| {
        let known: Vec<&str> = known.iter().map(|name| name.as_str()).collect();
        Invalid::unknown_field(path, format!("one of {}", known.join(", ")))
    };
    for (key, value) in patch {
        let name = field_name(key);
        // A path into an object replaces one of its fields. Paths come after their object in a patch, which is ordered.
        if let Some((outer, inner)) = key.split_once('.').filter(|(outer, _)| !names_in(outer).is_empty()) {
            if !names_in(outer).iter().any(|name| *name == inner) {
                return Err(unknown(format!("{section}.{key}"), &names_in(outer)));
            }
            fields[outer][inner] = value.clone();
            if let Err(e) = T::deserialize(&fields) {
                return Err(Invalid::schema(format!("{section}.{key}"), value, expectation(&e)));
            }
            continue;
        }
        if !known.iter().any(|k| k == name) {
            return Err(Invalid::unknown_field(format!("{section}.{key}"), format!("one of {}", known.join(", "))));
        }
        if name != key && patch.contains_key(name) {
            return Err(Invalid::new(format!("{section}.{key}"), value, format!("no value, because {name} is set, too")));
        }
        fields[name] = value.clone();
        if let Err(e) = T::deserialize(&fields) {
            // Of an object, the field inside that is wrong.
            for (inner, value) in value.as_object().filter(|_| !names_in(name).is_empty()).into_iter().flatten() {
                if !names_in(name).contains(&inner) {
                    return Err(unknown(format!("{section}.{key}.{inner}"), &names_in(name)));
                }
                fields[name] = Map::from_iter([(inner.clone(), value.clone())]).into();
                if let Err(e) = T::deserialize(&fields) {
                    return Err(Invalid::schema(format!("{section}.{key}.{inner}"), value, expectation(&e)));
                }
            }
            return Err(Invalid::schema(format!("{section}.{key}"), value, expectation(&e)));
        }
    }
    Ok(serde_json::from_value(fields).expect("checked field by field"))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::train_config::{Algorithm, Preset, TrainConfig};

    fn resolve(training: Value) -> Result<TrainConfig, Invalid> {
        let Value::Object(training) = training else { unreachable!("an object") };
        TrainConfig::resolve(Algorithm::Qmix, Preset::Practical, &Map::new(), &training, 1)
    }

    #[test]
    fn paths_lead_into_objects() {
        let vary = resolve(json!({"vary.uavs": [2, 4], "vary": {"uavs": [1, 2], "users": [3, 5]}})).unwrap().training.vary;
        assert_eq!((vary.uavs, vary.users), (Some([2, 4]), Some([3, 5])));
        assert_eq!(resolve(json!({"vary.uavs": [2, 4]})).unwrap().training.vary.uavs, Some([2, 4]));
    }

    #[test]
    fn errors_name_the_field_inside_of_an_object() {
        for (training, message) in [
            (json!({"vary": {"uav": [2, 3]}}), "training.vary.uav: unknown field, expected one of "),
            (json!({"vary.uav": [2, 3]}), "training.vary.uav: unknown field, expected one of "),
            (json!({"vary": {"users": [3, 5], "uavs": "many"}}), "training.vary.uavs: got \"many\", expected "),
            (json!({"vary.uavs": 3}), "training.vary.uavs: got 3, expected "),
            (json!({"vary": 3}), "training.vary: got 3, expected an object"),
            (json!({"gamma.x": 3}), "training.gamma.x: unknown field, expected one of "),
        ] {
            let refused = resolve(training).unwrap_err().to_string();
            assert!(refused.starts_with(message), "{refused}");
        }
        assert!(resolve(json!({"vary": {"uav": [2, 3]}})).unwrap_err().to_string().ends_with("did you mean uavs?"));
    }
}
