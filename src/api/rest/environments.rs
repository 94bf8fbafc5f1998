//! `/v1/environments`: the messages of `EnvironmentService` as JSON.

use std::sync::Arc;

use axum::Json;
use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::IntoResponse;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::extract::{self, Path, Query};
use super::observation::{Graph, Scene};
use super::openapi::{BadBody, BadRequest, Conflict, Draining, NotFound};
use super::policies::Paging;
use super::schemas;
use super::wording::{document, seconds, time};
use crate::api::convert::environments::{create_from, state};
use crate::env::EnvConfig;
use crate::service::{App, Error, environments};
use crate::wire::v1;

type Shared = axum::extract::State<Arc<App>>;

/// The routes.
pub(super) fn router() -> OpenApiRouter<Arc<App>> {
    OpenApiRouter::new().routes(routes!(create, list)).routes(routes!(one, delete)).routes(routes!(reset)).routes(routes!(step))
}

#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = CreateEnvironmentRequest, example = json!({"environment_id": "env-1", "environment": {"uavs": 2, "users": 4}}))]
struct Create {
    /// Fields over the defaults; the letters of the paper (`M`, `N`, `K`, `v`, `t`, `d`) are understood, too.
    #[serde(default)]
    #[schema(value_type = EnvConfig)]
    environment: Map<String, Value>,
    /// Copy b flies its first episode with this seed + b.
    #[serde(default)]
    #[schema(maximum = 9_007_199_254_740_991_u64)]
    seed: u64,
    /// Number of copies, 1 unless said otherwise.
    #[schema(minimum = 1, maximum = 1024)]
    count: Option<u32>,
    /// Whether the last step of an episode begins the next.
    #[serde(default)]
    auto_reset: bool,
    /// Chosen by the server when left empty.
    #[serde(default)]
    #[schema(max_length = 128)]
    environment_id: String,
}

#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = ResetRequest, example = json!({"seed": 10_000}))]
struct Reset {
    /// Begins episode 0 of this seed.
    #[schema(maximum = 9_007_199_254_740_991_u64)]
    seed: Option<u64>,
    /// Begins the episode of this number.
    episode: Option<u64>,
    /// Also answer with the graph that policies see.
    #[serde(default)]
    return_graph: bool,
}

#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = StepRequest, example = json!({"step": 0, "actions": [{"headings": [0, 3]}]}))]
struct Flight {
    /// One per copy.
    #[schema(max_items = 1024)]
    actions: Vec<Headings>,
    /// Slots since the last reset; the last one again is answered again, without flying.
    step: Option<u64>,
    /// Also answer with the graph that policies see.
    #[serde(default)]
    return_graph: bool,
}

#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
struct Headings {
    /// One per UAV: heading h of 45 h degrees; 8 hovers, where that is allowed.
    #[schema(value_type = Vec<schemas::Heading>)]
    headings: Vec<u32>,
}

#[derive(Debug, Serialize, ToSchema)]
#[schema(as = HostedEnvironment)]
struct Shown {
    environment_id: String,
    #[schema(value_type = EnvConfig)]
    environment: Option<Value>,
    seed: u64,
    count: u32,
    auto_reset: bool,
    /// 8, or 9 with hovering.
    headings: u32,
    episode: u64,
    /// Slots flown in the present episode.
    slot: u32,
    /// Slots since the last reset.
    step: u64,
    #[schema(value_type = String, format = DateTime)]
    created_at: Option<String>,
    /// Idle time after which it ends by itself.
    #[schema(value_type = schemas::Seconds)]
    ttl: Option<String>,
}

#[derive(Debug, Serialize, ToSchema)]
#[schema(as = EnvironmentPage)]
struct Page {
    environments: Vec<Shown>,
    /// Empty on the last page.
    next_page_token: String,
}

#[derive(Debug, Serialize, ToSchema)]
#[schema(as = EnvironmentState)]
struct Answer {
    environment_id: String,
    step: u64,
    episode: u64,
    slot: u32,
    copies: Vec<Copy>,
}

#[derive(Debug, Serialize, ToSchema)]
#[schema(as = CopyState)]
struct Copy {
    #[schema(value_type = Scene)]
    scene: Option<Scene>,
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    graph: Option<Graph>,
    reward: f32,
    /// Whether this was the last slot, which is a time limit: bootstrap through it.
    truncated: bool,
    /// Given to a reset, it is this episode again.
    seed: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    finished: Option<Finished>,
}

#[derive(Debug, Serialize, ToSchema)]
#[schema(as = FinishedEpisode)]
struct Finished {
    seed: u64,
    #[schema(value_type = Metrics)]
    metrics: Option<Metrics>,
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    scene: Option<Scene>,
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    graph: Option<Graph>,
}

#[derive(Debug, Serialize, ToSchema)]
#[schema(as = EpisodeMetrics)]
struct Metrics {
    /// Mean AoI over users (weighted, where users have weights) and slots.
    mean_aoi: f64,
    /// Largest AoI of any user in any slot.
    peak_aoi: f64,
    /// 95th percentile of AoI over users and slots.
    p95_aoi: f64,
    /// Share of users ever visited.
    coverage: f64,
    /// Jain's fairness index of the users' mean AoI.
    fairness: f64,
}

