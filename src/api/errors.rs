//! The translation of [`Error`] to gRPC statuses with `google.rpc` details and to HTTP problem details (RFC 9457).

use std::collections::HashMap;
use std::time::Duration;

use axum::Json;
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use tonic::metadata::MetadataMap;
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, FieldViolation, StatusExt};
use utoipa::ToSchema;
use utoipa::openapi::schema::{Object, ObjectBuilder, Type};

use crate::error_code::ErrorCode;
use crate::service::Error;
use crate::store::WriteFailure;

/// Trailer with the error code as clients compare it, the same text as `code` of REST.
pub(super) const CODE_METADATA: &str = "qedgix-code";

/// Domain of the reasons in `google.rpc.ErrorInfo`.
const DOMAIN: &str = "qedgix";

/// gRPC and HTTP status of an error.
fn statuses(error: &Error) -> (Code, StatusCode) {
    match error {
        Error::Invalid(invalid) if invalid.is_schema() => (Code::InvalidArgument, StatusCode::UNPROCESSABLE_ENTITY),
        Error::Invalid(_) => (Code::InvalidArgument, StatusCode::BAD_REQUEST),
        Error::NotFound { .. } => (Code::NotFound, StatusCode::NOT_FOUND),
        Error::Precondition { .. } | Error::ReadOnly { .. } => (Code::FailedPrecondition, StatusCode::CONFLICT),
        Error::Conflict { .. } => (Code::AlreadyExists, StatusCode::CONFLICT),
        Error::Busy { .. } => (Code::ResourceExhausted, StatusCode::TOO_MANY_REQUESTS),
        Error::TooLarge { .. } => (Code::ResourceExhausted, StatusCode::PAYLOAD_TOO_LARGE),
        Error::Overloaded => (Code::ResourceExhausted, StatusCode::SERVICE_UNAVAILABLE),
        Error::MediaType(_) => (Code::Unimplemented, StatusCode::UNSUPPORTED_MEDIA_TYPE),
        Error::Deadline(_) => (Code::DeadlineExceeded, StatusCode::GATEWAY_TIMEOUT),
        Error::Draining | Error::Unavailable(_) => (Code::Unavailable, StatusCode::SERVICE_UNAVAILABLE),
        Error::Storage(WriteFailure::Full) => (Code::ResourceExhausted, StatusCode::INSUFFICIENT_STORAGE),
        Error::Storage(_) => (Code::Unavailable, StatusCode::INSUFFICIENT_STORAGE),
        Error::Unauthenticated(_) => (Code::Unauthenticated, StatusCode::UNAUTHORIZED),
        Error::PermissionDenied { .. } | Error::CrossSite(_) => (Code::PermissionDenied, StatusCode::FORBIDDEN),
        Error::Internal(_) => (Code::Internal, StatusCode::INTERNAL_SERVER_ERROR),
    }
}

/// Seconds after which to retry, at least 1.
pub fn retry_after_seconds(error: &Error) -> Option<u64> {
    match error {
        Error::Busy { retry_after, .. } => Some(retry_after.as_secs_f64().ceil().max(1.0) as u64),
        Error::Draining | Error::Unavailable(_) | Error::Storage(_) | Error::Overloaded => Some(1),
        _ => None,
    }
}

/// The limit in bytes that the request exceeds.
fn limit(error: &Error) -> Option<u64> {
    match error {
        Error::TooLarge { limit, .. } => *limit,
        _ => None,
    }
}

/// The scope that the API key lacks.
fn required_scope(error: &Error) -> Option<&'static str> {
    match error {
        Error::PermissionDenied { scope, .. } => Some(scope),
        _ => None,
    }
}

/// The address of the primary, if the request belongs there.
fn primary(error: &Error) -> Option<&str> {
    match error {
        Error::ReadOnly { primary } => Some(primary),
        _ => None,
    }
}

/// Logs an internal error that is not the status of a call: it is part of a response, or ends a stream.
pub(super) fn log_internal(error: &Error) {
    if let Error::Internal(_) = error {
        tracing::error!(error = error.reason(), "internal error");
    }
}

