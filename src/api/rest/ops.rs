//! What operators ask: probes, metrics, and where things are.

use std::sync::Arc;

use axum::Json;
use axum::extract::State;
use axum::http::header;
use axum::response::IntoResponse;
use serde_json::{Value, json};

use crate::service::{App, Error, operations};

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
            "GET /v1/jobs/{id}/events",
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

/// Prometheus text. What is there is counted when it is asked for.
pub(super) async fn metrics(render: fn() -> String, app: &App) -> impl IntoResponse + use<> {
    let figures = operations::figures(app).await;
    for (name, value) in [
        ("qedgix_sessions", figures.sessions),
        ("qedgix_environments", figures.environments),
        ("qedgix_policy_versions", figures.policy_versions),
        ("qedgix_engine_queue_depth", figures.engine_queue),
        ("qedgix_training_threads_busy", figures.threads_busy),
        ("qedgix_training_threads", figures.threads),
        ("qedgix_job_watchers", figures.watchers),
    ] {
        metrics::gauge!(name).set(value as f64);
    }
    for (state, jobs) in figures.jobs {
        metrics::gauge!("qedgix_jobs", "state" => state.as_str()).set(jobs as f64);
    }
    ([(header::CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], render())
}