/// Create an environment, at slot 0 of episode 0
#[utoipa::path(
    post,
    path = "/v1/environments",
    operation_id = "createEnvironment",
    tag = "environments",
    request_body = Create,
    responses((status = 201, description = "It is there.", body = Shown), BadBody, Conflict, Draining)
)]
async fn create(State(app): Shared, extract::Json(body): extract::Json<Create>) -> Result<impl IntoResponse, Error> {
    let Create { environment, seed, count, auto_reset, environment_id } = body;
    let create = create_from(environment_id, Value::Object(environment), seed, count, auto_reset)?;
    let environment = shown(environments::create(&app, create).await?);
    Ok((StatusCode::CREATED, [(header::CACHE_CONTROL, "no-store")], Json(environment)))
}

/// Environments in order of names
#[utoipa::path(
    get,
    path = "/v1/environments",
    operation_id = "listEnvironments",
    tag = "environments",
    params(Paging),
    responses((status = 200, description = "A page of them.", body = Page), BadRequest)
)]
async fn list(State(app): Shared, Query(paging): Query<Paging>) -> Result<Json<Page>, Error> {
    let page = environments::list(&app, &paging.into())?.map(shown);
    Ok(Json(Page { environments: page.items, next_page_token: page.next_token }))
}

/// One environment
#[utoipa::path(
    get,
    path = "/v1/environments/{id}",
    operation_id = "getEnvironment",
    tag = "environments",
    params(("id" = String, Path, description = "Name of the environment.", example = "env-1")),
    responses((status = 200, description = "It is there.", body = Shown), BadRequest, NotFound, Conflict)
)]
async fn one(State(app): Shared, Path(id): Path<String>) -> Result<Json<Shown>, Error> {
    Ok(Json(shown(environments::get(&app, &id)?)))
}

/// End an environment, after its step in flight
#[utoipa::path(
    delete,
    path = "/v1/environments/{id}",
    operation_id = "deleteEnvironment",
    tag = "environments",
    params(("id" = String, Path, description = "Name of the environment.", example = "env-1")),
    responses((status = 200, description = "It has ended; what it was.", body = Shown), BadRequest, NotFound, Conflict)
)]
async fn delete(State(app): Shared, Path(id): Path<String>) -> Result<Json<Shown>, Error> {
    Ok(Json(shown(environments::delete(&app, &id).await?)))
}

/// Begin an episode in every copy
#[utoipa::path(
    post,
    path = "/v1/environments/{id}/reset",
    operation_id = "resetEnvironment",
    tag = "environments",
    params(("id" = String, Path, description = "Name of the environment.", example = "env-1")),
    request_body = Reset,
    responses((status = 200, description = "Slot 0.", body = Answer), BadBody, NotFound, Conflict, Draining)
)]
async fn reset(State(app): Shared, Path(id): Path<String>, body: extract::Json<Reset>) -> Result<Json<Answer>, Error> {
    let Reset { seed, episode, return_graph } = body.0;
    let request = v1::ResetRequest { seed, episode, return_graph, ..Default::default() };
    let reset = environments::reset(&app, &id, request.into()).await?;
    Ok(Json(state(id, reset).await?.into()))
}

/// Fly one slot in every copy
#[utoipa::path(
    post,
    path = "/v1/environments/{id}/step",
    operation_id = "stepEnvironment",
    tag = "environments",
    params(("id" = String, Path, description = "Name of the environment.", example = "env-1")),
    request_body = Flight,
    responses((status = 200, description = "The slot after it.", body = Answer), BadBody, NotFound, Conflict, Draining)
)]
async fn step(State(app): Shared, Path(id): Path<String>, body: extract::Json<Flight>) -> Result<Json<Answer>, Error> {
    let Flight { actions, step, return_graph } = body.0;
    let actions = actions.into_iter().map(|copy| v1::Headings { headings: copy.headings }).collect();
    let request = v1::StepRequest { actions, step, return_graph, ..Default::default() };
    let flown = environments::step(&app, &id, request.into()).await?;
    Ok(Json(state(id, flown).await?.into()))
}

fn shown(info: impl Into<v1::Environment>) -> Shown {
    let shown: v1::Environment = info.into();
    Shown {
        environment_id: shown.environment_id,
        environment: shown.environment.map(document),
        seed: shown.seed,
        count: shown.count,
        auto_reset: shown.auto_reset,
        headings: shown.headings,
        episode: shown.episode,
        slot: shown.slot,
        step: shown.step,
        created_at: shown.created_at.and_then(|at| time(&at)),
        ttl: shown.ttl.map(|ttl| seconds(&ttl)),
    }
}

impl From<v1::EnvironmentState> for Answer {
    fn from(state: v1::EnvironmentState) -> Self {
        let v1::EnvironmentState { environment_id, step, episode, slot, copies } = state;
        Self { environment_id, step, episode, slot, copies: copies.into_iter().map(Into::into).collect() }
    }
}

impl From<v1::CopyState> for Copy {
    fn from(copy: v1::CopyState) -> Self {
        let v1::CopyState { scene, graph, reward, truncated, seed, finished } = copy;
        let (scene, graph) = (scene.map(Into::into), graph.map(Into::into));
        Self { scene, graph, reward, truncated, seed, finished: finished.map(Into::into) }
    }
}

impl From<v1::FinishedEpisode> for Finished {
    fn from(finished: v1::FinishedEpisode) -> Self {
        let v1::FinishedEpisode { seed, metrics, scene, graph } = finished;
        let metrics = metrics.map(|m| Metrics {
            mean_aoi: m.mean_aoi,
            peak_aoi: m.peak_aoi,
            p95_aoi: m.p95_aoi,
            coverage: m.coverage,
            fairness: m.fairness,
        });
        Self { seed, metrics, scene: scene.map(Into::into), graph: graph.map(Into::into) }
    }
}
