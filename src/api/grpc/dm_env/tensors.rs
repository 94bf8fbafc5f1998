//! Tensors of dm_env_rpc: settings to JSON, actions to headings, observations and their specifications.

use serde_json::{Map, Number, Value};

use crate::invalid::Invalid;
use crate::wire::dm::dm_env_rpc::v1 as wire;
use wire::tensor::{BoolArray, DoubleArray, FloatArray, Int32Array, Int64Array, Payload, StringArray};
use wire::tensor_spec;

/// A tensor of f32.
pub(super) fn floats(array: Vec<f32>, shape: &[usize]) -> wire::Tensor {
    tensor(Payload::Floats(FloatArray { array }), shape)
}

/// A tensor of booleans.
pub(super) fn bools(array: Vec<bool>, shape: &[usize]) -> wire::Tensor {
    tensor(Payload::Bools(BoolArray { array }), shape)
}

/// An integer.
pub(super) fn integer(value: i64) -> wire::Tensor {
    tensor(Payload::Int64s(Int64Array { array: vec![value] }), &[])
}

/// An f64.
pub(super) fn double(value: f64) -> wire::Tensor {
    tensor(Payload::Doubles(DoubleArray { array: vec![value] }), &[])
}

/// A text.
pub(super) fn text(value: String) -> wire::Tensor {
    tensor(Payload::Strings(StringArray { array: vec![value] }), &[])
}

fn tensor(payload: Payload, shape: &[usize]) -> wire::Tensor {
    wire::Tensor { payload: Some(payload), shape: shape.iter().map(|&n| n as i32).collect() }
}

/// The specification of a tensor without bounds.
pub(super) fn spec(name: &str, dtype: wire::DataType, shape: &[usize]) -> wire::TensorSpec {
    let shape = shape.iter().map(|&n| n as i32).collect();
    wire::TensorSpec { name: name.to_owned(), shape, dtype: dtype.into(), ..Default::default() }
}

/// `spec` with a lower bound of f32.
pub(super) fn at_least(spec: wire::TensorSpec, min: f32) -> wire::TensorSpec {
    let payload = tensor_spec::value::Payload::Floats(FloatArray { array: vec![min] });
    wire::TensorSpec { min: Some(tensor_spec::Value { payload: Some(payload) }), ..spec }
}

/// The specification of the headings of `uavs` UAVs, each below `actions`.
pub(super) fn heading_spec(name: &str, uavs: usize, actions: usize) -> wire::TensorSpec {
    let value = |bound: usize| tensor_spec::Value {
        payload: Some(tensor_spec::value::Payload::Int32s(Int32Array { array: vec![bound as i32] })),
    };
    let spec = spec(name, wire::DataType::Int32, &[uavs]);
    wire::TensorSpec { min: Some(value(0)), max: Some(value(actions - 1)), ..spec }
}

/// The headings in an action.
///
/// # Errors
/// [`Invalid`] for another type or shape than the specification has, and for headings out of range.
pub(super) fn headings(action: wire::Tensor, uavs: usize, actions: usize) -> Result<Vec<u32>, Invalid> {
    let field = "actions.headings";
    let Some(Payload::Int32s(Int32Array { array })) = action.payload else {
        return Err(Invalid::new(field, "a tensor of another type", "int32s"));
    };
    let shape = action.shape;
    let known = shape == [uavs as i32] || shape == [-1] && array.len() == uavs;
    // One element stands for all.
    let fits = known && (array.len() == uavs || array.len() == 1);
    if !fits {
        let expected = format!("{uavs} heading indices, one per UAV, with the shape [{uavs}]");
        return Err(Invalid::new(field, format!("{} elements, shape {shape:?}", array.len()), expected));
    }
    let check = |&heading: &i32| match u32::try_from(heading) {
        Ok(index) if (index as usize) < actions => Ok(index),
        _ => Err(Invalid::new(field, heading, format!("heading indices from 0 to {}", actions - 1))),
    };
    let all: Vec<u32> = array.iter().map(check).collect::<Result<_, _>>()?;
    Ok(if all.len() == 1 { vec![all[0]; uavs] } else { all })
}

/// A setting as JSON: a scalar or a list. A text that is an object or a list in JSON counts as that.
///
/// # Errors
/// [`Invalid`] for tensors without values, of several dimensions, and of bytes.
pub(super) fn setting(name: &str, setting: wire::Tensor) -> Result<Value, Invalid> {
    let wrong =
        |value: String| Invalid::new(format!("settings.{name}"), value, "a scalar or a list of numbers, booleans or texts");
    let json = |text: String| match text.trim_start().chars().next() {
        Some('{' | '[') => serde_json::from_str(&text).unwrap_or(Value::String(text)),
        _ => Value::String(text),
    };
    let number = |x: f64| Number::from_f64(x).map_or(Value::Null, Value::Number);
    // f32 as people write it: 0.12, not the nearest f64.
    let short = |x: f32| x.to_string().parse().map_or(Value::Null, number);
    let mut values: Vec<Value> = match setting.payload {
        Some(Payload::Floats(values)) => values.array.into_iter().map(short).collect(),
        Some(Payload::Doubles(values)) => values.array.into_iter().map(number).collect(),
        Some(Payload::Int32s(values)) => values.array.into_iter().map(Value::from).collect(),
        Some(Payload::Int64s(values)) => values.array.into_iter().map(Value::from).collect(),
        Some(Payload::Uint32s(values)) => values.array.into_iter().map(Value::from).collect(),
        Some(Payload::Uint64s(values)) => values.array.into_iter().map(Value::from).collect(),
        Some(Payload::Bools(values)) => values.array.into_iter().map(Value::from).collect(),
        Some(Payload::Strings(values)) => values.array.into_iter().map(json).collect(),
        Some(_) | None => return Err(wrong("a tensor of bytes, or without values".into())),
    };
    match (setting.shape.len(), values.len()) {
        (0, 1) => Ok(values.remove(0)),
        (1, _) => Ok(Value::Array(values)),
        (dimensions, count) => Err(wrong(format!("{count} elements in {dimensions} dimensions"))),
    }
}

/// Settings as a JSON object.
///
/// # Errors
/// As [`setting`].
pub(super) fn settings(all: impl IntoIterator<Item = (String, wire::Tensor)>) -> Result<Map<String, Value>, Invalid> {
    all.into_iter().map(|(name, tensor)| setting(&name, tensor).map(|value| (name, value))).collect()
}