/// Logs an internal error and converts it to the status that ends a stream.
pub(super) fn stream_status(error: Error) -> Status {
    log_internal(&error);
    error.into()
}

/// Maximum bytes of the texts in a status. A status is sent in headers, of which clients accept 8 KiB; the message is in it
/// twice, once with up to 3 bytes per byte.
const MAX_MESSAGE: usize = 768;
const MAX_FIELD: usize = 256;
const MAX_VALUE: usize = 256;
const MAX_EXPECTED: usize = 512;

/// The text, cut if it is longer than `bytes`.
fn cut(text: &str, bytes: usize) -> String {
    if text.len() <= bytes {
        return text.to_owned();
    }
    let end = (0..=bytes - 3).rev().find(|&at| text.is_char_boundary(at)).unwrap_or(0);
    format!("{}...", &text[..end])
}

/// `google.rpc` details: ErrorInfo always, BadRequest for a field, RetryInfo where the caller may retry.
fn details(error: &Error) -> ErrorDetails {
    let mut details = ErrorDetails::new();
    let reason = error.code().as_str().to_ascii_uppercase();
    let mut metadata = HashMap::new();
    if let Some(invalid) = error.invalid() {
        let value = invalid.value.as_deref().map(|value| cut(value, MAX_VALUE));
        let expected = cut(&invalid.expected, MAX_EXPECTED);
        let description = match &value {
            Some(value) => format!("got {value}, expected {expected}"),
            None => format!("expected {expected}"),
        };
        let (field, reason) = (cut(&invalid.field, MAX_FIELD), reason.clone());
        details.set_bad_request([FieldViolation { field, description, reason, localized_message: None }]);
        metadata.extend(value.map(|value| ("value".to_owned(), value)));
        metadata.insert("expected".to_owned(), expected);
    }
    metadata.extend(limit(error).map(|limit| ("limit".to_owned(), limit.to_string())));
    metadata.extend(required_scope(error).map(|scope| ("required_scope".to_owned(), scope.to_owned())));
    metadata.extend(primary(error).map(|primary| ("primary".to_owned(), cut(primary, MAX_VALUE))));
    if let Some(seconds) = retry_after_seconds(error) {
        details.set_retry_info(Some(Duration::from_secs(seconds)));
    }
    details.set_error_info(reason, DOMAIN, metadata);
    details
}

/// The cause of an internal error becomes the source of the status, which is logged when the call ends and not sent.
impl From<Error> for Status {
    fn from(error: Error) -> Self {
        let mut metadata = MetadataMap::new();
        if let Ok(code) = error.code().as_str().parse() {
            metadata.insert(CODE_METADATA, code);
        }
        if let Some(seconds) = retry_after_seconds(&error) {
            metadata.insert("retry-after", seconds.into());
        }
        let (code, message) = (statuses(&error).0, cut(&error.to_string(), MAX_MESSAGE));
        let mut status = Self::with_error_details_and_metadata(code, message, details(&error), metadata);
        if let Error::Internal(cause) = error {
            status.set_source(cause.into());
        }
        status
    }
}

/// The error of one slot in a batch or stream.
pub fn act_error(error: &Error) -> crate::wire::v1::ActError {
    log_internal(error);
    crate::wire::v1::ActError {
        status: statuses(error).0.into(),
        code: error.code().to_string(),
        message: error.to_string(),
        field: error.invalid().map(|invalid| invalid.field.clone()).unwrap_or_default(),
    }
}

