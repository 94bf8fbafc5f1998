//! Content types of bodies.

use axum::http::{HeaderMap, header};

use crate::invalid::Invalid;
use crate::service::Error;

/// The content type of a body, in lower case and without parameters.
pub fn media_type(headers: &HeaderMap) -> Option<String> {
    let kind = headers.get(header::CONTENT_TYPE)?.to_str().unwrap_or("unreadable");
    Some(kind.split(';').next().unwrap_or_default().trim().to_ascii_lowercase())
}

/// The error for a body of another content type than `expected`.
pub fn unsupported(kind: Option<String>, expected: &str) -> Error {
    Error::MediaType(match kind {
        Some(kind) => Invalid::new("content-type", kind, expected),
        None => Invalid::missing("content-type", expected),
    })
}
