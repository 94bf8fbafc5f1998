//! What both transports tell of every request: an id, a span, a count and a time.

use std::collections::HashMap;
use std::sync::{PoisonError, RwLock};
use std::time::Instant;

use axum::http::{HeaderMap, HeaderName, HeaderValue};
use metrics::{Counter, Histogram};
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

/// Counts and times of one transport. The handles of metrics are kept: making one allocates its labels.
pub(super) struct Meters {
    transport: &'static str,
    methods: RwLock<HashMap<String, Meter>>,
}

struct Meter {
    seconds: Histogram,
    /// Few codes occur; they are looked through.
    codes: Vec<(String, Counter)>,
}

impl Meters {
    pub(super) fn new(transport: &'static str) -> Self {
        Self { transport, methods: RwLock::default() }
    }

    /// Counts a request that began at `begun` under a method of bounded variety.
    pub(super) fn end(&self, begun: Instant, method: &str, code: &str) {
        let seconds = begun.elapsed().as_secs_f64();
        tracing::debug!(method, code, seconds, "answered");
        let known = self.methods.read().unwrap_or_else(PoisonError::into_inner);
        if known.get(method).is_some_and(|meter| meter.count(code, seconds)) {
            return;
        }
        drop(known);
        let mut methods = self.methods.write().unwrap_or_else(PoisonError::into_inner);
        let meter = methods.entry(method.to_owned()).or_insert_with(|| Meter {
            seconds: metrics::histogram!("qedgix_request_seconds", "transport" => self.transport, "method" => method.to_owned()),
            codes: Vec::new(),
        });
        if !meter.count(code, seconds) {
            let (method, name) = (method.to_owned(), code.to_owned());
            let counter =
                metrics::counter!("qedgix_requests_total", "transport" => self.transport, "method" => method, "code" => name);
            meter.codes.push((code.to_owned(), counter));
            meter.count(code, seconds);
        }
    }
}

impl Meter {
    /// False if the code is new.
    fn count(&self, code: &str, seconds: f64) -> bool {
        let Some((_, counter)) = self.codes.iter().find(|(known, _)| known == code) else { return false };
        counter.increment(1);
        self.seconds.record(seconds);
        true
    }
}
