//! The learner: parameters, targets and optimiser, and the update that moves them (spec 5).

use rayon::ThreadPool;

use super::episodes::Episodes;
use super::objective::{Figures, Objective, Returns};
use crate::invalid::{Invalid, in_range};
use crate::nn::{Adam, Layout};
use crate::policy::Agent;
use crate::recipe::TrainConfig;
use crate::rng;

/// What an update reports.
pub type Update = Figures;

/// Everything of a learner that a snapshot must hold; vectors as long as [`Learner::layout`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LearnerState {
    /// Parameters.
    pub online: Vec<f32>,
    /// Target parameters.
    pub target: Vec<f32>,
    /// Adam's first moments.
    pub adam_m: Vec<f32>,
    /// Adam's second moments.
    pub adam_v: Vec<f32>,
    /// Adam's steps.
    pub adam_steps: u64,
}

/// Online and target networks with their optimiser. Same configuration, same episodes: same bits, on any number of threads.
#[derive(Debug)]
pub struct Learner {
    objective: Objective<f32>,
    online: Vec<f32>,
    target: Vec<f32>,
    adam: Adam<f32>,
    learning_rate: f64,
    clip: f64,
    pool: ThreadPool,
}

impl Learner {
    /// A learner with parameters drawn from the configuration's seed, targets equal to them.
    ///
    /// # Errors
    /// When `threads` is not in 1..=1024, or that many cannot be started.
    pub fn new(config: &TrainConfig, threads: usize) -> Result<Self, Invalid> {
        in_range("threads", threads, 1..=1024)?;
        let training = &config.training;
        let returns = Returns { gamma: training.gamma, lambda: training.lambda };
        let objective = Objective::new(config.agent(), config.dims(), training.mixer.into(), returns, threads);
        let online = objective.layout().initialise(&mut rng::stream(config.seed, "init", 0));
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .thread_name(|i| format!("learner-{i}"))
            .build()
            .map_err(|e| Invalid::new("threads", threads, format!("as many threads as can be started ({e})")))?;
        Ok(Self {
            target: online.clone(),
            adam: Adam::new(online.len()),
            objective,
            online,
            learning_rate: training.learning_rate,
            clip: training.clip,
            pool,
        })
    }

    /// One step of Adam against the loss of `episodes`.
    ///
    /// # Panics
    /// When the episodes' sizes are not those of the configuration, or there are none.
    pub fn update(&mut self, episodes: &Episodes) -> Update {
        let Self { objective, online, target, adam, pool, .. } = self;
        let figures = pool.install(|| objective.evaluate(online, target, episodes, None));
        adam.step(online, objective.gradient(), self.learning_rate, (figures.grad_norm, self.clip));
        figures
    }

    /// Copies the online networks to the targets.
    pub fn sync_targets(&mut self) {
        self.target.copy_from_slice(&self.online);
    }

    /// The agents' architecture.
    pub fn agent(&self) -> &Agent {
        self.objective.agent()
    }

    /// Names, shapes and ranges of the flat vectors: `agent.*`, then `mixer.*`.
    pub fn layout(&self) -> &Layout {
        self.objective.layout()
    }

    /// All parameters of the online networks.
    pub fn parameters(&self) -> &[f32] {
        &self.online
    }

    /// The agents' parameters: the first part of [`Learner::parameters`].
    pub fn agent_parameters(&self) -> &[f32] {
        &self.online[..self.agent().layout().len()]
    }

    /// A copy of everything that training changes.
    pub fn state(&self) -> LearnerState {
        LearnerState {
            online: self.online.clone(),
            target: self.target.clone(),
            adam_m: self.adam.m.clone(),
            adam_v: self.adam.v.clone(),
            adam_steps: self.adam.steps,
        }
    }

    /// Puts a state back.
    ///
    /// # Errors
    /// When a vector's length is not that of this architecture.
    pub fn restore(&mut self, state: LearnerState) -> Result<(), Invalid> {
        let len = self.online.len();
        let parts = [("online", &state.online), ("target", &state.target), ("adam_m", &state.adam_m), ("adam_v", &state.adam_v)];
        for (name, part) in parts {
            if part.len() != len {
                return Err(Invalid::new(name, format!("{} numbers", part.len()), format!("{len} numbers")));
            }
        }
        self.online = state.online;
        self.target = state.target;
        self.adam = Adam { m: state.adam_m, v: state.adam_v, steps: state.adam_steps };
        Ok(())
    }
}
