//! `/v1/jobs` and `/v1/checkpoints`.

mod request;
mod types;

use std::sync::Arc;

use axum::body::Body;
use axum::extract::State;
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use futures::{StreamExt, TryStreamExt};
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, ToSchema};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::extract::{self, Json, Path, Query};
use super::openapi::{BadBody, BadRequest, Conflict, Draining, NotFound};
use super::schemas;
use crate::api::errors::log_internal;
use crate::invalid::Invalid;
use crate::service::jobs::JobView;
use crate::service::keys::Caller;
use crate::service::{App, Error, PageRequest, checkpoints, jobs};
use crate::store::{JobAction, JobKind, JobState};
use crate::train_config::Algorithm;
use request::{JobContinuation, JobEdit, JobRequest};
use types::{Attempt, CSV_HEADER, Checkpoint, Job, JobSummary, add_csv};
pub(super) use types::{MetricRow, Progress};

type AppState = State<Arc<App>>;

/// The routes.
pub(super) fn router() -> OpenApiRouter<Arc<App>> {
    OpenApiRouter::new()
        .routes(routes!(submit, list))
        .routes(routes!(get, edit, delete))
        .routes(routes!(cancel))
        .routes(routes!(pause))
        .routes(routes!(resume))
        .routes(routes!(retry))
        .routes(routes!(continue_job))
        .routes(routes!(metrics))
        .routes(routes!(checkpoints))
        .routes(routes!(logs))
        .routes(routes!(result))
        .routes(routes!(checkpoint))
}

#[derive(Deserialize, IntoParams)]
#[into_params(parameter_in = Path)]
pub(super) struct JobPath {
    /// Id of the job.
    #[param(value_type = Uuid, example = "01a202d1-93be-769e-80f7-75eef9496f12")]
    pub id: String,
}

/// Submit a job
///
/// When the response arrives, the job is in the database.
#[utoipa::path(
    post, path = "/v1/jobs", operation_id = "submitJob", tag = "jobs",
    params((
        "idempotency-key" = Option<String>, Header,
        description = "A repeated request with the same key returns the existing job: 1 to 255 printable characters.",
        min_length = 1, max_length = 255, pattern = "^[!-~]([ -~]*[!-~])?$", nullable = false
    )),
    request_body = JobRequest,
    responses(
        (
            status = 201, description = "The job, new or existing.", body = Job,
            headers(
                ("location", description = "Path of the job."),
                ("idempotency-replayed", description = "`true` if the key was used before.")
            )
        ),
        BadBody, Conflict, Draining
    )
)]
async fn submit(
    State(app): AppState,
    caller: Caller,
    headers: HeaderMap,
    Json(request): Json<JobRequest>,
) -> Result<Response, Error> {
    let added = jobs::submit(&app, &caller, request.into(), idempotency_key(&headers)?).await?;
    Ok(created(added))
}

fn idempotency_key(headers: &HeaderMap) -> Result<Option<String>, Invalid> {
    const KEY: HeaderName = HeaderName::from_static("idempotency-key");
    let text = |value: &HeaderValue| value.to_str().map(str::to_owned);
    let key =
        headers.get(KEY).map(|value| text(value).map_err(|_| Invalid::new("idempotency-key", format!("{value:?}"), "ASCII")));
    key.transpose()
}

/// The response to a submission: the job, and whether it is new.
fn created((job, new): (JobView, bool)) -> Response {
    let location = (header::LOCATION, format!("/v1/jobs/{}", job.job.id));
    let replayed = (HeaderName::from_static("idempotency-replayed"), (!new).to_string());
    // The status is the one of the first response, which the caller of a retry did not receive.
    (StatusCode::CREATED, [location, replayed], axum::Json(Job::from(job))).into_response()
}

