//! The copies of a hosted environment and their current episode, without names, locks or limits.

use super::spec::{EnvironmentSpec, episode_seed};
use super::state::{CopyObservation, CopyState, EnvironmentState, FinishedEpisode};
use crate::env::{BatchEnv, EpisodeMetrics};
use crate::invalid::Invalid;

/// The current episode, slot and step of an environment.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct EpisodeCursor {
    /// The seed of copy 0's episode 0.
    pub seed: u64,
    /// Number of the episode.
    pub episode: u64,
    /// Slots of the episode that have passed.
    pub slot: usize,
    /// Steps since the last reset.
    pub step: u64,
}

/// The copies of an environment.
#[derive(Debug)]
pub(super) struct Simulation {
    env: BatchEnv,
    cursor: EpisodeCursor,
    /// Whether it has neither been stepped nor been given a seed or episode since its creation.
    untouched: bool,
    last: Option<LastStep>,
}

/// The part of the last step's result that `env` no longer holds.
#[derive(Debug)]
struct LastStep {
    rewards: Vec<f32>,
    /// Present if the step was the last of an episode.
    ended: Option<EndedEpisode>,
}

#[derive(Debug)]
struct EndedEpisode {
    number: u64,
    metrics: Vec<EpisodeMetrics>,
    /// (B, M, 2), (B, N, 2), (B, N) at the end of the episode, if an automatic reset has overwritten them in `env`.
    scene: Option<[Vec<f32>; 3]>,
}

impl Simulation {
    /// The copies of `spec` at slot 0 of episode 0. Takes time and memory in proportion to their nodes.
    pub(super) fn new(spec: &EnvironmentSpec) -> Result<Self, Invalid> {
        let env = BatchEnv::new(&spec.config, spec.copies)?;
        let mut simulation = Self { env, cursor: EpisodeCursor::default(), untouched: true, last: None };
        simulation.begin_episode(spec.seed, 0);
        Ok(simulation)
    }

    pub(super) fn cursor(&self) -> EpisodeCursor {
        self.cursor
    }

    pub(super) fn is_untouched(&self) -> bool {
        self.untouched
    }

    /// Whether the episode has ended.
    pub(super) fn is_done(&self) -> bool {
        self.env.done()
    }

    /// Whether `step` is the step that was computed last, so that its result is still known.
    pub(super) fn is_last_step(&self, step: u64) -> bool {
        self.last.is_some() && step.checked_add(1) == Some(self.cursor.step)
    }

    fn seeds(&self, episode: u64) -> impl Iterator<Item = u64> {
        let seed = self.cursor.seed;
        (0..self.env.copies() as u64).map(move |b| episode_seed(seed + b, episode))
    }

    fn begin_episode(&mut self, seed: u64, episode: u64) {
        self.cursor = EpisodeCursor { seed, episode, slot: 0, ..self.cursor };
        let seeds: Vec<u64> = self.seeds(episode).collect();
        self.env.reset(&seeds);
    }

    /// Begins `episode` (of `seed`). With neither given, begins the next episode, unless the current one is at slot 0.
    pub(super) fn reset(&mut self, seed: Option<u64>, episode: Option<u64>) {
        let current = self.cursor;
        match (seed, episode) {
            (Some(seed), episode) => self.begin_episode(seed, episode.unwrap_or(0)),
            (None, Some(episode)) => self.begin_episode(current.seed, episode),
            (None, None) if current.slot > 0 => self.begin_episode(current.seed, current.episode.saturating_add(1)),
            (None, None) => {}
        }
        self.cursor.step = 0;
        self.last = None;
        self.untouched = self.untouched && seed.is_none() && episode.is_none();
    }

    /// Advances every copy by one slot.
    pub(super) fn step(&mut self, headings: &[u8], auto_reset: bool) {
        let rewards = self.env.step(headings).to_vec();
        self.untouched = false;
        self.cursor.step += 1;
        self.cursor.slot = self.env.slot();
        let EpisodeCursor { seed, episode, .. } = self.cursor;
        let ended = self.env.done().then(|| EndedEpisode {
            number: episode,
            metrics: (0..self.env.copies()).map(|b| self.env.metrics(b)).collect(),
            scene: auto_reset.then(|| [self.env.uav_xy().to_vec(), self.env.user_xy().to_vec(), self.env.aoi().to_vec()]),
        });
        if auto_reset && ended.is_some() {
            self.begin_episode(seed, episode.saturating_add(1));
        }
        self.last = Some(LastStep { rewards, ended });
    }

    pub(super) fn state(&self, graph: bool) -> EnvironmentState {
        let config = self.env.config();
        let observations =
            CopyObservation::of_copies((config, self.env.slot()), self.env.uav_xy(), self.env.user_xy(), self.env.aoi(), graph);
        let mut copies: Vec<CopyState> = observations
            .zip(self.seeds(self.cursor.episode))
            .map(|(observation, seed)| CopyState { observation, seed, reward: 0.0, finished: None })
            .collect();
        if let Some(last) = &self.last {
            copies.iter_mut().zip(&last.rewards).for_each(|(copy, &reward)| copy.reward = reward);
            if let Some(ended) = &last.ended {
                let seeds = self.seeds(ended.number);
                for ((copy, &metrics), seed) in copies.iter_mut().zip(&ended.metrics).zip(seeds) {
                    copy.finished = Some(FinishedEpisode { seed, metrics, observation: None });
                }
                if let Some([uavs, users, aoi]) = &ended.scene {
                    let observations = CopyObservation::of_copies((config, config.slots), uavs, users, aoi, graph);
                    let finished = copies.iter_mut().filter_map(|copy| copy.finished.as_mut());
                    finished.zip(observations).for_each(|(finished, last)| finished.observation = Some(last));
                }
            }
        }
        let EpisodeCursor { episode, slot, step, .. } = self.cursor;
        EnvironmentState { step, episode, slot, copies }
    }
}
