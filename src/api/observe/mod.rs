//! What both transports tell of every request: its id, a span, and a line where it went wrong.
//!
//! The path of an `Act` pays for none of it unless somebody listens: a span is made where a subscriber wants it, an id is
//! a number until it is written, and metrics are handles that are kept.

mod valve;

use std::fmt;
use std::sync::atomic::{AtomicU64, Ordering};

use axum::http::{HeaderMap, HeaderName, HeaderValue};
use opentelemetry::propagation::Extractor;
use tracing::Span;
use tracing_opentelemetry::OpenTelemetrySpanExt;

pub(super) use valve::Valve;

/// Names a request; taken from the caller where it says one.
pub(super) const REQUEST_ID: HeaderName = HeaderName::from_static("x-request-id");

/// What is called once per slot, and by machines that only look: its spans are for debugging, so that they cost nothing
/// otherwise.
const QUIET: &[&str] = &[
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

/// Whether the method or route `name` is one of those.
pub(super) fn is_quiet(name: &str) -> bool {
    QUIET.contains(&name)
}

/// Where ids of requests come from: what tells this process from others, and a number.
pub(super) struct Ids {
    prefix: u64,
    next: AtomicU64,
}

impl Ids {
    pub(super) fn new() -> Self {
        let mut prefix = [0; 8];
        // Without randomness the time of day tells processes apart well enough: ids are for reading.
        if getrandom::fill(&mut prefix).is_err() {
            prefix = jiff::Timestamp::now().as_nanosecond().to_le_bytes()[..8].try_into().expect("8 of 16 bytes");
        }
        Self { prefix: u64::from_le_bytes(prefix), next: AtomicU64::new(0) }
    }

    /// The caller's id if it fits a line of a log, else a new one.
    pub(super) fn of(&self, headers: &HeaderMap) -> RequestId {
        let fits = |value: &&HeaderValue| value.len() <= 128 && value.to_str().is_ok_and(|text| !text.is_empty());
        match headers.get(REQUEST_ID).filter(fits) {
            Some(value) => RequestId::Told(value.clone()),
            None => RequestId::Ours(self.prefix, self.next.fetch_add(1, Ordering::Relaxed)),
        }
    }
}

/// The id of one request.
#[derive(Clone)]
pub(super) enum RequestId {
    /// The caller's.
    Told(HeaderValue),
    /// The process and a number.
    Ours(u64, u64),
}

impl RequestId {
    /// As it is sent back.
    pub(super) fn header(&self) -> HeaderValue {
        match self {
            Self::Told(value) => value.clone(),
            Self::Ours(prefix, number) => {
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
            // Checked when it came.
            Self::Told(value) => f.write_str(value.to_str().unwrap_or_default()),
            Self::Ours(prefix, number) => write!(f, "{prefix:016x}-{number:x}"),
        }
    }
}

/// The span of a request, child of the caller's trace where it tells one. `session` and `policy` are filled in where they
/// become known, `code` at the end.
pub(super) fn span(method: &dyn fmt::Display, quiet: bool, id: &RequestId, headers: &HeaderMap) -> Span {
    macro_rules! of_level {
        ($level:ident) => {
            tracing::span!(
                target: "qedgix::request",
                tracing::Level::$level,
                "request",
                %method,
                request_id = %id,
                session = tracing::field::Empty,
                policy = tracing::field::Empty,
                code = tracing::field::Empty,
                otel.name = %method,
                otel.kind = "server",
                otel.status_code = tracing::field::Empty,
            )
        };
    }
    let span = if quiet { of_level!(DEBUG) } else { of_level!(INFO) };
    if !span.is_disabled() && headers.contains_key("traceparent") {
        let parent = opentelemetry::global::get_text_map_propagator(|propagator| propagator.extract(&Headers(headers)));
        // Refused only where nobody exports traces.
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

/// What became of a request, for who runs the server.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Verdict {
    /// Answered, or the caller's mistake, or a server that drains, which says so itself.
    Settled,
    /// Turned away: a limit, no right to ask, too late.
    Refused,
    /// A fault of the server.
    Fault,
}

/// The end of a request.
pub(super) struct Ending<'a> {
    pub(super) method: &'a dyn fmt::Display,
    pub(super) id: &'a RequestId,
    pub(super) code: &'a str,
    pub(super) seconds: f64,
    pub(super) verdict: Verdict,
    /// What was the matter; empty where nothing was.
    pub(super) detail: &'a dyn fmt::Display,
}

/// Says how a request ended, inside its span: faults as errors, refusals as warnings as long as there are not too many
/// (they come when the server has least time to write), everything else to who debugs or wants an access log.
pub(super) fn tell(ending: &Ending<'_>, span: &Span, valve: &Valve) {
    let Ending { method, id, code, seconds, verdict, detail } = *ending;
    if !span.is_disabled() {
        span.record("code", code);
        if verdict == Verdict::Fault {
            span.record("otel.status_code", "ERROR");
        }
    }
    tracing::info!(target: "qedgix::access", %method, request_id = %id, code, seconds, "answered");
    let _inside = span.enter();
    match verdict {
        Verdict::Fault => {
            tracing::error!(target: "qedgix::request", %method, request_id = %id, code, seconds, error = %detail, "failed");
        }
        Verdict::Refused => {
            if let Some(muted) = valve.pass() {
                let muted = (muted > 0).then_some(muted);
                tracing::warn!(target: "qedgix::request", %method, request_id = %id, code, seconds, detail = %detail, muted, "refused");
            }
        }
        Verdict::Settled => {
            tracing::debug!(target: "qedgix::request", %method, request_id = %id, code, seconds, detail = %detail, "answered");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ids_are_the_callers_where_they_fit_a_line_and_never_come_twice() {
        let ids = Ids::new();
        let of = |value: &[u8]| {
            let headers = HeaderMap::from_iter([(REQUEST_ID, HeaderValue::from_bytes(value).unwrap())]);
            ids.of(&headers)
        };
        assert_eq!(of(b"mission 7/3").to_string(), "mission 7/3");
        assert_eq!(of(b"mission 7/3").header(), "mission 7/3");
        let long = vec![b'x'; 129];
        let ours = [of(b""), of(&long), of(b"caf\xe9"), ids.of(&HeaderMap::new())];
        let texts: std::collections::BTreeSet<_> = ours.iter().map(ToString::to_string).collect();
        assert_eq!(texts.len(), ours.len(), "{texts:?}");
        for id in &ours {
            assert_eq!(id.header(), id.to_string());
        }
        assert_eq!(RequestId::Ours(u64::MAX, u64::MAX).header().len(), 33);
    }
}
