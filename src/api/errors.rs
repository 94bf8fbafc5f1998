//! The one table of errors: what each use-case error is on gRPC and on HTTP (RFC 9457 problem details).

use axum::Json;
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use tonic::{Code, Status};
use utoipa::ToSchema;

use crate::service::Error;

/// gRPC and HTTP status of an error.
fn row(error: &Error) -> (Code, StatusCode) {
    match error {
        Error::Invalid(e) if !e.schema => (Code::InvalidArgument, StatusCode::BAD_REQUEST),
        Error::Invalid(_) | Error::Schema(_) => (Code::InvalidArgument, StatusCode::UNPROCESSABLE_ENTITY),
        Error::NotFound { .. } => (Code::NotFound, StatusCode::NOT_FOUND),
        Error::Precondition { .. } => (Code::FailedPrecondition, StatusCode::CONFLICT),
        Error::Conflict { .. } => (Code::AlreadyExists, StatusCode::CONFLICT),
        Error::Busy { .. } => (Code::ResourceExhausted, StatusCode::TOO_MANY_REQUESTS),
        Error::TooLarge(_) => (Code::ResourceExhausted, StatusCode::PAYLOAD_TOO_LARGE),
        Error::MediaType(_) => (Code::InvalidArgument, StatusCode::UNSUPPORTED_MEDIA_TYPE),
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

/// Logs a fault that no other line will tell about: part of an answer, or of a stream that has begun.
pub(super) fn log_internal(error: &Error) {
    if let Error::Internal(cause) = error {
        tracing::error!(error = %cause, "internal error");
    }
}

/// The status with which a stream that has begun ends.
pub(super) fn in_stream(error: Error) -> Status {
    log_internal(&error);
    error.into()
}

/// The cause of a fault is the status's source: it is logged when the call ends, and not sent.
impl From<Error> for Status {
    fn from(error: Error) -> Self {
        let mut status = Self::new(row(&error).0, error.to_string());
        if let Ok(code) = error.code().parse() {
            status.metadata_mut().insert("qedgix-code", code);
        }
        if let Some(seconds) = retry_after_seconds(&error) {
            status.metadata_mut().insert("retry-after", seconds.into());
        }
        if let Error::Internal(cause) = error {
            status.set_source(cause.into());
        }
        status
    }
}

/// The same as a part of an answer, for slots that are refused on their own.
pub fn act_error(error: &Error) -> crate::wire::v1::ActError {
    log_internal(error);
    crate::wire::v1::ActError { status: row(error).0.into(), code: error.code().to_owned(), message: error.to_string() }
}

/// RFC 9457 problem details.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct Problem {
    /// `about:blank`: the title says it all.
    #[schema(example = "about:blank")]
    pub r#type: &'static str,
    /// Reason phrase of the status.
    #[schema(example = "Bad Request")]
    pub title: &'static str,
    /// HTTP status.
    #[schema(minimum = 400, maximum = 599, example = 400)]
    pub status: u16,
    /// Stable code, for programs.
    #[schema(example = "invalid_argument")]
    pub code: &'static str,
    /// What is wrong with this request, for people.
    #[schema(example = "scene.users[2].aoi: -1 is not valid; expected a number from 0 to 1000000")]
    pub detail: String,
    /// The field that is wrong, if one is.
    #[schema(example = "scene.users[2].aoi")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub field: Option<String>,
}

/// A problem that is none of the use cases: an unknown method of a path.
pub(super) fn problem(status: StatusCode, code: &'static str, detail: String) -> Response {
    Problem::new(status, code, detail).into_response()
}

impl Problem {
    fn new(status: StatusCode, code: &'static str, detail: String) -> Self {
        let title = status.canonical_reason().unwrap_or("Error");
        Self { r#type: "about:blank", title, status: status.as_u16(), code, detail, field: None }
    }
}

impl IntoResponse for Problem {
    fn into_response(self) -> Response {
        let status = StatusCode::from_u16(self.status).unwrap_or(StatusCode::INTERNAL_SERVER_ERROR);
        let mut response = (status, Json(&self)).into_response();
        // For those who say it in other words.
        response.extensions_mut().insert(self);
        response.headers_mut().insert(header::CONTENT_TYPE, HeaderValue::from_static("application/problem+json"));
        response
    }
}

/// What an error response is about, for the log.
#[derive(Clone, Debug)]
pub(super) struct Failure(pub(super) String);

impl IntoResponse for Error {
    fn into_response(self) -> Response {
        let mut problem = Problem::new(row(&self).1, self.code(), self.to_string());
        if let Self::Invalid(e) = &self {
            problem.field = Some(e.field.clone());
        }
        let mut response = problem.into_response();
        if let Some(seconds) = retry_after_seconds(&self) {
            response.headers_mut().insert(header::RETRY_AFTER, seconds.into());
        }
        let detail = match &self {
            Self::Internal(cause) => cause.to_string(),
            error => error.to_string(),
        };
        response.extensions_mut().insert(Failure(detail));
        response
    }
}
