//! REST: JSON under `/v1`, the Open Inference Protocol under `/v2`, probes, metrics. Every error is a problem of RFC 9457, also for
//! unknown paths and methods; under `/v2` errors have the form of that protocol.

mod act;
mod aliases;
mod dashboard;
mod decentral;
mod environments;
mod events;
pub mod extract;
mod jobs;
mod manifest;
mod middleware;
mod openapi;
mod ops;
mod policies;
mod scene_graph;
mod schemas;
mod sessions;
mod v2;

use std::sync::Arc;

use axum::extract::Request;
use axum::http::StatusCode;
use axum::response::IntoResponse;
use axum::{Extension, Router};
use tokio::runtime::Handle;
use utoipa_axum::router::OpenApiRouter;

use super::auth::authorize_rest;
use super::browser::AllowedHosts;
use super::errors::problem;
use crate::error_code::ErrorCode;
use crate::service::{App, Error};
use middleware::Middleware;

/// The router with all routes. Refuses bodies larger than `max_body` bytes. `metrics` renders the Prometheus text.
/// `hosts`: the hosts that requests may name while the server has no keys. `background` answers the requests that may wait.
pub fn router(app: Arc<App>, metrics: fn() -> String, max_body: usize, hosts: AllowedHosts, background: Handle) -> Router {
    let (auth_app, hosts, middleware) = (app.clone(), Arc::new(hosts), Arc::new(Middleware::new(background)));
    // The OpenAPI document contains the routes that are merged here.
    let (router, document) = OpenApiRouter::with_openapi(openapi::document())
        .merge(ops::router())
        .merge(dashboard::router())
        .merge(act::router())
        .merge(decentral::router())
        .merge(sessions::router())
        .merge(policies::router())
        .merge(aliases::router())
        .merge(manifest::router())
        .merge(environments::router())
        .merge(jobs::router())
        .merge(events::router())
        .split_for_parts();
    let description = openapi::Description::new(&document, app.scheduler.config().cpu_budget);
    router
        // The Open Inference Protocol has a document of its own.
        .merge(v2::router())
        .fallback(|request: Request| async move { Error::not_found("endpoint", request.uri().path()).into_response() })
        .method_not_allowed_fallback(|request: Request| async move {
            let detail = format!("{} does not support {}", request.uri().path(), request.method());
            problem(StatusCode::METHOD_NOT_ALLOWED, ErrorCode::MethodNotAllowed, detail)
        })
        .layer(Extension(extract::MaxBody(max_body)))
        .layer(Extension(metrics))
        .layer(Extension(description))
        .layer(axum::middleware::from_fn(move |request, next| authorize_rest(auth_app.clone(), hosts.clone(), request, next)))
        .layer(axum::middleware::from_fn(move |request, next| middleware.clone().handle(request, next)))
        .with_state(app)
}
