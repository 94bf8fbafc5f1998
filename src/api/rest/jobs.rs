//! `/v1/jobs` and `/v1/checkpoints`.

use std::sync::Arc;

use axum::extract::State;
use axum::http::{HeaderMap, HeaderName, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use utoipa::{IntoParams, ToSchema};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;
use uuid::Uuid;

use super::extract::{Json, Path, Query};
use super::openapi::{BadBody, BadRequest, Conflict, Draining, NotFound};
use super::schemas;
use crate::api::convert::jobs::{AttemptView, CheckpointView, JobRequest, JobView, MetricView, SummaryView, to_csv};
use crate::invalid::Invalid;
use crate::service::{App, Error, PageRequest, checkpoints, jobs};
use crate::store::{Job, JobAction, JobState};

type Shared = State<Arc<App>>;

/// The routes.
pub(super) fn router() -> OpenApiRouter<Arc<App>> {
    OpenApiRouter::new()
        .routes(routes!(submit, list))
        .routes(routes!(one, delete))
        .routes(routes!(cancel))
        .routes(routes!(pause))
        .routes(routes!(resume))
        .routes(routes!(metrics))
        .routes(routes!(checkpoints))
        .routes(routes!(logs))
        .routes(routes!(checkpoint))
}

/// A job in a path.
#[derive(IntoParams)]
#[into_params(parameter_in = Path)]
#[expect(dead_code, reason = "read as text; this is its documentation")]
struct Id {
    /// Id of the job.
    #[param(example = "01a202d1-93be-769e-80f7-75eef9496f12")]
    id: Uuid,
}

/// Put a job into the queue; what is answered is on the disk
#[utoipa::path(
    post,
    path = "/v1/jobs",
    operation_id = "submitJob",
    tag = "jobs",
    params((
        "idempotency-key" = Option<String>, Header,
        description = "The same key with the same job is the same job, however often it is sent: 1 to 255 printable characters.",
        min_length = 1, max_length = 255, pattern = "^[!-~]([ -~]*[!-~])?$", nullable = false
    )),
    request_body = JobRequest,
    responses(
        (
            status = 201, description = "It is in the queue, or was already: the same answer.", body = JobView,
            headers(
                ("location", description = "Where it is."),
                ("idempotency-replayed", description = "`true` if the key was used before.")
            )
        ),
        BadBody, Conflict, Draining
    )
)]
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
    Ok((StatusCode::CREATED, [location, replayed], shown(job)).into_response())
}

fn shown(job: Job) -> Response {
    axum::Json(JobView::from(job)).into_response()
}

#[derive(Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
struct ListQuery {
    /// Only those in this state.
    #[param(nullable = false)]
    state: Option<JobState>,
    /// At most this many jobs; 0: 100. A page ends early before it exceeds about 1 MiB.
    #[serde(default)]
    #[param(maximum = 1000)]
    page_size: u32,
    /// `next_page_token` of the previous page.
    #[serde(default)]
    #[param(value_type = schemas::NumberToken, inline, required = false)]
    page_token: String,
}

#[derive(Serialize, ToSchema)]
struct JobPage {
    jobs: Vec<SummaryView>,
    /// Empty on the last page.
    next_page_token: String,
}

/// List summaries of jobs, newest first
#[utoipa::path(
    get,
    path = "/v1/jobs",
    operation_id = "listJobs",
    tag = "jobs",
    params(ListQuery),
    responses((status = 200, description = "A page of jobs.", body = JobPage), BadRequest)
)]
async fn list(State(app): Shared, Query(query): Query<ListQuery>) -> Result<axum::Json<JobPage>, Error> {
    let ListQuery { state, page_size, page_token } = query;
    let page = jobs::list(&app, state, &PageRequest { size: page_size, token: page_token }).await?.map(Into::into);
    Ok(axum::Json(JobPage { jobs: page.items, next_page_token: page.next_token }))
}

