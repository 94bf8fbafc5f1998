//! Collects episodes with epsilon-greedy exploration (docs/model.md, "Exploration"). Several episodes are stepped together.
//!
//! With `training.shaping`, the recorded reward is the AoI collected in the slot (a_i before the slot, a'_i after it):
//!
//! ```text
//! r' = r + gamma Phi(a') - Phi(a) = reward_scale / (1 - gamma) * mean_i w_i (a_i + 1) [a'_i = 0]
//! Phi(a) = -reward_scale * mean_i w_i (a_i / (1 - gamma) + 1 / (1 - gamma)^2)
//! ```
//!
//! Phi is the discounted return of a fleet that collects nothing from now on. It is a potential, so the optimal policies are the
//! same (Ng, Harada and Russell 1999).
//!
//! With `training.teacher`, a rule flies some of the UAVs (`learner::teacher`).
//!
//! The random streams of an episode (layout, tokens, exploration) depend on its number only, not on the episodes collected with it.
//! Nothing is allocated per slot.

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::replay::EpisodeShape;
use super::teacher::Teacher;
use super::{Episodes, TrainConfig};
use crate::env::{BatchEnv, EnvConfig};
use crate::invalid::Invalid;
use crate::nn::argmax;
use crate::policy::{Agent, BatchedAgent, Dims, StepInput, TOKEN};
use crate::rng;

/// The environments and the agents of a training run, and the last collected episodes.
#[derive(Debug)]
pub struct Rollout {
    seed: u64,
    env: BatchEnv,
    batched_agent: BatchedAgent,
    episodes: Episodes,
    seeds: Vec<u64>,
    exploration_rngs: Vec<ChaCha8Rng>,
    actions: Vec<u8>,
    teacher: Option<Teacher>,
    /// With shaping: per user reward_scale / (1 - gamma) * w_i / N.
    shaping_factors: Option<Vec<f64>>,
}

impl Rollout {
    /// A rollout of `training.envs` episodes at a time in `environment`.
    ///
    /// # Errors
    /// [`Invalid`] if the environment is invalid.
    pub fn new(config: &TrainConfig, environment: &EnvConfig, agent: &Agent) -> Result<Self, Invalid> {
        let fleets = config.training.envs;
        let (m, n, k) = (environment.uavs, environment.users, environment.slots);
        let env = BatchEnv::new(environment, fleets)?;
        let shape = EpisodeShape::of_environment(environment);
        let position_slots = if shape.users_move { k + 1 } else { 1 };
        let dims = Dims { uavs: m, users: n, env: environment.into() };
        let episodes = Episodes {
            env: dims.env,
            len: fleets,
            uav_xy: vec![0.0; fleets * (k + 1) * m * 2],
            user_xy: vec![0.0; fleets * position_slots * n * 2],
            aoi: vec![0.0; fleets * (k + 1) * n],
            actions: vec![0; fleets * k * m],
            reward: vec![0.0; fleets * k],
            identity_token: vec![0.0; fleets * m * TOKEN],
            ..shape.episodes()
        };
        Ok(Self {
            seed: config.seed,
            env,
            batched_agent: BatchedAgent::new(agent, dims, fleets),
            episodes,
            seeds: Vec::with_capacity(fleets),
            exploration_rngs: Vec::with_capacity(fleets),
            actions: vec![0; fleets * m],
            teacher: Teacher::new(config, environment, fleets)?,
            shaping_factors: config.training.shaping.then(|| {
                let factor = environment.effective_reward_scale() / (1.0 - config.training.gamma) / n as f64;
                environment.user_weights().iter().map(|w| w * factor).collect()
            }),
        })
    }

