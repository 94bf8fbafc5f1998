//! One hosted environment: its copies, its episode and its step. One reset or step is in flight at a time; others wait and
//! are judged afterwards, so that a retry that overtakes its first attempt gets the first attempt's answer.

use std::sync::{Arc, Mutex as Lock, MutexGuard, PoisonError};
use std::time::Duration;

use jiff::Timestamp;
use tokio::sync::{Mutex, OwnedMutexGuard, OwnedSemaphorePermit};

use super::blueprint::{Blueprint, check_seed, episode_seed};
use super::state::{CopyState, Finished, Sight, State};
use crate::clock::Clock;
use crate::env::{BatchEnv, EpisodeMetrics};
use crate::error_code::ErrorCode;
use crate::invalid::Invalid;
use crate::serving::Error;
use crate::serving::table::{Entry, LastUse};

/// Environments with more work per step are stepped away from the threads that serve connections.
pub(super) const LARGE: usize = 16_384;

/// What a caller is told of an environment.
#[derive(Clone, Debug, PartialEq)]
pub struct EnvironmentInfo {
    /// Its name.
    pub id: String,
    /// What it was made of; the seed is the one of the last reset that gave one.
    pub blueprint: Blueprint,
    /// Where it is.
    pub progress: Progress,
    /// When it was created.
    pub created_at: Timestamp,
    /// Idle time after which it expires.
    pub ttl: Duration,
}

/// Where an environment is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Progress {
    /// The seed of copy 0's episode 0.
    pub seed: u64,
    /// Number of the episode.
    pub episode: u64,
    /// Slots flown in it.
    pub slot: usize,
    /// Slots flown since the last reset.
    pub step: u64,
}

/// Which episode a reset is to begin.
#[derive(Clone, Copy, Debug, Default)]
pub struct Reset {
    /// A new seed.
    pub seed: Option<u64>,
    /// The number of the episode.
    pub episode: Option<u64>,
    /// Whether graphs are asked for.
    pub graph: bool,
}

/// A slot to fly.
#[derive(Clone, Debug, Default)]
pub struct Flight {
    /// Heading indices (B, M).
    pub actions: Vec<Vec<u32>>,
    /// The step, where the caller counts.
    pub step: Option<u64>,
    /// Whether graphs are asked for.
    pub graph: bool,
}

/// A hosted environment.
#[derive(Debug)]
pub struct Environment {
    id: String,
    blueprint: Blueprint,
    created_at: Timestamp,
    clock: Clock,
    used: LastUse,
    /// Copy of `World::progress`, readable while a step is in flight.
    progress: Lock<Progress>,
    world: Arc<Mutex<World>>,
    /// Its share of the memory for environments.
    _share: OwnedSemaphorePermit,
}

/// What a reset or a step changes.
#[derive(Debug)]
pub(super) struct World {
    ended: bool,
    env: BatchEnv,
    progress: Progress,
    /// Whether it is as it was created.
    untouched: bool,
    last: Option<Last>,
}

/// What the last step answered, besides what the copies still show.
#[derive(Debug)]
struct Last {
    rewards: Vec<f32>,
    /// The last slot of an episode.
    finished: Option<Ended>,
}

/// The end of an episode.
#[derive(Debug)]
struct Ended {
    /// Its number.
    episode: u64,
    metrics: Vec<EpisodeMetrics>,
    /// The copies then, where a new episode has begun since: (B, M, 2), (B, N, 2), (B, N).
    scene: Option<[Vec<f32>; 3]>,
}

impl World {
    /// The copies of `blueprint` at slot 0 of episode 0. Costs time and memory in proportion to their nodes.
    pub(super) fn new(blueprint: &Blueprint) -> Result<Self, Invalid> {
        let env = BatchEnv::new(&blueprint.config, blueprint.copies)?;
        let mut world = Self { ended: false, env, progress: Progress::default(), untouched: true, last: None };
        world.begin(blueprint.seed, 0);
        Ok(world)
    }

