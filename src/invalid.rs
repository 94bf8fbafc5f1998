//! [`Invalid`]: the error of every layer that checks input. It holds the field, the value received and what is accepted. Its message
//! also names the accepted word that a misspelled one is nearest to.

use std::fmt::{self, Display};

/// An input that is not accepted.
///
/// The message is a sentence about the field: `uavs: got 5000, expected a number from 1 to 4096`,
/// `scene.users: missing, expected at least one user`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Invalid {
    /// Path of the field as the caller wrote it: `environment.uavs`, `graph.nodes[2].id`.
    pub field: String,
    /// The value received, cut to [`Invalid::MAX_VALUE_LEN`] characters; none where the field is missing.
    pub value: Option<String>,
    /// What is accepted: `a number from 1 to 4096`, `one of qmix, vdn`.
    pub expected: String,
    /// What is wrong with the field.
    pub kind: InvalidKind,
}

/// What is wrong with a field.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum InvalidKind {
    /// The value has the right type but is not accepted, or a required value is missing.
    Value,
    /// The value does not match the schema: it has another type, or a required field is missing.
    Schema,
    /// The schema has no field of this name.
    UnknownField,
    /// A request has no parameter of this name.
    UnknownParameter,
}

impl Invalid {
    /// Maximum number of characters of a value that an error contains.
    pub const MAX_VALUE_LEN: usize = 120;

    /// `field` has a `value` of the right type that is not accepted: HTTP status 400, code `invalid_argument`.
    pub fn new(field: impl Into<String>, value: impl Display, expected: impl Into<String>) -> Self {
        let value = Some(cut(shorten_numbers(value.to_string())));
        Self { field: field.into(), value, expected: expected.into(), kind: InvalidKind::Value }
    }

    /// `field` is missing, and its absence is found by a check of values, not by the schema: HTTP status 400, code
    /// `invalid_argument`.
    pub fn missing(field: impl Into<String>, expected: impl Into<String>) -> Self {
        Self { field: field.into(), value: None, expected: expected.into(), kind: InvalidKind::Value }
    }

    /// `field` has a `value` of the wrong type: HTTP status 422, code `invalid_schema`.
    pub fn schema(field: impl Into<String>, value: impl Display, expected: impl Into<String>) -> Self {
        Self { kind: InvalidKind::Schema, ..Self::new(field, value, expected) }
    }

    /// `field` is missing, and the schema requires it: HTTP status 422, code `invalid_schema`.
    pub fn missing_field(field: impl Into<String>, expected: impl Into<String>) -> Self {
        Self { kind: InvalidKind::Schema, ..Self::missing(field, expected) }
    }

    /// The schema has no `field`; `expected` lists the fields that exist.
    pub fn unknown_field(field: impl Into<String>, expected: impl Into<String>) -> Self {
        Self { kind: InvalidKind::UnknownField, ..Self::missing(field, expected) }
    }

    /// A request has no parameter of the name `field`; `expected` lists those that exist: HTTP status 400, code `invalid_argument`.
    pub fn unknown_parameter(field: impl Into<String>, expected: impl Into<String>) -> Self {
        Self { kind: InvalidKind::UnknownParameter, ..Self::missing(field, expected) }
    }

