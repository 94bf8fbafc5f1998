//! `/v1/policies`: policies, uploads and exports of checkpoints, loading and unloading. `aliases` has their aliases.

use std::sync::Arc;

use axum::extract::{Request, State};
use axum::http::{StatusCode, header};
use axum::response::IntoResponse;
use axum::{Extension, Json};
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use utoipa::{IntoParams, ToSchema};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::extract::{self, MaxBody, Path, Query};
use super::openapi::{BadBody, BadRequest, Conflict, Draining, NotFound};
use super::schemas;
use crate::api::convert::response::environment;
use crate::api::json;
use crate::env::{Boundary, EnvConfig};
use crate::policy::RequiredInput;
use crate::service::keys::Caller;
use crate::service::policies::{PolicyDetails, VersionSummary};
use crate::service::{App, Error, PageRequest, policies};
use crate::serving;

type AppState = State<Arc<App>>;

/// Maximum size of a checkpoint that is accepted, in bytes, unless the limit of bodies is higher.
const MAX_CHECKPOINT: usize = 64 << 20;

/// The routes.
pub(super) fn router() -> OpenApiRouter<Arc<App>> {
    OpenApiRouter::new()
        .routes(routes!(list))
        .routes(routes!(get, delete))
        .routes(routes!(versions, upload))
        .routes(routes!(delete_version))
        .routes(routes!(export))
        .routes(routes!(load))
        .routes(routes!(unload))
}

#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct Paging {
    /// Maximum number of items. 0: 100. A page has fewer items if it would exceed about 1 MiB.
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

#[derive(Deserialize, IntoParams)]
#[into_params(parameter_in = Path)]
struct PolicyPath {
    /// NAME (its newest version), NAME@ALIAS or NAME:VERSION.
    #[param(
        pattern = "^[A-Za-z0-9_-][A-Za-z0-9._-]{0,63}(@[A-Za-z0-9_-][A-Za-z0-9._-]{0,63}|:[1-9][0-9]{0,18})?$",
        example = "qedgix"
    )]
    policy: String,
}

#[derive(Deserialize, IntoParams)]
#[into_params(parameter_in = Path)]
struct VersionsPath {
    /// NAME (all its versions) or NAME:VERSION.
    #[param(pattern = "^[A-Za-z0-9_-][A-Za-z0-9._-]{0,63}(:[1-9][0-9]{0,18})?$", example = "qedgix")]
    policy: String,
}

#[derive(Deserialize, IntoParams)]
#[into_params(parameter_in = Path)]
pub(super) struct NamePath {
    /// NAME of the policy, without a version or alias.
    #[param(pattern = "^[A-Za-z0-9_-][A-Za-z0-9._-]{0,63}$", example = "qedgix")]
    pub(super) name: String,
}

/// Exactly one version of one policy.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct PolicyRef {
    name: String,
    #[schema(minimum = 1)]
    version: u64,
    /// SHA-256 of the checkpoint.
    #[schema(pattern = "^[0-9a-f]{64}$")]
    digest: String,
}

impl From<&serving::PolicyRef> for PolicyRef {
    fn from(policy: &serving::PolicyRef) -> Self {
        Self { name: policy.name.clone(), version: policy.version, digest: policy.digest_hex() }
    }
}

#[derive(Debug, Serialize, ToSchema)]
struct Policy {
    r#ref: PolicyRef,
    kind: PolicyKind,
    description: String,
    /// The number of UAVs that the policy requires; absent: any number.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    uavs: Option<u32>,
    /// The number of users that the policy requires; absent: any number.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    users: Option<u32>,
    /// 8, or 9 if the policy supports hover.
    #[schema(minimum = 8, maximum = 9)]
    headings: usize,
    needs: Needs,
    /// In units of the square's side.
    detection_range: f64,
    world: PolicyWorld,
    /// Aliases that point to this version.
    aliases: Vec<String>,
    /// The newest 100 versions of the policy, oldest first. `GET /v1/policies/{name}/versions` lists all.
    #[schema(max_items = 100)]
    versions: Vec<u64>,
    /// Number of all versions of the policy.
    version_count: usize,
    /// Whether this version is loaded. If not loaded, open sessions continue and all other requests get 409 (`policy_unloaded`).
    loaded: bool,
    /// Those of `versions` that are loaded.
    loaded_versions: Vec<u64>,
    /// Resolved training configuration of a checkpoint.
    #[serde(skip_serializing_if = "Value::is_null")]
    #[schema(value_type = Object, required = false)]
    config: Value,
    /// Metrics of a checkpoint's evaluation.
    #[serde(skip_serializing_if = "Value::is_null")]
    #[schema(value_type = Object, required = false)]
    metrics: Value,
    created_at: Timestamp,
}

