//! What both transports tell of every request: an id, a span, a count and a time.

use std::time::Instant;

use axum::http::{HeaderMap, HeaderName, HeaderValue};
use uuid::Uuid;

/// Names a request; taken from the caller where it says one.
pub(super) const REQUEST_ID: HeaderName = HeaderName::from_static("x-request-id");

/// The caller's request id if it fits a line of a log, else a new one.
pub(super) fn request_id(headers: &HeaderMap) -> HeaderValue {
    let fits = |value: &&HeaderValue| value.len() <= 128 && value.to_str().is_ok_and(|text| !text.is_empty());
    headers.get(REQUEST_ID).filter(fits).cloned().unwrap_or_else(|| {
        let mut buffer = Uuid::encode_buffer();
        let text = Uuid::now_v7().hyphenated().encode_lower(&mut buffer);
        HeaderValue::from_str(text).expect("a uuid is plain ASCII")
    })
}

/// A request that is being answered.
pub(super) struct Observed {
    transport: &'static str,
    begun: Instant,
}

impl Observed {
    pub(super) fn begin(transport: &'static str) -> Self {
        Self { transport, begun: Instant::now() }
    }

    /// Counts the request under a method of bounded variety.
    pub(super) fn end(self, method: String, code: String) {
        let seconds = self.begun.elapsed().as_secs_f64();
        tracing::debug!(method, code, seconds, "answered");
        metrics::histogram!("qedgix_request_seconds", "transport" => self.transport, "method" => method.clone()).record(seconds);
        metrics::counter!("qedgix_requests_total", "transport" => self.transport, "method" => method, "code" => code)
            .increment(1);
    }
}
