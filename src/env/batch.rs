//! The dynamics (docs/model.md, "Environment"): many copies of one environment step together, without allocation per step.
//!
//! Positions are f32. Each move is computed in f64 from the f32 position and rounded once, so that replay stores exactly the
//! positions that detections and collection used. Range tests are computed in f64: distance^2 <= t^2.

use rand::RngExt;

use super::metrics::{EpisodeMetrics, MetricsCounter};
use super::walk::RandomWalk;
use super::{Boundary, DIRECTIONS, EnvConfig, Layout, Point, Start};
use crate::invalid::Invalid;
use crate::rng;

/// Why a step was rejected. The environment does not change.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum StepError {
    /// The episode has reached the time limit K.
    #[error("the episode ended after {slots} slots; reset starts a new one")]
    Finished {
        /// K.
        slots: usize,
    },
    /// The actions are invalid.
    #[error(transparent)]
    Invalid(#[from] Invalid),
}

/// B copies of one environment in the same slot of their episodes.
#[derive(Clone, Debug)]
pub struct BatchEnv {
    config: EnvConfig,
    copies: usize,
    slot: usize,
    /// Displacement by each action.
    moves: Vec<Point>,
    /// Per-user weights, scaled to mean 1.
    weights: Vec<f64>,
    /// (M) whether the UAV is lost: it neither moves nor collects.
    lost: Vec<bool>,
    /// (N) whether the user is there in the current slot.
    there: Vec<bool>,
    uav_xy: Vec<f32>,
    user_xy: Vec<f32>,
    aoi: Vec<f32>,
    reward: Vec<f32>,
    walks: Vec<RandomWalk>,
    counter: MetricsCounter,
}

impl BatchEnv {
    /// `copies` environments at slot 0 of the episodes with seeds 0, 1, and so on. [`BatchEnv::reset`] chooses other seeds.
    ///
    /// # Errors
    /// [`Invalid`] for the first field of `config` that is out of range, or for `copies` if it is 0.
    pub fn new(config: &EnvConfig, copies: usize) -> Result<Self, Invalid> {
        config.validate()?;
        if copies == 0 {
            return Err(Invalid::new("copies", copies, "at least 1"));
        }
        let (m, n) = (config.uavs, config.users);
        let mut env = Self {
            copies,
            slot: 0,
            moves: DIRECTIONS[..config.actions()].iter().map(|d| [d[0] * config.speed, d[1] * config.speed]).collect(),
            weights: config.user_weights(),
            lost: vec![false; m],
            there: vec![true; n],
            uav_xy: vec![0.0; copies * m * 2],
            user_xy: vec![0.0; copies * n * 2],
            aoi: vec![0.0; copies * n],
            reward: vec![0.0; copies],
            walks: Vec::new(),
            counter: MetricsCounter::new(copies, n, config.slots),
            config: config.clone(),
        };
        let seeds: Vec<u64> = (0..copies as u64).collect();
        env.reset(&seeds);
        Ok(env)
    }

    /// Starts a new episode in every copy. The layout of an episode depends on its seed and N only.
    ///
    /// # Panics
    /// If the number of seeds is not the number of copies.
    pub fn reset(&mut self, seeds: &[u64]) {
        assert_eq!(seeds.len(), self.copies, "one seed per copy");
        let (m, n) = (self.config.uavs, self.config.users);
        self.slot = 0;
        self.lost.fill(false);
        self.there.fill(true);
        self.lose_uavs(0);
        self.update_users(0);
        self.aoi.fill(0.0);
        self.reward.fill(0.0);
        self.counter.clear();
        self.walks.clear();
        for (b, &seed) in seeds.iter().enumerate() {
            let users = &mut self.user_xy[b * n * 2..(b + 1) * n * 2];
            match &self.config.layout {
                Layout::Random => uniform(users, seed, "layout"),
                Layout::Given(points) => given(users, points),
            }
            let uavs = &mut self.uav_xy[b * m * 2..(b + 1) * m * 2];
            match &self.config.start {
                Start::Center => uavs.fill(0.5),
                Start::Random => uniform(uavs, seed, "start"),
                Start::Given(points) => given(uavs, points),
            }
            if self.config.user_speed > 0.0 {
                self.walks.push(RandomWalk::new(seed, n, self.config.user_speed));
            }
        }
    }

