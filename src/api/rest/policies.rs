//! `/v1/policies`: which there are, checkpoints in and out, aliases, what is loaded.

use std::sync::Arc;

use axum::extract::{Request, State};
use axum::http::{StatusCode, header};
use axum::response::IntoResponse;
use axum::{Extension, Json};
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, ToSchema};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::extract::{self, MaxBody, Path, Query};
use super::openapi::{BadBody, BadRequest, Conflict, Draining, NotFound};
use super::schemas;
use super::wording::Policy;
use crate::service::keys::Caller;
use crate::service::{App, Error, PageRequest, policies};
use crate::serving::{PolicyDetails, PolicySpec};
use crate::store::Promotion;
use crate::wire::v1;

type Shared = State<Arc<App>>;

/// Largest checkpoint that is taken, in bytes, unless bodies may be larger anyway.
const LARGEST: usize = 64 << 20;

/// The routes.
pub(super) fn router() -> OpenApiRouter<Arc<App>> {
    OpenApiRouter::new()
        .routes(routes!(list))
        .routes(routes!(one))
        .routes(routes!(upload))
        .routes(routes!(export))
        .routes(routes!(load))
        .routes(routes!(unload))
        .routes(routes!(aliases))
        .routes(routes!(set_alias, delete_alias))
        .routes(routes!(history))
}

#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct Paging {
    /// At most this many items; 0: 100. A page ends early before it exceeds about 1 MiB.
    #[serde(default)]
    #[param(maximum = 1000)]
    page_size: u32,
    /// `next_page_token` of the previous page.
    #[serde(default)]
    page_token: String,
}

impl From<Paging> for PageRequest {
    fn from(paging: Paging) -> Self {
        Self { size: paging.page_size, token: paging.page_token }
    }
}

/// A policy in a path.
#[derive(IntoParams)]
#[into_params(parameter_in = Path)]
#[expect(dead_code, reason = "read as text; this is its documentation")]
struct Spec {
    /// NAME (its newest version), NAME@ALIAS or NAME:VERSION.
    #[param(value_type = schemas::PolicySpec, inline, example = "qedgix")]
    policy: String,
}

/// Versions in a path.
#[derive(IntoParams)]
#[into_params(parameter_in = Path)]
#[expect(dead_code, reason = "read as text; this is its documentation")]
struct Versions {
    /// NAME for all its versions, or NAME:VERSION.
    #[param(value_type = schemas::Versions, inline, example = "qedgix")]
    policy: String,
}

/// A policy's name in a path.
#[derive(IntoParams)]
#[into_params(parameter_in = Path)]
#[expect(dead_code, reason = "read as text; this is its documentation")]
struct Name {
    /// NAME of the policy, without a version or alias.
    #[param(value_type = schemas::Name, inline, example = "qedgix")]
    name: String,
}

/// An alias in a path.
#[derive(IntoParams)]
#[into_params(parameter_in = Path)]
#[expect(dead_code, reason = "read as text; this is its documentation")]
struct AliasOf {
    /// NAME of the policy, without a version or alias.
    #[param(value_type = schemas::Name, inline, example = "qedgix")]
    name: String,
    /// The alias.
    #[param(value_type = schemas::Name, inline, example = "live")]
    alias: String,
}

#[derive(Debug, Serialize, ToSchema)]
#[schema(as = PolicyPage)]
struct Page {
    policies: Vec<Policy>,
    /// Empty on the last page.
    next_page_token: String,
}

/// Policies in order of names, each in its newest version
#[utoipa::path(
    get,
    path = "/v1/policies",
    operation_id = "listPolicies",
    tag = "policies",
    params(Paging),
    responses((status = 200, description = "A page of them.", body = Page), BadRequest)
)]
async fn list(State(app): Shared, Query(paging): Query<Paging>) -> Result<Json<Page>, Error> {
    let page = policies::list(&app, &paging.into())?.map(shown);
    Ok(Json(Page { policies: page.items, next_page_token: page.next_token }))
}

/// One policy version
#[utoipa::path(
    get,
    path = "/v1/policies/{policy}",
    operation_id = "getPolicy",
    tag = "policies",
    params(Spec),
    responses((status = 200, description = "What is known of it.", body = Policy), BadRequest, NotFound)
)]
async fn one(State(app): Shared, Path(policy): Path<String>) -> Result<Json<Policy>, Error> {
    let spec: PolicySpec = policy.parse()?;
    Ok(Json(shown(policies::get(&app, &spec)?)))
}

fn shown(described: PolicyDetails) -> Policy {
    v1::Policy::from(described).into()
}

#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
struct UploadQuery {
    /// An alias that shall mean the version.
    #[param(value_type = schemas::Name, inline, required = false)]
    alias: Option<String>,
}

