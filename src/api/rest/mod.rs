//! REST: JSON under `/v1`, the Open Inference Protocol under `/v2`, probes, metrics. Every error is a problem of RFC 9457,
//! also those of paths and methods; under `/v2` it is what that protocol wants.

mod act;
mod envelope;
mod environments;
mod events;
pub mod extract;
mod jobs;
mod observation;
mod ops;
mod policies;
mod sessions;
mod v2;
mod wording;

use std::sync::Arc;

use axum::Router;
use axum::extract::{Request, State};
use axum::http::StatusCode;
use axum::response::IntoResponse;
use axum::routing::{get, post};

use super::errors::problem;
use super::gate;
use crate::service::{App, Error};

/// All of REST. A body larger than `max_body` bytes is refused; `metrics` renders what was counted.
pub fn router(app: Arc<App>, metrics: fn() -> String, max_body: usize) -> Router {
    let (gate, shared) = (app.clone(), Arc::new(envelope::Shared::new()));
    Router::new()
        .route("/", get(ops::index))
        .route("/livez", get(ops::live))
        .route("/readyz", get(ops::ready))
        .route("/metrics", get(async move |State(app): State<Arc<App>>| ops::metrics(metrics, &app).await))
        .route("/v1/act", post(act::act))
        .route("/v1/sessions", post(sessions::open).get(sessions::list))
        .route("/v1/sessions/{id}", get(sessions::get).delete(sessions::close))
        .merge(policies::router())
        .merge(environments::router())
        .merge(jobs::router())
        .merge(v2::router())
        .route("/v1/jobs/{id}/events", get(events::follow))
        .fallback(|request: Request| async move { Error::not_found("endpoint", request.uri().path()).into_response() })
        .method_not_allowed_fallback(|request: Request| async move {
            let detail = format!("{} does not answer {}", request.uri().path(), request.method());
            problem(StatusCode::METHOD_NOT_ALLOWED, "method_not_allowed", detail)
        })
        .layer(axum::Extension(extract::MaxBody(max_body)))
        .layer(axum::middleware::from_fn(move |request, next| gate::around(gate.clone(), request, next)))
        .layer(axum::middleware::from_fn(move |request, next| envelope::around(shared.clone(), request, next)))
        .with_state(app)
}
