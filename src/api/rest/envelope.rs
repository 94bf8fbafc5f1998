//! What happens around every REST request: its id and span, panics caught, its count and its time.

use std::collections::HashMap;
use std::fmt;
use std::panic::AssertUnwindSafe;
use std::sync::{Arc, PoisonError, RwLock};
use std::time::Instant;

use axum::extract::{MatchedPath, Request};
use axum::http::{Method, StatusCode};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use futures::FutureExt;
use metrics::{Counter, Histogram};
use tracing::Instrument;

use super::v2;
use crate::api::errors::Failure;
use crate::api::observe::{Ending, Ids, REQUEST_ID, Valve, Verdict, is_quiet, span, tell};
use crate::service::Error;

/// What all requests share.
pub(super) struct Shared {
    meters: Meters,
    ids: Ids,
    valve: Valve,
}

impl Shared {
    pub(super) fn new() -> Self {
        Self { meters: Meters::default(), ids: Ids::new(), valve: Valve::new() }
    }
}

/// Answers one request.
pub(super) async fn around(shared: Arc<Shared>, request: Request, next: Next) -> Response {
    let begun = Instant::now();
    let verb = verb(request.method());
    let matched = request.extensions().get::<MatchedPath>().cloned();
    let route = matched.as_ref().map_or("unknown", MatchedPath::as_str);
    let id = shared.ids.of(request.headers());
    let method = Named { verb, route };
    let span = span(&method, is_quiet(route), &id, request.headers());
    let is_v2 = v2::is_ours(request.uri().path());
    let answered = AssertUnwindSafe(next.run(request).instrument(span.clone())).catch_unwind().await;
    let mut response = answered.unwrap_or_else(|_| Error::internal("a handler panicked").into_response());
    response.headers_mut().insert(REQUEST_ID, id.header());
    let (seconds, status) = (begun.elapsed().as_secs_f64(), response.status());
    // A verb that a path does not answer is the caller's; it does not become a label.
    shared.meters.count(if status == StatusCode::METHOD_NOT_ALLOWED { "other" } else { verb }, route, status, seconds);
    let detail = response.extensions_mut().remove::<Failure>().map_or_else(String::new, |failure| failure.0);
    let ending = Ending { method: &method, id: &id, code: status.as_str(), seconds, verdict: verdict(status), detail: &detail };
    tell(&ending, &span, &shared.valve);
    if is_v2 { v2::in_our_words(response) } else { response }
}

/// As `POST /v1/act`.
struct Named<'a> {
    verb: &'static str,
    route: &'a str,
}

impl fmt::Display for Named<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {}", self.verb, self.route)
    }
}

fn verb(method: &Method) -> &'static str {
    match *method {
        Method::GET => "GET",
        Method::HEAD => "HEAD",
        Method::POST => "POST",
        Method::PUT => "PUT",
        Method::PATCH => "PATCH",
        Method::DELETE => "DELETE",
        Method::OPTIONS => "OPTIONS",
        _ => "other",
    }
}

fn verdict(status: StatusCode) -> Verdict {
    match status {
        StatusCode::UNAUTHORIZED
        | StatusCode::FORBIDDEN
        | StatusCode::PAYLOAD_TOO_LARGE
        | StatusCode::TOO_MANY_REQUESTS
        | StatusCode::GATEWAY_TIMEOUT => Verdict::Refused,
        // A server that drains is no news.
        StatusCode::SERVICE_UNAVAILABLE => Verdict::Settled,
        status if status.is_server_error() => Verdict::Fault,
        _ => Verdict::Settled,
    }
}

/// Counts and times by route. The handles of metrics are kept: making one allocates its labels.
#[derive(Default)]
struct Meters(RwLock<HashMap<String, Vec<Meter>>>);

/// Few verbs and statuses occur on a route; they are looked through.
struct Meter {
    verb: &'static str,
    status: StatusCode,
    requests: Counter,
    seconds: Histogram,
}

impl Meters {
    fn count(&self, verb: &'static str, route: &str, status: StatusCode, seconds: f64) {
        let known = self.0.read().unwrap_or_else(PoisonError::into_inner);
        if known.get(route).is_some_and(|meters| count(meters, verb, status, seconds)) {
            return;
        }
        drop(known);
        let mut known = self.0.write().unwrap_or_else(PoisonError::into_inner);
        let meters = known.entry(route.to_owned()).or_default();
        if !count(meters, verb, status, seconds) {
            let labels = [("method", verb.to_owned()), ("route", route.to_owned()), ("status", status.as_str().to_owned())];
            let requests = metrics::counter!("http_requests_total", &labels);
            let time = metrics::histogram!("http_request_duration_seconds", &labels);
            meters.push(Meter { verb, status, requests, seconds: time });
            count(meters, verb, status, seconds);
        }
    }
}

/// False where these have not occurred before.
fn count(meters: &[Meter], verb: &str, status: StatusCode, seconds: f64) -> bool {
    let Some(meter) = meters.iter().find(|meter| meter.status == status && meter.verb == verb) else { return false };
    meter.requests.increment(1);
    meter.seconds.record(seconds);
    true
}