    /// Advances one slot (docs/model.md, "Step") and returns the rewards (B).
    ///
    /// # Panics
    /// If the episode has ended, or `actions` (B, M) are invalid. [`BatchEnv::try_step`] checks them.
    pub fn step(&mut self, actions: &[u8]) -> &[f32] {
        assert!(self.slot < self.config.slots, "the episode has ended");
        assert_eq!(actions.len(), self.copies * self.config.uavs, "one action per UAV");
        let clamp = self.config.boundary == Boundary::Clamp;
        let flying = self.lost.iter().cycle().map(|lost| !lost);
        for ((xy, &action), flying) in self.uav_xy.chunks_exact_mut(2).zip(actions).zip(flying) {
            if !flying {
                continue;
            }
            let by = self.moves[action as usize];
            for (x, by) in xy.iter_mut().zip(by) {
                let to = f64::from(*x) + by;
                *x = if clamp { to.clamp(0.0, 1.0) } else { to } as f32;
            }
        }
        let n = self.config.users;
        for (walk, users) in self.walks.iter_mut().zip(self.user_xy.chunks_exact_mut(n * 2)) {
            walk.step(users);
        }
        let before = self.update_users(self.slot + 1);
        self.collect(&before);
        self.slot += 1;
        self.lose_uavs(self.slot);
        &self.reward
    }

    /// [`BatchEnv::step`] with checks of the actions.
    ///
    /// # Errors
    /// [`StepError::Finished`] if the episode has ended, [`StepError::Invalid`] if the number of actions is wrong or a heading index
    /// does not exist.
    pub fn try_step(&mut self, actions: &[u8]) -> Result<&[f32], StepError> {
        if self.slot >= self.config.slots {
            return Err(StepError::Finished { slots: self.config.slots });
        }
        let expected = self.copies * self.config.uavs;
        if actions.len() != expected {
            let expected = format!("{expected}, one per UAV");
            return Err(Invalid::new("actions", format!("{} heading indices", actions.len()), expected).into());
        }
        if let Some(i) = actions.iter().position(|&a| usize::from(a) >= self.moves.len()) {
            let expected = format!("a heading index from 0 to {}", self.moves.len() - 1);
            return Err(Invalid::new(format!("actions[{i}]"), actions[i], expected).into());
        }
        Ok(self.step(actions))
    }

    fn lose_uavs(&mut self, slot: usize) {
        if let Some(lost) = self.config.lose_uav {
            self.lost[lost.uav] |= lost.slot <= slot;
        }
    }

    /// Determines the users that are there in `slot`. Returns those that were there before; empty if users do not come and go.
    fn update_users(&mut self, slot: usize) -> Vec<bool> {
        let Self { config, there, .. } = self;
        if config.user_slots.is_empty() {
            return Vec::new();
        }
        let before = there.clone();
        config.user_slots.iter().for_each(|user| there[user.user] = user.contains(slot));
        before
    }

