//! `/v1/jobs/{id}/events` and `/v1/jobs/{id}/logs/events`: the events and the output of a job, as server-sent events.

use std::convert::Infallible;
use std::future::ready;
use std::sync::Arc;

use axum::extract::State;
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode};
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use futures::{StreamExt, TryStreamExt};
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, ToSchema};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::extract::{Path, Query};
use super::jobs::{JobPath, MetricRow, Progress};
use super::openapi::{BadRequest, Draining, NotFound};
use crate::api::errors::log_internal;
use crate::invalid::Invalid;
use crate::service::events::WatchedEvent;
use crate::service::jobs::LogLines;
use crate::service::keys::Caller;
use crate::service::{App, Error, events, jobs};
use crate::store::{JobEventKind, JobState};

/// The route.
pub(super) fn router() -> OpenApiRouter<Arc<App>> {
    OpenApiRouter::new().routes(routes!(follow)).routes(routes!(follow_logs))
}

#[derive(Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
struct FollowQuery {
    /// Only events with a greater id. 0: all events.
    #[serde(default)]
    after: u64,
}

/// One event of the stream.
#[derive(ToSchema)]
struct ServerSentEvent {
    #[schema(pattern = "^[0-9]+$")]
    id: String,
    event: EventName,
    /// JSON: `{state, attempt, reason, at}`, or `{metrics, progress}` with rows as in `listJobMetrics` and the progress of a job at that time.
    #[schema(content_media_type = "application/json")]
    data: String,
}

#[derive(ToSchema)]
#[schema(rename_all = "lowercase")]
enum EventName {
    State,
    Metrics,
}

/// The data of an event.
#[derive(Serialize)]
#[serde(untagged)]
enum EventData {
    State {
        state: JobState,
        /// The newest attempt at that time; 0: none.
        attempt: u32,
        reason: Option<String>,
        at: Timestamp,
    },
    Metrics {
        metrics: Vec<MetricRow>,
        progress: Option<Progress>,
    },
}

impl TryFrom<WatchedEvent> for ServerSentEvent {
    type Error = Error;

    fn try_from(WatchedEvent { event, progress }: WatchedEvent) -> Result<Self, Error> {
        let progress = progress.map(Into::into);
        let (name, data) = match event.kind {
            JobEventKind::State { state, attempt, reason, at } => {
                (EventName::State, EventData::State { state, attempt, reason, at })
            }
            JobEventKind::Metrics(rows) => {
                (EventName::Metrics, EventData::Metrics { metrics: rows.into_iter().map(Into::into).collect(), progress })
            }
        };
        let data = serde_json::to_string(&data).map_err(Error::internal)?;
        Ok(Self { id: event.id.to_string(), event: name, data })
    }
}

impl From<ServerSentEvent> for Event {
    fn from(event: ServerSentEvent) -> Self {
        let name = match event.event {
            EventName::State => "state",
            EventName::Metrics => "metrics",
        };
        Self::default().id(event.id).event(name).data(event.data)
    }
}

/// Header of browsers that resume a stream: the id of the last event received.
const LAST_EVENT_ID: HeaderName = HeaderName::from_static("last-event-id");
/// Header that disables the buffering of events in proxies.
const UNBUFFERED: (HeaderName, HeaderValue) = (HeaderName::from_static("x-accel-buffering"), HeaderValue::from_static("no"));

/// Follow a job: every change of its state and every metric, in order
///
/// The stream ends when the job has ended, when the server drains, or on an internal error. If the caller has already received
/// the last event of a job that has ended, the response is 204, so that browsers do not reconnect.
#[utoipa::path(
    get, path = "/v1/jobs/{id}/events", operation_id = "followJob", tag = "jobs",
    params(
        JobPath, FollowQuery,
        ("last-event-id" = Option<u64>, Header, description = "Replaces `after`: the id of the last event received.", nullable = false)
    ),
    responses(
        (status = 200, description = "Events as they happen.", content((ServerSentEvent = "text/event-stream"))),
        (status = 204, description = "The job has ended, and the caller has received its last event."),
        BadRequest, NotFound, Draining
    )
)]
async fn follow(
    State(app): State<Arc<App>>,
    caller: Caller,
    Path(JobPath { id }): Path<JobPath>,
    Query(query): Query<FollowQuery>,
    headers: HeaderMap,
) -> Result<Response, Error> {
    let after = match headers.get(LAST_EVENT_ID) {
        None => query.after,
        Some(value) => value
            .to_str()
            .ok()
            .and_then(|text| text.parse().ok())
            .ok_or_else(|| Invalid::new("last-event-id", format!("{value:?}"), "the id of an event of this job"))?,
    };
    let watch = events::watch(&app, &caller, &id, after).await?;
    if watch.has_ended() {
        return Ok(StatusCode::NO_CONTENT.into_response());
    }
    // An error ends the stream. If the caller reconnects, the response contains the error.
    let clock = app.clock.clone();
    let to_event = move |event| ready(caller.check(clock.now()).and_then(|()| ServerSentEvent::try_from(event)));
    let events = watch.events().and_then(to_event).inspect_err(log_internal);
    let events = events.map(Result::ok).take_while(|event| ready(event.is_some())).filter_map(ready);
    let events = events.map(|event| Ok::<_, Infallible>(Event::from(event)));
    let heartbeat = KeepAlive::new().interval(app.watchers.heartbeat());
    Ok(([UNBUFFERED], Sse::new(events).keep_alive(heartbeat)).into_response())
}

/// One event of the stream of output.
#[derive(ToSchema)]
#[allow(dead_code, reason = "describes the events in the document")]
struct OutputEvent {
    event: OutputEventName,
    /// JSON: `{attempt, text}`, where `text` has one or more lines.
    #[schema(content_media_type = "application/json")]
    data: String,
}

#[derive(ToSchema)]
#[schema(rename_all = "lowercase")]
#[allow(dead_code, reason = "describes the events in the document")]
enum OutputEventName {
    Output,
}

#[derive(Serialize)]
struct Output {
    attempt: u32,
    text: String,
}

/// Follow the output of a job: that of its newest attempt so far, then every line that arrives
///
/// The stream goes on with the next attempt, and ends when the job has ended, when the server drains, or on an internal error.
#[utoipa::path(
    get, path = "/v1/jobs/{id}/logs/events", operation_id = "followJobLogs", tag = "jobs", params(JobPath),
    responses(
        (status = 200, description = "Output as it arrives.", content((OutputEvent = "text/event-stream"))),
        BadRequest, NotFound, Draining
    )
)]
async fn follow_logs(
    State(app): State<Arc<App>>,
    caller: Caller,
    Path(JobPath { id }): Path<JobPath>,
) -> Result<Response, Error> {
    let clock = app.clock.clone();
    let lines = jobs::follow_logs(&app, &caller, &id).await?;
    let to_event = move |LogLines { attempt, text }| {
        let data = serde_json::to_string(&Output { attempt, text }).map_err(Error::internal);
        ready(caller.check(clock.now()).and(data).map(|data| Event::default().event("output").data(data)))
    };
    let events = lines.and_then(to_event).inspect_err(log_internal);
    let events = events.map(Result::ok).take_while(|event| ready(event.is_some())).filter_map(ready).map(Ok::<_, Infallible>);
    let heartbeat = KeepAlive::new().interval(app.watchers.heartbeat());
    Ok(([UNBUFFERED], Sse::new(events).keep_alive(heartbeat)).into_response())
}