/// The world that a policy was trained in, or made for. Lengths are in units of the square's side.
#[derive(Debug, Serialize, ToSchema)]
struct PolicyWorld {
    /// Distance per slot.
    speed: f64,
    /// Range within which a UAV collects the data of a user.
    transmission_range: f64,
    /// Range within which nodes detect each other.
    detection_range: f64,
    /// Range within which UAVs exchange messages.
    communication_range: f64,
    /// Slots per episode.
    slots: usize,
    /// `clamp`: UAVs stay in the square; `free`: they may leave it.
    boundary: &'static str,
}

impl From<EnvConfig> for PolicyWorld {
    fn from(env: EnvConfig) -> Self {
        Self {
            speed: env.speed,
            transmission_range: env.transmission_range,
            detection_range: env.detection_range,
            communication_range: env.ranges().communication,
            slots: env.slots,
            boundary: match env.boundary {
                Boundary::Clamp => "clamp",
                Boundary::Free => "free",
            },
        }
    }
}

/// Where a policy comes from.
#[derive(Debug, Serialize, ToSchema)]
enum PolicyKind {
    #[serde(rename = "POLICY_KIND_CHECKPOINT")]
    Checkpoint,
    #[serde(rename = "POLICY_KIND_BASELINE")]
    Baseline,
}

/// The input that a policy requires: a graph; a graph with the position of every UAV; a scene.
#[derive(Debug, Serialize, ToSchema)]
enum Needs {
    #[serde(rename = "NEEDS_DETECTIONS")]
    Detections,
    #[serde(rename = "NEEDS_OWN_POSITIONS")]
    OwnPositions,
    #[serde(rename = "NEEDS_FULL_SCENE")]
    FullScene,
}

impl From<PolicyDetails> for Policy {
    fn from(policy: PolicyDetails) -> Self {
        let PolicyDetails { info, loaded, aliases, versions, version_count } = policy;
        Self {
            r#ref: (&info.reference).into(),
            kind: match info.kind {
                serving::PolicyKind::Checkpoint => PolicyKind::Checkpoint,
                serving::PolicyKind::Baseline => PolicyKind::Baseline,
            },
            description: info.description.clone(),
            uavs: info.uavs,
            users: info.users,
            headings: info.actions,
            needs: match info.needs {
                RequiredInput::Detections => Needs::Detections,
                RequiredInput::OwnPositions => Needs::OwnPositions,
                RequiredInput::FullScene => Needs::FullScene,
            },
            detection_range: info.detection_range,
            world: environment(&info).into(),
            aliases,
            loaded,
            loaded_versions: versions.iter().filter(|(_, loaded)| *loaded).map(|(version, _)| *version).collect(),
            versions: versions.into_iter().map(|(version, _)| version).collect(),
            version_count,
            config: info.config.clone(),
            metrics: info.metrics.clone(),
            created_at: info.created_at,
        }
    }
}

#[derive(Debug, Serialize, ToSchema)]
struct PolicyPage {
    policies: Vec<Policy>,
    /// Empty on the last page.
    next_page_token: String,
}

/// List policies by name, each in its newest version
#[utoipa::path(
    get, path = "/v1/policies", operation_id = "listPolicies", tag = "policies", params(Paging),
    responses((status = 200, description = "A page of policies.", body = PolicyPage), BadRequest)
)]
async fn list(State(app): AppState, Query(paging): Query<Paging>) -> Result<Json<PolicyPage>, Error> {
    let page = policies::list(&app, &paging.into()).await?.map(Into::into);
    Ok(Json(PolicyPage { policies: page.items, next_page_token: page.next_token }))
}