/// A checkpoint of a training job.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = CheckpointOfJob)]
struct OfJob {
    /// Its id, as `GET /v1/jobs/{id}/checkpoints` tells it.
    checkpoint_id: String,
}

/// Whose key moves something, for the history.
fn by(caller: Option<Extension<Caller>>) -> Option<String> {
    caller.map(|Extension(caller)| caller.id().to_owned())
}

/// Publish a checkpoint as the next version of a policy
///
/// Equal bytes under the same name are the version that they already are.
#[utoipa::path(
    post,
    path = "/v1/policies/{name}/versions",
    operation_id = "uploadPolicy",
    tag = "policies",
    params(Name, UploadQuery),
    request_body(
        description = "A checkpoint as safetensors, or one of a training job.",
        content((inline(schemas::Bytes) = "application/octet-stream"), (OfJob = "application/json"))
    ),
    responses(
        (status = 201, description = "A new version.", body = Policy, headers(("location", description = "Where it is."))),
        (status = 200, description = "A version that was there.", body = Policy, headers(("location", description = "Where it is."))),
        BadBody, NotFound, Conflict, Draining
    )
)]
async fn upload(
    State(app): Shared,
    Path(name): Path<String>,
    Query(UploadQuery { alias }): Query<UploadQuery>,
    Extension(MaxBody(limit)): Extension<MaxBody>,
    caller: Option<Extension<Caller>>,
    request: Request,
) -> Result<impl IntoResponse, Error> {
    // Before a large body is read in vain.
    policies::check_publishable(&name)?;
    let source = match extract::media_type(request.headers()) {
        Some(kind) if kind == "application/octet-stream" => {
            let permit = app.uploads.acquire()?;
            policies::CheckpointSource::Bytes(extract::read(request, LARGEST.max(limit)).await?.into(), permit)
        }
        Some(kind) if kind == "application/json" => {
            let OfJob { checkpoint_id } = extract::parse(&extract::read(request, limit).await?)?;
            policies::CheckpointSource::Job(checkpoint_id)
        }
        kind => return Err(extract::unsupported(kind, "application/octet-stream, or application/json with a checkpoint_id")),
    };
    let (described, new) = policies::upload(&app, policies::PolicyUpload { name, source, alias, by: by(caller) }).await?;
    let location = [(header::LOCATION, format!("/v1/policies/{}", described.info.reference))];
    Ok((if new { StatusCode::CREATED } else { StatusCode::OK }, location, Json(shown(described))))
}

/// The checkpoint of a policy version, as safetensors
#[utoipa::path(
    get,
    path = "/v1/policies/{policy}/export",
    operation_id = "exportPolicy",
    tag = "policies",
    params(Spec),
    responses(
        (
            status = 200, description = "The bytes that were published.", body = inline(schemas::Bytes), content_type = "application/octet-stream",
            headers(("etag", description = "SHA-256 of the bytes."), ("content-disposition", description = "A name for the file."))
        ),
        BadRequest, NotFound, Conflict
    )
)]
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

/// Load all versions of a policy, or one
#[utoipa::path(
    post,
    path = "/v1/policies/{policy}/load",
    operation_id = "loadPolicy",
    tag = "policies",
    params(Versions),
    responses((status = 200, description = "Loaded.", body = Policy), BadRequest, NotFound)
)]
async fn load(State(app): Shared, Path(policy): Path<String>) -> Result<Json<Policy>, Error> {
    policies::load_policy(&app, &policy).await?;
    one(State(app), Path(policy)).await
}

/// Unload all versions of a policy, or one; sessions that fly them go on
///
/// Whatever else means them is refused with `policy_unloaded` until they are loaded, restarts included.
#[utoipa::path(
    post,
    path = "/v1/policies/{policy}/unload",
    operation_id = "unloadPolicy",
    tag = "policies",
    params(Versions),
    responses((status = 200, description = "Unloaded.", body = Policy), BadRequest, NotFound)
)]
async fn unload(State(app): Shared, Path(policy): Path<String>) -> Result<Json<Policy>, Error> {
    policies::unload_policy(&app, &policy).await?;
    one(State(app), Path(policy)).await
}

#[derive(Debug, Serialize, ToSchema)]
struct Alias {
    alias: String,
    #[schema(minimum = 1)]
    version: u64,
}

#[derive(Debug, Serialize, ToSchema)]
struct Aliases {
    aliases: Vec<Alias>,
}

/// Aliases of a policy
#[utoipa::path(
    get,
    path = "/v1/policies/{name}/aliases",
    operation_id = "listAliases",
    tag = "policies",
    params(Name),
    responses((status = 200, description = "All of them.", body = Aliases), BadRequest, NotFound)
)]
async fn aliases(State(app): Shared, Path(name): Path<String>) -> Result<Json<Aliases>, Error> {
    let all = policies::aliases(&app, &name)?.into_iter();
    Ok(Json(Aliases { aliases: all.map(|(alias, version)| Alias { alias, version }).collect() }))
}