    /// The error of a serde `parser` that failed at `path` (empty: the document itself).
    pub fn from_parser(path: &str, error: &impl Display) -> Self {
        let message = error.to_string();
        let message = message.split(" at line ").next().unwrap_or_default();
        let quoted = || message.split('`').nth(1).unwrap_or_default();
        if message.starts_with("unknown field") {
            let path = if path.is_empty() { quoted() } else { path };
            return Self::unknown_field(path, expectation(&message));
        }
        if message.starts_with("missing field") {
            let dot = if path.is_empty() { "" } else { "." };
            return Self::missing_field(format!("{path}{dot}{}", quoted()), "a value");
        }
        let path = if path.is_empty() { "body" } else { path };
        if message.starts_with("duplicate field") {
            return Self::schema(path, format!("{:?} twice", quoted()), "each field once");
        }
        match message.split_once(", expected ") {
            Some((received, wanted)) => {
                let value = received_value(received);
                // A whole number that is too large looks as if it were accepted, unless the limit is named.
                let limit = match wanted {
                    "u64" | "usize" => Some(u64::MAX),
                    "u32" => Some(u32::MAX.into()),
                    _ => None,
                };
                let too_large = value.parse().is_ok_and(|number: f64| number > 0.0 && number.fract() == 0.0);
                let limit = limit.filter(|_| too_large).map_or_else(String::new, |limit| format!(", at most {limit}"));
                Self::schema(path, value, expectation(&message) + &limit)
            }
            None => Self::schema(path, message, "a value of the documented type"),
        }
    }

    /// Whether the input does not match its schema.
    pub fn is_schema(&self) -> bool {
        matches!(self.kind, InvalidKind::Schema | InvalidKind::UnknownField)
    }

    /// The accepted word that the value, or the name of the unknown field, is nearest to: `expected` is a list `one of a, b, ...`.
    pub fn suggestion(&self) -> Option<&str> {
        let (_, known) = self.expected.split_once("one of ")?;
        let word = match self.kind {
            InvalidKind::UnknownField | InvalidKind::UnknownParameter => self.field.rsplit('.').next()?,
            _ => self.value.as_deref()?.trim_matches('"'),
        };
        nearest(word, known.split(", "))
    }

    /// The same error with `prefix.` in front of the field.
    #[must_use]
    pub fn with_prefix(mut self, prefix: &str) -> Self {
        self.field = format!("{prefix}.{}", self.field);
        self
    }
}

impl Display for Invalid {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { field, value, expected, kind } = self;
        match (kind, value) {
            (InvalidKind::UnknownField, _) => write!(f, "{field}: unknown field, expected {expected}")?,
            (InvalidKind::UnknownParameter, _) => write!(f, "{field}: unknown parameter, expected {expected}")?,
            (_, Some(value)) => write!(f, "{field}: got {value}, expected {expected}")?,
            (_, None) => write!(f, "{field}: missing, expected {expected}")?,
        }
        self.suggestion().map_or(Ok(()), |word| write!(f, "; did you mean {word}?"))
    }
}

impl std::error::Error for Invalid {}

/// The word of `known` that `word` was most likely meant to be: one that a few letters more, less, other or swapped make of it.
pub fn nearest<'a>(word: &str, known: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    // Long words are cut by whoever sent them wrong, not misspelled.
    let length = word.chars().count();
    if !(2..=64).contains(&length) {
        return None;
    }
    let lowercase = word.to_lowercase();
    let distance = |other: &str| strsim::damerau_levenshtein(&lowercase, &other.to_lowercase());
    let others = known.into_iter().filter(|other| *other != word).map(|other| (distance(other), other));
    others.filter(|(distance, _)| *distance <= (length / 3).max(1)).min_by_key(|(distance, _)| *distance).map(|(_, other)| other)
}

/// `text` with its very long numbers, such as the 309 digits of 1e308, in scientific form. Quoted text stays as it is.
fn shorten_numbers(text: String) -> String {
    /// Longer than any whole number of 64 bits, and than any other number of 17 digits that is not tiny.
    const MAX_DIGITS: usize = 24;
    let is_digit = |c: char| c.is_ascii_digit() || c == '.';
    if text.len() <= MAX_DIGITS || text.contains('"') || text.split(|c| !is_digit(c)).all(|digits| digits.len() <= MAX_DIGITS) {
        return text;
    }
    let mut short = String::new();
    let mut rest = text.as_str();
    while !rest.is_empty() {
        let (digits, after) = rest.split_at(rest.find(|c| !is_digit(c)).unwrap_or(rest.len()));
        match digits.parse::<f64>() {
            Ok(number) if digits.len() > MAX_DIGITS && number.is_finite() => short.extend([format!("{number:e}")]),
            _ => short += digits,
        }
        let (between, after) = after.split_at(after.find(is_digit).unwrap_or(after.len()));
        short += between;
        rest = after;
    }
    short
}

