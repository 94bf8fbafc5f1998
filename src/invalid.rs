//! One way to say that an input is wrong: which field, which value, what is allowed.
//!
//! Every layer that checks input returns [`Invalid`]; the transports turn it into `INVALID_ARGUMENT` / 400.

use std::fmt::Display;

/// An input that cannot be used, named so that the person who sent it can mend it.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{field}: {value} is not valid; expected {expected}")]
pub struct Invalid {
    /// Path of the field, as the sender wrote it: `environment.uavs`, `graph.nodes[2].id`.
    pub field: String,
    /// What was received, shortened to something that fits a line.
    pub value: String,
    /// What would have been accepted.
    pub expected: String,
    /// Whether the document does not even parse into its schema: an unknown field, a wrong type.
    pub schema: bool,
}

impl Invalid {
    /// Longest value repeated back to the sender, in characters.
    const SHOWN: usize = 120;

    /// Builds the error; a long `value` is cut.
    pub fn new(field: impl Into<String>, value: impl Display, expected: impl Into<String>) -> Self {
        let mut value = value.to_string();
        if value.chars().count() > Self::SHOWN {
            value = value.chars().take(Self::SHOWN).chain("...".chars()).collect();
        }
        Self { field: field.into(), value, expected: expected.into(), schema: false }
    }

    /// The same for what does not parse into the schema.
    pub fn schema(field: impl Into<String>, value: impl Display, expected: impl Into<String>) -> Self {
        Self { schema: true, ..Self::new(field, value, expected) }
    }

    /// The same error with `prefix.` in front of the field.
    #[must_use]
    pub fn within(mut self, prefix: &str) -> Self {
        self.field = format!("{prefix}.{}", self.field);
        self
    }
}

/// What would have been accepted, from the message of a parser that says `..., expected WHAT`.
pub fn expectation(error: &impl Display) -> String {
    let message = error.to_string();
    let expected = message.split_once("expected ").map_or(message.as_str(), |(_, expected)| expected);
    match expected {
        "usize" | "u64" | "u32" => "a whole number, 0 or more".to_owned(),
        "i64" | "i32" => "a whole number".to_owned(),
        "f64" => "a number".to_owned(),
        "a boolean" => "true or false".to_owned(),
        other => other.to_owned(),
    }
}

/// Checks that `value` lies in `range` (NaN never does).
///
/// # Errors
/// [`Invalid`] naming the field, the value and the range.
pub fn in_range<T>(field: &str, value: T, range: std::ops::RangeInclusive<T>) -> Result<(), Invalid>
where
    T: PartialOrd + Display,
{
    if range.contains(&value) {
        return Ok(());
    }
    Err(Invalid::new(field, &value, format!("a number from {} to {}", range.start(), range.end())))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn expectations_read_as_sentences() {
        let of = |message: &str| expectation(&message);
        assert_eq!(of("invalid type: string \"3\", expected usize"), "a whole number, 0 or more");
        assert_eq!(of("unknown variant `ppo`, expected one of `qmix`, `vdn`"), "one of `qmix`, `vdn`");
        assert_eq!(of("something else"), "something else");
    }

    #[test]
    fn long_values_are_cut_and_nan_is_in_no_range() {
        assert!(Invalid::new("f", "x".repeat(1000), "less").value.len() < 130);
        assert!(in_range("f", f64::NAN, 0.0..=1.0).is_err());
        assert!(in_range("f", 1.0, 0.0..=1.0).is_ok());
    }
}
