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