#[derive(Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
struct ListQuery {
    /// Only jobs in this state.
    #[param(nullable = false)]
    state: Option<JobState>,
    /// Only jobs of this kind.
    #[param(schema_with = request::kind, required = false)]
    kind: Option<JobKind>,
    /// Only jobs with this algorithm.
    #[param(nullable = false)]
    algorithm: Option<Algorithm>,
    /// Only jobs with this name; with `*` at the end: jobs whose names begin like this.
    #[serde(default)]
    #[param(schema_with = schemas::name_filter, required = false, example = "night-*")]
    name: String,
    /// Only jobs with all of these labels, separated by commas: `KEY=VALUE`, or `KEY` for any value.
    #[serde(default)]
    #[param(schema_with = schemas::label_filter, required = false, example = "team=a,urgent")]
    labels: String,
    /// Only jobs that the job with this id has made.
    #[serde(default, deserialize_with = "extract::job_id")]
    #[param(nullable = false)]
    parent: Option<uuid::Uuid>,
    /// Only jobs that were submitted at or after this time.
    #[serde(default, deserialize_with = "extract::time")]
    #[param(nullable = false, example = "2026-01-31T00:00:00Z")]
    created_after: Option<Timestamp>,
    /// Only jobs that were submitted before this time.
    #[serde(default, deserialize_with = "extract::time")]
    #[param(nullable = false, example = "2026-02-28T00:00:00Z")]
    created_before: Option<Timestamp>,
    /// `created`, `name`, `best:METRIC` or `last:METRIC`, after `-` in descending order; default: `-created`. Jobs without the name
    /// or the metric come last. The best value of `eval/coverage`, `eval/fairness`, `q_tot` and `env_steps_per_s` is the largest,
    /// that of all other metrics the smallest.
    #[serde(default)]
    #[param(schema_with = schemas::job_order, required = false, example = "best:eval/mean_aoi")]
    sort: String,
    /// Metrics whose best and last values each job shows, separated by commas; at most 16.
    #[serde(default)]
    #[param(schema_with = schemas::metric_names, required = false, example = "eval/mean_aoi,loss")]
    metrics: String,
    /// Maximum number of jobs. 0: 100. A page has fewer jobs if it would exceed about 1 MiB.
    #[serde(default)]
    #[param(maximum = 1000)]
    page_size: u32,
    /// `next_page_token` of the previous page.
    #[serde(default)]
    #[param(schema_with = schemas::job_token, required = false)]
    page_token: String,
}

impl From<ListQuery> for (jobs::ListRequest, PageRequest) {
    fn from(query: ListQuery) -> Self {
        let ListQuery { state, kind, algorithm, name, labels, parent, created_after, created_before, .. } = query;
        let parent = parent.map(|id| id.to_string()).unwrap_or_default();
        let ListQuery { sort, metrics, page_size: size, page_token: token, .. } = query;
        let request =
            jobs::ListRequest { state, kind, algorithm, name, labels, parent, created_after, created_before, sort, metrics };
        (request, PageRequest { size, token })
    }
}

#[derive(Serialize, ToSchema)]
struct JobPage {
    jobs: Vec<JobSummary>,
    /// Empty on the last page.
    next_page_token: String,
}

/// List summaries of jobs, newest first unless sorted otherwise
#[utoipa::path(
    get, path = "/v1/jobs", operation_id = "listJobs", tag = "jobs", params(ListQuery),
    responses((status = 200, description = "A page of jobs.", body = JobPage), BadRequest)
)]
async fn list(State(app): AppState, caller: Caller, Query(query): Query<ListQuery>) -> Result<axum::Json<JobPage>, Error> {
    let (request, page) = query.into();
    let page = jobs::list(&app, &caller, request, &page).await?.map(Into::into);
    Ok(axum::Json(JobPage { jobs: page.items, next_page_token: page.next_token }))
}

/// Get a job
#[utoipa::path(
    get, path = "/v1/jobs/{id}", operation_id = "getJob", tag = "jobs", params(JobPath),
    responses((status = 200, description = "The job.", body = Job), BadRequest, NotFound)
)]
async fn get(State(app): AppState, caller: Caller, Path(JobPath { id }): Path<JobPath>) -> Result<axum::Json<Job>, Error> {
    Ok(axum::Json(jobs::show(&app, &caller, &id).await?.into()))
}