    fn seeds(&self, episode: u64) -> impl Iterator<Item = u64> {
        let seed = self.progress.seed;
        (0..self.env.copies() as u64).map(move |b| episode_seed(seed + b, episode))
    }

    fn begin(&mut self, seed: u64, episode: u64) {
        self.progress = Progress { seed, episode, slot: 0, ..self.progress };
        let seeds: Vec<u64> = self.seeds(episode).collect();
        self.env.reset(&seeds);
    }

    fn reset(&mut self, reset: Reset) {
        let Progress { seed, episode, slot, .. } = self.progress;
        match reset {
            Reset { seed: Some(seed), episode, .. } => self.begin(seed, episode.unwrap_or(0)),
            Reset { episode: Some(episode), .. } => self.begin(seed, episode),
            _ if slot > 0 => self.begin(seed, episode.saturating_add(1)),
            _ => {}
        }
        self.progress.step = 0;
        self.last = None;
        self.untouched = self.untouched && reset.seed.is_none() && reset.episode.is_none();
    }

    fn fly(&mut self, headings: &[u8], auto_reset: bool) {
        let rewards = self.env.step(headings).to_vec();
        self.untouched = false;
        self.progress.step += 1;
        self.progress.slot = self.env.slot();
        let Progress { seed, episode, .. } = self.progress;
        let finished = self.env.done().then(|| Ended {
            episode,
            metrics: (0..self.env.copies()).map(|b| self.env.metrics(b)).collect(),
            scene: auto_reset.then(|| [self.env.uav_xy().to_vec(), self.env.user_xy().to_vec(), self.env.aoi().to_vec()]),
        });
        if auto_reset && finished.is_some() {
            self.begin(seed, episode.saturating_add(1));
        }
        self.last = Some(Last { rewards, finished });
    }

    fn state(&self, graph: bool) -> State {
        let config = self.env.config();
        let sights = Sight::all(config, self.env.uav_xy(), self.env.user_xy(), self.env.aoi(), graph);
        let mut copies: Vec<CopyState> = sights
            .zip(self.seeds(self.progress.episode))
            .map(|(sight, seed)| CopyState { sight, seed, reward: 0.0, finished: None })
            .collect();
        if let Some(last) = &self.last {
            copies.iter_mut().zip(&last.rewards).for_each(|(copy, &reward)| copy.reward = reward);
            if let Some(ended) = &last.finished {
                let seeds = self.seeds(ended.episode);
                for ((copy, &metrics), seed) in copies.iter_mut().zip(&ended.metrics).zip(seeds) {
                    copy.finished = Some(Finished { seed, metrics, sight: None });
                }
                if let Some([uavs, users, aoi]) = &ended.scene {
                    let sights = Sight::all(config, uavs, users, aoi, graph);
                    let finished = copies.iter_mut().filter_map(|copy| copy.finished.as_mut());
                    finished.zip(sights).for_each(|(finished, sight)| finished.sight = Some(sight));
                }
            }
        }
        let Progress { episode, slot, step, .. } = self.progress;
        State { step, episode, slot, copies }
    }
}

impl Environment {
    pub(super) fn new(id: String, blueprint: Blueprint, world: World, share: OwnedSemaphorePermit, clock: Clock) -> Self {
        let created_at = clock.now();
        Self {
            id,
            blueprint,
            created_at,
            used: LastUse::at(clock.monotonic()),
            clock,
            progress: Lock::new(world.progress),
            world: Arc::new(Mutex::new(world)),
            _share: share,
        }
    }

    fn progress(&self) -> MutexGuard<'_, Progress> {
        // Nothing panics while holding it.
        self.progress.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What a caller is told of it.
    pub fn info(&self, ttl: Duration) -> EnvironmentInfo {
        let progress = *self.progress();
        let blueprint = Blueprint { seed: progress.seed, ..self.blueprint.clone() };
        EnvironmentInfo { id: self.id.clone(), blueprint, progress, created_at: self.created_at, ttl }
    }

