//! The Open Inference Protocol, independent of the transport: every policy is a model, and a request is one slot of a fleet.
//! The transports read their messages into an [`InferRequest`] and write an [`InferResponse`].

mod model;
mod outputs;
mod parameters;
mod settings;
pub mod shared_memory;
mod statistics;

use std::time::Instant;

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use bytes::Bytes;

pub use model::{Model, config_type, describe, index, is_ready, load, state, unload};
pub use parameters::Parameter;
pub use settings::{LogSetting, TRACE_SETTINGS, check_log_settings, check_trace_settings, log_settings};
pub use statistics::statistics;

use self::model::{model_error, policy_spec};
use self::outputs::OutputSelection;
use self::parameters::Parameters;
use super::convert::tensors::{INPUTS, Tensor, element_count, fleet_input};
use crate::invalid::Invalid;
use crate::service::act::{self, MemoryLocation};
use crate::service::keys::Caller;
use crate::service::{App, Error};

/// Name of the server in its metadata.
pub const NAME: &str = "qedgix";
/// Version of the server in its metadata.
pub const VERSION: &str = env!("CARGO_PKG_VERSION");
/// Supported extensions of the protocol.
pub const EXTENSIONS: [&str; 9] = [
    "sequence",
    "sequence(string_id)",
    "model_repository",
    "model_configuration",
    "binary_tensor_data",
    "parameters",
    "statistics",
    "trace",
    "logging",
];
/// Input and output with the recurrent state that callers keep.
const STATE: &str = "recurrent_state";

/// A request for inference.
#[derive(Clone, Debug, Default)]
pub struct InferRequest {
    /// The policy: `NAME`, `NAME@ALIAS` or `NAME:VERSION`.
    pub model: String,
    /// The version of `NAME`; empty for the newest.
    pub version: String,
    /// Returned in the response.
    pub id: String,
    /// Parameters of the whole request.
    pub parameters: Vec<(String, Parameter)>,
    /// Inputs.
    pub inputs: Vec<Tensor>,
    /// Names of the requested outputs; empty for all.
    pub outputs: Vec<String>,
}

/// The response to an [`InferRequest`].
#[derive(Clone, Debug, PartialEq)]
pub struct InferResponse {
    /// The model as the request names it.
    pub model: String,
    /// The version that computed the outputs.
    pub version: u64,
    /// The id of the request.
    pub id: String,
    /// The step.
    pub step: u64,
    /// The digest of the policy version in hexadecimal.
    pub digest: String,
    /// Outputs in the order of the request.
    pub outputs: Vec<Tensor>,
}

/// Runs the policy for one slot.
///
/// # Errors
/// [`Error::Invalid`] for input that is not accepted, [`Error::NotFound`] for a model that is unknown or not loaded, and the
/// errors of [`act::act`].
pub async fn infer(app: &App, caller: &Caller, request: InferRequest, deadline: Option<Instant>) -> Result<InferResponse, Error> {
    let InferRequest { model, version, id, parameters, inputs, outputs } = request;
    let spec = policy_spec(&model, &version)?;
    let Parameters { sequence, step, seed, timeout, flight } = Parameters::read(parameters)?;
    let flight = flight.options()?;
    let outputs = OutputSelection::new(outputs, sequence.is_none())?;
    check_names(&inputs)?;
    let timeout = timeout.and_then(|timeout| Instant::now().checked_add(timeout));
    let deadline = deadline.into_iter().chain(timeout).min();
    let (state, input) = act::decode(app, caller, element_count(&inputs), deadline, || read(inputs)).await??;
    let memory = match (sequence, state) {
        (None, state) => MemoryLocation::RecurrentState(state.unwrap_or_default()),
        (Some(sequence), None) => MemoryLocation::Sequence(sequence),
        (Some(_), Some(_)) => {
            let expected = "no value beside sequence_id, because the server keeps the state of a sequence";
            return Err(Invalid::new(STATE, "a tensor", expected).into());
        }
    };
    let request = act::Request {
        policy: Some(spec.clone()),
        input,
        memory,
        step,
        run_id: None,
        seed,
        flight,
        return_motion: false,
        explain: false,
    };
    let response = act::act(app, caller, request, deadline).await.map_err(model_error)?;
    let reference = &response.policy.reference;
    let (version, digest, step) = (reference.version, reference.digest_hex(), response.decision.step);
    Ok(InferResponse { model, version, id, step, digest, outputs: outputs.tensors(response) })
}

/// Checks the names of the parameters of the input or output `field`.
///
/// # Errors
/// [`Invalid`] for parameters of extensions that are not supported: shared memory and classification.
pub fn check_tensor_parameters<'a>(field: &str, mut names: impl Iterator<Item = &'a String>) -> Result<(), Invalid> {
    let unsupported = |name: &&String| name.starts_with("shared_memory") || *name == "classification";
    match names.find(unsupported) {
        None => Ok(()),
        Some(name) => {
            let expected = "no shared memory and no classification, which are not supported";
            Err(Invalid::new(format!("{field}.parameters"), format!("{name:?}"), expected))
        }
    }
}

/// Checks that every input is known and occurs once.
fn check_names(inputs: &[Tensor]) -> Result<(), Invalid> {
    for (i, Tensor { name, .. }) in inputs.iter().enumerate() {
        let invalid = |expected: String| Invalid::new(format!("inputs[{i}].name"), format!("{name:?}"), expected);
        if name != STATE && !INPUTS.iter().any(|(known, ..)| known == name) {
            let known: Vec<&str> = INPUTS.iter().map(|(known, ..)| *known).chain([STATE]).collect();
            return Err(invalid(format!("one of {}", known.join(", "))));
        }
        if inputs[..i].iter().any(|other| other.name == *name) {
            return Err(invalid("each input once".into()));
        }
    }
    Ok(())
}

/// The recurrent state, if there is one, and the input of the fleet.
fn read(mut inputs: Vec<Tensor>) -> Result<(Option<Bytes>, crate::serving::FleetInput), Invalid> {
    let input = fleet_input(&mut inputs)?;
    let state = inputs.into_iter().find(|tensor| tensor.name == STATE);
    Ok((state.map(|state| decode_state(&state)).transpose()?, input))
}

/// The bytes of a `recurrent_state`. JSON responses contain the state in base64, and a client may send this text over gRPC, too.
/// The state itself is never valid base64, because its fifth byte, the format version, is not in the base64 alphabet.
fn decode_state(state: &Tensor) -> Result<Bytes, Invalid> {
    let bytes = state.one_byte_string()?;
    Ok(BASE64_STANDARD.decode(&bytes).map_or(bytes, Bytes::from))
}