/// Edit the name, the labels, the priority or the notes of a job, in any state
///
/// The body is a JSON merge patch (RFC 7396). The name of a job that has not ended is the policy that it will publish.
#[utoipa::path(
    patch, path = "/v1/jobs/{id}", operation_id = "editJob", tag = "jobs", params(JobPath), request_body = JobEdit,
    responses((status = 200, description = "The job.", body = Job), BadBody, NotFound)
)]
async fn edit(
    State(app): AppState,
    caller: Caller,
    Path(JobPath { id }): Path<JobPath>,
    Json(edit): Json<JobEdit>,
) -> Result<axum::Json<Job>, Error> {
    Ok(axum::Json(jobs::edit(&app, &caller, &id, edit.into()).await?.into()))
}

/// Delete a job that has ended
#[utoipa::path(
    delete, path = "/v1/jobs/{id}", operation_id = "deleteJob", tag = "jobs", params(JobPath),
    responses((status = 204, description = "The job is deleted."), BadRequest, NotFound, Conflict)
)]
async fn delete(State(app): AppState, caller: Caller, Path(JobPath { id }): Path<JobPath>) -> Result<StatusCode, Error> {
    jobs::change(&app, &caller, &id, JobAction::Delete).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// Cancel a job; a running job ends when its worker has stopped
#[utoipa::path(
    post, path = "/v1/jobs/{id}/cancel", operation_id = "cancelJob", tag = "jobs", params(JobPath),
    responses((status = 200, description = "The job.", body = Job), BadRequest, NotFound, Conflict)
)]
async fn cancel(State(app): AppState, caller: Caller, Path(JobPath { id }): Path<JobPath>) -> Result<axum::Json<Job>, Error> {
    Ok(axum::Json(jobs::change(&app, &caller, &id, JobAction::Cancel).await?.into()))
}

/// Pause a job; a running job saves a snapshot first
#[utoipa::path(
    post, path = "/v1/jobs/{id}/pause", operation_id = "pauseJob", tag = "jobs", params(JobPath),
    responses((status = 200, description = "The job.", body = Job), BadRequest, NotFound, Conflict)
)]
async fn pause(State(app): AppState, caller: Caller, Path(JobPath { id }): Path<JobPath>) -> Result<axum::Json<Job>, Error> {
    Ok(axum::Json(jobs::change(&app, &caller, &id, JobAction::Pause).await?.into()))
}

/// Put a paused job back into the queue; it continues from its snapshot
#[utoipa::path(
    post, path = "/v1/jobs/{id}/resume", operation_id = "resumeJob", tag = "jobs", params(JobPath),
    responses((status = 200, description = "The job.", body = Job), BadRequest, NotFound, Conflict, Draining)
)]
async fn resume(State(app): AppState, caller: Caller, Path(JobPath { id }): Path<JobPath>) -> Result<axum::Json<Job>, Error> {
    Ok(axum::Json(jobs::change(&app, &caller, &id, JobAction::Resume).await?.into()))
}

/// Put a failed job back into the queue; it continues from its snapshot
#[utoipa::path(
    post, path = "/v1/jobs/{id}/retry", operation_id = "retryJob", tag = "jobs", params(JobPath),
    responses((status = 200, description = "The job.", body = Job), BadRequest, NotFound, Conflict, Draining)
)]
async fn retry(State(app): AppState, caller: Caller, Path(JobPath { id }): Path<JobPath>) -> Result<axum::Json<Job>, Error> {
    Ok(axum::Json(jobs::change(&app, &caller, &id, JobAction::Retry).await?.into()))
}

