//! `/v1/sessions`.

use std::sync::Arc;

use axum::Json;
use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::IntoResponse;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::extract::{self, Path, Query};
use super::openapi::{BadBody, BadRequest, Conflict, Draining, NotFound};
use super::policies::Paging;
use super::schemas;
use super::wording::Session;
use crate::api::convert::request::open_session;
use crate::service::{App, Error, sessions};
use crate::wire::v1;

/// The routes.
pub(super) fn router() -> OpenApiRouter<Arc<App>> {
    OpenApiRouter::new().routes(routes!(open, list)).routes(routes!(one, close))
}

#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = OpenSessionRequest, example = json!({"policy": "qedgix", "session_id": "flight-1"}))]
struct Open {
    /// NAME, NAME@ALIAS or NAME:VERSION; the session stays with the version that this means now.
    #[schema(value_type = schemas::PolicySpec)]
    policy: String,
    /// Chosen by the server when left empty.
    #[serde(default)]
    #[schema(max_length = 128)]
    session_id: String,
    #[schema(min_length = 1, max_length = 128)]
    run_id: Option<String>,
    /// Fixes what is random about the policy; when absent, `session_id` and `run_id` do.
    seed: Option<u64>,
}

#[derive(Debug, Serialize, ToSchema)]
#[schema(as = SessionPage)]
struct Page {
    sessions: Vec<Session>,
    /// Empty on the last page.
    next_page_token: String,
}

/// Open a session: the server keeps the fleet's memory and pins the policy version
#[utoipa::path(
    post,
    path = "/v1/sessions",
    operation_id = "openSession",
    tag = "sessions",
    request_body = Open,
    responses(
        (status = 201, description = "It is open.", body = Session),
        BadBody, NotFound, Conflict, Draining
    )
)]
async fn open(State(app): State<Arc<App>>, extract::Json(open): extract::Json<Open>) -> Result<impl IntoResponse, Error> {
    let Open { policy, session_id, run_id, seed } = open;
    let (policy, how) = open_session(v1::OpenSessionRequest { policy, session_id, run_id, seed })?;
    let session = Session::from(v1::Session::from(sessions::open(&app, &policy, how).await?));
    Ok((StatusCode::CREATED, [(header::CACHE_CONTROL, "no-store")], Json(session)))
}

/// Open sessions, in the order of their names
#[utoipa::path(
    get,
    path = "/v1/sessions",
    operation_id = "listSessions",
    tag = "sessions",
    params(Paging),
    responses((status = 200, description = "A page of them.", body = Page), BadRequest)
)]
async fn list(State(app): State<Arc<App>>, Query(paging): Query<Paging>) -> Result<Json<Page>, Error> {
    let page = sessions::list(&app, &paging.into())?.map(|session| v1::Session::from(session).into());
    Ok(Json(Page { sessions: page.items, next_page_token: page.next_token }))
}

/// One session
#[utoipa::path(
    get,
    path = "/v1/sessions/{id}",
    operation_id = "getSession",
    tag = "sessions",
    params(("id" = String, Path, description = "Name of the session.", example = "flight-1")),
    responses((status = 200, description = "It is open.", body = Session), BadRequest, NotFound, Conflict)
)]
async fn one(State(app): State<Arc<App>>, Path(id): Path<String>) -> Result<Json<Session>, Error> {
    Ok(Json(v1::Session::from(sessions::get(&app, &id)?).into()))
}

/// End a session, after its slot in flight
#[utoipa::path(
    delete,
    path = "/v1/sessions/{id}",
    operation_id = "closeSession",
    tag = "sessions",
    params(("id" = String, Path, description = "Name of the session.", example = "flight-1")),
    responses((status = 200, description = "It has ended; what it was.", body = Session), BadRequest, NotFound, Conflict)
)]
async fn close(State(app): State<Arc<App>>, Path(id): Path<String>) -> Result<Json<Session>, Error> {
    Ok(Json(v1::Session::from(sessions::close(&app, &id).await?).into()))
}