/// Problem details of RFC 9457.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct Problem {
    /// Always `about:blank`: `title` is the reason phrase of the status.
    #[schema(example = "about:blank")]
    pub r#type: &'static str,
    /// Reason phrase of the status.
    #[schema(example = "Bad Request")]
    pub title: &'static str,
    /// HTTP status.
    #[schema(minimum = 400, maximum = 599, example = 400)]
    pub status: u16,
    /// Stable code for programs.
    #[schema(schema_with = code_schema)]
    pub code: ErrorCode,
    /// Description for people; may change.
    #[schema(example = "scene.users[2].aoi: got -1, expected a number from 0 to 1000000")]
    pub detail: String,
    /// Path of the field that is not accepted, if the error is about a field.
    #[schema(example = "scene.users[2].aoi")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub field: Option<String>,
    /// The value received in `field`, as text and cut where it is long.
    #[schema(example = "-1")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub value: Option<String>,
    /// What `field` accepts.
    #[schema(example = "a number from 0 to 1000000")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub expected: Option<String>,
    /// The limit in bytes that the request exceeds.
    #[schema(example = 4_194_304)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub limit: Option<u64>,
    /// Seconds after which to retry, as in the header `retry-after`.
    #[schema(example = 1)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub retry_after: Option<u64>,
    /// The scope that the API key lacks.
    #[schema(example = "act")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub required_scope: Option<&'static str>,
    /// REST address of the primary, to which the request belongs.
    #[schema(example = "http://primary:8080")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub primary: Option<String>,
}

fn code_schema() -> Object {
    let codes = ErrorCode::ALL.iter().map(|code| code.as_str());
    ObjectBuilder::new()
        .schema_type(Type::String)
        .description(Some("Stable code for programs."))
        .enum_values(Some(codes))
        .examples([ErrorCode::InvalidArgument.as_str()])
        .build()
}

/// The response for an error that no use case returns, such as a method that the path does not support.
pub(super) fn problem(status: StatusCode, code: ErrorCode, detail: String) -> Response {
    Problem::new(status, code, detail).into_response()
}

impl Problem {
    fn new(status: StatusCode, code: ErrorCode, detail: String) -> Self {
        Self {
            r#type: "about:blank",
            title: status.canonical_reason().unwrap_or("Error"),
            status: status.as_u16(),
            code,
            detail,
            field: None,
            value: None,
            expected: None,
            limit: None,
            retry_after: None,
            required_scope: None,
            primary: None,
        }
    }
}

impl From<&Error> for Problem {
    fn from(error: &Error) -> Self {
        let invalid = error.invalid();
        Self {
            field: invalid.map(|invalid| invalid.field.clone()),
            value: invalid.and_then(|invalid| invalid.value.clone()),
            expected: invalid.map(|invalid| invalid.expected.clone()),
            limit: limit(error),
            retry_after: retry_after_seconds(error),
            required_scope: required_scope(error),
            primary: primary(error).map(str::to_owned),
            ..Self::new(statuses(error).1, error.code(), error.to_string())
        }
    }
}

impl IntoResponse for Problem {
    fn into_response(self) -> Response {
        let status = StatusCode::from_u16(self.status).unwrap_or(StatusCode::INTERNAL_SERVER_ERROR);
        let mut response = (status, Json(&self)).into_response();
        // `/v2` writes its own body from the problem.
        response.extensions_mut().insert(self);
        response.headers_mut().insert(header::CONTENT_TYPE, HeaderValue::from_static("application/problem+json"));
        response
    }
}

/// Extension of an error response: the text for the log, with the causes of an internal error.
#[derive(Clone, Debug)]
pub(super) struct LogDetail(pub(super) String);

