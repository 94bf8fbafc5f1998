//! REST: JSON under `/v1`, the Open Inference Protocol under `/v2`, probes, metrics. Every error is a problem of RFC 9457,
//! also those of paths and methods; under `/v2` it is what that protocol wants.

mod act;
mod environments;
pub mod extract;
mod jobs;
mod observation;
mod ops;
mod policies;
mod sessions;
mod v2;
mod wording;

use std::panic::AssertUnwindSafe;
use std::sync::Arc;
use std::time::Instant;

use axum::Router;
use axum::extract::{MatchedPath, Request, State};
use axum::http::StatusCode;
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use futures::FutureExt;
use metrics_exporter_prometheus::PrometheusHandle;
use tracing::Instrument;

use super::errors::problem;
use super::observe::{Meters, REQUEST_ID, request_id};
use crate::service::{App, Error};

/// All of REST. A body larger than `max_body` bytes is refused.
pub fn router(app: Arc<App>, metrics: PrometheusHandle, max_body: usize) -> Router {
    let meters = Arc::new(Meters::new("http"));
    Router::new()
        .route("/", get(ops::index))
        .route("/livez", get(ops::live))
        .route("/readyz", get(ops::ready))
        .route("/metrics", get(async move |State(app): State<Arc<App>>| ops::metrics(&metrics, &app)))
        .route("/v1/act", post(act::act))
        .route("/v1/sessions", post(sessions::open).get(sessions::list))
        .route("/v1/sessions/{id}", get(sessions::get).delete(sessions::close))
        .merge(policies::router())
        .merge(environments::router())
        .merge(jobs::router())
        .merge(v2::router())
        .fallback(|request: Request| async move { Error::not_found("endpoint", request.uri().path()).into_response() })
        .method_not_allowed_fallback(|request: Request| async move {
            let detail = format!("{} does not answer {}", request.uri().path(), request.method());
            problem(StatusCode::METHOD_NOT_ALLOWED, "method_not_allowed", detail)
        })
        .layer(axum::Extension(extract::MaxBody(max_body)))
        .layer(axum::middleware::from_fn(move |request, next| around(meters.clone(), request, next)))
        .with_state(app)
}

/// What happens around every request: its id, panics caught, and its count.
async fn around(meters: Arc<Meters>, request: Request, next: Next) -> Response {
    let begun = Instant::now();
    let verb = request.method().clone();
    let path = request.extensions().get::<MatchedPath>().map_or("unknown", MatchedPath::as_str).to_owned();
    let id = request_id(request.headers());
    let span = tracing::info_span!("http", %verb, path, request_id = ?id);
    let is_v2 = v2::is_ours(request.uri().path());
    let work = AssertUnwindSafe(next.run(request).instrument(span.clone())).catch_unwind();
    let answered = work.await;
    let _inside = span.enter();
    let mut response = answered.unwrap_or_else(|_| Error::internal("a handler panicked").into_response());
    if is_v2 {
        response = v2::in_our_words(response);
    }
    response.headers_mut().insert(REQUEST_ID, id);
    // Made-up verbs are the caller's; they do not become labels.
    let verb = if response.status() == StatusCode::METHOD_NOT_ALLOWED { "other" } else { verb.as_str() };
    meters.end(begun, &format!("{verb} {path}"), response.status().as_str());
    response
}