    /// Collects the episodes with the numbers `first`, `first + 1`, ..; `epsilon` is the probability of a random action.
    pub fn collect(&mut self, agent: &Agent, parameters: &[f32], epsilon: f64, first: u64) -> &Episodes {
        let numbers = first..first + self.env.copies() as u64;
        self.seeds.clear();
        self.seeds.extend(numbers.clone().map(|e| rng::training_episode_seed(self.seed, e)));
        self.exploration_rngs.clear();
        self.exploration_rngs.extend(numbers.map(|e| rng::stream(self.seed, "explore", e)));
        let tokens = self.episodes.identity_token.chunks_exact_mut(self.env.config().uavs * TOKEN);
        for (identity_token, &seed) in tokens.zip(&self.seeds) {
            let mut rng = rng::stream(seed, "token", 0);
            identity_token.fill_with(|| rng.random_range(-1.0..=1.0));
        }
        self.env.reset(&self.seeds);
        self.batched_agent.begin(agent, parameters, &self.episodes.identity_token);
        let actions = self.env.config().actions();
        let uavs = self.env.config().uavs;
        if let Some(teacher) = &mut self.teacher {
            teacher.begin(epsilon, &self.seeds, &mut self.exploration_rngs);
        }
        self.record_scene();
        while !self.env.done() {
            let input = StepInput { uav_xy: self.env.uav_xy(), user_xy: self.env.user_xy(), aoi: self.env.aoi() };
            let q = self.batched_agent.step(agent, input);
            if let Some(teacher) = &mut self.teacher {
                teacher.decide(&self.env);
            }
            for (i, (action, q)) in self.actions.iter_mut().zip(q.chunks_exact(actions)).enumerate() {
                let rng = &mut self.exploration_rngs[i / uavs];
                let (led, epsilon) = match &self.teacher {
                    Some(teacher) => (teacher.leads(i, rng), teacher.epsilon),
                    None => (None, epsilon),
                };
                *action = match led {
                    Some(heading) => heading,
                    None if rng.random::<f64>() < epsilon => rng.random_range(0..actions as u8),
                    None => argmax(q) as u8,
                };
            }
            self.batched_agent.record_actions(&self.actions);
            self.env.step(&self.actions);
            self.record_step();
            self.record_scene();
        }
        &self.episodes
    }

    /// Mean AoI of the last collected episodes.
    pub fn mean_aoi(&self) -> f64 {
        let b = self.env.copies();
        (0..b).map(|b| self.env.metrics(b).mean_aoi).sum::<f64>() / b as f64
    }

    /// Records positions and AoI of the current slot.
    fn record_scene(&mut self) {
        let (e, slot) = (&mut self.episodes, self.env.slot());
        place(&mut e.uav_xy, self.env.uav_xy(), e.len, slot);
        place(&mut e.aoi, self.env.aoi(), e.len, slot);
        if e.users_move || slot == 0 {
            place(&mut e.user_xy, self.env.user_xy(), e.len, slot);
        }
    }

    /// Records actions and rewards of the last step.
    fn record_step(&mut self) {
        let (e, slot) = (&mut self.episodes, self.env.slot() - 1);
        place(&mut e.actions, &self.actions, e.len, slot);
        let Some(factors) = &self.shaping_factors else {
            place(&mut e.reward, self.env.reward(), e.len, slot);
            return;
        };
        let (n, slots) = (factors.len(), e.slots);
        for (b, now) in self.env.aoi().chunks_exact(n).enumerate() {
            let before = &e.aoi[(b * (slots + 1) + slot) * n..][..n];
            let gains = factors.iter().zip(before).zip(now).filter(|(_, now)| **now == 0.0);
            e.reward[b * slots + slot] = gains.fold(0.0, |sum, ((f, before), _)| sum + f * (f64::from(*before) + 1.0)) as f32;
        }
    }
}

/// Writes `now` (B, W) to slot `slot` of `all` (B, T, W).
fn place<T: Copy>(all: &mut [T], now: &[T], episodes: usize, slot: usize) {
    let (total, width) = (all.len() / episodes, now.len() / episodes);
    for (all, now) in all.chunks_exact_mut(total).zip(now.chunks_exact(width)) {
        all[slot * width..][..width].copy_from_slice(now);
    }
}

#[cfg(test)]
#[allow(clippy::float_cmp, reason = "recorded values are exact")]
mod tests {
    use super::*;
    use crate::env::{Layout, Start};
    use crate::policy::Memory;
    use crate::train_config::{Algorithm, Preset};

    fn config(envs: usize, user_speed: f64) -> TrainConfig {
        let mut config = TrainConfig::preset(Algorithm::Qmix, Preset::Practical);
        config.environment.slots = 30;
        config.environment.user_speed = user_speed;
        config.training.envs = envs;
        config.training.shaping = false;
        config.training.memory = Memory::None;
        config.training.teacher = None;
        config
    }

    fn collect_episodes(config: &TrainConfig, epsilon: f64, first: u64) -> Episodes {
        let agent = Agent::new(config.agent(), config.dims());
        let parameters: Vec<f32> = agent.layout().initialise(&mut rng::stream(5, "test", 0));
        Rollout::new(config, &config.environment, &agent).unwrap().collect(&agent, &parameters, epsilon, first).clone()
    }

