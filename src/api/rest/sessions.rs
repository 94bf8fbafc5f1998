//! `/v1/sessions`.

use std::sync::Arc;

use axum::Json;
use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::IntoResponse;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, ToSchema};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::extract::{self, Path, Query};
use super::openapi::{BadBody, BadRequest, Conflict, Draining, NotFound};
use super::policies::{Paging, PolicyRef};
use super::schemas::{self, Seconds};
use crate::api::convert::request::open_session;
use crate::api::flight::{self, Constraints, Frame, Warning, World};
use crate::api::json;
use crate::service::keys::Caller;
use crate::service::{App, Error, sessions};
use crate::serving::SessionInfo;

type AppState = State<Arc<App>>;

/// The routes.
pub(super) fn router() -> OpenApiRouter<Arc<App>> {
    OpenApiRouter::new().routes(routes!(open, list)).routes(routes!(get, close))
}

#[derive(Deserialize, IntoParams)]
#[into_params(parameter_in = Path)]
struct SessionPath {
    /// Name of the session.
    #[param(example = "flight-1")]
    id: String,
}

#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(example = json!({"policy": "qedgix", "session_id": "flight-1"}))]
struct OpenSessionRequest {
    /// NAME, NAME@ALIAS or NAME:VERSION; the session keeps the version that this resolves to now.
    #[schema(schema_with = schemas::policy_spec)]
    policy: String,
    /// Empty: the server generates an id. If the session is open: with no steps and the same options, the response contains it;
    /// with a new `run_id` it is restarted; otherwise 409.
    #[serde(default)]
    #[schema(max_length = 128)]
    session_id: String,
    #[schema(min_length = 1, max_length = 128)]
    run_id: Option<String>,
    /// Seed of the random choices of the policy. Default: derived from `session_id` and `run_id`.
    #[serde(default, deserialize_with = "json::optional_integer")]
    seed: Option<u64>,
    /// Whether, where only one of two nodes of a graph reports the other, both detect each other; default: true.
    symmetric: Option<bool>,
    frame: Option<Frame>,
    world: Option<World>,
    constraints: Option<Constraints>,
}

#[derive(Debug, Serialize, ToSchema)]
struct Session {
    #[serde(rename = "session_id")]
    id: String,
    policy: PolicyRef,
    /// Number of steps in the current run.
    steps: u64,
    opened_at: Timestamp,
    /// The session expires after this time without a request.
    ttl: Seconds,
    /// Id of the API key that made it, or of the first of the keys that replaced each other; null: no key was required.
    #[schema(required = true)]
    owner: Option<String>,
    /// How the world of the session differs from the one that the policy was trained in, or made for.
    warnings: Vec<Warning>,
}

impl From<SessionInfo> for Session {
    fn from(session: SessionInfo) -> Self {
        Self {
            id: session.id,
            policy: (&session.policy).into(),
            steps: session.steps,
            opened_at: session.opened_at,
            ttl: Seconds(session.ttl),
            owner: session.owner.id().map(str::to_owned),
            warnings: session.warnings.into_iter().map(Into::into).collect(),
        }
    }
}

#[derive(Debug, Serialize, ToSchema)]
struct SessionPage {
    sessions: Vec<Session>,
    /// Empty on the last page.
    next_page_token: String,
}

/// Open a session: the server keeps the recurrent state of the fleet and pins the policy version
#[utoipa::path(
    post, path = "/v1/sessions", operation_id = "openSession", tag = "sessions", request_body = OpenSessionRequest,
    responses((status = 201, description = "The open session.", body = Session), BadBody, NotFound, Conflict, Draining)
)]
async fn open(
    State(app): AppState,
    caller: Caller,
    extract::Json(request): extract::Json<OpenSessionRequest>,
) -> Result<impl IntoResponse, Error> {
    let OpenSessionRequest { policy, session_id, run_id, seed, symmetric, frame, world, constraints } = request;
    let flight = flight::fields(frame, world, symmetric, constraints)?;
    let (policy, options) = open_session(&policy, session_id, run_id, seed, flight)?;
    let session = Session::from(sessions::open(&app, &caller, &policy, options).await?);
    Ok((StatusCode::CREATED, [(header::CACHE_CONTROL, "no-store")], Json(session)))
}

/// List open sessions by name
#[utoipa::path(
    get, path = "/v1/sessions", operation_id = "listSessions", tag = "sessions", params(Paging),
    responses((status = 200, description = "A page of sessions.", body = SessionPage), BadRequest)
)]
async fn list(State(app): AppState, caller: Caller, Query(paging): Query<Paging>) -> Result<Json<SessionPage>, Error> {
    let page = sessions::list(&app, &caller, &paging.into())?.map(Into::into);
    Ok(Json(SessionPage { sessions: page.items, next_page_token: page.next_token }))
}

/// Get a session
#[utoipa::path(
    get, path = "/v1/sessions/{id}", operation_id = "getSession", tag = "sessions", params(SessionPath),
    responses((status = 200, description = "The open session.", body = Session), BadRequest, NotFound, Conflict)
)]
async fn get(State(app): AppState, caller: Caller, Path(SessionPath { id }): Path<SessionPath>) -> Result<Json<Session>, Error> {
    Ok(Json(sessions::get(&app, &caller, &id)?.into()))
}

/// Close a session, after a step that is in progress
#[utoipa::path(
    delete, path = "/v1/sessions/{id}", operation_id = "closeSession", tag = "sessions", params(SessionPath),
    responses((status = 200, description = "The session as it ended.", body = Session), BadRequest, NotFound, Conflict)
)]
async fn close(
    State(app): AppState,
    caller: Caller,
    Path(SessionPath { id }): Path<SessionPath>,
) -> Result<Json<Session>, Error> {
    Ok(Json(sessions::close(&app, &caller, &id).await?.into()))
}