/// One job
#[utoipa::path(
    get,
    path = "/v1/jobs/{id}",
    operation_id = "getJob",
    tag = "jobs",
    params(Id),
    responses((status = 200, description = "As it stands.", body = JobView), BadRequest, NotFound)
)]
async fn one(State(app): Shared, Path(id): Path<String>) -> Result<Response, Error> {
    Ok(shown(jobs::get(&app, &id).await?))
}

/// Forget a job that has ended
#[utoipa::path(
    delete,
    path = "/v1/jobs/{id}",
    operation_id = "deleteJob",
    tag = "jobs",
    params(Id),
    responses((status = 204, description = "It is forgotten."), BadRequest, NotFound, Conflict)
)]
async fn delete(State(app): Shared, Path(id): Path<String>) -> Result<StatusCode, Error> {
    jobs::change(&app, &id, JobAction::Delete).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// End a job; a running one is cancelled as soon as its worker has stopped
#[utoipa::path(
    post,
    path = "/v1/jobs/{id}/cancel",
    operation_id = "cancelJob",
    tag = "jobs",
    params(Id),
    responses((status = 200, description = "As it stands now.", body = JobView), BadRequest, NotFound, Conflict)
)]
async fn cancel(State(app): Shared, Path(id): Path<String>) -> Result<Response, Error> {
    Ok(shown(jobs::change(&app, &id, JobAction::Cancel).await?))
}

/// Take a job off the machine; a running one is snapshotted first
#[utoipa::path(
    post,
    path = "/v1/jobs/{id}/pause",
    operation_id = "pauseJob",
    tag = "jobs",
    params(Id),
    responses((status = 200, description = "As it stands now.", body = JobView), BadRequest, NotFound, Conflict)
)]
async fn pause(State(app): Shared, Path(id): Path<String>) -> Result<Response, Error> {
    Ok(shown(jobs::change(&app, &id, JobAction::Pause).await?))
}

/// Put a paused job back into the queue, to go on where it was
#[utoipa::path(
    post,
    path = "/v1/jobs/{id}/resume",
    operation_id = "resumeJob",
    tag = "jobs",
    params(Id),
    responses((status = 200, description = "As it stands now.", body = JobView), BadRequest, NotFound, Conflict, Draining)
)]
async fn resume(State(app): Shared, Path(id): Path<String>) -> Result<Response, Error> {
    Ok(shown(jobs::change(&app, &id, JobAction::Resume).await?))
}

#[derive(Clone, Copy, Default, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
enum Format {
    #[default]
    Json,
    Csv,
}

#[derive(Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
struct MetricsQuery {
    /// Only this metric.
    #[param(nullable = false, example = "eval/mean_aoi")]
    name: Option<String>,
    #[serde(default)]
    #[param(inline)]
    format: Format,
    /// At most this many rows; 0: 10 000, or all rows as CSV.
    #[serde(default)]
    #[param(maximum = 100_000)]
    page_size: u32,
    /// `next_page_token` of the previous page.
    #[serde(default)]
    #[param(value_type = schemas::MetricToken, inline, required = false)]
    page_token: String,
}

/// The token of the next page of a format that has no field for it.
const NEXT_PAGE_TOKEN: HeaderName = HeaderName::from_static("qedgix-next-page-token");

#[derive(Serialize, ToSchema)]
struct MetricPage {
    metrics: Vec<MetricView>,
    /// Empty on the last page.
    next_page_token: String,
}

