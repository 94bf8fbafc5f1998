//! `/v1/environments`: hosted environments, created, reset, stepped and deleted.

use std::sync::Arc;

use axum::Json;
use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use utoipa::openapi::RefOr;
use utoipa::openapi::schema::Schema;
use utoipa::{IntoParams, ToSchema};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::extract::{self, Path, Query};
use super::openapi::{BadBody, BadRequest, Conflict, Draining, NotFound};
use super::policies::Paging;
use super::scene_graph::{Graph, Scene};
use super::schemas::Seconds;
use crate::api::config_schemas::schema;
use crate::api::convert::environments::{create_environment, is_large};
use crate::api::json::{self, objects_only};
use crate::api::offload;
use crate::env::{self, EnvConfig};
use crate::service::keys::Caller;
use crate::service::{App, Error, environments};
use crate::serving::{self, EnvironmentInfo, EnvironmentReset, EnvironmentStep};

type AppState = State<Arc<App>>;

/// The routes.
pub(super) fn router() -> OpenApiRouter<Arc<App>> {
    OpenApiRouter::new().routes(routes!(create, list)).routes(routes!(get, delete)).routes(routes!(reset)).routes(routes!(step))
}

#[derive(Deserialize, IntoParams)]
#[into_params(parameter_in = Path)]
struct EnvironmentPath {
    /// Name of the environment.
    #[param(example = "env-1")]
    id: String,
}

#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(example = json!({"environment_id": "env-1", "environment": {"uavs": 2, "users": 4}}))]
struct CreateEnvironmentRequest {
    /// Fields that differ from the defaults. The symbols `M`, `N`, `K`, `v`, `t` and `d` are accepted, too.
    #[serde(default, deserialize_with = "json::object")]
    #[schema(value_type = EnvConfig)]
    environment: Map<String, Value>,
    /// The first episode of copy b has the seed `seed` + b.
    #[serde(default, deserialize_with = "json::integer")]
    #[schema(maximum = 9_007_199_254_740_991_u64)]
    seed: u64,
    /// Number of copies; default: 1.
    #[serde(default, deserialize_with = "json::optional_integer")]
    #[schema(minimum = 1, maximum = 1024)]
    count: Option<u32>,
    /// Whether the last step of an episode begins the next episode.
    #[serde(default)]
    auto_reset: bool,
    /// Empty: the server generates an id. If an environment with this id exists: created by the same request and not used yet,
    /// the response contains it; otherwise 409.
    #[serde(default)]
    #[schema(max_length = 128)]
    environment_id: String,
}

#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(example = json!({"seed": 10_000}))]
struct ResetRequest {
    /// New seed of the environment. Default: not changed.
    #[serde(default, deserialize_with = "json::optional_integer")]
    #[schema(maximum = 9_007_199_254_740_991_u64)]
    seed: Option<u64>,
    /// Index of the episode. Default: 0 with a seed; otherwise the next episode, or the current one if it is at slot 0.
    #[serde(default, deserialize_with = "json::optional_integer")]
    episode: Option<u64>,
    /// Whether to return the graph of each scene.
    #[serde(default)]
    return_graph: bool,
}

#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(example = json!({"step": 0, "actions": [{"headings": [0, 3]}]}))]
struct StepRequest {
    /// One per copy.
    #[schema(max_items = 1024)]
    actions: Vec<Headings>,
    /// Index of the step since the last reset, from 0. Default: the next step. Repeating the last step returns the same response.
    #[serde(default, deserialize_with = "json::optional_integer")]
    step: Option<u64>,
    /// Whether to return the graph of each scene.
    #[serde(default)]
    return_graph: bool,
}

#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, remote = "Self")]
struct Headings {
    /// One per UAV. Heading index h: direction 45*h degrees counter-clockwise from +x; 8 = hover, if the configuration supports
    /// it.
    #[serde(deserialize_with = "json::integers")]
    #[schema(schema_with = headings)]
    headings: Vec<u32>,
}

objects_only!(Headings);

fn headings() -> RefOr<Schema> {
    schema(serde_json::json!({"type": "array", "items": {"type": "integer", "minimum": 0, "maximum": 8}}))
}

