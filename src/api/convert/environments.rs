//! Messages of `EnvironmentService`.

use serde_json::Value;

use super::name;
use super::response::{duration, timestamp};
use super::structs::{from_struct, to_struct};
use crate::env::EpisodeMetrics;
use crate::invalid::Invalid;
use crate::policy::Slot;
use crate::service::{Error, environments::Create};
use crate::serving::{CopyState, EnvironmentInfo, EnvironmentReset, EnvironmentState, EnvironmentStep, FinishedEpisode, Scene};
use crate::wire::v1;

/// What `CreateEnvironment` asks for.
///
/// # Errors
/// A name that cannot be used, a number that is not finite.
pub fn create(request: v1::CreateEnvironmentRequest) -> Result<Create, Invalid> {
    let v1::CreateEnvironmentRequest { environment, seed, count, auto_reset, environment_id } = request;
    let environment = from_struct("environment", environment.unwrap_or_default())?;
    create_from(environment_id, environment, seed, count, auto_reset)
}

/// The same with the configuration as JSON.
///
/// # Errors
/// A name that cannot be used.
pub fn create_from(id: String, environment: Value, seed: u64, count: Option<u32>, auto_reset: bool) -> Result<Create, Invalid> {
    let id = Some(id).filter(|id| !id.is_empty());
    if let Some(id) = &id {
        name("environment_id", id)?;
    }
    Ok(Create { id, environment, seed, count: count.unwrap_or(1) as usize, auto_reset })
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
        let EnvironmentInfo { id, spec, cursor, created_at, ttl } = info;
        let config = serde_json::to_value(&spec.config).expect("a configuration is plain data");
        Self {
            environment_id: id,
            environment: to_struct(&config),
            seed: cursor.seed,
            count: spec.copies as u32,
            auto_reset: spec.auto_reset,
            headings: spec.config.headings() as u32,
            episode: cursor.episode,
            slot: cursor.slot as u32,
            step: cursor.step,
            created_at: Some(timestamp(created_at)),
            ttl: Some(duration(ttl)),
        }
    }
}

/// The answer of environment `id`. A large one takes a few milliseconds, so it is put together where that blocks nobody.
///
/// # Errors
/// The process is ending.
pub async fn state(id: String, state: EnvironmentState) -> Result<v1::EnvironmentState, Error> {
    /// Nodes and detections of what is written down in place.
    const SMALL: usize = 2048;
    let size: usize = state.copies.iter().map(|copy| copy.observation.size()).sum();
    if size <= SMALL {
        return Ok(write(id, state));
    }
    tokio::task::spawn_blocking(move || write(id, state)).await.map_err(Error::internal)
}

fn write(id: String, state: EnvironmentState) -> v1::EnvironmentState {
    let EnvironmentState { step, episode, slot, copies } = state;
    let copies = copies.into_iter().map(Into::into).collect();
    v1::EnvironmentState { environment_id: id, step, episode, slot: slot as u32, copies }
}

impl From<CopyState> for v1::CopyState {
    fn from(copy: CopyState) -> Self {
        let CopyState { observation, seed, reward, finished } = copy;
        let truncated = finished.is_some();
        Self {
            graph: observation.graph.as_ref().map(graph),
            scene: Some(scene(&observation.scene)),
            reward,
            truncated,
            seed,
            finished: finished.map(Into::into),
        }
    }
}

impl From<FinishedEpisode> for v1::FinishedEpisode {
    fn from(finished: FinishedEpisode) -> Self {
        let FinishedEpisode { seed, metrics, observation } = finished;
        Self {
            seed,
            metrics: Some(metrics.into()),
            graph: observation.as_ref().and_then(|last| last.graph.as_ref()).map(graph),
            scene: observation.as_ref().map(|last| scene(&last.scene)),
        }
    }
}

impl From<EpisodeMetrics> for v1::EpisodeMetrics {
    fn from(metrics: EpisodeMetrics) -> Self {
        let EpisodeMetrics { mean_aoi, peak_aoi, p95_aoi, coverage, fairness } = metrics;
        Self { mean_aoi, peak_aoi, p95_aoi, coverage, fairness }
    }
}

fn uav_id(i: usize) -> String {
    format!("uav-{i}")
}

fn user_id(j: usize) -> String {
    format!("user-{j}")
}

fn scene(scene: &Scene) -> v1::Scene {
    let uavs = scene.uavs.iter().enumerate();
    let users = scene.users.iter().zip(&scene.aoi).enumerate();
    v1::Scene {
        uavs: uavs.map(|(i, &[x, y])| v1::SceneUav { id: uav_id(i), x, y }).collect(),
        users: users.map(|(j, (&[x, y], &aoi))| v1::SceneUser { id: user_id(j), x, y, aoi: f64::from(aoi) }).collect(),
    }
}

fn graph(slot: &Slot) -> v1::Graph {
    let uavs = slot.uavs();
    let id = |node: usize| node.checked_sub(uavs).map_or_else(|| uav_id(node), user_id);
    let aoi = |node: usize| node.checked_sub(uavs).map(|user| f64::from(slot.aoi()[user]));
    let node = |node: usize| {
        let detections = slot.detections(node).iter().map(|seen| {
            let target = seen.target as usize;
            let [rel_x, rel_y] = seen.rel.map(f64::from);
            v1::Detection { target_id: id(target), rel_x, rel_y, aoi: aoi(target) }
        });
        let position = slot.uav_positions().and_then(|positions| positions.get(node));
        v1::Node {
            id: id(node),
            kind: if node < uavs { v1::NodeKind::Uav } else { v1::NodeKind::User }.into(),
            detections: detections.collect(),
            position: position.map(|&[x, y]| v1::Position { x, y }),
            aoi: aoi(node),
        }
    };
    v1::Graph { nodes: (0..uavs + slot.users()).map(node).collect() }
}
