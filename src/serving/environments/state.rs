//! What an environment answers: what each copy shows, and what its last slot brought.

use crate::env::{EnvConfig, EpisodeMetrics, Point, points};
use crate::policy::Slot;

/// All copies after a reset or a step.
#[derive(Clone, Debug, PartialEq)]
pub struct State {
    /// Slots flown since the last reset.
    pub step: u64,
    /// Number of the episode that is shown.
    pub episode: u64,
    /// Slots flown in it.
    pub slot: usize,
    /// B of them.
    pub copies: Vec<CopyState>,
}

/// One copy.
#[derive(Clone, Debug, PartialEq)]
pub struct CopyState {
    /// What is seen.
    pub sight: Sight,
    /// Seed of the episode that is seen.
    pub seed: u64,
    /// Of the slot that was flown; 0 after a reset.
    pub reward: f32,
    /// The episode that the slot ended.
    pub finished: Option<Finished>,
}

/// An episode that is over.
#[derive(Clone, Debug, PartialEq)]
pub struct Finished {
    /// Its seed.
    pub seed: u64,
    /// Its figures.
    pub metrics: EpisodeMetrics,
    /// What was seen at its end, where an automatic reset took its place.
    pub sight: Option<Sight>,
}

/// A scene, and who detects whom in it where that was asked for.
#[derive(Clone, Debug, PartialEq)]
pub struct Sight {
    /// Position of each UAV.
    pub uavs: Vec<Point>,
    /// Position of each user.
    pub users: Vec<Point>,
    /// AoI of each user in slots.
    pub aoi: Vec<f32>,
    /// Detections within the environment's detection range.
    pub graph: Option<Slot>,
}

impl Sight {
    /// What is seen in each copy, from (B, M, 2) and (B, N, 2) positions and (B, N) AoI.
    pub(super) fn all(
        config: &EnvConfig,
        uav_xy: &[f32],
        user_xy: &[f32],
        aoi: &[f32],
        graph: bool,
    ) -> impl Iterator<Item = Self> {
        let (m, n, range) = (config.uavs, config.users, config.detection_range);
        let fleets = uav_xy.chunks_exact(2 * m).zip(user_xy.chunks_exact(2 * n)).zip(aoi.chunks_exact(n));
        fleets.map(move |((uavs, users), aoi)| {
            let (uavs, users): (Vec<Point>, Vec<Point>) = (points(uavs).collect(), points(users).collect());
            let graph = graph.then(|| Slot::from_scene(&uavs, &users, aoi, range));
            Self { uavs, users, aoi: aoi.to_vec(), graph }
        })
    }

    /// Nodes and detections: what it costs to write it down.
    pub fn size(&self) -> usize {
        let nodes = self.uavs.len() + self.users.len();
        nodes + self.graph.as_ref().map_or(0, |graph| (0..nodes).map(|i| graph.detections(i).len()).sum())
    }
}