/// Continue a training job that has ended, in a new job with the same configuration, name and labels
///
/// The new job begins with the snapshot of the job if that is kept (failed jobs keep theirs), or else with its last weights; `init`
/// of the new job says which.
#[utoipa::path(
    post, path = "/v1/jobs/{id}/continue", operation_id = "continueJob", tag = "jobs",
    params(
        JobPath,
        (
            "idempotency-key" = Option<String>, Header, description = "As in `submitJob`.",
            min_length = 1, max_length = 255, pattern = "^[!-~]([ -~]*[!-~])?$", nullable = false
        )
    ),
    request_body = JobContinuation,
    responses(
        (
            status = 201, description = "The new job.", body = Job,
            headers(
                ("location", description = "Path of the job."),
                ("idempotency-replayed", description = "`true` if the key was used before.")
            )
        ),
        BadBody, NotFound, Conflict, Draining
    )
)]
async fn continue_job(
    State(app): AppState,
    caller: Caller,
    Path(JobPath { id }): Path<JobPath>,
    headers: HeaderMap,
    Json(request): Json<JobContinuation>,
) -> Result<Response, Error> {
    Ok(created(jobs::continue_job(&app, &caller, &id, request.into(), idempotency_key(&headers)?).await?))
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
    #[param(schema_with = schemas::metric_name, required = false, example = "eval/mean_aoi")]
    name: Option<String>,
    #[serde(default)]
    #[param(inline)]
    format: Format,
    /// Maximum number of rows. 0: 10 000, or all rows as CSV.
    #[serde(default)]
    #[param(maximum = 100_000)]
    page_size: u32,
    /// `next_page_token` of the previous page.
    #[serde(default)]
    #[param(schema_with = schemas::metric_token, required = false)]
    page_token: String,
}

/// The token of the next page of a format that has no field for it.
const NEXT_PAGE_TOKEN: HeaderName = HeaderName::from_static("qedgix-next-page-token");

#[derive(Serialize, ToSchema)]
struct MetricPage {
    metrics: Vec<MetricRow>,
    /// Empty on the last page.
    next_page_token: String,
}

/// List the metrics of a job by name and step
#[utoipa::path(
    get, path = "/v1/jobs/{id}/metrics", operation_id = "listJobMetrics", tag = "jobs", params(JobPath, MetricsQuery),
    responses(
        (
            status = 200, description = "A page of rows.", content((MetricPage = "application/json"), (String = "text/csv")),
            headers(("qedgix-next-page-token", description = "With CSV, the token of the next page, if there is one."))
        ),
        BadRequest, NotFound
    )
)]
async fn metrics(
    State(app): AppState,
    caller: Caller,
    Path(JobPath { id }): Path<JobPath>,
    Query(query): Query<MetricsQuery>,
) -> Result<Response, Error> {
    let MetricsQuery { name, format, page_size, page_token } = query;
    let request = PageRequest { size: page_size, token: page_token };
    let page = jobs::metrics(&app, &caller, &id, name.as_deref(), &request).await?;
    if let Format::Json = format {
        let page = page.map(Into::into);
        return Ok(axum::Json(MetricPage { metrics: page.items, next_page_token: page.next_token }).into_response());
    }
    let csv_type = [(header::CONTENT_TYPE, "text/csv; charset=utf-8")];
    let mut text = CSV_HEADER.to_owned();
    add_csv(&mut text, &page.items);
    // CSV has all rows unless the request sets a page size.
    if page_size == 0 && !page.next_token.is_empty() {
        let rest = MetricsCsv { app, caller, id, name, next_token: page.next_token };
        let rest = futures::stream::try_unfold(rest, MetricsCsv::next).inspect_err(log_internal);
        let all = futures::stream::once(std::future::ready(Ok(text))).chain(rest);
        return Ok((csv_type, Body::from_stream(all)).into_response());
    }
    let mut response = (csv_type, text).into_response();
    if let Some(token) = page.next_token.parse().ok().filter(|_| !page.next_token.is_empty()) {
        response.headers_mut().insert(NEXT_PAGE_TOKEN, token);
    }
    Ok(response)
}

/// The rest of the metrics of a job as CSV. One page is in memory at a time.
struct MetricsCsv {
    app: Arc<App>,
    caller: Caller,
    id: String,
    name: Option<String>,
    /// Empty: nothing is left.
    next_token: String,
}

impl MetricsCsv {
    async fn next(mut self) -> Result<Option<(String, Self)>, Error> {
        if self.next_token.is_empty() {
            return Ok(None);
        }
        let request = PageRequest { size: 0, token: std::mem::take(&mut self.next_token) };
        self.caller.check(self.app.clock.now())?;
        let page = jobs::metrics(&self.app, &self.caller, &self.id, self.name.as_deref(), &request).await?;
        let mut text = String::new();
        add_csv(&mut text, &page.items);
        self.next_token = page.next_token;
        Ok(Some((text, self)))
    }
}