/// List the metrics of a job by name and step
#[utoipa::path(
    get,
    path = "/v1/jobs/{id}/metrics",
    operation_id = "listJobMetrics",
    tag = "jobs",
    params(Id, MetricsQuery),
    responses(
        (
            status = 200, description = "A page of rows.", content((MetricPage = "application/json"), (String = "text/csv")),
            headers(("qedgix-next-page-token", description = "With CSV, the token of the next page, if there is one."))
        ),
        BadRequest, NotFound
    )
)]
async fn metrics(State(app): Shared, Path(id): Path<String>, Query(query): Query<MetricsQuery>) -> Result<Response, Error> {
    let MetricsQuery { name, format, page_size, page_token } = query;
    let mut request = PageRequest { size: page_size, token: page_token };
    let mut page = jobs::metrics(&app, &id, name.as_deref(), &request).await?;
    if let Format::Json = format {
        let page = page.map(Into::into);
        return Ok(axum::Json(MetricPage { metrics: page.items, next_page_token: page.next_token }).into_response());
    }
    // CSV has all rows unless the request sets a page size.
    while page_size == 0 && !page.next_token.is_empty() {
        request.token = std::mem::take(&mut page.next_token);
        let more = jobs::metrics(&app, &id, name.as_deref(), &request).await?;
        page.items.extend(more.items);
        page.next_token = more.next_token;
    }
    let mut response = ([(header::CONTENT_TYPE, "text/csv; charset=utf-8")], to_csv(&page.items)).into_response();
    if let Some(token) = page.next_token.parse().ok().filter(|_| !page.next_token.is_empty()) {
        response.headers_mut().insert(NEXT_PAGE_TOKEN, token);
    }
    Ok(response)
}

#[derive(Serialize, ToSchema)]
struct Checkpoints {
    checkpoints: Vec<CheckpointView>,
}

/// Checkpoints of a job, oldest first
#[utoipa::path(
    get,
    path = "/v1/jobs/{id}/checkpoints",
    operation_id = "listCheckpoints",
    tag = "jobs",
    params(Id),
    responses((status = 200, description = "The best and the last.", body = Checkpoints), BadRequest, NotFound)
)]
async fn checkpoints(State(app): Shared, Path(id): Path<String>) -> Result<axum::Json<Checkpoints>, Error> {
    let checkpoints = jobs::checkpoints(&app, &id).await?.into_iter().map(Into::into).collect();
    Ok(axum::Json(Checkpoints { checkpoints }))
}

#[derive(Serialize, ToSchema)]
struct Attempts {
    attempts: Vec<AttemptView>,
}

/// Attempts at a job with the last output of their workers, oldest first
#[utoipa::path(
    get,
    path = "/v1/jobs/{id}/logs",
    operation_id = "listJobLogs",
    tag = "jobs",
    params(Id),
    responses((status = 200, description = "All of them.", body = Attempts), BadRequest, NotFound)
)]
async fn logs(State(app): Shared, Path(id): Path<String>) -> Result<axum::Json<Attempts>, Error> {
    let attempts = jobs::logs(&app, &id).await?.into_iter().map(Into::into).collect();
    Ok(axum::Json(Attempts { attempts }))
}

/// A checkpoint, as safetensors
#[utoipa::path(
    get,
    path = "/v1/checkpoints/{id}",
    operation_id = "getCheckpoint",
    tag = "jobs",
    params(("id" = Uuid, Path, description = "Id of the checkpoint.", example = "01a202d1-93be-769e-80f7-75eef9496f12")),
    responses(
        (
            status = 200, description = "Its bytes.", body = inline(schemas::Bytes), content_type = "application/octet-stream",
            headers(
                ("etag", description = "SHA-256 of the bytes, in quotes."),
                ("qedgix-sha256", description = "SHA-256 of the bytes."),
                ("content-disposition", description = "A name for the file.")
            )
        ),
        BadRequest, NotFound
    )
)]
async fn checkpoint(State(app): Shared, Path(id): Path<String>) -> Result<Response, Error> {
    let (checkpoint, bytes) = checkpoints::get(&app, &id).await?;
    let headers = [
        (header::CONTENT_TYPE, "application/octet-stream".to_owned()),
        (header::ETAG, format!("\"{}\"", checkpoint.sha256)),
        (HeaderName::from_static("qedgix-sha256"), checkpoint.sha256.clone()),
        (header::CONTENT_DISPOSITION, format!("attachment; filename=\"{}.safetensors\"", checkpoint.id)),
    ];
    Ok((headers, bytes).into_response())
}
