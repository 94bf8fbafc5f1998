//! `/v1/jobs/{id}/events`: what happens to a job, as server-sent events.

use std::convert::Infallible;
use std::future::ready;
use std::sync::Arc;

use axum::extract::State;
use axum::http::{Extensions, HeaderMap, HeaderName, HeaderValue, StatusCode};
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use futures::{StreamExt, TryStreamExt};
use serde::Deserialize;
use utoipa::{IntoParams, ToSchema};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::extract::{Path, Query};
use super::openapi::{BadRequest, Draining, NotFound};
use crate::api::auth::StreamCaller;
use crate::api::convert::events::EventView;
use crate::api::errors::log_internal;
use crate::invalid::Invalid;
use crate::service::{App, Error, events};
use crate::store::JobEvent;

/// The route.
pub(super) fn router() -> OpenApiRouter<Arc<App>> {
    OpenApiRouter::new().routes(routes!(follow))
}

#[derive(Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
struct FollowQuery {
    /// Events behind this one; 0: from the first.
    #[serde(default)]
    after: u64,
}

/// One event of the stream.
#[derive(ToSchema)]
#[schema(as = ServerSentEvent)]
#[expect(dead_code, reason = "written by axum; this is its documentation")]
struct Sent {
    #[schema(pattern = "^[0-9]+$")]
    id: String,
    event: Name,
    /// JSON: `{state, attempt, reason, at}`, or `{metrics}` with rows as `listJobMetrics` has them.
    #[schema(content_media_type = "application/json")]
    data: String,
}

/// What an event is about.
#[derive(ToSchema)]
#[schema(as = EventName, rename_all = "lowercase")]
#[expect(dead_code, reason = "written by axum; this is its documentation")]
enum Name {
    State,
    Metrics,
}

/// What browsers say when they come back.
const LAST_EVENT_ID: HeaderName = HeaderName::from_static("last-event-id");
/// Proxies are asked not to collect events before they pass them on.
const UNBUFFERED: (HeaderName, HeaderValue) = (HeaderName::from_static("x-accel-buffering"), HeaderValue::from_static("no"));

/// Follow a job behind the last event that the caller has seen
///
/// The stream ends when the job has, when the server drains, or on a fault; a caller that comes back for more than there will
/// ever be is told so by 204, which ends its trying.
#[utoipa::path(
    get,
    path = "/v1/jobs/{id}/events",
    operation_id = "followJob",
    tag = "jobs",
    params(
        ("id" = Uuid, Path, description = "Id of the job."),
        FollowQuery,
        ("last-event-id" = Option<u64>, Header, description = "Instead of `after`: the last event that was seen.", nullable = false)
    ),
    responses(
        (status = 200, description = "Events as they happen.", body = Sent, content_type = "text/event-stream"),
        (status = 204, description = "The job has ended, and its last event was seen."),
        BadRequest, NotFound, Draining
    )
)]
async fn follow(
    State(app): State<Arc<App>>,
    Path(id): Path<String>,
    Query(query): Query<FollowQuery>,
    headers: HeaderMap,
    extensions: Extensions,
) -> Result<Response, Error> {
    let after = match headers.get(LAST_EVENT_ID) {
        None => query.after,
        Some(value) => value
            .to_str()
            .ok()
            .and_then(|text| text.parse().ok())
            .ok_or_else(|| Invalid::new("last-event-id", format!("{value:?}"), "the id of an event of this job"))?,
    };
    let watch = events::watch(&app, &id, after).await?;
    if watch.has_ended() {
        return Ok(StatusCode::NO_CONTENT.into_response());
    }
    // Why a stream ends before its job is told to who comes back.
    let (live, caller) = (app.clone(), StreamCaller::new(&extensions));
    let shown = move |event| ready(caller.check(&live).and_then(|()| event_of(event)));
    let events = watch.events().and_then(shown).inspect_err(log_internal);
    let events = events.map(Result::ok).take_while(|event| ready(event.is_some())).filter_map(ready).map(Ok::<_, Infallible>);
    let heartbeat = KeepAlive::new().interval(app.watchers.heartbeat());
    Ok(([UNBUFFERED], Sse::new(events).keep_alive(heartbeat)).into_response())
}

fn event_of(event: JobEvent) -> Result<Event, Error> {
    let (id, view) = (event.id, EventView::from(event.kind));
    Event::default().id(id.to_string()).event(view.name()).json_data(&view).map_err(Error::internal)
}
