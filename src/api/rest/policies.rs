//! `/v1/policies`: which there are, checkpoints in and out, aliases, what is loaded.

use std::sync::Arc;

use axum::extract::{Request, State};
use axum::http::{StatusCode, header};
use axum::response::IntoResponse;
use axum::routing::{get, post, put};
use axum::{Extension, Json, Router};
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use tokio::sync::Semaphore;

use super::extract::{self, MaxBody, Path, Query};
use super::wording::Policy;
use crate::service::keys::Caller;
use crate::service::{App, Error, policies};
use crate::serving::{Described, PolicySpec};
use crate::store::Promotion;
use crate::wire::v1;

type Shared = State<Arc<App>>;

/// Largest checkpoint that is taken, in bytes, unless bodies may be larger anyway.
const LARGEST: usize = 64 << 20;
/// Checkpoints that may be on their way in at once: they are held in memory.
const AT_ONCE: usize = 4;

/// The routes.
pub fn router() -> Router<Arc<App>> {
    let room = Extension(Arc::new(Semaphore::new(AT_ONCE)));
    Router::new()
        .route("/v1/policies", get(list))
        .route("/v1/policies/{policy}", get(one))
        .route("/v1/policies/{policy}/versions", post(upload).layer(room))
        .route("/v1/policies/{policy}/export", get(export))
        .route("/v1/policies/{policy}/load", post(load))
        .route("/v1/policies/{policy}/unload", post(unload))
        .route("/v1/policies/{policy}/aliases", get(aliases))
        .route("/v1/policies/{policy}/aliases/{alias}", put(set_alias).delete(delete_alias))
        .route("/v1/policies/{policy}/history", get(history))
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Paging {
    #[serde(default)]
    pub page_size: u32,
    #[serde(default)]
    pub page_token: String,
}

#[derive(Debug, Serialize)]
struct Page {
    policies: Vec<Policy>,
    next_page_token: String,
}

async fn list(State(app): Shared, Query(paging): Query<Paging>) -> Result<Json<Page>, Error> {
    let (page, next) = policies::list(&app, paging.page_size, &paging.page_token)?;
    Ok(Json(Page { policies: page.into_iter().map(shown).collect(), next_page_token: next.unwrap_or_default() }))
}

async fn one(State(app): Shared, Path(policy): Path<String>) -> Result<Json<Policy>, Error> {
    let spec: PolicySpec = policy.parse()?;
    Ok(Json(shown(policies::get(&app, &spec)?)))
}

fn shown(described: Described) -> Policy {
    v1::Policy::from(described).into()
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct UploadQuery {
    alias: Option<String>,
}

/// A checkpoint of a training job.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct OfJob {
    checkpoint_id: String,
}

/// Whose key moves something, for the history.
fn by(caller: Option<Extension<Caller>>) -> Option<String> {
    caller.map(|Extension(caller)| caller.id().to_owned())
}

async fn upload(
    State(app): Shared,
    Path(name): Path<String>,
    Query(UploadQuery { alias }): Query<UploadQuery>,
    Extension(room): Extension<Arc<Semaphore>>,
    Extension(MaxBody(limit)): Extension<MaxBody>,
    caller: Option<Extension<Caller>>,
    request: Request,
) -> Result<impl IntoResponse, Error> {
    // Before a large body is read in vain.
    policies::check_publishable(&name)?;
    let busy = |_| Error::busy(format!("{AT_ONCE} checkpoints are on their way in; the next one has to wait"));
    let source = match extract::media_type(request.headers()) {
        Some(kind) if kind == "application/octet-stream" => {
            let _room = room.try_acquire().map_err(busy)?;
            policies::Source::Bytes(extract::read(request, LARGEST.max(limit)).await?.into())
        }
        Some(kind) if kind == "application/json" => {
            let OfJob { checkpoint_id } = extract::parse(&extract::read(request, limit).await?)?;
            policies::Source::Checkpoint(checkpoint_id)
        }
        kind => return Err(extract::unsupported(kind, "application/octet-stream, or application/json with a checkpoint_id")),
    };
    let (described, new) = policies::upload(&app, policies::Upload { name, source, alias, by: by(caller) }).await?;
    let location = [(header::LOCATION, format!("/v1/policies/{}", described.about.reference))];
    Ok((if new { StatusCode::CREATED } else { StatusCode::OK }, location, Json(shown(described))))
}

async fn export(State(app): Shared, Path(policy): Path<String>) -> Result<impl IntoResponse, Error> {
    let (reference, bytes) = policies::export(&app, &policy.parse()?).await?;
    let file = format!("{}-{}.safetensors", reference.name, reference.version);
    let headers = [
        (header::CONTENT_TYPE, "application/octet-stream".to_owned()),
        (header::ETAG, format!("\"{}\"", reference.digest_hex())),
        (header::CONTENT_DISPOSITION, format!("attachment; filename=\"{file}\"")),
    ];
    Ok((headers, bytes))
}

async fn load(State(app): Shared, Path(policy): Path<String>) -> Result<Json<Policy>, Error> {
    policies::load_policy(&app, &policy).await?;
    one(State(app), Path(policy)).await
}

async fn unload(State(app): Shared, Path(policy): Path<String>) -> Result<Json<Policy>, Error> {
    policies::unload_policy(&app, &policy).await?;
    one(State(app), Path(policy)).await
}

#[derive(Debug, Serialize)]
struct Alias {
    alias: String,
    version: u64,
}

#[derive(Debug, Serialize)]
struct Aliases {
    aliases: Vec<Alias>,
}

async fn aliases(State(app): Shared, Path(policy): Path<String>) -> Result<Json<Aliases>, Error> {
    let all = policies::aliases(&app, &policy)?.into_iter();
    Ok(Json(Aliases { aliases: all.map(|(alias, version)| Alias { alias, version }).collect() }))
}

/// Which version an alias shall mean, and what it must mean now for that.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct SetAlias {
    version: u64,
    expected: Option<u64>,
}