    /// What creating it with its name a second time does.
    pub(super) async fn recreate(&self, blueprint: &Blueprint) -> Result<(), Error> {
        let world = self.world.lock().await;
        let why = match &*world {
            world if world.ended => "and is being deleted",
            _ if self.blueprint != *blueprint => "and was created differently",
            world if !world.untouched => "and has flown or been reset",
            _ => {
                self.used.touch(self.clock.monotonic());
                return Ok(());
            }
        };
        Err(Error::Exists(format!("environment {:?} exists {why}; delete it, or choose another name", self.id)))
    }

    pub(super) async fn end(&self) {
        self.world.lock().await.ended = true;
    }

    /// Begins an episode.
    ///
    /// # Errors
    /// A seed that is out of range, graphs that are too large, or it has ended.
    pub async fn reset(self: &Arc<Self>, reset: Reset) -> Result<State, Error> {
        reset.seed.map_or(Ok(()), check_seed)?;
        self.check_graph(reset.graph)?;
        let mut world = self.enter().await?;
        self.work(move |environment| {
            world.reset(reset);
            environment.leave(&world, reset.graph)
        })
        .await
    }

    /// Flies one slot. The last step again gets the same answer, whatever its actions: it has been flown.
    ///
    /// # Errors
    /// Actions that do not fit, a step that is neither the last nor the next, an episode that is over, graphs that are too
    /// large, or it has ended.
    pub async fn step(self: &Arc<Self>, flight: Flight) -> Result<State, Error> {
        let headings = self.blueprint.headings(&flight.actions)?;
        self.check_graph(flight.graph)?;
        let mut world = self.enter().await?;
        let next = world.progress.step;
        let step = flight.step.unwrap_or(next);
        let repeated = world.last.is_some() && step.checked_add(1) == Some(next);
        if !repeated && step != next {
            return Err(wrong_step(&self.id, next, step));
        }
        if !repeated && world.env.done() {
            let slots = self.blueprint.config.slots;
            let message = format!("the episode of environment {:?} is over after {slots} slots; Reset begins another", self.id);
            return Err(Error::precondition(ErrorCode::EpisodeOver, message));
        }
        self.work(move |environment| {
            if !repeated {
                world.fly(&headings, environment.blueprint.auto_reset);
            }
            environment.leave(&world, flight.graph)
        })
        .await
    }

    fn check_graph(&self, wanted: bool) -> Result<(), Invalid> {
        if wanted { self.blueprint.check_graph() } else { Ok(()) }
    }

    /// Waits for what is in flight.
    async fn enter(&self) -> Result<OwnedMutexGuard<World>, Error> {
        let world = self.world.clone().lock_owned().await;
        if world.ended { Err(Error::unknown(Self::WHAT, &self.id)) } else { Ok(world) }
    }

    /// Shows what is the case now.
    fn leave(&self, world: &World, graph: bool) -> State {
        *self.progress() = world.progress;
        self.used.touch(self.clock.monotonic());
        world.state(graph)
    }

    /// Does `work` where it blocks nobody. Once begun it comes to its end, whether or not the caller waits.
    async fn work(self: &Arc<Self>, work: impl FnOnce(&Self) -> State + Send + 'static) -> Result<State, Error> {
        if self.blueprint.work() <= LARGE {
            return Ok(work(self));
        }
        let environment = self.clone();
        let done = tokio::task::spawn_blocking(move || work(&environment));
        done.await.map_err(|e| Error::Fault(e.to_string()))
    }
}

impl Entry for Environment {
    const WHAT: &'static str = "environment";
    const EXPIRED: ErrorCode = ErrorCode::EnvironmentExpired;

    fn id(&self) -> &str {
        &self.id
    }

    fn used(&self) -> &LastUse {
        &self.used
    }
}

fn wrong_step(id: &str, next: u64, step: u64) -> Error {
    let message = match next {
        0 => format!("step {step} does not follow: environment {id:?} has not flown since its reset; send step 0"),
        _ => format!("step {step} does not follow in environment {id:?}; send {next}, or {} to repeat the last", next - 1),
    };
    Error::precondition(ErrorCode::WrongStep, message)
}
