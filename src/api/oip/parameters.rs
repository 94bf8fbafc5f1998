//! Parameters of a request: the sequence it belongs to, its step, its seed, the caller's patience.

use std::time::Duration;

use crate::invalid::Invalid;
use crate::service::sequences::{Sequence, SequenceId};
use crate::serving::Fleet;

/// The value of a parameter.
#[derive(Clone, Debug, PartialEq)]
pub enum Parameter {
    /// Yes or no.
    Bool(bool),
    /// A whole number.
    Int(i64),
    /// A whole number that is not negative.
    Uint(u64),
    /// A number.
    Double(f64),
    /// A text.
    Text(String),
}

/// Parameters that have no meaning here, but are none the worse for that: those that Triton's clients send by themselves.
const IGNORED: [&str; 2] = ["priority", "triton_enable_empty_final_response"];
const KNOWN: &str = "one of sequence_id, sequence_start, sequence_end, step, seed, timeout";

/// What the parameters of a request say.
#[derive(Debug, Default)]
pub(super) struct Parameters {
    pub(super) sequence: Option<Sequence>,
    pub(super) step: Option<u64>,
    pub(super) seed: Option<u64>,
    pub(super) timeout: Option<Duration>,
}

impl Parameters {
    /// Reads them; each name is there once.
    ///
    /// # Errors
    /// An unknown parameter, or a value of another type.
    pub(super) fn read(sent: Vec<(String, Parameter)>) -> Result<Self, Invalid> {
        let mut read = Self::default();
        let (mut id, mut start, mut end) = (None, None, None);
        for (name, value) in sent {
            match name.as_str() {
                "sequence_id" => id = sequence_id(value)?,
                "sequence_start" => start = Some(flag(&name, &value)?),
                "sequence_end" => end = Some(flag(&name, &value)?),
                "step" => read.step = Some(whole(&name, &value)?),
                "seed" => read.seed = Some(whole(&name, &value)?),
                "timeout" => read.timeout = Some(whole(&name, &value)?).filter(|&us| us > 0).map(Duration::from_micros),
                ignored if IGNORED.contains(&ignored) => {}
                _ => return Err(Invalid::new("parameters", format!("{name:?}"), KNOWN)),
            }
        }
        let flagged = start == Some(true) || end == Some(true);
        read.sequence = id.map(|id| Sequence { id, start: start == Some(true), end: end == Some(true) });
        if flagged && read.sequence.is_none() {
            let expected = "a number other than 0 or a text, which sequence_start and sequence_end need";
            return Err(Invalid::new("parameters.sequence_id", "nothing", expected));
        }
        Ok(read)
    }
}

fn wrong(name: &str, value: &Parameter, expected: &str) -> Invalid {
    let shown = match value {
        Parameter::Bool(value) => value.to_string(),
        Parameter::Int(value) => value.to_string(),
        Parameter::Uint(value) => value.to_string(),
        Parameter::Double(value) => format!("{value:?}"),
        Parameter::Text(value) => format!("{value:?}"),
    };
    Invalid::new(format!("parameters.{name}"), shown, expected)
}

fn flag(name: &str, value: &Parameter) -> Result<bool, Invalid> {
    if let Parameter::Bool(value) = value { Ok(*value) } else { Err(wrong(name, value, "true or false")) }
}

fn whole(name: &str, value: &Parameter) -> Result<u64, Invalid> {
    match *value {
        Parameter::Uint(value) => Ok(value),
        Parameter::Int(number) if number >= 0 => Ok(number as u64),
        _ => Err(wrong(name, value, "a whole number, 0 or more")),
    }
}

/// 0 and the empty text are what clients send for none. A negative number is the same 64 bits without a sign.
fn sequence_id(value: Parameter) -> Result<Option<SequenceId>, Invalid> {
    let longest = Fleet::LONGEST_ID;
    match value {
        Parameter::Uint(0) | Parameter::Int(0) => Ok(None),
        Parameter::Uint(number) => Ok(Some(SequenceId::Number(number))),
        Parameter::Int(number) => Ok(Some(SequenceId::Number(number as u64))),
        Parameter::Text(name) if name.is_empty() => Ok(None),
        Parameter::Text(name) if name.len() <= longest => Ok(Some(SequenceId::Name(name))),
        other => Err(wrong("sequence_id", &other, &format!("a whole number, or a text of at most {longest} bytes"))),
    }
}