/// Which version an alias shall mean, and what it must mean now for that.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(example = json!({"version": 1}))]
struct SetAlias {
    /// The version that it shall mean.
    version: u64,
    /// What it must mean now for anything to happen: a version, or 0 for nothing.
    expected: Option<u64>,
}

#[derive(Debug, Serialize, ToSchema)]
#[schema(as = MovedAlias)]
struct Moved {
    alias: String,
    /// The version that it means.
    #[schema(minimum = 1)]
    version: u64,
    /// What it meant before.
    #[schema(required = true, minimum = 1)]
    previous: Option<u64>,
}

/// Let an alias mean a version, for all requests at once
#[utoipa::path(
    put,
    path = "/v1/policies/{name}/aliases/{alias}",
    operation_id = "setAlias",
    tag = "policies",
    params(AliasOf),
    request_body = SetAlias,
    responses(
        (status = 201, description = "It is new.", body = Moved),
        (status = 200, description = "It has moved.", body = Moved),
        BadBody, NotFound, Conflict
    )
)]
async fn set_alias(
    State(app): Shared,
    Path((name, alias)): Path<(String, String)>,
    caller: Option<Extension<Caller>>,
    extract::Json(SetAlias { version, expected }): extract::Json<SetAlias>,
) -> Result<impl IntoResponse, Error> {
    let target = policies::AliasChange { name, alias: alias.clone(), expected, by: by(caller) };
    let previous = policies::set_alias(&app, target, version).await?;
    let status = if previous.is_none() { StatusCode::CREATED } else { StatusCode::OK };
    Ok((status, Json(Moved { alias, version, previous })))
}

#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
struct Expected {
    /// The version that it must mean now for anything to happen.
    #[param(nullable = false)]
    expected: Option<u64>,
}

/// Delete an alias
#[utoipa::path(
    delete,
    path = "/v1/policies/{name}/aliases/{alias}",
    operation_id = "deleteAlias",
    tag = "policies",
    params(AliasOf, Expected),
    responses((status = 204, description = "It means nothing any more."), BadRequest, NotFound, Conflict)
)]
async fn delete_alias(
    State(app): Shared,
    Path((name, alias)): Path<(String, String)>,
    Query(Expected { expected }): Query<Expected>,
    caller: Option<Extension<Caller>>,
) -> Result<StatusCode, Error> {
    policies::delete_alias(&app, policies::AliasChange { name, alias, expected, by: by(caller) }).await?;
    Ok(StatusCode::NO_CONTENT)
}

#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
struct HistoryQuery {
    /// Only this alias.
    #[param(value_type = schemas::Name, inline, required = false)]
    alias: Option<String>,
    /// At most this many moves; 0: 100.
    #[serde(default)]
    #[param(maximum = 1000)]
    page_size: u32,
    /// `next_page_token` of the previous page.
    #[serde(default)]
    #[param(value_type = schemas::NumberToken, inline, required = false)]
    page_token: String,
}

/// A move of an alias.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = AliasMove)]
struct Move {
    alias: String,
    /// What it means since then; null: nothing, it was deleted.
    #[schema(required = true, minimum = 1)]
    version: Option<u64>,
    /// What it meant before; null: nothing, it was new.
    #[schema(required = true, minimum = 1)]
    previous: Option<u64>,
    at: Timestamp,
    /// Who moved it, where that is known.
    #[schema(required = true)]
    by: Option<String>,
}

impl From<Promotion> for Move {
    fn from(promotion: Promotion) -> Self {
        let Promotion { id: _, alias, version, previous, at, by } = promotion;
        Self { alias, version, previous, at, by }
    }
}

#[derive(Debug, Serialize, ToSchema)]
#[schema(as = AliasHistory)]
struct History {
    history: Vec<Move>,
    /// Empty on the last page.
    next_page_token: String,
}

/// Where the aliases of a policy have been, newest first
#[utoipa::path(
    get,
    path = "/v1/policies/{name}/history",
    operation_id = "listAliasMoves",
    tag = "policies",
    params(Name, HistoryQuery),
    responses((status = 200, description = "A page of moves.", body = History), BadRequest, NotFound)
)]
async fn history(
    State(app): Shared,
    Path(name): Path<String>,
    Query(query): Query<HistoryQuery>,
) -> Result<Json<History>, Error> {
    let HistoryQuery { alias, page_size, page_token } = query;
    let page = PageRequest { size: page_size, token: page_token };
    let page = policies::history(&app, &name, alias.as_deref(), &page).await?.map(Into::into);
    Ok(Json(History { history: page.items, next_page_token: page.next_token }))
}
