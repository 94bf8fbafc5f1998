//! Request ids, spans and log lines of both transports.
//!
//! `Act` is fast: its span exists only if a subscriber enables it, a request id is a number until it is written, and metric
//! handles are kept.

mod log_limiter;

use std::fmt;
use std::sync::atomic::{AtomicU64, Ordering};

use axum::http::{HeaderMap, HeaderName, HeaderValue};
use opentelemetry::propagation::Extractor;
use tracing::Span;
use tracing_opentelemetry::OpenTelemetrySpanExt;

pub(super) use log_limiter::LogLimiter;

/// Header with the id of a request. The server uses the id of the client, if there is one.
pub(super) const REQUEST_ID: HeaderName = HeaderName::from_static("x-request-id");

/// Methods and routes called once per slot or by monitoring. Their spans have level DEBUG, so that they cost nothing by
/// default.
const DEBUG_SPANS: &[&str] = &[
    "Act",
    "Step",
    "ModelInfer",
    "Check",
    "Report",
    "Heartbeat",
    "/v1/act",
    "/v1/environments/{id}/step",
    "/v2/models/{model}/infer",
    "/v2/models/{model}/versions/{version}/infer",
    "/livez",
    "/readyz",
    "/metrics",
];

/// Whether the span of the method or route `name` has level DEBUG.
pub(super) fn has_debug_span(name: &str) -> bool {
    DEBUG_SPANS.contains(&name)
}

/// Creates request ids: a random number per process and a counter.
pub(super) struct RequestIds {
    prefix: u64,
    next: AtomicU64,
}

impl RequestIds {
    pub(super) fn new() -> Self {
        let mut prefix = [0; 8];
        // Ids need not be secret: without a random source the time distinguishes processes well enough.
        if getrandom::fill(&mut prefix).is_err() {
            prefix = jiff::Timestamp::now().as_nanosecond().to_le_bytes()[..8].try_into().expect("8 of 16 bytes");
        }
        Self { prefix: u64::from_le_bytes(prefix), next: AtomicU64::new(0) }
    }

    /// The client's id if it is text of 1 to 128 bytes, otherwise a new one.
    pub(super) fn for_request(&self, headers: &HeaderMap) -> RequestId {
        let fits = |value: &&HeaderValue| value.len() <= 128 && value.to_str().is_ok_and(|text| !text.is_empty());
        match headers.get(REQUEST_ID).filter(fits) {
            Some(value) => RequestId::Client(value.clone()),
            None => RequestId::Generated(self.prefix, self.next.fetch_add(1, Ordering::Relaxed)),
        }
    }
}

/// The id of one request.
#[derive(Clone)]
pub(super) enum RequestId {
    /// Chosen by the client.
    Client(HeaderValue),
    /// The number of the process and of the request.
    Generated(u64, u64),
}

impl RequestId {
    /// The value of the response header.
    pub(super) fn header(&self) -> HeaderValue {
        match self {
            Self::Client(value) => value.clone(),
            Self::Generated(prefix, number) => {
                use std::io::Write;
                // 16 digits, a dash, at most 16 digits.
                let mut text = [0; 33];
                let mut rest = &mut text[..];
                write!(rest, "{prefix:016x}-{number:x}").expect("33 bytes are enough");
                let left = rest.len();
                HeaderValue::from_bytes(&text[..33 - left]).expect("digits and a dash")
            }
        }
    }
}

impl fmt::Display for RequestId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            // `RequestIds::for_request` has checked that it is text.
            Self::Client(value) => f.write_str(value.to_str().unwrap_or_default()),
            Self::Generated(prefix, number) => write!(f, "{prefix:016x}-{number:x}"),
        }
    }
}