/// Get a policy version
#[utoipa::path(
    get, path = "/v1/policies/{policy}", operation_id = "getPolicy", tag = "policies", params(PolicyPath),
    responses((status = 200, description = "The version.", body = Policy), BadRequest, NotFound)
)]
async fn get(State(app): AppState, Path(PolicyPath { policy }): Path<PolicyPath>) -> Result<Json<Policy>, Error> {
    Ok(Json(policies::get(&app, &policy.parse()?).await?.into()))
}

#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
struct UploadQuery {
    /// An alias to point to the version.
    #[param(schema_with = schemas::name, required = false)]
    alias: Option<String>,
}

/// A checkpoint of a training job.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
struct CheckpointOfJob {
    /// Its id, as `GET /v1/jobs/{id}/checkpoints` returns it.
    checkpoint_id: String,
}

/// Delete all versions of a policy
///
/// Deletes all or none. Their numbers are never given to other versions. Refused with `wrong_state` while an alias points to a
/// version or a session or a request uses one, and for policies that are bundled with the server.
#[utoipa::path(
    delete, path = "/v1/policies/{policy}", operation_id = "deletePolicy", tag = "policies",
    params(("policy" = String, Path, description = "NAME of the policy.", pattern = "^[A-Za-z0-9_-][A-Za-z0-9._-]{0,63}$")),
    responses((status = 204, description = "The policy is deleted."), BadRequest, NotFound, Conflict)
)]
async fn delete(State(app): AppState, Path(PolicyPath { policy }): Path<PolicyPath>) -> Result<StatusCode, Error> {
    policies::delete(&app, &policy, None).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// A version of a policy.
#[derive(Debug, Serialize, ToSchema)]
struct PolicyVersion {
    r#ref: PolicyRef,
    /// Whether this version is loaded.
    loaded: bool,
    /// Aliases that point to this version.
    aliases: Vec<String>,
}

impl From<VersionSummary> for PolicyVersion {
    fn from(version: VersionSummary) -> Self {
        let VersionSummary { reference, loaded, aliases } = version;
        Self { r#ref: (&reference).into(), loaded, aliases }
    }
}

#[derive(Debug, Serialize, ToSchema)]
struct PolicyVersionPage {
    versions: Vec<PolicyVersion>,
    /// Empty on the last page.
    next_page_token: String,
}

#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
struct VersionsQuery {
    /// Maximum number of versions. 0: 100.
    #[serde(default)]
    #[param(maximum = 1000)]
    page_size: u32,
    /// `next_page_token` of the previous page.
    #[serde(default)]
    #[param(schema_with = schemas::number_token, required = false)]
    page_token: String,
}

/// List the versions of a policy, newest first
#[utoipa::path(
    get, path = "/v1/policies/{name}/versions", operation_id = "listPolicyVersions", tag = "policies",
    params(NamePath, VersionsQuery),
    responses((status = 200, description = "A page of versions.", body = PolicyVersionPage), BadRequest, NotFound)
)]
async fn versions(
    State(app): AppState,
    Path(NamePath { name }): Path<NamePath>,
    Query(VersionsQuery { page_size, page_token }): Query<VersionsQuery>,
) -> Result<Json<PolicyVersionPage>, Error> {
    let page = policies::versions(&app, &name, &PageRequest { size: page_size, token: page_token })?.map(Into::into);
    Ok(Json(PolicyVersionPage { versions: page.items, next_page_token: page.next_token }))
}

#[derive(Deserialize, IntoParams)]
#[into_params(parameter_in = Path)]
struct VersionPath {
    /// NAME of the policy, without a version or alias.
    #[param(pattern = "^[A-Za-z0-9_-][A-Za-z0-9._-]{0,63}$", example = "qedgix")]
    name: String,
    /// The version.
    #[param(minimum = 1)]
    version: u64,
}

