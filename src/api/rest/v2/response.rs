//! Responses to inference requests: JSON, followed by the binary data of the outputs for which the request selects it.

use axum::http::{HeaderMap, HeaderValue, header};
use axum::response::{IntoResponse, Response};
use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use bytes::{BufMut, Bytes, BytesMut};
use serde::Serialize;

use super::HEADER_LENGTH;
use super::request::BinaryOutputs;
use crate::api::compression::Encoding;
use crate::api::convert::tensors::{Data, Tensor};
use crate::api::offload;
use crate::api::oip::InferResponse;
use crate::service::Error;

#[derive(Serialize)]
struct Body {
    model_name: String,
    model_version: String,
    #[serde(skip_serializing_if = "String::is_empty")]
    id: String,
    parameters: Parameters,
    outputs: Vec<Output>,
}

#[derive(Serialize)]
struct Parameters {
    step: u64,
    digest: String,
}

#[derive(Serialize)]
struct Output {
    name: String,
    datatype: String,
    shape: Vec<i64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    parameters: Option<BinarySize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    data: Option<Values>,
}

#[derive(Serialize)]
struct BinarySize {
    binary_data_size: usize,
}

/// The values of a tensor. Numbers that are not finite become `null`, because JSON has none.
#[derive(Serialize)]
#[serde(untagged)]
enum Values {
    Int32(Vec<i32>),
    Int64(Vec<i64>),
    Fp32(Vec<f32>),
    Fp64(Vec<f64>),
    /// In base64, because the bytes need not be UTF-8.
    Bytes(Vec<String>),
}

impl From<Data> for Values {
    fn from(data: Data) -> Self {
        let text = |value: &Bytes| BASE64_STANDARD.encode(value);
        match data {
            Data::Int32(values) => Self::Int32(values),
            Data::Int64(values) => Self::Int64(values),
            Data::Fp32(values) => Self::Fp32(values),
            Data::Fp64(values) => Self::Fp64(values),
            Data::Bytes(values) => Self::Bytes(values.iter().map(text).collect()),
            Data::Raw(raw) => Self::Bytes(vec![text(&raw)]),
        }
    }
}

/// A response that is encoded: its headers and its body.
pub(super) struct Encoded {
    headers: HeaderMap,
    body: Bytes,
}

/// Smaller bodies are not compressed: the rest of the response would be larger than what is saved.
const MIN_COMPRESSED: usize = 1 << 10;
/// Larger bodies are compressed on a thread of their own.
const LARGE: usize = 64 << 10;

/// The response, compressed if the caller accepts an `encoding`.
///
/// # Errors
/// None in practice: the result of the compression is in memory.
pub(super) async fn compressed(response: Result<Encoded, Error>, encoding: Option<Encoding>) -> Result<Response, Error> {
    let Encoded { mut headers, body } = response?;
    headers.insert(header::VARY, HeaderValue::from_name(header::ACCEPT_ENCODING));
    let Some(encoding) = encoding.filter(|_| body.len() >= MIN_COMPRESSED) else {
        return Ok((headers, body).into_response());
    };
    let body = offload(body.len() > LARGE, move || encoding.compress(&body)).await?.map_err(Error::internal)?;
    headers.insert(header::CONTENT_ENCODING, HeaderValue::from_static(encoding.name()));
    Ok((headers, body).into_response())
}

/// Encodes a response.
///
/// # Errors
/// [`Error::Internal`] if it cannot be written as JSON.
pub(super) fn encode(response: InferResponse, binary: &BinaryOutputs) -> Result<Encoded, Error> {
    let InferResponse { model, version, id, step, digest, outputs } = response;
    let mut binary_data = Vec::new();
    let outputs = outputs.into_iter().enumerate().map(|(i, Tensor { name, datatype, shape, data })| {
        if !binary.requested.get(i).copied().unwrap_or(binary.default) {
            return Output { name, datatype, shape, parameters: None, data: Some(data.into()) };
        }
        let raw = data.into_raw();
        let parameters = Some(BinarySize { binary_data_size: raw.len() });
        binary_data.push(raw);
        Output { name, datatype, shape, parameters, data: None }
    });
    let outputs = outputs.collect();
    let parameters = Parameters { step, digest };
    let body = Body { model_name: model, model_version: version.to_string(), id, parameters, outputs };
    let json = serde_json::to_vec(&body).map_err(Error::internal)?;
    if binary_data.is_empty() {
        let headers = [(header::CONTENT_TYPE, HeaderValue::from_static("application/json"))].into_iter().collect();
        return Ok(Encoded { headers, body: json.into() });
    }
    let mut body = BytesMut::with_capacity(json.len() + binary_data.iter().map(Bytes::len).sum::<usize>());
    body.put_slice(&json);
    binary_data.into_iter().for_each(|raw| body.put(raw));
    let kind = HeaderValue::from_static("application/octet-stream");
    let headers = [(header::CONTENT_TYPE, kind), (HEADER_LENGTH, json.len().into())].into_iter().collect();
    Ok(Encoded { headers, body: body.freeze() })
}