#[derive(Debug, Serialize)]
struct Moved {
    alias: String,
    version: u64,
    previous: Option<u64>,
}

async fn set_alias(
    State(app): Shared,
    Path((name, alias)): Path<(String, String)>,
    caller: Option<Extension<Caller>>,
    extract::Json(SetAlias { version, expected }): extract::Json<SetAlias>,
) -> Result<impl IntoResponse, Error> {
    let target = policies::Target { name, alias: alias.clone(), expected, by: by(caller) };
    let previous = policies::set_alias(&app, target, version).await?;
    let status = if previous.is_none() { StatusCode::CREATED } else { StatusCode::OK };
    Ok((status, Json(Moved { alias, version, previous })))
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Expected {
    expected: Option<u64>,
}

async fn delete_alias(
    State(app): Shared,
    Path((name, alias)): Path<(String, String)>,
    Query(Expected { expected }): Query<Expected>,
    caller: Option<Extension<Caller>>,
) -> Result<StatusCode, Error> {
    policies::delete_alias(&app, policies::Target { name, alias, expected, by: by(caller) }).await?;
    Ok(StatusCode::NO_CONTENT)
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct HistoryQuery {
    alias: Option<String>,
    #[serde(default)]
    page_size: u32,
    #[serde(default)]
    page_token: String,
}

/// A move of an alias.
#[derive(Debug, Serialize)]
struct Move {
    alias: String,
    version: Option<u64>,
    previous: Option<u64>,
    at: Timestamp,
    by: Option<String>,
}

impl From<Promotion> for Move {
    fn from(promotion: Promotion) -> Self {
        let Promotion { id: _, alias, version, previous, at, by } = promotion;
        Self { alias, version, previous, at, by }
    }
}

#[derive(Debug, Serialize)]
struct History {
    history: Vec<Move>,
    next_page_token: String,
}

async fn history(
    State(app): Shared,
    Path(policy): Path<String>,
    Query(query): Query<HistoryQuery>,
) -> Result<Json<History>, Error> {
    let HistoryQuery { alias, page_size, page_token } = query;
    let page = policies::history(&app, &policy, alias.as_deref(), page_size, &page_token).await?;
    let history = page.items.into_iter().map(Into::into).collect();
    Ok(Json(History { history, next_page_token: page.next.unwrap_or_default() }))
}