impl IntoResponse for Error {
    fn into_response(self) -> Response {
        let mut response = Problem::from(&self).into_response();
        if let Some(seconds) = retry_after_seconds(&self) {
            response.headers_mut().insert(header::RETRY_AFTER, seconds.into());
        }
        if let Self::Unauthenticated(_) = self {
            response.headers_mut().insert(header::WWW_AUTHENTICATE, HeaderValue::from_static("Bearer realm=\"qedgix\""));
        }
        response.extensions_mut().insert(LogDetail(self.reason()));
        response
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::invalid::Invalid;

    fn json(error: Error) -> serde_json::Value {
        serde_json::to_value(Problem::from(&error)).unwrap()
    }

    #[test]
    fn problems_carry_field_value_and_expectation() {
        let problem = json(Invalid::new("uavs", 5000, "at most 4096").into());
        assert_eq!((&problem["status"], &problem["code"]), (&400.into(), &"invalid_argument".into()));
        assert_eq!((&problem["field"], &problem["value"]), (&"uavs".into(), &"5000".into()));
        assert_eq!(problem["expected"], "at most 4096");
        let problem = json(Invalid::missing_field("uavs", "a number").into());
        assert_eq!((&problem["status"], &problem["code"]), (&422.into(), &"invalid_schema".into()));
        assert!(problem.get("value").is_none());
    }

    #[test]
    fn problems_carry_limits_and_waiting_times() {
        let problem = json(Error::TooLarge { message: "too large".into(), limit: Some(7) });
        assert_eq!((&problem["status"], &problem["limit"]), (&413.into(), &7.into()));
        let problem = json(Error::Busy { message: "full".into(), retry_after: Duration::from_millis(1200) });
        assert_eq!((&problem["status"], &problem["retry_after"]), (&429.into(), &2.into()));
    }

    #[test]
    fn statuses_carry_details() {
        let status = Status::from(Error::from(Invalid::new("uavs", "x".repeat(10_000), "at most 4096")));
        assert!(status.details().len() < 1024, "{} bytes", status.details().len());
        let details = status.get_error_details();
        let violation = &details.bad_request().unwrap().field_violations[0];
        assert_eq!((violation.field.as_str(), violation.reason.as_str()), ("uavs", "INVALID_ARGUMENT"));
        let info = details.error_info().unwrap();
        assert_eq!((info.reason.as_str(), info.domain.as_str()), ("INVALID_ARGUMENT", DOMAIN));
        assert_eq!(info.metadata["expected"], "at most 4096");
        assert_eq!(status.metadata().get(CODE_METADATA).unwrap(), "invalid_argument");

        let status = Status::from(Error::busy("full"));
        assert_eq!(status.get_error_details().retry_info().unwrap().retry_delay, Some(Duration::from_secs(1)));
        assert_eq!(status.metadata().get("retry-after").unwrap(), "1");
    }

    #[test]
    fn statuses_fit_into_the_headers_that_clients_accept() {
        for text in ["x", "é", "\u{1f681}", "\n"] {
            let long = text.repeat(20_000);
            for error in [
                Error::from(Invalid::new(long.clone(), long.clone(), long.clone())),
                Error::not_found("policy", long.clone()),
                Error::TooLarge { message: long.clone(), limit: Some(1) },
            ] {
                let headers = Status::from(error).into_http::<()>().headers().clone();
                // HTTP/2 counts 32 bytes more for every header.
                let size: usize = headers.iter().map(|(name, value)| name.as_str().len() + value.len() + 32).sum();
                assert!(size < 8 << 10, "{size} bytes for {text:?}");
            }
        }
    }

    #[test]
    fn every_code_is_documented() {
        let document = include_str!("../../docs/errors.md");
        for code in ErrorCode::ALL {
            assert_eq!(document.matches(&format!("\n| `{code}` |")).count(), 1, "{code}");
        }
    }

    #[test]
    fn logs_have_every_cause_of_an_internal_error_once() {
        let damaged = || Error::internal(std::sync::Arc::new(Error::internal("the checkpoint is damaged")));
        let detail = damaged().into_response().extensions_mut().remove::<LogDetail>().unwrap().0;
        assert_eq!(detail, "internal error: the checkpoint is damaged");
        assert_eq!(damaged().reason(), detail);
    }

    #[test]
    fn clients_do_not_see_the_cause_of_an_internal_error() {
        let status = Status::from(Error::internal("the secret cause"));
        assert_eq!(status.message(), "internal error");
        assert!(!String::from_utf8_lossy(status.details()).contains("secret"));
        assert!(!json(Error::internal("the secret cause")).to_string().contains("secret"));
    }
}
