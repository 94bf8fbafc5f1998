//! `/v1/jobs` and `/v1/checkpoints`.

use std::sync::Arc;

use axum::Router;
use axum::extract::State;
use axum::http::{HeaderMap, HeaderName, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::extract::{Json, Path, Query};
use crate::api::convert::jobs::{AttemptView, CheckpointView, JobView, MetricView, to_csv};
use crate::invalid::Invalid;
use crate::service::{App, Error, jobs};
use crate::store::{Job, JobState, Verb};

type Shared = State<Arc<App>>;

/// The routes.
pub fn router() -> Router<Arc<App>> {
    Router::new()
        .route("/v1/jobs", post(submit).get(list))
        .route("/v1/jobs/{id}", get(one).delete(delete))
        .route("/v1/jobs/{id}/cancel", post(cancel))
        .route("/v1/jobs/{id}/pause", post(pause))
        .route("/v1/jobs/{id}/resume", post(resume))
        .route("/v1/jobs/{id}/metrics", get(metrics))
        .route("/v1/jobs/{id}/checkpoints", get(checkpoints))
        .route("/v1/jobs/{id}/logs", get(logs))
        .route("/v1/checkpoints/{id}", get(checkpoint))
}

fn show(job: &Job) -> Response {
    axum::Json(JobView::from(job)).into_response()
}

async fn submit(State(app): Shared, headers: HeaderMap, Json(document): Json<Value>) -> Result<Response, Error> {
    const KEY: HeaderName = HeaderName::from_static("idempotency-key");
    let key = match headers.get(KEY) {
        None => None,
        Some(value) => match value.to_str() {
            Ok(key) => Some(key.to_owned()),
            Err(_) => return Err(Invalid::new("idempotency-key", format!("{value:?}"), "ASCII").into()),
        },
    };
    let (job, new) = jobs::submit(&app, document, key).await?;
    let location = (header::LOCATION, format!("/v1/jobs/{}", job.id));
    let replayed = (HeaderName::from_static("idempotency-replayed"), (!new).to_string());
    // The same answer as the first time: who repeats a request did not see it.
    Ok((StatusCode::CREATED, [location, replayed], show(&job)).into_response())
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ListQuery {
    state: Option<String>,
    #[serde(default)]
    limit: u32,
    cursor: Option<String>,
}

async fn list(State(app): Shared, Query(query): Query<ListQuery>) -> Result<Response, Error> {
    let state = query
        .state
        .map(|name| JobState::parse(&name).ok_or_else(|| Invalid::new("state", format!("{name:?}"), JobState::NAMES.join(", "))));
    let page = jobs::list(&app, state.transpose()?, query.limit, query.cursor.as_deref()).await?;
    let jobs: Vec<JobView<'_>> = page.items.iter().map(Into::into).collect();
    Ok(axum::Json(json!({"jobs": jobs, "next_cursor": page.next})).into_response())
}

async fn one(State(app): Shared, Path(id): Path<String>) -> Result<Response, Error> {
    Ok(show(&jobs::get(&app, &id).await?))
}

async fn delete(State(app): Shared, Path(id): Path<String>) -> Result<StatusCode, Error> {
    jobs::change(&app, &id, Verb::Delete).await?;
    Ok(StatusCode::NO_CONTENT)
}

async fn cancel(State(app): Shared, Path(id): Path<String>) -> Result<Response, Error> {
    Ok(show(&jobs::change(&app, &id, Verb::Cancel).await?))
}

async fn pause(State(app): Shared, Path(id): Path<String>) -> Result<Response, Error> {
    Ok(show(&jobs::change(&app, &id, Verb::Pause).await?))
}

async fn resume(State(app): Shared, Path(id): Path<String>) -> Result<Response, Error> {
    Ok(show(&jobs::change(&app, &id, Verb::Resume).await?))
}

#[derive(Clone, Copy, Default, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Format {
    #[default]
    Json,
    Csv,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct MetricsQuery {
    name: Option<String>,
    #[serde(default)]
    format: Format,
    #[serde(default)]
    limit: u32,
    cursor: Option<String>,
}

/// Behind which the next page begins, for formats without a place for it.
const NEXT_CURSOR: HeaderName = HeaderName::from_static("qedgix-next-cursor");

async fn metrics(State(app): Shared, Path(id): Path<String>, Query(query): Query<MetricsQuery>) -> Result<Response, Error> {
    let MetricsQuery { name, format, limit, cursor } = query;
    let mut page = jobs::metrics(&app, &id, name.as_deref(), limit, cursor.as_deref()).await?;
    match format {
        Format::Json => {
            let rows: Vec<MetricView> = page.items.into_iter().map(Into::into).collect();
            Ok(axum::Json(json!({"metrics": rows, "next_cursor": page.next})).into_response())
        }
        Format::Csv => {
            // A table is wanted whole, unless a limit says otherwise.
            while limit == 0
                && let Some(next) = page.next.take()
            {
                let more = jobs::metrics(&app, &id, name.as_deref(), limit, Some(&next)).await?;
                page.items.extend(more.items);
                page.next = more.next;
            }
            let mut response = ([(header::CONTENT_TYPE, "text/csv; charset=utf-8")], to_csv(&page.items)).into_response();
            if let Some(next) = page.next.and_then(|next| next.parse().ok()) {
                response.headers_mut().insert(NEXT_CURSOR, next);
            }
            Ok(response)
        }
    }
}

fn all<T: Serialize>(name: &str, items: impl IntoIterator<Item = impl Into<T>>) -> Response {
    let items: Vec<T> = items.into_iter().map(Into::into).collect();
    axum::Json(json!({name: items})).into_response()
}

async fn checkpoints(State(app): Shared, Path(id): Path<String>) -> Result<Response, Error> {
    Ok(all::<CheckpointView>("checkpoints", jobs::checkpoints(&app, &id).await?))
}

async fn logs(State(app): Shared, Path(id): Path<String>) -> Result<Response, Error> {
    Ok(all::<AttemptView>("attempts", jobs::logs(&app, &id).await?))
}

async fn checkpoint(State(app): Shared, Path(id): Path<String>) -> Result<Response, Error> {
    let (checkpoint, bytes) = jobs::checkpoint(&app, &id).await?;
    let headers = [
        (header::CONTENT_TYPE, "application/octet-stream".to_owned()),
        (header::ETAG, format!("\"{}\"", checkpoint.sha256)),
        (HeaderName::from_static("qedgix-sha256"), checkpoint.sha256.clone()),
        (header::CONTENT_DISPOSITION, format!("attachment; filename=\"{}.safetensors\"", checkpoint.id)),
    ];
    Ok((headers, bytes).into_response())
}
