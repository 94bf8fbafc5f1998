//! What a reset or a step of an environment returns, per copy.

use crate::env::{EnvConfig, EpisodeMetrics};
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
    /// Numbers of the UAVs and of the users that are there, from which their ids are made.
    pub numbers: (Vec<u32>, Vec<u32>),
}

impl CopyObservation {
    /// The observation of each copy in `slot`, from (B, M, 2) and (B, N, 2) positions and (B, N) AoI.
    pub(super) fn of_copies(
        (config, slot): (&EnvConfig, usize),
        uav_xy: &[f32],
        user_xy: &[f32],
        aoi: &[f32],
        graph: bool,
    ) -> impl Iterator<Item = Self> {
        let (m, n, ranges) = (config.uavs, config.users, config.ranges());
        let mut present = vec![true; n];
        config.user_slots.iter().for_each(|user| present[user.user] = config.is_there(user.user, slot));
        let there: Vec<u32> = (0..n as u32).filter(|&j| present[j as usize]).collect();
        let copies = uav_xy.chunks_exact(2 * m).zip(user_xy.chunks_exact(2 * n)).zip(aoi.chunks_exact(n));
        copies.map(move |((uavs, users), aoi)| {
            let flying = |i: &usize| config.flies(*i, slot);
            let numbers: (Vec<u32>, Vec<u32>) = ((0..m).filter(flying).map(|i| i as u32).collect(), there.clone());
            let listed = |all: &[f32], numbers: &[u32]| {
                let at = |&i: &u32| [0, 1].map(|axis| f64::from(all[2 * i as usize + axis]));
                numbers.iter().map(at).collect()
            };
            let scene = Scene {
                uavs: listed(uavs, &numbers.0),
                users: listed(users, &numbers.1),
                aoi: numbers.1.iter().map(|&j| aoi[j as usize]).collect(),
            };
            let graph = graph.then(|| FleetGraph::from_scene(&scene.uavs, &scene.users, &scene.aoi, ranges));
            Self { scene, graph, numbers }
        })
    }

    /// Nodes plus detections: a measure of the cost of encoding it.
    pub fn size(&self) -> usize {
        let nodes = self.scene.uavs.len() + self.scene.users.len();
        nodes + self.graph.as_ref().map_or(0, |graph| (0..nodes).map(|i| graph.detections(i).len()).sum())
    }
}