    /// Collects data at the current positions and computes AoI, metrics and rewards. `before`: see [`BatchEnv::update_users`].
    fn collect(&mut self, before: &[bool]) {
        let (m, n) = (self.config.uavs, self.config.users);
        let range = self.config.transmission_range * self.config.transmission_range;
        let factor = self.config.effective_reward_scale();
        for b in 0..self.copies {
            let uavs = &self.uav_xy[b * m * 2..(b + 1) * m * 2];
            let users = &self.user_xy[b * n * 2..(b + 1) * n * 2];
            let aoi = &mut self.aoi[b * n..(b + 1) * n];
            let (mut sum, mut total) = (0.0, n as f64);
            for (j, ((user, age), weight)) in users.chunks_exact(2).zip(aoi.iter_mut()).zip(&self.weights).enumerate() {
                let (x, y) = (f64::from(user[0]), f64::from(user[1]));
                let collected = uavs.chunks_exact(2).zip(&self.lost).any(|(uav, lost)| {
                    let (dx, dy) = (f64::from(uav[0]) - x, f64::from(uav[1]) - y);
                    dx * dx + dy * dy <= range && !lost
                });
                let came = before.get(j) == Some(&false);
                *age = if collected || came || !self.there[j] { 0.0 } else { *age + 1.0 };
                sum += weight * f64::from(*age);
            }
            if before.is_empty() {
                self.counter.add(b, aoi);
            } else {
                self.counter.add_present(b, aoi, &self.there);
                total = self
                    .weights
                    .iter()
                    .zip(&self.there)
                    .filter(|(_, there)| **there)
                    .map(|(weight, _)| weight)
                    .sum::<f64>()
                    .max(1e-9);
            }
            self.reward[b] = (-factor * sum / total) as f32;
        }
    }

    /// Until the next reset, UAV `uav` of every copy ignores its actions, stays in place and collects nothing.
    ///
    /// # Panics
    /// If `uav` is not below M.
    pub fn lose_uav(&mut self, uav: usize) {
        self.lost[uav] = true;
    }

    /// Mean AoI over the users of copy `b` in the current slot, weighted if users have weights, in slots.
    ///
    /// # Panics
    /// If `b` is not below the number of copies.
    pub fn mean_aoi(&self, b: usize) -> f64 {
        let n = self.config.users;
        let aoi = &self.aoi[b * n..(b + 1) * n];
        let there = |j: usize| if self.there[j] { self.weights[j] } else { 0.0 };
        // Users that are not there have AoI 0.
        let total = if self.config.user_slots.is_empty() { n as f64 } else { (0..n).map(there).sum::<f64>().max(1e-9) };
        aoi.iter().zip(&self.weights).map(|(&a, w)| w * f64::from(a)).sum::<f64>() / total
    }

    /// Metrics of copy `b` over the slots so far.
    ///
    /// # Panics
    /// If `b` is not below the number of copies.
    pub fn metrics(&self, b: usize) -> EpisodeMetrics {
        self.counter.metrics(b, self.slot, &self.weights)
    }

    /// The configuration.
    pub fn config(&self) -> &EnvConfig {
        &self.config
    }

    /// B, the number of copies.
    pub fn copies(&self) -> usize {
        self.copies
    }

    /// Slots since the reset.
    pub fn slot(&self) -> usize {
        self.slot
    }

    /// Whether the episode has reached the time limit K.
    pub fn done(&self) -> bool {
        self.slot >= self.config.slots
    }

    /// (B, M, 2) UAV positions.
    pub fn uav_xy(&self) -> &[f32] {
        &self.uav_xy
    }

    /// (B, N, 2) user positions.
    pub fn user_xy(&self) -> &[f32] {
        &self.user_xy
    }

    /// (B, N) AoI in slots.
    pub fn aoi(&self) -> &[f32] {
        &self.aoi
    }

    /// (B) rewards of the last step, 0 after a reset.
    pub fn reward(&self) -> &[f32] {
        &self.reward
    }
}

/// Draws coordinates uniformly in the unit square, from the stream `name` of the episode.
fn uniform(xy: &mut [f32], seed: u64, name: &str) {
    let mut rng = rng::stream(seed, name, 0);
    for x in xy {
        *x = rng.random::<f64>() as f32;
    }
}

fn given(xy: &mut [f32], points: &[Point]) {
    for (x, from) in xy.iter_mut().zip(points.as_flattened()) {
        *x = *from as f32;
    }
}
