//! REST: JSON under `/v1`, probes, metrics. Every error is a problem of RFC 9457, also those of paths and methods.

mod act;
mod environments;
pub mod extract;
mod jobs;
mod observation;
mod openapi;
mod ops;
mod policies;
mod schemas;
mod sessions;
mod strict;
mod wording;

use std::panic::AssertUnwindSafe;
use std::sync::Arc;
use std::time::Instant;

use axum::extract::{MatchedPath, Request};
use axum::http::StatusCode;
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use axum::{Extension, Router};
use futures::FutureExt;
use metrics_exporter_prometheus::PrometheusHandle;
use tracing::Instrument;
use utoipa_axum::router::OpenApiRouter;

use super::errors::problem;
use super::observe::{Meters, REQUEST_ID, request_id};
use crate::service::{App, Error};

/// All of REST. A body larger than `max_body` bytes is refused.
pub fn router(app: Arc<App>, metrics: PrometheusHandle, max_body: usize) -> Router {
    let meters = Arc::new(Meters::new("http"));
    // What is not merged here is not in the document.
    let (router, document) = OpenApiRouter::with_openapi(openapi::document())
        .merge(ops::router())
        .merge(act::router())
        .merge(sessions::router())
        .merge(policies::router())
        .merge(environments::router())
        .merge(jobs::router())
        .split_for_parts();
    let description = openapi::Description::new(&document, app.jobs.settings().cpu_budget);
    router
        .fallback(|request: Request| async move { Error::not_found("endpoint", request.uri().path()).into_response() })
        .method_not_allowed_fallback(|request: Request| async move {
            let detail = format!("{} does not answer {}", request.uri().path(), request.method());
            problem(StatusCode::METHOD_NOT_ALLOWED, "method_not_allowed", detail)
        })
        .layer(Extension(extract::MaxBody(max_body)))
        .layer(Extension(metrics))
        .layer(Extension(description))
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
    let work = AssertUnwindSafe(next.run(request).instrument(span.clone())).catch_unwind();
    let answered = work.await;
    let _inside = span.enter();
    let mut response = answered.unwrap_or_else(|_| Error::internal("a handler panicked").into_response());
    response.headers_mut().insert(REQUEST_ID, id);
    // Made-up verbs are the caller's; they do not become labels.
    let verb = if response.status() == StatusCode::METHOD_NOT_ALLOWED { "other" } else { verb.as_str() };
    meters.end(begun, &format!("{verb} {path}"), response.status().as_str());
    response
}