/// Delete a policy version
///
/// Its number is never given to another version. Refused with `wrong_state` while an alias points to it or a session or a request
/// uses it, and for versions that are bundled with the server.
#[utoipa::path(
    delete, path = "/v1/policies/{name}/versions/{version}", operation_id = "deletePolicyVersion", tag = "policies",
    params(VersionPath),
    responses((status = 204, description = "The version is deleted."), BadRequest, NotFound, Conflict)
)]
async fn delete_version(
    State(app): AppState,
    Path(VersionPath { name, version }): Path<VersionPath>,
) -> Result<StatusCode, Error> {
    policies::delete(&app, &name, Some(version)).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// Publish a checkpoint as the next version of a policy
///
/// Publishing identical bytes under the same name returns the existing version.
#[utoipa::path(
    post, path = "/v1/policies/{name}/versions", operation_id = "uploadPolicy", tag = "policies", params(NamePath, UploadQuery),
    request_body(
        description = "A checkpoint as safetensors, or the id of a checkpoint of a training job.",
        content((inline(schemas::Binary) = "application/octet-stream"), (CheckpointOfJob = "application/json"))
    ),
    responses(
        (status = 201, description = "A new version.", body = Policy, headers(("location", description = "Its path."))),
        (status = 200, description = "The existing version.", body = Policy, headers(("location", description = "Its path."))),
        BadBody, NotFound, Conflict, Draining
    )
)]
async fn upload(
    State(app): AppState,
    Path(NamePath { name }): Path<NamePath>,
    Query(UploadQuery { alias }): Query<UploadQuery>,
    Extension(MaxBody(limit)): Extension<MaxBody>,
    caller: Caller,
    request: Request,
) -> Result<impl IntoResponse, Error> {
    // Checked before the body, which may be large, is read.
    policies::check_publishable(&name)?;
    let source = match extract::media_type(request.headers()) {
        Some(kind) if kind == "application/octet-stream" => {
            let permit = app.uploads.acquire()?;
            policies::CheckpointSource::Bytes(extract::read(request, MAX_CHECKPOINT.max(limit)).await?.into(), permit)
        }
        Some(kind) if kind == "application/json" => {
            let CheckpointOfJob { checkpoint_id } = json::parse(&extract::read(request, limit).await?)?;
            policies::CheckpointSource::Job(checkpoint_id)
        }
        kind => return Err(extract::unsupported(kind, "application/octet-stream, or application/json with a checkpoint_id")),
    };
    let (published, new) = policies::publish(&app, &caller, policies::PublishRequest { name, source, alias }).await?;
    let location = [(header::LOCATION, format!("/v1/policies/{}", published.info.reference))];
    Ok((if new { StatusCode::CREATED } else { StatusCode::OK }, location, Json(Policy::from(published))))
}

/// Download the checkpoint of a policy version as safetensors
#[utoipa::path(
    get, path = "/v1/policies/{policy}/export", operation_id = "exportPolicy", tag = "policies", params(PolicyPath),
    responses(
        (
            status = 200, description = "The checkpoint as it was published.",
            content((inline(schemas::Binary) = "application/octet-stream")),
            headers(("etag", description = "SHA-256 of the bytes."), ("content-disposition", description = "Name of the file."))
        ),
        BadRequest, NotFound, Conflict
    )
)]
async fn export(State(app): AppState, Path(PolicyPath { policy }): Path<PolicyPath>) -> Result<impl IntoResponse, Error> {
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
    post, path = "/v1/policies/{policy}/load", operation_id = "loadPolicy", tag = "policies", params(VersionsPath),
    responses((status = 200, description = "The loaded version.", body = Policy), BadRequest, NotFound)
)]
async fn load(State(app): AppState, Path(VersionsPath { policy }): Path<VersionsPath>) -> Result<Json<Policy>, Error> {
    policies::load_policy(&app, &policy).await?;
    Ok(Json(policies::get(&app, &policy.parse()?).await?.into()))
}

/// Unload all versions of a policy, or one; open sessions keep using them
///
/// Other requests for an unloaded version are refused with `policy_unloaded` until it is loaded, also after a restart.
#[utoipa::path(
    post, path = "/v1/policies/{policy}/unload", operation_id = "unloadPolicy", tag = "policies", params(VersionsPath),
    responses((status = 200, description = "The unloaded version.", body = Policy), BadRequest, NotFound)
)]
async fn unload(State(app): AppState, Path(VersionsPath { policy }): Path<VersionsPath>) -> Result<Json<Policy>, Error> {
    policies::unload_policy(&app, &policy).await?;
    Ok(Json(policies::get(&app, &policy.parse()?).await?.into()))
}