fn cut(value: String) -> String {
    if value.chars().count() <= Invalid::MAX_VALUE_LEN {
        return value;
    }
    value.chars().take(Invalid::MAX_VALUE_LEN).chain("...".chars()).collect()
}

/// The value in a serde message such as ``invalid type: integer `3` ``.
fn received_value(message: &str) -> String {
    let received = message.split_once(": ").map_or(message, |(_, received)| received);
    match received {
        "map" => "an object".to_owned(),
        "sequence" => "an array".to_owned(),
        _ if message.starts_with("unknown variant") => format!("{:?}", message.split('`').nth(1).unwrap_or_default()),
        _ if received.contains('`') => received.split('`').nth(1).unwrap_or(received).to_owned(),
        _ => received.strip_prefix("string ").unwrap_or(received).to_owned(),
    }
}

/// What a serde parser expected, from its message (`..., expected WHAT`).
pub fn expectation(error: &impl Display) -> String {
    let message = error.to_string();
    let expected = message.split_once("expected ").map_or(message.as_str(), |(_, expected)| expected);
    match expected {
        "usize" | "u64" | "u32" => "a whole number, 0 or more".to_owned(),
        "i64" | "i32" => "a whole number".to_owned(),
        "f64" | "f32" => "a number".to_owned(),
        "a boolean" => "true or false".to_owned(),
        "a sequence" => "an array".to_owned(),
        "a map" => "an object".to_owned(),
        other if other.starts_with("struct ") => "an object".to_owned(),
        other => other.replace('`', ""),
    }
}

/// `value` without what rounding added to it: lengths in units of a caller have been in other units.
pub fn tidy(value: f64) -> f64 {
    format!("{value:.11e}").parse().unwrap_or(value)
}

/// Checks that `value` lies in `range`. NaN lies in no range.
///
/// # Errors
/// [`Invalid`] if `value` is outside of `range`.
pub fn in_range<T>(field: &str, value: T, range: std::ops::RangeInclusive<T>) -> Result<(), Invalid>
where
    T: PartialOrd + Display,
{
    if range.contains(&value) {
        return Ok(());
    }
    let ends = [range.start(), range.end()].map(|end| shorten_numbers(end.to_string()));
    Err(Invalid::new(field, &value, format!("a number from {} to {}", ends[0], ends[1])))
}

