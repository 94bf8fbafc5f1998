//! What a reset or a step of an environment returns, per copy.

use crate::env::{EnvConfig, EpisodeMetrics, points};
use crate::policy::FleetGraph;
use crate::serving::Scene;

/// All copies after a reset or a step.
#[derive(Clone, Debug, PartialEq)]
pub struct EnvironmentState {
    /// Steps since the last reset.
    pub step: u64,
    /// Number of the current episode.
    pub episode: u64,
    /// Slots of the current episode that have passed.
    pub slot: usize,
    /// B copies.
    pub copies: Vec<CopyState>,
}

/// One copy.
#[derive(Clone, Debug, PartialEq)]
pub struct CopyState {
    /// The current observation.
    pub observation: CopyObservation,
    /// Seed of the current episode.
    pub seed: u64,
    /// Reward of the last step; 0 after a reset.
    pub reward: f32,
    /// The episode that the last step ended.
    pub finished: Option<FinishedEpisode>,
}

/// An episode that has ended.
#[derive(Clone, Debug, PartialEq)]
pub struct FinishedEpisode {
    /// Its seed.
    pub seed: u64,
    /// Its metrics.
    pub metrics: EpisodeMetrics,
    /// Its last observation, if an automatic reset has begun the next episode.
    pub observation: Option<CopyObservation>,
}

/// The scene of one copy and, if requested, the graph of detections in it.
#[derive(Clone, Debug, PartialEq)]
pub struct CopyObservation {
    /// Positions and AoI.
    pub scene: Scene,
    /// Detections within the environment's detection range.
    pub graph: Option<FleetGraph>,
}

impl CopyObservation {
    /// The observation of each copy, from (B, M, 2) and (B, N, 2) positions and (B, N) AoI.
    pub(super) fn of_copies(
        config: &EnvConfig,
        uav_xy: &[f32],
        user_xy: &[f32],
        aoi: &[f32],
        graph: bool,
    ) -> impl Iterator<Item = Self> {
        let (m, n, ranges) = (config.uavs, config.users, config.ranges());
        let copies = uav_xy.chunks_exact(2 * m).zip(user_xy.chunks_exact(2 * n)).zip(aoi.chunks_exact(n));
        copies.map(move |((uavs, users), aoi)| {
            let scene = Scene { uavs: points(uavs).collect(), users: points(users).collect(), aoi: aoi.to_vec() };
            let graph = graph.then(|| FleetGraph::from_scene(&scene.uavs, &scene.users, &scene.aoi, ranges));
            Self { scene, graph }
        })
    }

    /// Nodes plus detections: a measure of the cost of encoding it.
    pub fn size(&self) -> usize {
        let nodes = self.scene.uavs.len() + self.scene.users.len();
        nodes + self.graph.as_ref().map_or(0, |graph| (0..nodes).map(|i| graph.detections(i).len()).sum())
    }
}