#[derive(Debug, Serialize, ToSchema)]
struct HostedEnvironment {
    environment_id: String,
    environment: EnvConfig,
    seed: u64,
    count: usize,
    auto_reset: bool,
    /// 8, or 9 with hover.
    headings: usize,
    episode: u64,
    /// Slots of the current episode.
    slot: usize,
    /// Slots since the last reset.
    step: u64,
    created_at: Timestamp,
    /// The environment expires after this time without a request.
    ttl: Seconds,
    /// Id of the API key that made it, or of the first of the keys that replaced each other; null: no key was required.
    #[schema(required = true)]
    owner: Option<String>,
}

impl From<EnvironmentInfo> for HostedEnvironment {
    fn from(info: EnvironmentInfo) -> Self {
        let EnvironmentInfo { owner, id, spec, cursor, created_at, ttl } = info;
        Self {
            environment_id: id,
            headings: spec.config.actions(),
            environment: spec.config,
            seed: cursor.seed,
            count: spec.copies,
            auto_reset: spec.auto_reset,
            episode: cursor.episode,
            slot: cursor.slot,
            step: cursor.step,
            created_at,
            ttl: Seconds(ttl),
            owner: owner.id().map(str::to_owned),
        }
    }
}

#[derive(Debug, Serialize, ToSchema)]
struct EnvironmentPage {
    environments: Vec<HostedEnvironment>,
    /// Empty on the last page.
    next_page_token: String,
}

#[derive(Debug, Serialize, ToSchema)]
struct EnvironmentState {
    environment_id: String,
    step: u64,
    episode: u64,
    slot: usize,
    copies: Vec<CopyState>,
}

#[derive(Debug, Serialize, ToSchema)]
struct CopyState {
    scene: Scene,
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    graph: Option<Graph>,
    reward: f32,
    /// Whether the last step was the last one of its episode. Episodes end at a time limit, not in a terminal state.
    truncated: bool,
    /// A reset with this seed begins the same episode.
    seed: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    finished: Option<FinishedEpisode>,
}

#[derive(Debug, Serialize, ToSchema)]
struct FinishedEpisode {
    seed: u64,
    metrics: EpisodeMetrics,
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    scene: Option<Scene>,
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    graph: Option<Graph>,
}

#[derive(Debug, Serialize, ToSchema)]
struct EpisodeMetrics {
    /// Mean AoI over users (weighted, where users have weights) and slots.
    mean_aoi: f64,
    /// Largest AoI of any user in any slot.
    peak_aoi: f64,
    /// 95th percentile of AoI over users and slots.
    p95_aoi: f64,
    /// Fraction of the users whose data a UAV collected at least once.
    coverage: f64,
    /// Jain's fairness index of the users' mean AoI.
    fairness: f64,
}

impl EnvironmentState {
    fn new(id: String, state: serving::EnvironmentState) -> Self {
        let serving::EnvironmentState { step, episode, slot, copies } = state;
        Self { environment_id: id, step, episode, slot, copies: copies.into_iter().map(Into::into).collect() }
    }
}

impl From<serving::CopyState> for CopyState {
    fn from(copy: serving::CopyState) -> Self {
        Self {
            scene: (&copy.observation).into(),
            graph: Graph::of(&copy.observation),
            reward: copy.reward,
            truncated: copy.finished.is_some(),
            seed: copy.seed,
            finished: copy.finished.map(Into::into),
        }
    }
}

impl From<serving::FinishedEpisode> for FinishedEpisode {
    fn from(finished: serving::FinishedEpisode) -> Self {
        let env::EpisodeMetrics { mean_aoi, peak_aoi, p95_aoi, coverage, fairness } = finished.metrics;
        Self {
            seed: finished.seed,
            metrics: EpisodeMetrics { mean_aoi, peak_aoi, p95_aoi, coverage, fairness },
            scene: finished.observation.as_ref().map(Into::into),
            graph: finished.observation.as_ref().and_then(Graph::of),
        }
    }
}

