//! Conversions between the messages of `GRPCInferenceService` and the types of `api::oip`.

use std::collections::HashMap;
use std::time::Duration;

use bytes::Bytes;

use crate::api::convert::tensors::{Data, Datatype, Tensor, TensorShape};
use crate::api::oip::{self, InferRequest, InferResponse, Model, Parameter};
use crate::invalid::Invalid;
use crate::service::policies::IndexEntry;
use crate::wire::oip as wire;
use crate::wire::oip::infer_parameter::ParameterChoice;

/// Decodes a request.
///
/// # Errors
/// [`Invalid`] if a tensor has its values twice or not at all, or for unsupported parameters.
pub(super) fn infer_request(request: wire::ModelInferRequest) -> Result<InferRequest, Invalid> {
    let wire::ModelInferRequest { model_name, model_version, id, parameters, inputs, outputs, raw_input_contents } = request;
    let raw = raw_input_contents;
    if !raw.is_empty() && raw.len() != inputs.len() {
        let expected = format!("{}, one per input, or none", inputs.len());
        return Err(Invalid::new("raw_input_contents", format!("{} entries", raw.len()), expected));
    }
    let mut raw = raw.into_iter();
    let inputs = inputs.into_iter().enumerate().map(|(i, sent)| input(i, sent, raw.next()));
    let outputs = outputs.into_iter().enumerate().map(|(i, sent)| {
        oip::check_tensor_parameters(&format!("outputs[{i}]"), sent.parameters.keys())?;
        Ok(sent.name)
    });
    Ok(InferRequest {
        model: model_name,
        version: model_version,
        id,
        parameters: parameters.into_iter().map(parameter).collect::<Result<_, _>>()?,
        inputs: inputs.collect::<Result<_, _>>()?,
        outputs: outputs.collect::<Result<_, Invalid>>()?,
    })
}

fn parameter((name, value): (String, wire::InferParameter)) -> Result<(String, Parameter), Invalid> {
    let value = match value.parameter_choice {
        Some(ParameterChoice::BoolParam(value)) => Parameter::Bool(value),
        Some(ParameterChoice::Int64Param(value)) => Parameter::Int(value),
        Some(ParameterChoice::Uint64Param(value)) => Parameter::Uint(value),
        Some(ParameterChoice::DoubleParam(value)) => Parameter::Double(value),
        Some(ParameterChoice::StringParam(value)) => Parameter::Text(value),
        None => return Err(Invalid::missing(format!("parameters.{name}"), "a value")),
    };
    Ok((name, value))
}

fn input(i: usize, sent: wire::model_infer_request::InferInputTensor, raw: Option<Bytes>) -> Result<Tensor, Invalid> {
    let wire::model_infer_request::InferInputTensor { name, datatype, shape, parameters, contents } = sent;
    oip::check_tensor_parameters(&format!("inputs[{i}]"), parameters.keys())?;
    let data = match (raw, contents) {
        (Some(raw), None) => Data::Raw(raw),
        (Some(_), Some(_)) => {
            let expected = "no value, because raw_input_contents has the values";
            return Err(Invalid::new(format!("inputs[{i}].contents"), "values", expected));
        }
        (None, contents) => typed(&datatype, contents.unwrap_or_default()),
    };
    Ok(Tensor { name, datatype, shape, data })
}

/// The values of a tensor from the field for its datatype. An unknown datatype is rejected later, with the name of the tensor.
fn typed(datatype: &str, contents: wire::InferTensorContents) -> Data {
    match Datatype::parse(datatype) {
        Some(Datatype::Int32) => Data::Int32(contents.int_contents),
        Some(Datatype::Int64) => Data::Int64(contents.int64_contents),
        Some(Datatype::Fp32) => Data::Fp32(contents.fp32_contents),
        Some(Datatype::Fp64) => Data::Fp64(contents.fp64_contents),
        Some(Datatype::Bytes) => Data::Bytes(contents.bytes_contents),
        None => Data::Raw(Bytes::new()),
    }
}

/// A string parameter.
pub(super) fn string(value: String) -> wire::InferParameter {
    wire::InferParameter { parameter_choice: Some(ParameterChoice::StringParam(value)) }
}

/// The parameter that marks the last response to a request in a stream.
pub(super) fn final_response() -> (String, wire::InferParameter) {
    let yes = wire::InferParameter { parameter_choice: Some(ParameterChoice::BoolParam(true)) };
    ("triton_final_response".into(), yes)
}

/// Encodes a response. The values are raw, however those of the request were sent.
pub(super) fn infer_response(response: InferResponse) -> wire::ModelInferResponse {
    let InferResponse { model, version, id, step, digest, outputs } = response;
    let step = wire::InferParameter { parameter_choice: Some(ParameterChoice::Int64Param(step as i64)) };
    let (outputs, raw_output_contents) = outputs
        .into_iter()
        .map(|Tensor { name, datatype, shape, data }| {
            let (parameters, contents) = (HashMap::new(), None);
            let head = wire::model_infer_response::InferOutputTensor { name, datatype, shape, parameters, contents };
            (head, data.into_raw())
        })
        .unzip();
    wire::ModelInferResponse {
        model_name: model,
        model_version: version.to_string(),
        id,
        parameters: [("step".to_owned(), step), ("digest".to_owned(), string(digest))].into(),
        outputs,
        raw_output_contents,
    }
}

/// Encodes the metadata of a model.
pub(super) fn metadata(model: Model) -> wire::ModelMetadataResponse {
    let tensor = |tensor: TensorShape| wire::model_metadata_response::TensorMetadata {
        name: tensor.name.to_owned(),
        datatype: tensor.datatype.name().to_owned(),
        shape: tensor.shape,
    };
    wire::ModelMetadataResponse {
        name: model.name,
        versions: model.versions,
        platform: oip::NAME.to_owned(),
        inputs: model.inputs.into_iter().map(tensor).collect(),
        outputs: model.outputs.into_iter().map(tensor).collect(),
    }
}

/// Encodes the configuration of a model. Sequences expire when idle for `ttl`.
pub(super) fn config(model: Model, ttl: Duration) -> wire::ModelConfig {
    let data_type = |datatype| {
        let known = wire::DataType::from_str_name(oip::config_type(datatype));
        known.unwrap_or(wire::DataType::TypeInvalid).into()
    };
    let input = |TensorShape { name, datatype, shape, optional }| wire::ModelInput {
        name: name.to_owned(),
        data_type: data_type(datatype),
        dims: shape,
        optional,
    };
    let output = |TensorShape { name, datatype, shape, .. }| wire::ModelOutput {
        name: name.to_owned(),
        data_type: data_type(datatype),
        dims: shape,
    };
    let max_sequence_idle_microseconds = u64::try_from(ttl.as_micros()).unwrap_or(u64::MAX);
    wire::ModelConfig {
        name: model.name,
        platform: oip::NAME.to_owned(),
        max_batch_size: 0,
        input: model.inputs.into_iter().map(input).collect(),
        output: model.outputs.into_iter().map(output).collect(),
        sequence_batching: Some(wire::ModelSequenceBatching { max_sequence_idle_microseconds }),
        backend: oip::NAME.to_owned(),
        model_transaction_policy: Some(wire::ModelTransactionPolicy { decoupled: false }),
    }
}

/// Encodes an entry of the repository index.
pub(super) fn entry(entry: IndexEntry) -> wire::repository_index_response::ModelIndex {
    let IndexEntry { name, version, loaded, reason } = entry;
    wire::repository_index_response::ModelIndex {
        name,
        version: version.to_string(),
        state: oip::state(loaded).to_owned(),
        reason,
    }
}
