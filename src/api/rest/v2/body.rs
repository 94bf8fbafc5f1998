//! The body of a request for inference: JSON, then the binary data of the tensors that have a `binary_data_size`, in their
//! order.

use axum::http::{HeaderMap, header};
use bytes::Bytes;
use serde::Deserialize;
use serde_json::{Map, Value};

use super::HEADER_LENGTH;
use super::data::Values;
use crate::api::convert::tensors::{Data, Tensor};
use crate::api::oip::{Call, Parameter, check_tensor_parameters};
use crate::api::rest::extract::parse;
use crate::invalid::Invalid;
use crate::service::Error;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Body {
    #[serde(default)]
    id: String,
    #[serde(default)]
    parameters: Map<String, Value>,
    inputs: Vec<Input>,
    #[serde(default)]
    outputs: Vec<Output>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Input {
    name: String,
    shape: Vec<i64>,
    datatype: String,
    #[serde(default)]
    parameters: Map<String, Value>,
    data: Option<Values>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Output {
    name: String,
    #[serde(default)]
    parameters: Map<String, Value>,
}

/// Which outputs are answered in binary.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Binary {
    /// Of those asked for, in their order.
    pub(super) asked: Vec<bool>,
    /// Of all, where none was asked for.
    pub(super) default: bool,
}

/// Reads a body.
///
/// # Errors
/// It is no request, or its parts do not fit together.
pub(super) fn read(headers: &HeaderMap, mut body: Bytes, model: String, version: String) -> Result<(Call, Binary), Error> {
    if let Some(encoding) = headers.get(header::CONTENT_ENCODING).filter(|encoding| *encoding != "identity") {
        return Err(Invalid::new("Content-Encoding", format!("{encoding:?}"), "identity").into());
    }
    let json = body.split_to(json_length(headers, body.len())?);
    let sent: Body = parse(&json)?;
    let mut parameters = sent.parameters;
    let default = flag("parameters.binary_data_output", parameters.remove("binary_data_output"))?.unwrap_or(false);
    let mut outputs = Vec::with_capacity(sent.outputs.len());
    let mut asked = Vec::with_capacity(sent.outputs.len());
    for (i, mut output) in sent.outputs.into_iter().enumerate() {
        check_tensor_parameters(&format!("outputs[{i}]"), output.parameters.keys())?;
        let binary = output.parameters.remove("binary_data");
        asked.push(flag(&format!("outputs[{i}].parameters.binary_data"), binary)?.unwrap_or(default));
        outputs.push(output.name);
    }
    let mut inputs = Vec::with_capacity(sent.inputs.len());
    for (i, input) in sent.inputs.into_iter().enumerate() {
        inputs.push(tensor(i, input, &mut body)?);
    }
    if !body.is_empty() {
        let expected = "nothing after the binary data that the inputs announce";
        return Err(Invalid::new("body", format!("{} bytes more", body.len()), expected).into());
    }
    let parameters = parameters.into_iter().map(parameter).collect::<Result<_, _>>()?;
    Ok((Call { model, version, id: sent.id, parameters, inputs, outputs }, Binary { asked, default }))
}

/// How much of a body of `size` bytes is JSON.
fn json_length(headers: &HeaderMap, size: usize) -> Result<usize, Invalid> {
    let Some(value) = headers.get(HEADER_LENGTH) else { return Ok(size) };
    let length = value.to_str().ok().and_then(|text| text.parse().ok()).filter(|&length: &usize| length <= size);
    let expected = || format!("a whole number, at most {size}, the bytes of the body");
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
    let read = match &value {
        Value::Bool(flag) => Some(Parameter::Bool(*flag)),
        Value::String(text) => Some(Parameter::Text(text.clone())),
        Value::Number(number) => {
            let whole = number.as_u64().map(Parameter::Uint).or_else(|| number.as_i64().map(Parameter::Int));
            whole.or_else(|| number.as_f64().map(Parameter::Double))
        }
        _ => None,
    };
    let expected = "true, false, a number or a text";
    let read = read.ok_or_else(|| Invalid::schema(format!("parameters.{name}"), value, expected))?;
    Ok((name, read))
}

/// The tensor of an input, whose binary data is taken from the front of `rest`.
fn tensor(i: usize, input: Input, rest: &mut Bytes) -> Result<Tensor, Invalid> {
    let Input { name, shape, datatype, mut parameters, data } = input;
    check_tensor_parameters(&format!("inputs[{i}]"), parameters.keys())?;
    let data = match (parameters.remove("binary_data_size"), data) {
        (None, Some(values)) => values.into_data(&name, &datatype, &shape)?,
        (None, None) => {
            let expected = "its values as data, or their binary_data_size";
            return Err(Invalid::schema(format!("inputs[{i}].data"), "nothing", expected));
        }
        (Some(size), None) => {
            let fits = size.as_u64().and_then(|size| usize::try_from(size).ok()).filter(|&size| size <= rest.len());
            let expected = || format!("a whole number, at most {}, the bytes that are left", rest.len());
            let field = || format!("inputs[{i}].parameters.binary_data_size");
            let size = fits.ok_or_else(|| Invalid::new(field(), &size, expected()))?;
            Data::Raw(rest.split_to(size))
        }
        (Some(_), Some(_)) => {
            let expected = "nothing beside a binary_data_size";
            return Err(Invalid::schema(format!("inputs[{i}].data"), "values", expected));
        }
    };
    Ok(Tensor { name, datatype, shape, data })
}
