//! Operations: probes, metrics, the OpenAPI document and its viewer.

use std::sync::Arc;

use axum::extract::State;
use axum::http::header;
use axum::response::{Html, IntoResponse, Response};
use axum::{Extension, Json};
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::extract::{Json as Body, Path};
use super::openapi::{BadBody, BadRequest, Description, Draining, Fault, NotFound};
use super::schemas;
use crate::api::json;
use crate::service::{App, Error, operations};

/// The routes.
pub(super) fn router() -> OpenApiRouter<Arc<App>> {
    OpenApiRouter::new()
        .routes(routes!(live))
        .routes(routes!(ready))
        .routes(routes!(metrics))
        .routes(routes!(budget, set_budget))
        .routes(routes!(openapi))
        .routes(routes!(docs))
        .routes(routes!(docs_file))
}

/// Whether the process is alive
#[utoipa::path(
    get, path = "/livez", operation_id = "live", tag = "operations",
    responses((status = 200, description = "The process is alive.", body = String, content_type = "text/plain"))
)]
async fn live() -> &'static str {
    "ok\n"
}

/// Whether the server is ready to serve
///
/// A replica also says how old its copy of the primary's policies is.
#[utoipa::path(
    get, path = "/readyz", operation_id = "ready", tag = "operations",
    responses((status = 200, description = "The server is ready.", body = String, content_type = "text/plain"), Fault, Draining)
)]
async fn ready(State(app): State<Arc<App>>) -> Result<String, Error> {
    app.ready().await?;
    let replica = app.replica.as_ref().and_then(|replica| Some((replica.primary(), replica.age(&app.clock)?.as_secs())));
    Ok(match replica {
        Some((primary, age)) => format!("ok\nreplica of {primary}, whose policies it had {age} s ago\n"),
        None => "ok\n".to_owned(),
    })
}

/// The CPU budget of training.
#[derive(Serialize, ToSchema)]
struct Budget {
    /// Threads that all running jobs may use together.
    threads: usize,
    /// Threads that running jobs use; more than `threads` while a smaller budget is not reached yet.
    threads_busy: usize,
}

impl From<operations::Budget> for Budget {
    fn from(operations::Budget { threads, threads_busy }: operations::Budget) -> Self {
        Self { threads, threads_busy }
    }
}

#[derive(Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(example = json!({"threads": 2}))]
struct BudgetChange {
    /// Threads that all running jobs may use together.
    #[serde(deserialize_with = "json::integer")]
    #[schema(minimum = 1, maximum = 4096)]
    threads: usize,
}

/// Get the CPU budget of training
#[utoipa::path(
    get, path = "/v1/server/budget", operation_id = "getBudget", tag = "operations",
    responses((status = 200, description = "The budget, and what is used of it.", body = Budget))
)]
async fn budget(State(app): State<Arc<App>>) -> Json<Budget> {
    Json(operations::budget(&app).into())
}

/// Change the CPU budget of training until the server stops
///
/// Jobs that run stay: a smaller budget is reached when some of them have ended.
#[utoipa::path(
    put, path = "/v1/server/budget", operation_id = "setBudget", tag = "operations", request_body = BudgetChange,
    responses((status = 200, description = "The new budget.", body = Budget), BadBody)
)]
async fn set_budget(
    State(app): State<Arc<App>>,
    Body(BudgetChange { threads }): Body<BudgetChange>,
) -> Result<Json<Budget>, Error> {
    Ok(Json(operations::set_budget(&app, threads)?.into()))
}

/// Metrics for Prometheus
#[utoipa::path(
    get, path = "/metrics", operation_id = "metrics", tag = "operations",
    responses((status = 200, description = "Prometheus text, version 0.0.4.", body = String, content_type = "text/plain"))
)]
async fn metrics(State(app): State<Arc<App>>, Extension(render): Extension<fn() -> String>) -> impl IntoResponse {
    // Gauges are computed at scrape time.
    let metrics = operations::server_metrics(&app).await;
    for (name, value) in [
        ("qedgix_ready", usize::from(metrics.ready)),
        ("qedgix_database_writable", usize::from(metrics.database_writable)),
        ("qedgix_sessions", metrics.sessions),
        ("qedgix_session_memory_bytes", metrics.session_memory),
        ("qedgix_environments", metrics.environments),
        ("qedgix_policy_versions", metrics.policy_versions),
        ("qedgix_policy_memory_bytes", metrics.policy_memory),
        ("qedgix_engine_queue_depth", metrics.engine_queue),
        ("qedgix_training_threads_busy", metrics.threads_busy),
        ("qedgix_training_threads", metrics.threads),
        ("qedgix_job_watchers", metrics.watchers),
    ] {
        metrics::gauge!(name).set(value as f64);
    }
    metrics::counter!("qedgix_policy_loads_total").absolute(metrics.policy_loads);
    if let Some(age) = metrics.replica_age {
        metrics::gauge!("qedgix_replica_age_seconds").set(age.as_secs_f64());
    }
    if let Some(missing) = metrics.replica_missing {
        metrics::gauge!("qedgix_replica_missing_versions").set(missing as f64);
    }
    for (state, jobs) in metrics.jobs {
        metrics::gauge!("qedgix_jobs", "state" => state.as_str()).set(jobs as f64);
    }
    ([(header::CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], render())
}

/// The OpenAPI document
#[utoipa::path(
    get, path = "/openapi.json", operation_id = "openapi", tag = "operations",
    responses((status = 200, description = "The OpenAPI 3.1 document.", body = Object))
)]
async fn openapi(Extension(description): Extension<Description>) -> impl IntoResponse {
    ([(header::CONTENT_TYPE, "application/json")], description.document)
}

/// The page of the viewer, whose files are built into the program.
const PAGE: &str = r#"<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Qedgix</title>
<link rel="icon" href="docs/favicon-32x32.png">
<link rel="stylesheet" href="docs/swagger-ui.css">
<div id="swagger-ui"></div>
<script src="docs/swagger-ui-bundle.js"></script>
<script src="docs/swagger-ui-standalone-preset.js"></script>
<script src="docs/swagger-initializer.js"></script>
</html>
"#;

/// The viewer of the OpenAPI document
#[utoipa::path(
    get, path = "/docs", operation_id = "docs", tag = "operations",
    responses((status = 200, description = "The viewer, as HTML.", body = String, content_type = "text/html"))
)]
async fn docs() -> Html<&'static str> {
    Html(PAGE)
}

/// A file of the viewer
#[utoipa::path(
    get, path = "/docs/{file}", operation_id = "docsFile", tag = "operations",
    params(("file" = String, Path, description = "Name of the file.", example = "swagger-ui.css")),
    responses(
        (status = 200, description = "The file.", content(
            (String = "text/css"), (String = "text/javascript"), (String = "text/html"), (inline(schemas::Binary) = "image/png")
        )),
        BadRequest, NotFound, Fault
    )
)]
async fn docs_file(Path(file): Path<String>) -> Result<Response, Error> {
    let config = utoipa_swagger_ui::Config::new(["openapi.json"]).validator_url("none");
    let found = utoipa_swagger_ui::serve(&file, Arc::new(config)).map_err(|e| Error::internal(e.to_string()))?;
    let found = found.ok_or_else(|| Error::not_found("file", file))?;
    Ok(([(header::CONTENT_TYPE, found.content_type)], found.bytes.into_owned()).into_response())
}
