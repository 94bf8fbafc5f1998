//! The one table of errors: what each use-case error is on gRPC and on HTTP (RFC 9457 problem details).

use axum::Json;
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use tonic::{Code, Status};

use crate::service::Error;

/// gRPC and HTTP status of an error.
fn row(error: &Error) -> (Code, StatusCode) {
    match error {
        Error::Invalid(_) => (Code::InvalidArgument, StatusCode::BAD_REQUEST),
        Error::Schema(_) => (Code::InvalidArgument, StatusCode::UNPROCESSABLE_ENTITY),
        Error::NotFound { .. } => (Code::NotFound, StatusCode::NOT_FOUND),
        Error::Precondition { .. } => (Code::FailedPrecondition, StatusCode::CONFLICT),
        Error::Conflict { .. } => (Code::AlreadyExists, StatusCode::CONFLICT),
        Error::Busy { .. } => (Code::ResourceExhausted, StatusCode::TOO_MANY_REQUESTS),
        Error::TooLarge(_) => (Code::ResourceExhausted, StatusCode::PAYLOAD_TOO_LARGE),
        Error::Deadline(_) => (Code::DeadlineExceeded, StatusCode::GATEWAY_TIMEOUT),
        Error::Draining => (Code::Unavailable, StatusCode::SERVICE_UNAVAILABLE),
        Error::Unauthenticated(_) => (Code::Unauthenticated, StatusCode::UNAUTHORIZED),
        Error::PermissionDenied(_) => (Code::PermissionDenied, StatusCode::FORBIDDEN),
        Error::Internal(_) => (Code::Internal, StatusCode::INTERNAL_SERVER_ERROR),
    }
}

/// Seconds after which to try again, at least 1.
pub fn retry_after_seconds(error: &Error) -> Option<u64> {
    match error {
        Error::Busy { retry_after, .. } => Some(retry_after.as_secs().max(1)),
        Error::Draining => Some(1),
        _ => None,
    }
}

fn log_internal(error: &Error) {
    if let Error::Internal(cause) = error {
        tracing::error!(error = %cause, "internal error");
    }
}

impl From<Error> for Status {
    fn from(error: Error) -> Self {
        log_internal(&error);
        let mut status = Self::new(row(&error).0, error.to_string());
        if let Ok(code) = error.code().parse() {
            status.metadata_mut().insert("qedgix-code", code);
        }
        if let Some(seconds) = retry_after_seconds(&error) {
            status.metadata_mut().insert("retry-after", seconds.into());
        }
        status
    }
}

/// RFC 9457 problem details.
#[derive(Debug, Serialize)]
pub struct Problem {
    /// `about:blank`: the title says it all.
    pub r#type: &'static str,
    /// Reason phrase of the status.
    pub title: &'static str,
    /// HTTP status.
    pub status: u16,
    /// Stable code, for programs.
    pub code: &'static str,
    /// What is wrong with this request, for people.
    pub detail: String,
    /// The field that is wrong, if one is.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub field: Option<String>,
}

impl IntoResponse for Error {
    fn into_response(self) -> Response {
        log_internal(&self);
        let status = row(&self).1;
        let problem = Problem {
            r#type: "about:blank",
            title: status.canonical_reason().unwrap_or("Error"),
            status: status.as_u16(),
            code: self.code(),
            detail: self.to_string(),
            field: if let Self::Invalid(e) = &self { Some(e.field.clone()) } else { None },
        };
        let mut response = (status, Json(problem)).into_response();
        let headers = response.headers_mut();
        headers.insert(header::CONTENT_TYPE, HeaderValue::from_static("application/problem+json"));
        if let Some(seconds) = retry_after_seconds(&self) {
            headers.insert(header::RETRY_AFTER, seconds.into());
        }
        response
    }
}