/// Checks that a list has a number of `items` (`policies`) in `range`.
///
/// # Errors
/// [`Invalid`] if it has fewer or more.
pub fn count_in_range(field: &str, count: usize, range: std::ops::RangeInclusive<usize>, items: &str) -> Result<(), Invalid> {
    if range.contains(&count) {
        return Ok(());
    }
    Err(Invalid::new(field, format!("{count} {items}"), format!("from {} to {}", range.start(), range.end())))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_are_sentences() {
        let message = |invalid: Invalid| invalid.to_string();
        assert_eq!(message(Invalid::new("uavs", 5000, "at most 4096")), "uavs: got 5000, expected at most 4096");
        assert_eq!(message(Invalid::missing("scene", "a scene")), "scene: missing, expected a scene");
        assert_eq!(message(Invalid::unknown_field("job.x", "one of a, b")), "job.x: unknown field, expected one of a, b");
        let none = count_in_range("policies", 0, 1..=32, "policies").unwrap_err();
        assert_eq!(message(none), "policies: got 0 policies, expected from 1 to 32");
    }

    #[test]
    fn parser_messages_become_fields_values_and_expectations() {
        let parse = |path: &str, message: &str| {
            let Invalid { field, value, expected, kind } = Invalid::from_parser(path, &message);
            (field, value.unwrap_or_default(), expected, kind)
        };
        let owned = |field: &str, value: &str, expected: &str, kind| (field.into(), value.into(), expected.into(), kind);
        for (path, message, expected) in [
            (
                "a[1].b",
                "invalid type: string \"3\", expected usize at line 1 column 5",
                owned("a[1].b", "\"3\"", "a whole number, 0 or more", InvalidKind::Schema),
            ),
            (
                "n",
                "invalid value: integer `-1`, expected u32",
                owned("n", "-1", "a whole number, 0 or more", InvalidKind::Schema),
            ),
            ("", "invalid type: sequence, expected struct Act", owned("body", "an array", "an object", InvalidKind::Schema)),
            (
                "algorithm",
                "unknown variant `ppo`, expected one of `qmix`, `vdn`",
                owned("algorithm", "\"ppo\"", "one of qmix, vdn", InvalidKind::Schema),
            ),
            (
                "seed",
                "invalid value: floating point `18446744073709551616.0`, expected u64",
                owned(
                    "seed",
                    "18446744073709551616.0",
                    "a whole number, 0 or more, at most 18446744073709551615",
                    InvalidKind::Schema,
                ),
            ),
            ("a", "missing field `x`", owned("a.x", "", "a value", InvalidKind::Schema)),
            ("", "missing field `x`", owned("x", "", "a value", InvalidKind::Schema)),
            ("a.y", "unknown field `y`, expected `x`", owned("a.y", "", "x", InvalidKind::UnknownField)),
            ("a", "duplicate field `x`", owned("a", "\"x\" twice", "each field once", InvalidKind::Schema)),
        ] {
            assert_eq!(parse(path, message), expected, "{message}");
        }
    }

    #[test]
    fn the_nearest_word_is_suggested() {
        let known = ["qmix", "vdn", "sweep", "sweep-shared", "learning_rate"];
        for (word, expected) in [
            ("qmx", Some("qmix")),
            ("QMIX", Some("qmix")),
            ("swep", Some("sweep")),
            ("sweep_shared", Some("sweep-shared")),
            ("learing_rate", Some("learning_rate")),
            ("vnd", Some("vdn")),
            ("sweeps", Some("sweep")),
            ("ppo", None),
            ("", None),
            ("q", None),
        ] {
            assert_eq!(nearest(word, known), expected, "{word}");
        }
        assert_eq!(nearest(&"x".repeat(1_000_000), known), None);
        let field = Invalid::unknown_field("training.learing_rate", "one of gamma, learning_rate");
        assert_eq!(field.suggestion(), Some("learning_rate"));
        assert_eq!(Invalid::new("algorithm", "\"qmx\"", "one of qmix, vdn").suggestion(), Some("qmix"));
        assert_eq!(Invalid::new("uavs", 5000, "at most 4096").suggestion(), None);
    }

    #[test]
    fn long_numbers_are_in_scientific_form() {
        let value = |value: &dyn Display| Invalid::new("f", value, "less").value.unwrap();
        assert_eq!(value(&1e308), "1e308");
        assert_eq!(value(&-2.5e-300), "-2.5e-300");
        assert_eq!(value(&format!("({}, 0.5)", 1e200)), "(1e200, 0.5)");
        for plain in ["18446744073709551615", "-0.1234567890123456789", "1.5", "a.b.c", ""] {
            assert_eq!(value(&plain), plain);
        }
        let error = in_range("f", -1.0, 0.0..=1e30).unwrap_err();
        assert_eq!(error.to_string(), "f: got -1, expected a number from 0 to 1e30");
    }

    #[test]
    fn long_values_are_cut() {
        let value = Invalid::new("f", "x".repeat(1000), "less").value.unwrap();
        assert_eq!(value.len(), Invalid::MAX_VALUE_LEN + 3);
    }

    #[test]
    fn ranges_include_their_ends_and_exclude_nan() {
        assert!(in_range("f", f64::NAN, 0.0..=1.0).is_err());
        assert!(in_range("f", 1.0, 0.0..=1.0).is_ok());
        assert!(in_range("f", 1.1, 0.0..=1.0).is_err());
    }
}
