//! What operators ask: probes, metrics, and where things are.

use std::sync::Arc;

use axum::Json;
use axum::extract::State;
use axum::http::header;
use axum::response::IntoResponse;
use metrics_exporter_prometheus::PrometheusHandle;
use serde_json::{Value, json};

use crate::service::{App, Error};

/// Where things are.
pub(super) async fn index() -> Json<Value> {
    Json(json!({
        "name": "qedgix",
        "version": env!("CARGO_PKG_VERSION"),
        "endpoints": [
            "POST /v1/act",
            "GET|POST /v1/sessions",
            "GET|DELETE /v1/sessions/{id}",
            "GET /v1/policies",
            "GET /v1/policies/{policy}",
            "GET|POST /v1/environments",
            "GET|DELETE /v1/environments/{id}",
            "POST /v1/environments/{id}/reset",
            "POST /v1/environments/{id}/step",
            "GET|POST /v1/jobs",
            "GET|DELETE /v1/jobs/{id}",
            "GET /v2",
            "GET /v2/health/live",
            "GET /v2/health/ready",
            "GET /v2/models/{model}",
            "GET /v2/models/{model}/ready",
            "GET /v2/models/{model}/config",
            "POST /v2/models/{model}/infer",
            "POST /v2/repository/index",
            "POST /v2/repository/models/{model}/load",
            "POST /v2/repository/models/{model}/unload",
            "GET /livez",
            "GET /readyz",
            "GET /metrics",
        ],
    }))
}

/// The process answers.
pub(super) async fn live() -> &'static str {
    "ok\n"
}

/// The server can do its work.
pub(super) async fn ready(State(app): State<Arc<App>>) -> Result<&'static str, Error> {
    app.ready().await?;
    Ok("ok\n")
}

/// Prometheus text.
pub(super) fn metrics(handle: &PrometheusHandle, app: &App) -> impl IntoResponse + use<> {
    metrics::gauge!("qedgix_sessions").set(app.sessions.len() as f64);
    metrics::gauge!("qedgix_environments").set(app.environments.table().len() as f64);
    metrics::gauge!("qedgix_policy_versions").set(app.registry.len() as f64);
    ([(header::CONTENT_TYPE, "text/plain; version=0.0.4")], handle.render())
}
