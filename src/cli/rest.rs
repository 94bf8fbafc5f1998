//! Paths, queries and documents of the REST interface, for commands that use a server.

use percent_encoding::{AsciiSet, NON_ALPHANUMERIC, PercentEncode, utf8_percent_encode};
use serde_json::Value;

/// The path of a resource below `/v1/collection`. Each segment is percent-encoded.
pub fn path(collection: &str, segments: &[&str]) -> String {
    segments.iter().fold(format!("/v1/{collection}"), |path, segment| format!("{path}/{}", encode(segment)))
}

/// The query of the parameters that are given, with its `?`; empty without any.
pub fn query(parameters: &[(&str, Option<String>)]) -> String {
    let given = parameters.iter().filter_map(|(name, value)| Some(format!("{name}={}", encode(value.as_deref()?))));
    let given: Vec<String> = given.collect();
    if given.is_empty() { String::new() } else { format!("?{}", given.join("&")) }
}

/// Characters that are percent-encoded in segments and query values.
const ENCODED: &AsciiSet = &NON_ALPHANUMERIC.remove(b'-').remove(b'_').remove(b'.').remove(b':').remove(b'@');

fn encode(text: &str) -> PercentEncode<'_> {
    utf8_percent_encode(text, ENCODED)
}

/// The items of a list in a response.
pub fn items<'a>(response: &'a Value, name: &str) -> impl Iterator<Item = &'a Value> {
    response[name].as_array().into_iter().flatten()
}

/// A JSON value as text.
pub fn text(value: &Value) -> String {
    match value {
        Value::Null => "-".to_owned(),
        Value::String(text) => text.clone(),
        Value::Array(items) if items.is_empty() => "-".to_owned(),
        Value::Array(items) => items.iter().map(text).collect::<Vec<_>>().join(", "),
        other => other.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn segments_and_query_values_are_percent_encoded() {
        assert_eq!(path("policies", &["my policy/..?x", "aliases", "live"]), "/v1/policies/my%20policy%2F..%3Fx/aliases/live");
        assert_eq!(path("policies", &["mine:3"]), "/v1/policies/mine:3");
        assert_eq!(query(&[("alias", Some("a&b".into())), ("page_size", None)]), "?alias=a%26b");
        assert_eq!(query(&[("alias", None)]), "");
    }
}