/// The span of a request, child of the client's trace if there is one. Handlers record `key`, `session` and `policy`;
/// [`log_request`] records `code`.
pub(super) fn span(method: &dyn fmt::Display, quiet: bool, id: &RequestId, headers: &HeaderMap) -> Span {
    macro_rules! span_of_level {
        ($level:ident) => {
            tracing::span!(
                target: "qedgix::request",
                tracing::Level::$level,
                "request",
                %method,
                request_id = %id,
                key = tracing::field::Empty,
                session = tracing::field::Empty,
                policy = tracing::field::Empty,
                code = tracing::field::Empty,
                otel.name = %method,
                otel.kind = "server",
                otel.status_code = tracing::field::Empty,
            )
        };
    }
    let span = if quiet { span_of_level!(DEBUG) } else { span_of_level!(INFO) };
    if !span.is_disabled() && headers.contains_key("traceparent") {
        let parent = opentelemetry::global::get_text_map_propagator(|propagator| propagator.extract(&Headers(headers)));
        // Fails only if no traces are exported.
        let _ = span.set_parent(parent);
    }
    span
}

struct Headers<'a>(&'a HeaderMap);

impl Extractor for Headers<'_> {
    fn get(&self, key: &str) -> Option<&str> {
        self.0.get(key)?.to_str().ok()
    }

    fn keys(&self) -> Vec<&str> {
        self.0.keys().map(HeaderName::as_str).collect()
    }
}

/// How important the end of a request is to the operator.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Severity {
    /// A success, an error of the client, or a refusal during shutdown.
    Normal,
    /// Refused because of a limit, a missing permission or a deadline.
    Refused,
    /// The server failed.
    Failed,
}

/// The end of a request.
pub(super) struct Completion<'a> {
    pub(super) method: &'a dyn fmt::Display,
    pub(super) id: &'a RequestId,
    pub(super) code: &'a str,
    pub(super) seconds: f64,
    pub(super) severity: Severity,
    /// The error; empty if there is none.
    pub(super) detail: &'a dyn fmt::Display,
}

/// Logs the end of a request inside its span: failures as ERROR, refusals as WARN up to the limit of `limiter`, all others as
/// DEBUG. The access log (target `qedgix::access`) has a line for every request.
pub(super) fn log_request(completion: &Completion<'_>, span: &Span, limiter: &LogLimiter) {
    let Completion { method, id, code, seconds, severity, detail } = *completion;
    if !span.is_disabled() {
        span.record("code", code);
        if severity == Severity::Failed {
            span.record("otel.status_code", "ERROR");
        }
    }
    tracing::info!(target: "qedgix::access", %method, request_id = %id, code, seconds, "answered");
    let _inside = span.enter();
    match severity {
        Severity::Failed => {
            tracing::error!(target: "qedgix::request", %method, request_id = %id, code, seconds, error = %detail, "failed");
        }
        Severity::Refused => {
            if let Some(suppressed) = limiter.allow() {
                let suppressed = (suppressed > 0).then_some(suppressed);
                tracing::warn!(
                    target: "qedgix::request", %method, request_id = %id, code, seconds, detail = %detail, suppressed, "refused"
                );
            }
        }
        Severity::Normal => {
            tracing::debug!(target: "qedgix::request", %method, request_id = %id, code, seconds, detail = %detail, "answered");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn valid_client_ids_are_kept_and_generated_ids_are_distinct() {
        let ids = RequestIds::new();
        let id_for = |value: &[u8]| {
            let headers = HeaderMap::from_iter([(REQUEST_ID, HeaderValue::from_bytes(value).unwrap())]);
            ids.for_request(&headers)
        };
        assert_eq!(id_for(b"mission 7/3").to_string(), "mission 7/3");
        assert_eq!(id_for(b"mission 7/3").header(), "mission 7/3");
        let long = vec![b'x'; 129];
        let generated = [id_for(b""), id_for(&long), id_for(b"caf\xe9"), ids.for_request(&HeaderMap::new())];
        let texts: std::collections::BTreeSet<_> = generated.iter().map(ToString::to_string).collect();
        assert_eq!(texts.len(), generated.len(), "{texts:?}");
        for id in &generated {
            assert_eq!(id.header(), id.to_string());
        }
        assert_eq!(RequestId::Generated(u64::MAX, u64::MAX).header().len(), 33);
    }
}
