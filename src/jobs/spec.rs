//! Parses job requests from JSON. Both transports use it, so they accept the same requests.

use std::collections::BTreeMap;

use serde::de::DeserializeOwned;
use serde_json::{Map, Value};
use sha2::{Digest, Sha256};

use crate::invalid::{Invalid, expectation, in_range};
use crate::store::{JobKind, JobSpec};
use crate::train_config::{Algorithm, EXACT, Preset, TrainConfig, integral};

/// The fields of a job request.
pub const FIELDS: [&str; 10] =
    ["kind", "algorithm", "preset", "environment", "training", "threads", "priority", "seed", "name", "labels"];

/// A checked job request.
#[derive(Clone, Debug)]
pub struct JobRequest {
    /// The specification, with all defaults filled in.
    pub spec: JobSpec,
    /// SHA-256 of the request in canonical form, by which idempotency recognises a repeated request.
    pub digest: [u8; 32],
}

/// Parses a job request. Numbers with integral values are accepted as integers in any notation, because a protobuf `Struct`
/// has no integers.
///
/// # Errors
/// [`Invalid`] with the first field that is unknown, has the wrong type, or is out of range.
pub fn parse(mut document: Value, cpu_budget: usize) -> Result<JobRequest, Invalid> {
    integral(&mut document);
    // Canonical, because objects are ordered by key.
    let digest = Sha256::digest(document.to_string()).into();
    let Value::Object(mut fields) = document else {
        return Err(Invalid::schema("job", type_name(&document), "an object"));
    };
    if let Some(unknown) = fields.keys().find(|key| !FIELDS.contains(&key.as_str())) {
        return Err(Invalid::unknown_field(unknown, format!("one of {}", FIELDS.join(", "))));
    }
    let kind = take(&mut fields, "kind", JobKind::Train)?;
    if kind != JobKind::Train {
        return Err(Invalid::new("kind", kind, "train, the only kind that this version supports"));
    }
    let algorithm = take(&mut fields, "algorithm", Algorithm::default())?;
    let preset = take(&mut fields, "preset", Preset::default())?;
    let environment: Map<String, Value> = take(&mut fields, "environment", Map::new())?;
    let training: Map<String, Value> = take(&mut fields, "training", Map::new())?;
    let threads: usize = take(&mut fields, "threads", 1)?;
    let priority: i64 = take(&mut fields, "priority", 0)?;
    let seed: u64 = take(&mut fields, "seed", 1)?;
    let name: Option<String> = take(&mut fields, "name", None)?;
    let labels: BTreeMap<String, String> = take(&mut fields, "labels", BTreeMap::new())?;
    if !(1..=cpu_budget).contains(&threads) {
        let expected = format!("a number from 1 to {cpu_budget}, the server's CPU budget");
        return Err(Invalid::new("threads", threads, expected));
    }
    in_range("priority", priority, -100..=100)?;
    in_range("seed", seed, 0..=EXACT)?;
    if let Some(name) = &name {
        check_name("name", name)?;
    }
    check_labels(&labels)?;
    let config = TrainConfig::resolve(algorithm, preset, &environment, &training, seed)?;
    Ok(JobRequest { spec: JobSpec { kind, name, labels, threads, priority, config }, digest })
}

/// Takes a field, or its default if it is absent or null.
fn take<T: DeserializeOwned>(fields: &mut Map<String, Value>, name: &str, default: T) -> Result<T, Invalid> {
    match fields.remove(name) {
        None | Some(Value::Null) => Ok(default),
        Some(value) => T::deserialize(&value).map_err(|e| Invalid::schema(name, &value, expectation(&e))),
    }
}

fn type_name(value: &Value) -> &'static str {
    match value {
        Value::Null => "null",
        Value::Bool(_) => "a boolean",
        Value::Number(_) => "a number",
        Value::String(_) => "a string",
        Value::Array(_) => "an array",
        Value::Object(_) => "an object",
    }
}

