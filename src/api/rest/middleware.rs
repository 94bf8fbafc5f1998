//! The outermost middleware of REST. It admits the request to the budget of bytes in flight, assigns the request id, opens the span, catches panics, and logs and counts the response.

use std::collections::HashMap;
use std::fmt;
use std::panic::AssertUnwindSafe;
use std::pin::Pin;
use std::sync::{Arc, PoisonError, RwLock};
use std::task::{Context, Poll};
use std::time::Instant;

use axum::body::Body;
use axum::extract::{MatchedPath, Request};
use axum::http::{Method, StatusCode};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use futures::FutureExt;
use http_body::{Body as HttpBody, Frame, SizeHint};
use metrics::{Counter, Histogram};
use tokio::runtime::Handle;
use tokio_util::task::AbortOnDropHandle;
use tracing::Instrument;

use super::v2;
use crate::api::access::{Requirement, rest_may_wait, rest_requirement};
use crate::api::body::Exchange;
use crate::api::browser;
use crate::api::errors::LogDetail;
use crate::api::is_probe;
use crate::api::request_log::{Completion, LogLimiter, REQUEST_ID, RequestIds, Severity, has_debug_span, log_request, span};
use crate::inflight::{Class, Exhausted};
use crate::service::Error;

/// The state that all requests share.
pub(super) struct Middleware {
    metrics: RouteMetrics,
    ids: RequestIds,
    log_limiter: LogLimiter,
    /// Answers the requests that may wait.
    background: Handle,
}

impl Middleware {
    pub(super) fn new(background: Handle) -> Self {
        Self { metrics: RouteMetrics::default(), ids: RequestIds::new(), log_limiter: LogLimiter::new(), background }
    }

    /// Handles one request.
    pub(super) async fn handle(self: Arc<Self>, request: Request, next: Next) -> Response {
        let started = Instant::now();
        let verb = verb(request.method());
        let matched = request.extensions().get::<MatchedPath>().cloned();
        let route = matched.as_ref().map_or("unknown", MatchedPath::as_str);
        let id = self.ids.for_request(request.headers());
        let method = MethodName { verb, route };
        let span = span(&method, has_debug_span(route), &id, request.headers());
        let is_v2 = v2::is_v2(request.uri().path());
        // Tests call the router without a connection.
        let exchange = request.extensions().get::<Arc<Exchange>>().cloned();
        let admitted = exchange.as_ref().map_or(Ok(()), |exchange| admit(exchange, &request));
        let mut response = if let Err(exhausted) = admitted {
            Error::from(exhausted).into_response()
        } else {
            let may_wait = rest_may_wait(request.method(), matched.as_ref().map(MatchedPath::as_str));
            let work = AssertUnwindSafe(next.run(request).instrument(span.clone())).catch_unwind();
            let done =
                if may_wait { AbortOnDropHandle::new(self.background.spawn(work)).await.map_err(drop) } else { Ok(work.await) };
            // A task ends without a result only with the server.
            done.ok().and_then(Result::ok).unwrap_or_else(|| Error::internal("a handler panicked").into_response())
        };
        if let Some(exchange) = exchange {
            response = held(response, exchange);
        }
        response.headers_mut().insert(REQUEST_ID, id.header());
        let (seconds, status) = (started.elapsed().as_secs_f64(), response.status());
        // Clients choose the method of a 405. It must not become a label.
        self.metrics.record(if status == StatusCode::METHOD_NOT_ALLOWED { "other" } else { verb }, route, status, seconds);
        let detail = response.extensions_mut().remove::<LogDetail>().map_or_else(String::new, |detail| detail.0);
        let (code, severity) = (status.as_str(), severity(status));
        let completion = Completion { method: &method, id: &id, code, seconds, severity, detail: &detail };
        log_request(&completion, &span, &self.log_limiter);
        let mut response = if is_v2 { v2::convert_problem(response) } else { response };
        browser::add_headers(route, response.headers_mut());
        response
    }
}

/// Admits a request to the budget of bytes in flight.
fn admit(exchange: &Exchange, request: &Request) -> Result<(), Exhausted> {
    // Only probes have a place in the reserve of connections.
    if exchange.reserved && !is_probe(request.uri().path()) {
        return Err(Exhausted);
    }
    let route = request.extensions().get::<MatchedPath>().map(MatchedPath::as_str);
    let is_open = rest_requirement(request.method(), route) == Requirement::NoKey;
    exchange.holding.admit(if is_open { Class::Open } else { Class::Main })
}

/// The response, holding its bytes until they are sent; an error if the budget has no room for them.
fn held(response: Response, exchange: Arc<Exchange>) -> Response {
    let size = response.body().size_hint().exact().unwrap_or(0) as usize;
    match exchange.holding.grow(size) {
        Ok(()) => response.map(|body| Body::new(HeldBody { body, _exchange: exchange })),
        Err(exhausted) => Error::from(exhausted).into_response(),
    }
}

/// The body of a response, which holds what its request holds until it is sent.
struct HeldBody {
    body: Body,
    _exchange: Arc<Exchange>,
}

impl HttpBody for HeldBody {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        Pin::new(&mut self.body).poll_frame(context)
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

/// Method and route in logs: `POST /v1/act`.
struct MethodName<'a> {
    verb: &'static str,
    route: &'a str,
}

impl fmt::Display for MethodName<'_> {
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

fn severity(status: StatusCode) -> Severity {
    match status {
        StatusCode::UNAUTHORIZED
        | StatusCode::FORBIDDEN
        | StatusCode::PAYLOAD_TOO_LARGE
        | StatusCode::TOO_MANY_REQUESTS
        | StatusCode::GATEWAY_TIMEOUT
        | StatusCode::INSUFFICIENT_STORAGE => Severity::Refused,
        // Sent during shutdown, which is logged on its own.
        StatusCode::SERVICE_UNAVAILABLE => Severity::Normal,
        status if status.is_server_error() => Severity::Failed,
        _ => Severity::Normal,
    }
}

/// Counters and histograms by route. The handles are kept because creating one allocates its labels.
#[derive(Default)]
struct RouteMetrics(RwLock<HashMap<String, Vec<Series>>>);

/// The metrics of one method and status on a route. A route has few, so they are searched one by one.
struct Series {
    verb: &'static str,
    status: StatusCode,
    requests: Counter,
    seconds: Histogram,
}

impl RouteMetrics {
    fn record(&self, verb: &'static str, route: &str, status: StatusCode, seconds: f64) {
        let known = self.0.read().unwrap_or_else(PoisonError::into_inner);
        if known.get(route).is_some_and(|series| record_in(series, verb, status, seconds)) {
            return;
        }
        drop(known);
        let mut known = self.0.write().unwrap_or_else(PoisonError::into_inner);
        let series = known.entry(route.to_owned()).or_default();
        if !record_in(series, verb, status, seconds) {
            let labels = [("method", verb.to_owned()), ("route", route.to_owned()), ("status", status.as_str().to_owned())];
            let requests = metrics::counter!("http_requests_total", &labels);
            let time = metrics::histogram!("http_request_duration_seconds", &labels);
            series.push(Series { verb, status, requests, seconds: time });
            record_in(series, verb, status, seconds);
        }
    }
}

/// Records a request in its series. Returns false if there is no such series yet.
fn record_in(series: &[Series], verb: &str, status: StatusCode, seconds: f64) -> bool {
    let Some(series) = series.iter().find(|series| series.status == status && series.verb == verb) else { return false };
    series.requests.increment(1);
    series.seconds.record(seconds);
    true
}
