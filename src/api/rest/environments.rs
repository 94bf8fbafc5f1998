//! `/v1/environments`: the messages of `EnvironmentService` as JSON.

use std::sync::Arc;

use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::IntoResponse;
use axum::routing::{get, post};
use axum::{Json, Router};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::extract::{self, Path, Query};
use super::observation::{Graph, Scene};
use super::policies::Paging;
use super::wording::{document, seconds, time};
use crate::api::convert::environments::{create_from, state};
use crate::service::{App, Error, environments};
use crate::wire::v1;

type Shared = axum::extract::State<Arc<App>>;

/// The routes.
pub fn router() -> Router<Arc<App>> {
    Router::new()
        .route("/v1/environments", post(create).get(list))
        .route("/v1/environments/{id}", get(one).delete(delete))
        .route("/v1/environments/{id}/reset", post(reset))
        .route("/v1/environments/{id}/step", post(step))
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Create {
    #[serde(default)]
    environment: Map<String, Value>,
    #[serde(default)]
    seed: u64,
    count: Option<u32>,
    #[serde(default)]
    auto_reset: bool,
    #[serde(default)]
    environment_id: String,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Reset {
    seed: Option<u64>,
    episode: Option<u64>,
    #[serde(default)]
    return_graph: bool,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Flight {
    actions: Vec<Headings>,
    step: Option<u64>,
    #[serde(default)]
    return_graph: bool,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Headings {
    headings: Vec<u32>,
}

#[derive(Debug, Serialize)]
struct Shown {
    environment_id: String,
    environment: Option<Value>,
    seed: u64,
    count: u32,
    auto_reset: bool,
    headings: u32,
    episode: u64,
    slot: u32,
    step: u64,
    created_at: Option<String>,
    ttl: Option<String>,
}

#[derive(Debug, Serialize)]
struct Page {
    environments: Vec<Shown>,
    next_page_token: String,
}

#[derive(Debug, Serialize)]
struct Answer {
    environment_id: String,
    step: u64,
    episode: u64,
    slot: u32,
    copies: Vec<Copy>,
}

#[derive(Debug, Serialize)]
struct Copy {
    scene: Option<Scene>,
    #[serde(skip_serializing_if = "Option::is_none")]
    graph: Option<Graph>,
    reward: f32,
    truncated: bool,
    seed: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    finished: Option<Finished>,
}

#[derive(Debug, Serialize)]
struct Finished {
    seed: u64,
    metrics: Option<Metrics>,
    #[serde(skip_serializing_if = "Option::is_none")]
    scene: Option<Scene>,
    #[serde(skip_serializing_if = "Option::is_none")]
    graph: Option<Graph>,
}

#[derive(Debug, Serialize)]
struct Metrics {
    mean_aoi: f64,
    peak_aoi: f64,
    p95_aoi: f64,
    coverage: f64,
    fairness: f64,
}

async fn create(State(app): Shared, extract::Json(body): extract::Json<Create>) -> Result<impl IntoResponse, Error> {
    let Create { environment, seed, count, auto_reset, environment_id } = body;
    let create = create_from(environment_id, Value::Object(environment), seed, count, auto_reset)?;
    let environment = shown(environments::create(&app, create).await?);
    Ok((StatusCode::CREATED, [(header::CACHE_CONTROL, "no-store")], Json(environment)))
}

async fn list(State(app): Shared, Query(paging): Query<Paging>) -> Result<Json<Page>, Error> {
    let (page, next) = environments::list(&app, paging.page_size, &paging.page_token)?;
    Ok(Json(Page { environments: page.into_iter().map(shown).collect(), next_page_token: next.unwrap_or_default() }))
}

async fn one(State(app): Shared, Path(id): Path<String>) -> Result<Json<Shown>, Error> {
    Ok(Json(shown(environments::get(&app, &id)?)))
}

async fn delete(State(app): Shared, Path(id): Path<String>) -> Result<Json<Shown>, Error> {
    Ok(Json(shown(environments::delete(&app, &id).await?)))
}

async fn reset(State(app): Shared, Path(id): Path<String>, body: extract::Json<Reset>) -> Result<Json<Answer>, Error> {
    let Reset { seed, episode, return_graph } = body.0;
    let request = v1::ResetRequest { seed, episode, return_graph, ..Default::default() };
    let reset = environments::reset(&app, &id, request.into()).await?;
    Ok(Json(state(id, reset).await?.into()))
}

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
