//! The Open Inference Protocol as both transports speak it: every policy is a model, a request is a slot of a fleet.
//! Transports read their messages into a [`Call`] and write a [`Reply`]; all that has a meaning is here.

mod model;
mod outputs;
mod parameters;

use std::time::Instant;

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use bytes::Bytes;

pub use model::{Model, config_type, describe, index, is_ready, load, state, unload};
pub use parameters::Parameter;

use self::model::{in_words_of_models, spec};
use self::outputs::Outputs;
use self::parameters::Parameters;
use super::convert::tensors::{INPUTS, Tensor, observation, weight};
use crate::invalid::Invalid;
use crate::service::act::{self, Memory};
use crate::service::{App, Error};

/// What the server calls itself.
pub const NAME: &str = "qedgix";
/// Its version.
pub const VERSION: &str = env!("CARGO_PKG_VERSION");
/// Parts of the protocol beyond its core that are spoken here.
pub const EXTENSIONS: [&str; 6] =
    ["sequence", "sequence(string_id)", "model_repository", "model_configuration", "binary_tensor_data", "parameters"];
/// Memory that callers keep, in and out.
const STATE: &str = "recurrent_state";
/// Requests of more elements are read away from the threads that serve connections.
const LARGE: usize = 2048;

/// A request for inference.
#[derive(Clone, Debug, Default)]
pub struct Call {
    /// A policy: `NAME`, `NAME@ALIAS` or `NAME:VERSION`.
    pub model: String,
    /// A version of `NAME`; empty: the newest.
    pub version: String,
    /// Comes back in the answer.
    pub id: String,
    /// Of the request as a whole.
    pub parameters: Vec<(String, Parameter)>,
    /// Inputs.
    pub inputs: Vec<Tensor>,
    /// Outputs asked for; none: all there are.
    pub outputs: Vec<String>,
}

/// The answer to a [`Call`].
#[derive(Clone, Debug, PartialEq)]
pub struct Reply {
    /// The model as it was asked for.
    pub model: String,
    /// The version that answered.
    pub version: u64,
    /// The request's.
    pub id: String,
    /// The step that was answered.
    pub step: u64,
    /// The policy version's digest, in hexadecimal.
    pub digest: String,
    /// Outputs in the order asked for.
    pub outputs: Vec<Tensor>,
}

/// Answers one slot.
///
/// # Errors
/// Everything in the table of errors that concerns policies, sessions and input.
pub async fn infer(app: &App, call: Call, deadline: Option<Instant>) -> Result<Reply, Error> {
    let Call { model, version, id, parameters, inputs, outputs } = call;
    let spec = spec(&model, &version)?;
    let Parameters { sequence, step, seed, timeout } = Parameters::read(parameters)?;
    let outputs = Outputs::asked(outputs, sequence.is_none())?;
    check_names(&inputs)?;
    let (state, observation) = if weight(&inputs) < LARGE {
        read(inputs)?
    } else {
        tokio::task::spawn_blocking(|| read(inputs)).await.map_err(Error::internal)??
    };
    let memory = match (sequence, state) {
        (None, state) => Memory::Held(state.unwrap_or_default()),
        (Some(sequence), None) => Memory::Sequence(sequence),
        (Some(_), Some(_)) => {
            let expected = "nothing beside sequence_id: the server keeps the memory of a sequence";
            return Err(Invalid::new(STATE, "a tensor", expected).into());
        }
    };
    let timeout = timeout.and_then(|timeout| Instant::now().checked_add(timeout));
    let deadline = deadline.into_iter().chain(timeout).min();
    let request = act::Request { policy: Some(spec.clone()), observation, memory, step, run_id: None, seed };
    let answer = act::act(app, request, deadline).await.map_err(|error| in_words_of_models(&spec, error))?;
    let reference = &answer.policy.reference;
    let (version, digest, step) = (reference.version, reference.digest_hex(), answer.step);
    Ok(Reply { model, version, id, step, digest, outputs: outputs.of(answer) })
}

/// Checks the parameters of the input or output `field`: those that would have its values elsewhere, or others, are refused.
///
/// # Errors
/// The first one.
pub fn check_tensor_parameters<'a>(field: &str, mut names: impl Iterator<Item = &'a String>) -> Result<(), Invalid> {
    let elsewhere = |name: &&String| name.starts_with("shared_memory") || *name == "classification";
    match names.find(elsewhere) {
        None => Ok(()),
        Some(name) => {
            let expected = "tensors that travel with the request and its answer";
            Err(Invalid::new(format!("{field}.parameters"), format!("{name:?}"), expected))
        }
    }
}

/// Checks that every input is a known one, once.
fn check_names(inputs: &[Tensor]) -> Result<(), Invalid> {
    for (i, Tensor { name, .. }) in inputs.iter().enumerate() {
        let wrong = |expected: String| Invalid::new(format!("inputs[{i}].name"), format!("{name:?}"), expected);
        if name != STATE && !INPUTS.iter().any(|(known, ..)| known == name) {
            let known: Vec<&str> = INPUTS.iter().map(|(known, ..)| *known).chain([STATE]).collect();
            return Err(wrong(format!("one of {}", known.join(", "))));
        }
        if inputs[..i].iter().any(|other| other.name == *name) {
            return Err(wrong("each input once".into()));
        }
    }
    Ok(())
}

/// The memory that was sent, and what is observed.
fn read(mut inputs: Vec<Tensor>) -> Result<(Option<Bytes>, crate::serving::Observation), Invalid> {
    let observation = observation(&mut inputs)?;
    let state = inputs.into_iter().find(|tensor| tensor.name == STATE);
    Ok((state.map(|state| held(&state)).transpose()?, observation))
}

/// The bytes of a `recurrent_state`. JSON has it in base64, and whoever read it there may send it on by other ways; the
/// bytes themselves are never base64, because the fifth is none of its letters.
fn held(state: &Tensor) -> Result<Bytes, Invalid> {
    let bytes = state.one_byte_string()?;
    Ok(BASE64_STANDARD.decode(&bytes).map_or(bytes, Bytes::from))
}
