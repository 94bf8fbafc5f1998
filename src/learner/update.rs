//! The learner: online and target networks, the optimiser, and the update (docs/model.md, "Optimiser").

use rayon::ThreadPool;

use super::episodes::Episodes;
use super::loss::{Loss, LossMetrics, TdLambda};
use crate::invalid::{Invalid, in_range};
use crate::nn::{Adam, ParameterLayout};
use crate::policy::Agent;
use crate::rng;
use crate::train_config::TrainConfig;

/// The state of a learner in a snapshot. Vectors have the length of [`Learner::parameter_layout`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LearnerState {
    /// Parameters of the online networks.
    pub online: Vec<f32>,
    /// Parameters of the target networks.
    pub target: Vec<f32>,
    /// Adam's first moments.
    pub adam_m: Vec<f32>,
    /// Adam's second moments.
    pub adam_v: Vec<f32>,
    /// Adam's steps.
    pub adam_steps: u64,
    /// Averaged parameters; empty without averaging.
    pub average: Vec<f32>,
}

/// Online and target networks and the optimiser. The same configuration and episodes give the same bits on any number of threads.
#[derive(Debug)]
pub struct Learner {
    loss: Loss<f32>,
    online: Vec<f32>,
    target: Vec<f32>,
    adam: Adam<f32>,
    average: Option<AveragedParameters>,
    clip: f64,
    tau: f32,
    pool: ThreadPool,
}

/// An exponential moving average of the online parameters.
#[derive(Debug)]
struct AveragedParameters {
    parameters: Vec<f32>,
    /// Number of updates that the average covers.
    updates: u64,
}

impl Learner {
    /// A learner with parameters initialised from the configuration's seed, and equal target networks.
    ///
    /// # Errors
    /// [`Invalid`] if `threads` is not in 1..=1024, or the threads cannot be started.
    pub fn new(config: &TrainConfig, threads: usize) -> Result<Self, Invalid> {
        in_range("threads", threads, 1..=1024)?;
        let training = &config.training;
        let td_lambda = TdLambda { gamma: training.gamma, lambda: training.lambda };
        let loss = Loss::new(config.agent(), config.dims(), training.mixer, td_lambda, threads);
        let mut online: Vec<f32> = loss.layout().initialise(&mut rng::stream(config.seed, "init", 0));
        // The last layers of the hypernetworks, by their names in the checkpoint.
        for p in loss.layout().parameters().iter().filter(|p| p.name.starts_with("mixer.") && p.name.contains(".2.")) {
            online[p.range.clone()].iter_mut().for_each(|x| *x *= training.hyper_init as f32);
        }
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .thread_name(|i| format!("learner-{i}"))
            .build()
            .map_err(|e| Invalid::new("threads", threads, format!("as many threads as can be started ({e})")))?;
        Ok(Self {
            target: online.clone(),
            adam: Adam::new(online.len()),
            loss,
            average: (training.average > 1).then(|| AveragedParameters { parameters: online.clone(), updates: training.average }),
            online,
            tau: training.target_tau as f32,
            clip: training.clip,
            pool,
        })
    }

    /// Makes these the parameters of all networks, before the first update.
    ///
    /// # Panics
    /// If there are not as many as the networks have.
    pub fn begin_with(&mut self, parameters: &[f32]) {
        self.online.copy_from_slice(parameters);
        self.target.copy_from_slice(parameters);
        if let Some(average) = &mut self.average {
            average.parameters.copy_from_slice(parameters);
        }
    }

    /// One Adam step on the loss of the episodes in `groups`, then the updates of target networks and averaged parameters.
    ///
    /// # Panics
    /// If the networks do not fit the sizes of the episodes, or there are no episodes.
    pub fn update(&mut self, groups: &[Episodes], learning_rate: f64) -> LossMetrics {
        let Self { loss, online, target, adam, pool, .. } = self;
        let metrics = pool.install(|| loss.compute_gradient(online, target, groups, None));
        adam.step(online, loss.gradient(), learning_rate, (metrics.grad_norm, self.clip));
        if self.tau > 0.0 {
            blend(&mut self.target, &self.online, self.tau);
        }
        if let Some(average) = &mut self.average {
            // The first averages are over the updates so far, and exclude the initial parameters.
            let updates = self.adam.steps.min(average.updates);
            blend(&mut average.parameters, &self.online, 1.0 / updates as f32);
        }
        metrics
    }

    /// Copies the online networks to the target networks.
    pub fn sync_targets(&mut self) {
        self.target.copy_from_slice(&self.online);
    }

    /// The agents' architecture.
    pub fn agent(&self) -> &Agent {
        self.loss.agent()
    }

    /// Names, shapes and ranges of the flat vectors: `agent.*`, then `mixer.*`.
    pub fn parameter_layout(&self) -> &ParameterLayout {
        self.loss.layout()
    }

    /// All parameters of the online networks.
    pub fn parameters(&self) -> &[f32] {
        &self.online
    }

    /// The parameters that are evaluated and published: the averaged ones, or those of the online networks without averaging.
    pub fn published_parameters(&self) -> &[f32] {
        self.average.as_ref().map_or(&self.online, |average| &average.parameters)
    }

    /// The agents' parameters: the first part of [`Learner::parameters`].
    pub fn agent_parameters(&self) -> &[f32] {
        &self.online[..self.agent().layout().len()]
    }

    /// A copy of the state.
    pub fn state(&self) -> LearnerState {
        LearnerState {
            online: self.online.clone(),
            target: self.target.clone(),
            adam_m: self.adam.m.clone(),
            adam_v: self.adam.v.clone(),
            adam_steps: self.adam.steps,
            average: self.average.as_ref().map_or_else(Vec::new, |average| average.parameters.clone()),
        }
    }

    /// Restores a state.
    ///
    /// # Errors
    /// [`Invalid`] if a vector has another length.
    pub fn restore(&mut self, state: LearnerState) -> Result<(), Invalid> {
        let len = self.online.len();
        let parts = [("online", &state.online), ("target", &state.target), ("adam_m", &state.adam_m), ("adam_v", &state.adam_v)];
        for (name, part) in parts {
            if part.len() != len {
                return Err(Invalid::new(name, format!("{} numbers", part.len()), format!("{len} numbers")));
            }
        }
        let averaged = if self.average.is_some() { len } else { 0 };
        if state.average.len() != averaged {
            return Err(Invalid::new("average", format!("{} numbers", state.average.len()), format!("{averaged} numbers")));
        }
        if let Some(average) = &mut self.average {
            average.parameters = state.average;
        }
        self.online = state.online;
        self.target = state.target;
        self.adam = Adam { m: state.adam_m, v: state.adam_v, steps: state.adam_steps };
        Ok(())
    }
}

/// Moves `to` towards `from` by the fraction `tau` of the difference.
fn blend(to: &mut [f32], from: &[f32], tau: f32) {
    to.iter_mut().zip(from).for_each(|(t, f)| *t += tau * (f - *t));
}