    #[test]
    fn recorded_episodes_equal_a_repetition_of_their_actions() {
        for user_speed in [0.0, 0.02] {
            let config = config(3, user_speed);
            let e = collect_episodes(&config, 0.5, 10);
            let (m, n, k) = (e.uavs, e.users, e.slots);
            for b in 0..e.len {
                let mut env = BatchEnv::new(&config.environment, 1).unwrap();
                env.reset(&[rng::training_episode_seed(config.seed, 10 + b as u64)]);
                for slot in 0..=k {
                    let at = b * (k + 1) + slot;
                    assert_eq!(env.uav_xy(), &e.uav_xy[at * m * 2..][..m * 2]);
                    assert_eq!(env.aoi(), &e.aoi[at * n..][..n]);
                    let users = if e.users_move { at } else { b };
                    assert_eq!(env.user_xy(), &e.user_xy[users * n * 2..][..n * 2]);
                    if slot < k {
                        env.step(&e.actions[(b * k + slot) * m..][..m]);
                        assert_eq!(env.reward()[0], e.reward[b * k + slot]);
                    }
                }
            }
            assert!(e.identity_token.iter().all(|t| (-1.0..=1.0).contains(t)));
        }
    }

    #[test]
    fn shaped_rewards_differ_by_a_potential() {
        let mut config = config(4, 0.0);
        config.environment.weights = Some(vec![1.0, 2.0, 3.0, 0.0, 4.0]);
        config.environment.slots = 60;
        let plain = collect_episodes(&config, 1.0, 0);
        config.training.shaping = true;
        config.training.gamma = 0.9;
        let shaped = collect_episodes(&config, 1.0, 0);
        assert_eq!(shaped.actions, plain.actions);
        let (gamma, scale) = (0.9, 1.0 / 60.0);
        let weights = [0.5, 1.0, 1.5, 0.0, 2.0];
        let potential = |aoi: &[f32]| {
            let worth = |a: f64| a / (1.0 - gamma) + 1.0 / (1.0 - gamma) / (1.0 - gamma);
            -scale * aoi.iter().zip(weights).map(|(&a, w)| w * worth(a.into())).sum::<f64>() / 5.0
        };
        let mut collected = 0;
        for e in 0..plain.len {
            for k in 0..60 {
                let at = |slot: usize| &plain.aoi[(e * 61 + slot) * 5..][..5];
                let r = f64::from(plain.reward[e * 60 + k]);
                let expected = r + gamma * potential(at(k + 1)) - potential(at(k));
                let got = f64::from(shaped.reward[e * 60 + k]);
                assert!((got - expected).abs() < 1e-5, "episode {e}, slot {k}: {got}, expected {expected}");
                collected += usize::from(got > 0.0);
            }
        }
        assert!(collected > 5);
    }

    #[test]
    fn an_episode_does_not_depend_on_the_others() {
        let (eight, three) = (collect_episodes(&config(8, 0.0), 1.0, 0), collect_episodes(&config(3, 0.0), 1.0, 4));
        let width = eight.slots * eight.uavs;
        assert_eq!(eight.actions[4 * width..7 * width], three.actions);
        assert_eq!(eight.identity_token[4 * 12..7 * 12], three.identity_token);
    }

    #[test]
    fn each_uav_explores_on_its_own() {
        let mut config = config(8, 0.0);
        // With one layout and no identity, all greedy UAVs of all fleets take the same actions.
        config.environment.start = Start::Center;
        config.environment.layout = Layout::Given(vec![[0.1, 0.2]; 5]);
        config.training.identity = crate::policy::Identity::None;
        let greedy = collect_episodes(&config, 0.0, 0).actions;
        assert!(greedy.chunks(3).all(|a| a[0] == a[1] && a[1] == a[2]));
        assert!(greedy.chunks(90).all(|episode| episode == &greedy[..90]));
        let random = collect_episodes(&config, 1.0, 0).actions;
        let together = random.chunks(3).filter(|a| a[0] == a[1] && a[1] == a[2]).count();
        // 240 slots, one in 64 expected.
        assert!(together < 15, "{together}");
        let mut counts = [0; 8];
        for &a in &random {
            counts[a as usize] += 1;
        }
        assert!(counts.iter().all(|c| (50..130).contains(c)), "{counts:?}: 90 each expected");
        let half = collect_episodes(&config, 0.5, 0).actions;
        assert_ne!(half, greedy);
        assert_ne!(half, random);
    }
}
