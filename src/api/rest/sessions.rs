//! `/v1/sessions`.

use std::sync::Arc;

use axum::Json;
use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::IntoResponse;
use serde::{Deserialize, Serialize};

use super::extract::{self, Path, Query};
use super::policies::Paging;
use super::wording::Session;
use crate::api::convert::request::open_session;
use crate::service::{App, Error, sessions};
use crate::wire::v1;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Open {
    policy: String,
    #[serde(default)]
    session_id: String,
    run_id: Option<String>,
    seed: Option<u64>,
}

#[derive(Debug, Serialize)]
pub(super) struct Page {
    sessions: Vec<Session>,
    next_page_token: String,
}

pub(super) async fn open(
    State(app): State<Arc<App>>,
    extract::Json(open): extract::Json<Open>,
) -> Result<impl IntoResponse, Error> {
    let Open { policy, session_id, run_id, seed } = open;
    let (policy, how) = open_session(v1::OpenSessionRequest { policy, session_id, run_id, seed })?;
    let session = Session::from(v1::Session::from(sessions::open(&app, &policy, how).await?));
    Ok((StatusCode::CREATED, [(header::CACHE_CONTROL, "no-store")], Json(session)))
}

pub(super) async fn list(State(app): State<Arc<App>>, Query(paging): Query<Paging>) -> Result<Json<Page>, Error> {
    let (page, next) = sessions::list(&app, paging.page_size, &paging.page_token)?;
    let sessions = page.into_iter().map(|session| v1::Session::from(session).into()).collect();
    Ok(Json(Page { sessions, next_page_token: next.unwrap_or_default() }))
}

pub(super) async fn get(State(app): State<Arc<App>>, Path(id): Path<String>) -> Result<Json<Session>, Error> {
    Ok(Json(v1::Session::from(sessions::get(&app, &id)?).into()))
}

pub(super) async fn close(State(app): State<Arc<App>>, Path(id): Path<String>) -> Result<Json<Session>, Error> {
    Ok(Json(v1::Session::from(sessions::close(&app, &id).await?).into()))
}