/// Create an environment, in slot 0 of episode 0
#[utoipa::path(
    post, path = "/v1/environments", operation_id = "createEnvironment", tag = "environments",
    request_body = CreateEnvironmentRequest,
    responses((status = 201, description = "The environment.", body = HostedEnvironment), BadBody, Conflict, Draining)
)]
async fn create(
    State(app): AppState,
    caller: Caller,
    extract::Json(request): extract::Json<CreateEnvironmentRequest>,
) -> Result<impl IntoResponse, Error> {
    let CreateEnvironmentRequest { environment, seed, count, auto_reset, environment_id } = request;
    let create = create_environment(environment_id, environment.into(), seed, count, auto_reset)?;
    let environment = HostedEnvironment::from(environments::create(&app, &caller, create).await?);
    Ok((StatusCode::CREATED, [(header::CACHE_CONTROL, "no-store")], Json(environment)))
}

/// List environments by name
#[utoipa::path(
    get, path = "/v1/environments", operation_id = "listEnvironments", tag = "environments", params(Paging),
    responses((status = 200, description = "A page of environments.", body = EnvironmentPage), BadRequest)
)]
async fn list(State(app): AppState, caller: Caller, Query(paging): Query<Paging>) -> Result<Json<EnvironmentPage>, Error> {
    let page = environments::list(&app, &caller, &paging.into())?.map(Into::into);
    Ok(Json(EnvironmentPage { environments: page.items, next_page_token: page.next_token }))
}

/// Get an environment
#[utoipa::path(
    get, path = "/v1/environments/{id}", operation_id = "getEnvironment", tag = "environments", params(EnvironmentPath),
    responses((status = 200, description = "The environment.", body = HostedEnvironment), BadRequest, NotFound, Conflict)
)]
async fn get(
    State(app): AppState,
    caller: Caller,
    Path(EnvironmentPath { id }): Path<EnvironmentPath>,
) -> Result<Json<HostedEnvironment>, Error> {
    Ok(Json(environments::get(&app, &caller, &id)?.into()))
}

/// Delete an environment, after a step that is in progress
#[utoipa::path(
    delete, path = "/v1/environments/{id}", operation_id = "deleteEnvironment", tag = "environments", params(EnvironmentPath),
    responses(
        (status = 200, description = "The environment as it ended.", body = HostedEnvironment), BadRequest, NotFound, Conflict
    )
)]
async fn delete(
    State(app): AppState,
    caller: Caller,
    Path(EnvironmentPath { id }): Path<EnvironmentPath>,
) -> Result<Json<HostedEnvironment>, Error> {
    Ok(Json(environments::delete(&app, &caller, &id).await?.into()))
}

/// Begin an episode in every copy
#[utoipa::path(
    post, path = "/v1/environments/{id}/reset", operation_id = "resetEnvironment", tag = "environments",
    params(EnvironmentPath), request_body = ResetRequest,
    responses((status = 200, description = "Slot 0.", body = EnvironmentState), BadBody, NotFound, Conflict, Draining)
)]
async fn reset(
    State(app): AppState,
    caller: Caller,
    Path(EnvironmentPath { id }): Path<EnvironmentPath>,
    extract::Json(request): extract::Json<ResetRequest>,
) -> Result<Response, Error> {
    let ResetRequest { seed, episode, return_graph } = request;
    let state = environments::reset(&app, &caller, &id, EnvironmentReset { seed, episode, graph: return_graph }).await?;
    offload(is_large(&state), || Json(EnvironmentState::new(id, state)).into_response()).await
}

/// Step every copy by one slot
#[utoipa::path(
    post, path = "/v1/environments/{id}/step", operation_id = "stepEnvironment", tag = "environments",
    params(EnvironmentPath), request_body = StepRequest,
    responses((status = 200, description = "The next slot.", body = EnvironmentState), BadBody, NotFound, Conflict, Draining)
)]
async fn step(
    State(app): AppState,
    caller: Caller,
    Path(EnvironmentPath { id }): Path<EnvironmentPath>,
    extract::Json(request): extract::Json<StepRequest>,
) -> Result<Response, Error> {
    let StepRequest { actions, step, return_graph } = request;
    let actions = actions.into_iter().map(|copy| copy.headings).collect();
    let state = environments::step(&app, &caller, &id, EnvironmentStep { actions, step, graph: return_graph }).await?;
    offload(is_large(&state), || Json(EnvironmentState::new(id, state)).into_response()).await
}