fn check_name(field: &str, name: &str) -> Result<(), Invalid> {
    let allowed = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.');
    if (1..=63).contains(&name.len()) && name.chars().all(allowed) && name.starts_with(|c: char| c.is_ascii_alphanumeric()) {
        return Ok(());
    }
    Err(Invalid::new(field, format!("{name:?}"), "1 to 63 letters, digits, '-', '_' or '.', starting with a letter or digit"))
}

fn check_labels(labels: &BTreeMap<String, String>) -> Result<(), Invalid> {
    if labels.len() > 32 {
        return Err(Invalid::new("labels", format!("{} labels", labels.len()), "at most 32"));
    }
    for (key, value) in labels {
        check_name("labels", key)?;
        if value.chars().count() > 255 || value.chars().any(char::is_control) {
            let expected = "at most 255 characters without control characters";
            return Err(Invalid::new(format!("labels.{key}"), format!("{value:?}"), expected));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn parse_error(document: Value) -> Invalid {
        parse(document, 2).expect_err("an invalid request")
    }

    #[test]
    fn defaults_are_filled_in() {
        let spec = parse(json!({}), 2).unwrap().spec;
        assert_eq!((spec.kind, spec.threads, spec.priority), (JobKind::Train, 1, 0));
        assert_eq!(spec.config.seed, 1);
        assert_eq!(spec.config.environment.uavs, 3);
    }

    #[test]
    fn invalid_fields_are_reported_by_name() {
        let cases = [
            (json!([]), "job", true),
            (json!({"algoritm": "qmix"}), "algoritm", true),
            (json!({"algorithm": "dqn"}), "algorithm", true),
            (json!({"kind": "dance"}), "kind", true),
            (json!({"kind": "sweep"}), "kind", false),
            (json!({"environment": 3}), "environment", true),
            (json!({"environment": {"uvas": 3}}), "environment.uvas", true),
            (json!({"environment": {"uavs": "three"}}), "environment.uavs", true),
            (json!({"environment": {"uavs": 0}}), "environment.uavs", false),
            (json!({"training": {"gamma": 1.5}}), "training.gamma", false),
            (json!({"threads": 3}), "threads", false),
            (json!({"threads": 0}), "threads", false),
            (json!({"threads": -1}), "threads", true),
            (json!({"priority": 101}), "priority", false),
            (json!({"seed": 1.5}), "seed", true),
            (json!({"seed": 9_007_199_254_740_992_u64}), "seed", false),
            (json!({"name": ""}), "name", false),
            (json!({"name": "a:b"}), "name", false),
            (json!({"name": "x".repeat(64)}), "name", false),
            (json!({"labels": {"a": 1}}), "labels", true),
            (json!({"labels": {"a b": "c"}}), "labels", false),
            (json!({"labels": {"a": "\n"}}), "labels.a", false),
        ];
        for (document, field, schema) in cases {
            let e = parse_error(document.clone());
            assert_eq!((e.field.as_str(), e.is_schema()), (field, schema), "{document}: {e}");
        }
    }

    #[test]
    fn digest_does_not_depend_on_notation() {
        let digest = |text: &str| parse(serde_json::from_str(text).unwrap(), 2).unwrap().digest;
        assert_eq!(digest(r#"{"seed": 2, "threads": 1}"#), digest(r#"{"threads":1.0,"seed":2.0}"#));
        assert_ne!(digest(r#"{"seed": 2}"#), digest(r#"{"seed": 3}"#));
    }

    #[test]
    fn configuration_is_stored_exactly_as_json() {
        // The digits of these numbers exceed 2^53, so a fast float parser may round twice.
        let text = r#"{"environment": {"slots": 11, "speed": 0.09232400000000001}, "training": {"gamma": 0.9232400000000001}}"#;
        let config = parse(serde_json::from_str(text).unwrap(), 2).unwrap().spec.config;
        assert_eq!(config.training.gamma, 0.923_240_000_000_000_1);
        assert_eq!(config.environment.reward_scale, Some(1.0 / 11.0));
        let again: TrainConfig = serde_json::from_str(&serde_json::to_string(&config).unwrap()).unwrap();
        assert_eq!(again, config);
    }
}
