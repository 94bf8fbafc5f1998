//! What happens around every gRPC call: its deadline, its id, panics caught, statuses brought in line with the table of
//! errors, and its count.

use std::panic::AssertUnwindSafe;
use std::sync::Arc;
use std::time::Instant;

use axum::extract::Request;
use axum::middleware::Next;
use axum::response::Response;
use futures::FutureExt;
use tonic::{Code, Status};
use tracing::Instrument;

use super::Deadline;
use crate::api::observe::{Meters, REQUEST_ID, request_id};
use crate::invalid::Invalid;
use crate::service::Error;

pub(super) async fn around(meters: Arc<Meters>, request: Request, next: Next) -> Response {
    let begun = Instant::now();
    let uri = request.uri().clone();
    let method = uri.path().trim_start_matches('/');
    let id = request_id(request.headers());
    let deadline = request.extensions().get::<Deadline>().map(|deadline| deadline.0);
    let span = tracing::info_span!("grpc", method, request_id = ?id);
    let work = AssertUnwindSafe(next.run(request).instrument(span.clone())).catch_unwind();
    let answered = match deadline {
        None => work.await,
        Some(deadline) if deadline <= Instant::now() => Ok(too_late()),
        Some(deadline) => tokio::time::timeout_at(deadline.into(), work).await.unwrap_or_else(|_| Ok(too_late())),
    };
    let _inside = span.enter();
    let response = answered.unwrap_or_else(|_| Status::from(Error::internal("a handler panicked")).into_http());
    let (mut response, code) = in_line(response);
    response.headers_mut().insert(REQUEST_ID, id);
    // Paths are the caller's; only those that exist become labels.
    let method = if code == Code::Unimplemented { "unknown" } else { method };
    meters.end(begun, method, name(code));
    response
}

fn too_late() -> Response {
    Status::from(Error::Deadline("before the answer was ready")).into_http()
}

fn in_line(response: Response) -> (Response, Code) {
    let Some(status) = response.extensions().get::<Status>() else { return (response, Code::Ok) };
    let code = status.code();
    match of_the_table(status) {
        None => (response, code),
        Some(status) => {
            let code = status.code();
            (status.into_http(), code)
        }
    }
}

/// The transport has its own statuses for messages that are too large or do not decode; the table of errors has others.
pub(super) fn of_the_table(status: &Status) -> Option<Status> {
    let ours = status.metadata().contains_key("qedgix-code");
    match status.code() {
        Code::OutOfRange if !ours => Some(Error::TooLarge(status.message().to_owned()).into()),
        Code::Internal if !ours => {
            let wrong = Invalid::new("message", status.message(), "one message of the method's request type");
            Some(Error::from(wrong).into())
        }
        _ => None,
    }
}

/// The status code as gRPC's documents write it.
fn name(code: Code) -> &'static str {
    match code {
        Code::Ok => "OK",
        Code::Cancelled => "CANCELLED",
        Code::Unknown => "UNKNOWN",
        Code::InvalidArgument => "INVALID_ARGUMENT",
        Code::DeadlineExceeded => "DEADLINE_EXCEEDED",
        Code::NotFound => "NOT_FOUND",
        Code::AlreadyExists => "ALREADY_EXISTS",
        Code::PermissionDenied => "PERMISSION_DENIED",
        Code::ResourceExhausted => "RESOURCE_EXHAUSTED",
        Code::FailedPrecondition => "FAILED_PRECONDITION",
        Code::Aborted => "ABORTED",
        Code::OutOfRange => "OUT_OF_RANGE",
        Code::Unimplemented => "UNIMPLEMENTED",
        Code::Internal => "INTERNAL",
        Code::Unavailable => "UNAVAILABLE",
        Code::DataLoss => "DATA_LOSS",
        Code::Unauthenticated => "UNAUTHENTICATED",
    }
}
