//! `google.protobuf.Struct` and JSON. A `Struct` has no integers: every number is a double. Integers that a double may not hold
//! exactly are refused in requests, and sent as strings of digits, as JSON of protobuf writes 64-bit integers.

use prost_types::value::Kind;
use prost_types::{ListValue, Struct};
use serde_json::{Map, Number, Value};

use crate::invalid::Invalid;
use crate::train_config::MAX_EXACT_INTEGER;

/// A JSON object as a `Struct`; `None` for anything else.
pub fn to_struct(value: &Value) -> Option<Struct> {
    let fields = value.as_object()?.iter().map(|(name, value)| (name.clone(), to_proto(value))).collect();
    Some(Struct { fields })
}

fn to_proto(value: &Value) -> prost_types::Value {
    let kind = match value {
        Value::Null => Kind::NullValue(0),
        Value::Bool(b) => Kind::BoolValue(*b),
        Value::Number(n) if n.as_u64().is_some_and(|n| n > MAX_EXACT_INTEGER) => Kind::StringValue(n.to_string()),
        Value::Number(n) => Kind::NumberValue(n.as_f64().unwrap_or(f64::NAN)),
        Value::String(s) => Kind::StringValue(s.clone()),
        Value::Array(values) => Kind::ListValue(ListValue { values: values.iter().map(to_proto).collect() }),
        Value::Object(_) => to_struct(value).map_or(Kind::NullValue(0), Kind::StructValue),
    };
    prost_types::Value { kind: Some(kind) }
}

/// A `Struct` as a JSON object.
///
/// # Errors
/// A number that is not finite, or an integer beyond [`MAX_EXACT_INTEGER`].
pub fn from_struct(field: &str, document: Struct) -> Result<Value, Invalid> {
    let fields: Result<Map<_, _>, Invalid> = document
        .fields
        .into_iter()
        .map(|(name, value)| {
            let value = from_proto(&format!("{field}.{name}"), value)?;
            Ok((name, value))
        })
        .collect();
    Ok(Value::Object(fields?))
}

fn from_proto(field: &str, value: prost_types::Value) -> Result<Value, Invalid> {
    Ok(match value.kind {
        None | Some(Kind::NullValue(_)) => Value::Null,
        Some(Kind::BoolValue(b)) => Value::Bool(b),
        Some(Kind::NumberValue(x)) if x.fract() == 0.0 && x.abs() > MAX_EXACT_INTEGER as f64 => {
            let expected = format!(
                "a number up to {MAX_EXACT_INTEGER}, which a google.protobuf.Struct holds exactly; REST accepts larger integers"
            );
            return Err(Invalid::new(field, x, expected));
        }
        Some(Kind::NumberValue(x)) => {
            Value::Number(Number::from_f64(x).ok_or_else(|| Invalid::new(field, x, "a finite number"))?)
        }
        Some(Kind::StringValue(s)) => Value::String(s),
        Some(Kind::ListValue(list)) => {
            let items = list.values.into_iter().enumerate().map(|(i, value)| from_proto(&format!("{field}[{i}]"), value));
            Value::Array(items.collect::<Result<_, _>>()?)
        }
        Some(Kind::StructValue(document)) => from_struct(field, document)?,
    })
}
