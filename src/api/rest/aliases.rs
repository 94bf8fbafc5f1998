//! `/v1/policies/{name}/aliases`: the aliases of policies and their history.

use std::sync::Arc;

use axum::Json;
use axum::extract::State;
use axum::http::StatusCode;
use axum::response::IntoResponse;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, ToSchema};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::extract::{self, Path, Query};
use super::openapi::{BadBody, BadRequest, Conflict, NotFound};
use super::policies::{NamePath, Paging};
use super::schemas;
use crate::api::json;
use crate::service::keys::Caller;
use crate::service::{App, Error, PageRequest, policies};
use crate::store::AliasHistoryEntry;

type AppState = State<Arc<App>>;

/// The routes.
pub(super) fn router() -> OpenApiRouter<Arc<App>> {
    OpenApiRouter::new().routes(routes!(aliases)).routes(routes!(set_alias, delete_alias)).routes(routes!(history))
}

#[derive(Deserialize, IntoParams)]
#[into_params(parameter_in = Path)]
struct AliasPath {
    /// NAME of the policy, without a version or alias.
    #[param(pattern = "^[A-Za-z0-9_-][A-Za-z0-9._-]{0,63}$", example = "qedgix")]
    name: String,
    /// The alias.
    #[param(pattern = "^[A-Za-z0-9_-][A-Za-z0-9._-]{0,63}$", example = "live")]
    alias: String,
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
    /// Empty on the last page.
    next_page_token: String,
}

/// List the aliases of a policy by name
#[utoipa::path(
    get, path = "/v1/policies/{name}/aliases", operation_id = "listAliases", tag = "policies", params(NamePath, Paging),
    responses((status = 200, description = "A page of aliases.", body = Aliases), BadRequest, NotFound)
)]
async fn aliases(
    State(app): AppState,
    Path(NamePath { name }): Path<NamePath>,
    Query(paging): Query<Paging>,
) -> Result<Json<Aliases>, Error> {
    let page = policies::aliases(&app, &name, &paging.into())?.map(|(alias, version)| Alias { alias, version });
    Ok(Json(Aliases { aliases: page.items, next_page_token: page.next_token }))
}

/// The version that an alias is to point to.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(example = json!({"version": 1}))]
struct SetAlias {
    #[serde(deserialize_with = "json::integer")]
    version: u64,
    /// Moves the alias only if it points to this version now; 0: only if it does not exist.
    #[serde(default, deserialize_with = "json::optional_integer")]
    expected: Option<u64>,
}

#[derive(Debug, Serialize, ToSchema)]
struct MovedAlias {
    alias: String,
    /// The version that it points to.
    #[schema(minimum = 1)]
    version: u64,
    /// The version that it pointed to before; null: it is new.
    #[schema(required = true, minimum = 1)]
    previous: Option<u64>,
}

/// Point an alias to a version, for all requests at once
#[utoipa::path(
    put, path = "/v1/policies/{name}/aliases/{alias}", operation_id = "setAlias", tag = "policies", params(AliasPath),
    request_body = SetAlias,
    responses(
        (status = 201, description = "The alias is new.", body = MovedAlias),
        (status = 200, description = "The alias has moved.", body = MovedAlias),
        BadBody, NotFound, Conflict
    )
)]
async fn set_alias(
    State(app): AppState,
    Path(AliasPath { name, alias }): Path<AliasPath>,
    caller: Caller,
    extract::Json(SetAlias { version, expected }): extract::Json<SetAlias>,
) -> Result<impl IntoResponse, Error> {
    let target = policies::AliasChange { name, alias: alias.clone(), expected, by: caller.key_id().map(str::to_owned) };
    let previous = policies::set_alias(&app, target, version).await?;
    let status = if previous.is_none() { StatusCode::CREATED } else { StatusCode::OK };
    Ok((status, Json(MovedAlias { alias, version, previous })))
}

#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
struct DeleteAliasQuery {
    /// Deletes the alias only if it points to this version now.
    #[param(nullable = false)]
    expected: Option<u64>,
}

/// Delete an alias
#[utoipa::path(
    delete, path = "/v1/policies/{name}/aliases/{alias}", operation_id = "deleteAlias", tag = "policies",
    params(AliasPath, DeleteAliasQuery),
    responses((status = 204, description = "The alias is deleted."), BadRequest, NotFound, Conflict)
)]
async fn delete_alias(
    State(app): AppState,
    Path(AliasPath { name, alias }): Path<AliasPath>,
    Query(DeleteAliasQuery { expected }): Query<DeleteAliasQuery>,
    caller: Caller,
) -> Result<StatusCode, Error> {
    policies::delete_alias(&app, policies::AliasChange { name, alias, expected, by: caller.key_id().map(str::to_owned) }).await?;
    Ok(StatusCode::NO_CONTENT)
}

#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
struct HistoryQuery {
    /// Only moves of this alias.
    #[param(schema_with = schemas::name, required = false)]
    alias: Option<String>,
    /// Maximum number of moves. 0: 100.
    #[serde(default)]
    #[param(maximum = 1000)]
    page_size: u32,
    /// `next_page_token` of the previous page.
    #[serde(default)]
    #[param(schema_with = schemas::number_token, required = false)]
    page_token: String,
}

/// A move of an alias.
#[derive(Debug, Serialize, ToSchema)]
struct AliasMove {
    alias: String,
    /// The version that it points to since then; null: it was deleted.
    #[schema(required = true, minimum = 1)]
    version: Option<u64>,
    /// The version that it pointed to before; null: it was new.
    #[schema(required = true, minimum = 1)]
    previous: Option<u64>,
    at: Timestamp,
    /// Id of the API key that moved it, where known.
    #[schema(required = true)]
    by: Option<String>,
}

impl From<AliasHistoryEntry> for AliasMove {
    fn from(promotion: AliasHistoryEntry) -> Self {
        let AliasHistoryEntry { id: _, alias, version, previous, at, by } = promotion;
        Self { alias, version, previous, at, by }
    }
}

#[derive(Debug, Serialize, ToSchema)]
struct AliasHistory {
    history: Vec<AliasMove>,
    /// Empty on the last page.
    next_page_token: String,
}

/// List the moves of a policy's aliases, newest first
#[utoipa::path(
    get, path = "/v1/policies/{name}/history", operation_id = "listAliasMoves", tag = "policies",
    params(NamePath, HistoryQuery),
    responses((status = 200, description = "A page of moves.", body = AliasHistory), BadRequest, NotFound)
)]
async fn history(
    State(app): AppState,
    Path(NamePath { name }): Path<NamePath>,
    Query(query): Query<HistoryQuery>,
) -> Result<Json<AliasHistory>, Error> {
    let HistoryQuery { alias, page_size, page_token } = query;
    let page = PageRequest { size: page_size, token: page_token };
    let page = policies::history(&app, &name, alias.as_deref(), &page).await?.map(Into::into);
    Ok(Json(AliasHistory { history: page.items, next_page_token: page.next_token }))
}
