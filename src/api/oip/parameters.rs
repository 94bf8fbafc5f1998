//! Parameters of a request: sequence, step, seed and timeout.

use std::time::Duration;

use serde::de::DeserializeOwned;

use crate::api::convert::flight::FlightFields;
use crate::api::flight::{Constraints, Frame, World, constraints};
use crate::api::json::parse;
use crate::invalid::Invalid;
use crate::service::Error;
use crate::service::act::{Sequence, SequenceId};
use crate::serving::FleetIds;

/// The value of a parameter.
#[derive(Clone, Debug, PartialEq)]
pub enum Parameter {
    /// A boolean.
    Bool(bool),
    /// A signed integer.
    Int(i64),
    /// An unsigned integer.
    Uint(u64),
    /// A floating-point number.
    Double(f64),
    /// A string.
    Text(String),
}

/// Parameters without effect, which clients of Triton send by default.
const IGNORED: [&str; 2] = ["priority", "triton_enable_empty_final_response"];
const KNOWN: &str = "one of sequence_id, sequence_start, sequence_end, step, seed, timeout, symmetric, frame, world, \
                     constraints";

/// The parsed parameters.
#[derive(Debug, Default)]
pub(super) struct Parameters {
    pub(super) sequence: Option<Sequence>,
    pub(super) step: Option<u64>,
    pub(super) seed: Option<u64>,
    pub(super) timeout: Option<Duration>,
    pub(super) flight: FlightFields,
}

impl Parameters {
    /// Parses parameters. Each name occurs once.
    ///
    /// # Errors
    /// [`Invalid`] for an unknown parameter, a value of another type, or a flag of a sequence without `sequence_id`.
    pub(super) fn read(sent: Vec<(String, Parameter)>) -> Result<Self, Invalid> {
        let mut parsed = Self::default();
        let (mut id, mut start, mut end) = (None, None, None);
        for (name, value) in sent {
            match name.as_str() {
                "sequence_id" => id = sequence_id(value)?,
                "sequence_start" => start = Some(flag(&name, &value)?),
                "sequence_end" => end = Some(flag(&name, &value)?),
                "step" => parsed.step = Some(whole(&name, &value)?),
                "seed" => parsed.seed = Some(whole(&name, &value)?),
                "timeout" => parsed.timeout = Some(whole(&name, &value)?).filter(|&us| us > 0).map(Duration::from_micros),
                "symmetric" => parsed.flight.symmetric = Some(flag(&name, &value)?),
                "frame" => parsed.flight.frame = Some(document::<Frame>(&name, &value)?.into()),
                "constraints" => parsed.flight.constraints = Some(constraints(document::<Constraints>(&name, &value)?)?),
                "world" => parsed.flight.world = Some(document::<World>(&name, &value)?.into()),
                ignored if IGNORED.contains(&ignored) => {}
                _ => return Err(Invalid::new("parameters", format!("{name:?}"), KNOWN)),
            }
        }
        let has_flag = start == Some(true) || end == Some(true);
        parsed.sequence = id.map(|id| Sequence { id, start: start == Some(true), end: end == Some(true) });
        if has_flag && parsed.sequence.is_none() {
            let expected = "a number other than 0 or a string, because sequence_start or sequence_end is set";
            return Err(Invalid::missing("parameters.sequence_id", expected));
        }
        Ok(parsed)
    }
}

fn invalid(name: &str, value: &Parameter, expected: &str) -> Invalid {
    let text = match value {
        Parameter::Bool(value) => value.to_string(),
        Parameter::Int(value) => value.to_string(),
        Parameter::Uint(value) => value.to_string(),
        Parameter::Double(value) => format!("{value:?}"),
        Parameter::Text(value) => format!("{value:?}"),
    };
    Invalid::new(format!("parameters.{name}"), text, expected)
}

fn flag(name: &str, value: &Parameter) -> Result<bool, Invalid> {
    if let Parameter::Bool(value) = value { Ok(*value) } else { Err(invalid(name, value, "true or false")) }
}

/// A JSON document in a text.
fn document<T: DeserializeOwned>(name: &str, value: &Parameter) -> Result<T, Invalid> {
    let Parameter::Text(text) = value else { return Err(invalid(name, value, "a JSON object as a text")) };
    parse(text.as_bytes()).map_err(|error| match error {
        Error::Invalid(error) => error.with_prefix(&format!("parameters.{name}")),
        _ => invalid(name, value, "a JSON object as a text"),
    })
}

fn whole(name: &str, value: &Parameter) -> Result<u64, Invalid> {
    match *value {
        Parameter::Uint(value) => Ok(value),
        Parameter::Int(number) if number >= 0 => Ok(number as u64),
        _ => Err(invalid(name, value, "a whole number, 0 or more")),
    }
}

/// Parses a sequence id. Clients send 0 or an empty string if there is no sequence. A negative number is read as the unsigned
/// number with the same 64 bits.
fn sequence_id(value: Parameter) -> Result<Option<SequenceId>, Invalid> {
    let longest = FleetIds::MAX_ID_LEN;
    match value {
        Parameter::Uint(0) | Parameter::Int(0) => Ok(None),
        Parameter::Uint(number) => Ok(Some(SequenceId::Number(number))),
        Parameter::Int(number) => Ok(Some(SequenceId::Number(number as u64))),
        Parameter::Text(name) if name.is_empty() => Ok(None),
        Parameter::Text(name) if name.len() <= longest => Ok(Some(SequenceId::Name(name))),
        other => Err(invalid("sequence_id", &other, &format!("a whole number, or a string of at most {longest} bytes"))),
    }
}