#[derive(Serialize, ToSchema)]
struct Checkpoints {
    checkpoints: Vec<Checkpoint>,
}

/// List the checkpoints of a job, oldest first
#[utoipa::path(
    get, path = "/v1/jobs/{id}/checkpoints", operation_id = "listCheckpoints", tag = "jobs", params(JobPath),
    responses((status = 200, description = "The best and the last checkpoint.", body = Checkpoints), BadRequest, NotFound)
)]
async fn checkpoints(
    State(app): AppState,
    caller: Caller,
    Path(JobPath { id }): Path<JobPath>,
) -> Result<axum::Json<Checkpoints>, Error> {
    let checkpoints = jobs::checkpoints(&app, &caller, &id).await?.into_iter().map(Into::into).collect();
    Ok(axum::Json(Checkpoints { checkpoints }))
}

#[derive(Serialize, ToSchema)]
struct Attempts {
    attempts: Vec<Attempt>,
}

/// List the attempts at a job with the last output of their workers, oldest first
#[utoipa::path(
    get, path = "/v1/jobs/{id}/logs", operation_id = "listJobLogs", tag = "jobs", params(JobPath),
    responses((status = 200, description = "All attempts.", body = Attempts), BadRequest, NotFound)
)]
async fn logs(State(app): AppState, caller: Caller, Path(JobPath { id }): Path<JobPath>) -> Result<axum::Json<Attempts>, Error> {
    let attempts = jobs::logs(&app, &caller, &id).await?.into_iter().map(Into::into).collect();
    Ok(axum::Json(Attempts { attempts }))
}

/// Get the result of a job: of an evaluation that has succeeded, the report of `qedgix evaluate --json`
///
/// Of a sweep, at any time: the states of its jobs, and the means of metrics over the seeds of each combination. Of an experiment, at
/// any time: the states of its jobs, and `report`, which is null until all have succeeded. Of a training job with `publish.alias`:
/// whether the alias moved.
#[utoipa::path(
    get, path = "/v1/jobs/{id}/result", operation_id = "getJobResult", tag = "jobs", params(JobPath),
    responses((status = 200, description = "The result.", body = Object), BadRequest, NotFound, Conflict)
)]
async fn result(
    State(app): AppState,
    caller: Caller,
    Path(JobPath { id }): Path<JobPath>,
) -> Result<axum::Json<serde_json::Value>, Error> {
    Ok(axum::Json(jobs::result(&app, &caller, &id).await?))
}

#[derive(Deserialize, IntoParams)]
#[into_params(parameter_in = Path)]
struct CheckpointPath {
    /// Id of the checkpoint.
    #[param(value_type = Uuid, example = "01a202d1-93be-769e-80f7-75eef9496f12")]
    id: String,
}

/// Download a checkpoint as safetensors
#[utoipa::path(
    get, path = "/v1/checkpoints/{id}", operation_id = "getCheckpoint", tag = "jobs", params(CheckpointPath),
    responses(
        (
            status = 200, description = "The checkpoint.", content((inline(schemas::Binary) = "application/octet-stream")),
            headers(
                ("etag", description = "SHA-256 of the bytes, in quotes."),
                ("qedgix-sha256", description = "SHA-256 of the bytes."),
                ("content-disposition", description = "Name of the file.")
            )
        ),
        BadRequest, NotFound
    )
)]
async fn checkpoint(
    State(app): AppState,
    caller: Caller,
    Path(CheckpointPath { id }): Path<CheckpointPath>,
) -> Result<Response, Error> {
    let (checkpoint, bytes) = checkpoints::get(&app, &caller, &id).await?;
    let headers = [
        (header::CONTENT_TYPE, "application/octet-stream".to_owned()),
        (header::ETAG, format!("\"{}\"", checkpoint.sha256)),
        (HeaderName::from_static("qedgix-sha256"), checkpoint.sha256.clone()),
        (header::CONTENT_DISPOSITION, format!("attachment; filename=\"{}.safetensors\"", checkpoint.id)),
    ];
    Ok((headers, bytes).into_response())
}
