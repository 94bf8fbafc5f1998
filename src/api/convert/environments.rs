//! Messages of `EnvironmentService`.

use serde_json::Value;

use super::response::{duration, timestamp};
use super::scene_graph::graph;
use super::structs::{from_struct, to_struct};
use crate::env::EpisodeMetrics;
use crate::invalid::Invalid;
use crate::service::environments::NewEnvironment;
use crate::serving::{
    CopyState, EnvironmentInfo, EnvironmentReset, EnvironmentState, EnvironmentStep, FinishedEpisode, FleetIds,
};
use crate::wire::v1;

/// The environment that a message of `CreateEnvironment` describes.
///
/// # Errors
/// A name that is not valid, or a number that JSON or a `Struct` cannot hold.
pub fn create(request: v1::CreateEnvironmentRequest) -> Result<NewEnvironment, Invalid> {
    let v1::CreateEnvironmentRequest { environment, seed, count, auto_reset, environment_id } = request;
    let environment = from_struct("environment", environment.unwrap_or_default())?;
    create_environment(environment_id, environment, seed, count, auto_reset)
}

/// The environment to create, for both transports; an empty `id` lets the server choose one.
///
/// # Errors
/// A name that is not valid.
pub fn create_environment(
    id: String,
    environment: Value,
    seed: u64,
    count: Option<u32>,
    auto_reset: bool,
) -> Result<NewEnvironment, Invalid> {
    let id = Some(id).filter(|id| !id.is_empty());
    id.as_deref().map_or(Ok(()), |id| FleetIds::check_id("environment_id", id))?;
    Ok(NewEnvironment { id, environment, seed, count: count.unwrap_or(1) as usize, auto_reset })
}

impl From<v1::ResetRequest> for EnvironmentReset {
    fn from(request: v1::ResetRequest) -> Self {
        Self { seed: request.seed, episode: request.episode, graph: request.return_graph }
    }
}

impl From<v1::StepRequest> for EnvironmentStep {
    fn from(request: v1::StepRequest) -> Self {
        let actions = request.actions.into_iter().map(|copy| copy.headings).collect();
        Self { actions, step: request.step, graph: request.return_graph }
    }
}

impl From<EnvironmentInfo> for v1::Environment {
    fn from(info: EnvironmentInfo) -> Self {
        let EnvironmentInfo { owner, id, spec, cursor, created_at, ttl } = info;
        let config = serde_json::to_value(&spec.config).expect("a configuration is plain data");
        Self {
            environment_id: id,
            environment: to_struct(&config),
            seed: cursor.seed,
            count: spec.copies as u32,
            auto_reset: spec.auto_reset,
            headings: spec.config.actions() as u32,
            episode: cursor.episode,
            slot: cursor.slot as u32,
            step: cursor.step,
            created_at: Some(timestamp(created_at)),
            ttl: Some(duration(ttl)),
            owner: owner.id().unwrap_or_default().to_owned(),
        }
    }
}

/// Whether the response with this state takes so long to write that it should not occupy a thread of connections.
pub fn is_large(state: &EnvironmentState) -> bool {
    /// Nodes and detections.
    const LARGE: usize = 2048;
    state.copies.iter().map(|copy| copy.observation.size()).sum::<usize>() > LARGE
}

/// The response of environment `id`.
pub fn environment_state(id: String, state: EnvironmentState) -> v1::EnvironmentState {
    let EnvironmentState { step, episode, slot, copies } = state;
    let copies = copies.into_iter().map(Into::into).collect();
    v1::EnvironmentState { environment_id: id, step, episode, slot: slot as u32, copies }
}

impl From<CopyState> for v1::CopyState {
    fn from(copy: CopyState) -> Self {
        let CopyState { observation, seed, reward, finished } = copy;
        let truncated = finished.is_some();
        let (scene, graph) = (Some((&observation).into()), graph(&observation));
        Self { scene, graph, reward, truncated, seed, finished: finished.map(Into::into) }
    }
}

impl From<FinishedEpisode> for v1::FinishedEpisode {
    fn from(finished: FinishedEpisode) -> Self {
        let FinishedEpisode { seed, metrics, observation } = finished;
        let graph = observation.as_ref().and_then(graph);
        Self { seed, metrics: Some(metrics.into()), scene: observation.as_ref().map(Into::into), graph }
    }
}

impl From<EpisodeMetrics> for v1::EpisodeMetrics {
    fn from(metrics: EpisodeMetrics) -> Self {
        let EpisodeMetrics { mean_aoi, peak_aoi, p95_aoi, coverage, fairness } = metrics;
        Self { mean_aoi, peak_aoi, p95_aoi, coverage, fairness }
    }
}
