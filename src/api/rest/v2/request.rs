//! Inference requests: JSON, followed by the binary data of the inputs that have a `binary_data_size`, in their order.

use axum::http::HeaderMap;
use bytes::Bytes;
use serde::Deserialize;
use serde_json::{Map, Value};

use super::HEADER_LENGTH;
use super::values::Values;
use crate::api::convert::tensors::{Data, Tensor};
use crate::api::json;
use crate::api::json::parse;
use crate::api::oip::{InferRequest, Parameter, check_tensor_parameters};
use crate::invalid::Invalid;
use crate::service::Error;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Body {
    #[serde(default)]
    id: String,
    #[serde(default, deserialize_with = "json::object")]
    parameters: Map<String, Value>,
    inputs: Vec<Input>,
    #[serde(default)]
    outputs: Vec<Output>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields, remote = "Self")]
struct Input {
    name: String,
    #[serde(deserialize_with = "json::integers")]
    shape: Vec<i64>,
    datatype: String,
    #[serde(default, deserialize_with = "json::object")]
    parameters: Map<String, Value>,
    data: Option<Values>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields, remote = "Self")]
struct Output {
    name: String,
    #[serde(default, deserialize_with = "json::object")]
    parameters: Map<String, Value>,
}

json::objects_only!(Input, Output);

/// The outputs that the response has as binary data.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct BinaryOutputs {
    /// For each requested output.
    pub(super) requested: Vec<bool>,
    /// For all outputs, if none is requested.
    pub(super) default: bool,
}

/// Decodes a request.
///
/// # Errors
/// [`Error::Invalid`] if the body does not match its schema, or if its JSON and its binary data do not agree.
pub(super) fn decode(
    headers: &HeaderMap,
    mut body: Bytes,
    model: String,
    version: String,
) -> Result<(InferRequest, BinaryOutputs), Error> {
    let text = body.split_to(json_length(headers, body.len())?);
    let json: Body = parse(&text)?;
    let mut parameters = json.parameters;
    let default = flag("parameters.binary_data_output", parameters.remove("binary_data_output"))?.unwrap_or(false);
    let mut outputs = Vec::with_capacity(json.outputs.len());
    let mut requested = Vec::with_capacity(json.outputs.len());
    for (i, mut output) in json.outputs.into_iter().enumerate() {
        check_tensor_parameters(&format!("outputs[{i}]"), output.parameters.keys())?;
        let binary = output.parameters.remove("binary_data");
        requested.push(flag(&format!("outputs[{i}].parameters.binary_data"), binary)?.unwrap_or(default));
        outputs.push(output.name);
    }
    let mut inputs = Vec::with_capacity(json.inputs.len());
    for (i, input) in json.inputs.into_iter().enumerate() {
        inputs.push(tensor(i, input, &mut body)?);
    }
    if !body.is_empty() {
        let expected = "no bytes after the binary data of the inputs";
        return Err(Invalid::new("body", format!("{} further bytes", body.len()), expected).into());
    }
    let parameters = parameters.into_iter().map(parameter).collect::<Result<_, _>>()?;
    let request = InferRequest { model, version, id: json.id, parameters, inputs, outputs };
    Ok((request, BinaryOutputs { requested, default }))
}

/// The length of the JSON in a body of `size` bytes.
fn json_length(headers: &HeaderMap, size: usize) -> Result<usize, Invalid> {
    let Some(value) = headers.get(HEADER_LENGTH) else { return Ok(size) };
    let length = value.to_str().ok().and_then(|text| text.parse().ok()).filter(|&length: &usize| length <= size);
    let expected = || format!("a whole number, at most {size}, the length of the body");
    length.ok_or_else(|| Invalid::new("Inference-Header-Content-Length", format!("{value:?}"), expected()))
}

fn flag(field: &str, value: Option<Value>) -> Result<Option<bool>, Invalid> {
    match value {
        None => Ok(None),
        Some(Value::Bool(flag)) => Ok(Some(flag)),
        Some(other) => Err(Invalid::schema(field, other, "true or false")),
    }
}

fn parameter((name, value): (String, Value)) -> Result<(String, Parameter), Invalid> {
    let parsed = match &value {
        Value::Bool(flag) => Some(Parameter::Bool(*flag)),
        Value::String(text) => Some(Parameter::Text(text.clone())),
        Value::Number(number) => {
            let whole = number.as_u64().map(Parameter::Uint).or_else(|| number.as_i64().map(Parameter::Int));
            whole.or_else(|| number.as_f64().map(Parameter::Double))
        }
        _ => None,
    };
    let expected = "true, false, a number or a string";
    let parsed = parsed.ok_or_else(|| Invalid::schema(format!("parameters.{name}"), value, expected))?;
    Ok((name, parsed))
}

/// The tensor of an input. Its binary data, if any, is split off the front of `rest`.
fn tensor(i: usize, input: Input, rest: &mut Bytes) -> Result<Tensor, Invalid> {
    let Input { name, shape, datatype, mut parameters, data } = input;
    check_tensor_parameters(&format!("inputs[{i}]"), parameters.keys())?;
    let data = match (parameters.remove("binary_data_size"), data) {
        (None, Some(values)) => values.into_data(&name, &datatype, &shape)?,
        (None, None) => {
            let expected = "the values, or a binary_data_size";
            return Err(Invalid::missing_field(format!("inputs[{i}].data"), expected));
        }
        (Some(size), None) => {
            let fits = size.as_u64().and_then(|size| usize::try_from(size).ok()).filter(|&size| size <= rest.len());
            let expected = || format!("a whole number, at most {}, the remaining bytes", rest.len());
            let field = || format!("inputs[{i}].parameters.binary_data_size");
            let size = fits.ok_or_else(|| Invalid::new(field(), &size, expected()))?;
            Data::Raw(rest.split_to(size))
        }
        (Some(_), Some(_)) => {
            let expected = "no value, because binary_data_size is set";
            return Err(Invalid::schema(format!("inputs[{i}].data"), "values", expected));
        }
    };
    Ok(Tensor { name, datatype, shape, data })
}
