//! A training run as an iterator of events (docs/model.md, "Learner").
//!
//! An iteration collects `envs` episodes, makes its updates, and copies the target networks when due. The greedy policy is evaluated
//! at step 0, every `eval_every` steps and at the end, on `eval_episodes` layouts of `valid-v1`; training never uses `eval-v1`.
//! (configuration, seed) fixes every event and parameter, whatever the number of threads. A run restored from a snapshot yields the
//! same events and parameters as a run without interruption.
//!
//! An event is a unit of work: between two events the run can be stopped and a snapshot taken. An evaluation has several if it has
//! many layouts or large ones.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use rand::RngExt;

use super::episodes::Symmetry;
use super::evaluation::{evaluate_until, layouts_per_part};
use super::replay::{Replay, group_environment};
use super::rollout::Rollout;
use super::snapshot::{self, SnapshotError};
use super::state::{Counters, Phase, RunState};
use super::{Disturbance, Episodes, Evaluation, Event, Iteration, Learner, TrainConfig, layout_list};
use crate::checkpoint::{self, Checkpoint};
use crate::env::EpisodeMetrics;
use crate::invalid::Invalid;
use crate::rng;

/// A training run.
pub struct Trainer {
    config: TrainConfig,
    threads: usize,
    learner: Learner,
    rollout: Rollout,
    replay: Replay,
    batch: Vec<Episodes>,
    run: RunState,
    stop: Arc<AtomicBool>,
}

impl Trainer {
    /// A new run.
    ///
    /// # Errors
    /// [`Invalid`] if the configuration is invalid or the threads cannot be started.
    pub fn new(config: TrainConfig, threads: usize) -> Result<Self, Invalid> {
        config.validate()?;
        let learner = Learner::new(&config, threads)?;
        Ok(Self {
            rollout: Rollout::new(&config, &config.environment, learner.agent())?,
            threads,
            learner,
            replay: Replay::new(&config),
            batch: Vec::new(),
            run: RunState::new(),
            stop: Arc::default(),
            config,
        })
    }

    /// The run of a [`Trainer::snapshot`], with any number of threads.
    ///
    /// # Errors
    /// [`SnapshotError`] if the bytes are damaged, of another version, or inconsistent.
    pub fn restore(bytes: &[u8], threads: usize) -> Result<Self, SnapshotError> {
        let snapshot = snapshot::decode(bytes)?;
        let mut trainer = Self::new(snapshot.config, threads)?;
        trainer.learner.restore(snapshot.learner)?;
        trainer.replay = snapshot.replay;
        trainer.run = snapshot.run;
        Ok(trainer)
    }

    /// Begins with the parameters of a checkpoint instead of drawn ones. Returns whether those of the mixer are among them. To be
    /// called before the first step.
    ///
    /// # Errors
    /// [`Invalid`] with the field of the architecture that differs.
    pub fn begin_with(&mut self, checkpoint: &Checkpoint) -> Result<bool, Invalid> {
        let initial = checkpoint.initial_parameters(&self.config, self.learner.parameters())?;
        self.learner.begin_with(&initial.parameters);
        Ok(initial.mixer)
    }

    /// Lets a restored run go on to `steps` environment steps, which is not less than before.
    ///
    /// # Errors
    /// [`Invalid`] for fewer steps, or if training diverged.
    pub fn extend_to(&mut self, steps: u64) -> Result<(), Invalid> {
        let before = self.config.training.steps;
        let Counters { phase, env_steps, .. } = self.run.counters;
        if steps < before || (phase == Phase::Done && env_steps < before) {
            return Err(Invalid::new("training.steps", steps, format!("at least {before}, in a run that did not diverge")));
        }
        self.config.training.steps = steps;
        let ended = env_steps > 0 && !matches!(phase, Phase::Evaluate | Phase::Iterate);
        if ended && env_steps < steps {
            self.run.layouts.clear();
            self.run.counters.phase = Phase::Iterate;
        }
        Ok(())
    }

    /// Everything needed to resume the run later, also on another machine.
    pub fn snapshot(&self) -> Vec<u8> {
        snapshot::encode(&self.config, &self.run, &self.learner.state(), &self.replay)
    }

    /// Adds reports: evaluations on `eval_episodes` layouts of `eval-v1` (at most all of them), of the initial parameters before the
    /// first step and of the best ones after the last. A run that has them already stays as it is.
    pub fn add_reports(&mut self) {
        let Counters { phase, env_steps, .. } = self.run.counters;
        if std::mem::replace(&mut self.run.reports, true) {
            return;
        }
        let begun = self.run.latest.is_some() || !self.run.layouts.is_empty();
        let all_steps = env_steps >= self.config.training.steps && matches!(phase, Phase::YieldFinished | Phase::Done);
        if !begun || all_steps {
            self.run.counters.phase = Phase::Report;
        }
    }

    /// Uses `stop` as the stop flag, see [`Trainer::stop_flag`].
    pub fn stop_with(&mut self, stop: Arc<AtomicBool>) {
        self.stop = stop;
    }

    /// A flag that stops the run: while it is set, [`Iterator::next`] returns `None`. An iteration in progress is completed and
    /// returned; a part of an evaluation is not, and is repeated later.
    pub fn stop_flag(&self) -> Arc<AtomicBool> {
        Arc::clone(&self.stop)
    }

    /// The configuration.
    pub fn config(&self) -> &TrainConfig {
        &self.config
    }

    /// Environment steps made.
    pub fn env_steps(&self) -> u64 {
        self.run.counters.env_steps
    }

    /// Whether the run has ended: all steps are made, or training diverged.
    pub fn finished(&self) -> bool {
        self.run.counters.phase == Phase::Done
    }

    /// The current parameters, with metrics if they were just evaluated.
    ///
    /// # Errors
    /// [`checkpoint::Error::Value`] if training diverged.
    pub fn checkpoint(&self) -> Result<Checkpoint, checkpoint::Error> {
        let latest = self.run.latest.filter(|e| e.env_steps == self.run.counters.env_steps);
        let parameters = self.learner.published_parameters().to_vec();
        Checkpoint::new(self.config.clone(), self.run.counters.env_steps, latest.map(|e| e.metrics), parameters)
    }

    /// The parameters with the lowest mean AoI on the validation layouts so far; `None` before the first evaluation.
    ///
    /// # Errors
    /// [`checkpoint::Error::Value`] if training diverged.
    pub fn best(&self) -> Result<Option<Checkpoint>, checkpoint::Error> {
        let best = self.run.best.as_ref();
        best.map(|(e, parameters)| Checkpoint::new(self.config.clone(), e.env_steps, Some(e.metrics), parameters.clone()))
            .transpose()
    }

    /// The evaluation of the best parameters.
    pub fn best_evaluation(&self) -> Option<Evaluation> {
        self.run.best.as_ref().map(|(e, _)| *e)
    }

    /// Evaluates the next part of the layouts: of the validation layouts in [`Phase::Evaluate`], of the layouts of reports in
    /// [`Phase::Report`]. `None` if the stop flag is set meanwhile.
    fn evaluate(&mut self) -> Option<Event> {
        let (config, run) = (&self.config, &mut self.run);
        let reporting = run.counters.phase == Phase::Report;
        let trained = run.counters.env_steps > 0;
        let published = self.learner.published_parameters();
        let parameters = match &run.best {
            Some((_, best)) if reporting && trained => best,
            _ => published,
        };
        let list = layout_list(if reporting { "eval-v1" } else { "valid-v1" }).expect("both lists exist");
        let seeds = list.seeds(config.training.eval_episodes);
        let rest = &seeds[run.layouts.len().min(seeds.len())..];
        let part = &rest[..rest.len().min(layouts_per_part(&config.environment, 8))];
        let agent_parameters = parameters[..self.learner.agent().layout().len()].to_vec();
        let policy = config.policy(agent_parameters).expect("the parameters have the length of the agent's layout");
        let metrics = evaluate_until(&policy, &config.environment, part, self.threads, &Disturbance::default(), &self.stop);
        run.layouts.extend(metrics.expect("an agent fits its environment")?);
        let env_steps = run.counters.env_steps;
        if run.layouts.len() < seeds.len() {
            return Some(Event::Evaluating { env_steps, layouts: run.layouts.len() });
        }
        let now = Evaluation { env_steps, metrics: EpisodeMetrics::mean(&std::mem::take(&mut run.layouts)) };
        if reporting {
            run.counters.phase = if env_steps >= config.training.steps { Phase::YieldFinished } else { Phase::Evaluate };
            return Some(Event::Report(now));
        }
        run.latest = Some(now);
        if run.best.as_ref().is_none_or(|(best, _)| now.metrics.mean_aoi < best.metrics.mean_aoi) {
            run.best = Some((now, published.to_vec()));
        }
        let t = &config.training;
        run.counters.next_evaluation = (env_steps / t.eval_every + 1) * t.eval_every;
        run.counters.phase = match run.reports {
            _ if env_steps < t.steps => Phase::Iterate,
            true => Phase::Report,
            false => Phase::YieldFinished,
        };
        Some(Event::Evaluation(now))
    }

    fn iterate(&mut self) -> Event {
        let t = &self.config.training;
        let counters = &mut self.run.counters;
        let epsilon = t.epsilon_at(counters.env_steps);
        let learning_rate = t.learning_rate_at(counters.env_steps);
        if !t.vary.is_none() {
            let environment = group_environment(&self.config, counters.episodes);
            self.rollout =
                Rollout::new(&self.config, &environment, self.learner.agent()).expect("every drawn environment is valid");
        }
        let episodes = self.rollout.collect(self.learner.agent(), self.learner.agent_parameters(), epsilon, counters.episodes);
        counters.env_steps += (episodes.len * episodes.slots) as u64;
        counters.episodes += episodes.len as u64;
        self.replay.push(episodes);
        let (mut loss, mut grad_norm, mut q_tot) = (0.0, 0.0, 0.0);
        let learning = self.replay.len() >= t.batch;
        if learning {
            for _ in 0..t.updates_per_iteration {
                let mut draw = rng::stream(self.config.seed, "replay", counters.updates);
                self.replay.sample(t.batch, &mut draw, &mut self.batch);
                if t.augment {
                    for group in &mut self.batch {
                        let symmetries: Vec<_> =
                            (0..group.len).map(|_| Symmetry::from_index(draw.random_range(0..Symmetry::COUNT))).collect();
                        group.transform(&symmetries);
                    }
                }
                let update = self.learner.update(&self.batch, learning_rate);
                loss += update.loss;
                grad_norm += update.grad_norm;
                q_tot += update.q_tot;
                counters.updates += 1;
            }
            if t.target_tau == 0.0 && counters.episodes - counters.targets_copied_at_episode >= t.target_every {
                self.learner.sync_targets();
                counters.targets_copied_at_episode = counters.episodes;
            }
        }
        if self.learner.parameters().iter().any(|x| x.is_nan() || x.abs() > checkpoint::MAX_MAGNITUDE) {
            counters.phase = Phase::Done;
            return Event::Diverged { env_steps: counters.env_steps };
        }
        let mean = |sum: f64| learning.then(|| sum / t.updates_per_iteration as f64);
        counters.phase = if counters.env_steps >= t.steps || counters.env_steps >= counters.next_evaluation {
            Phase::Evaluate
        } else {
            Phase::Iterate
        };
        Event::Iteration(Iteration {
            env_steps: counters.env_steps,
            episodes: counters.episodes,
            updates: counters.updates,
            epsilon,
            mean_aoi: self.rollout.mean_aoi(),
            loss: mean(loss),
            grad_norm: mean(grad_norm),
            q_tot: mean(q_tot),
        })
    }
}

impl Iterator for Trainer {
    type Item = Event;

    fn next(&mut self) -> Option<Event> {
        if self.stop.load(Ordering::Acquire) {
            return None;
        }
        match self.run.counters.phase {
            Phase::Evaluate | Phase::Report => self.evaluate(),
            Phase::Iterate => Some(self.iterate()),
            Phase::YieldFinished => {
                self.run.counters.phase = Phase::Done;
                Some(Event::Finished { env_steps: self.run.counters.env_steps })
            }
            Phase::Done => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train_config::{Algorithm, Preset};

    #[test]
    fn a_diverged_run_ends_and_keeps_its_best_weights() {
        let mut config = TrainConfig::preset(Algorithm::Vdn, Preset::Practical);
        config.environment.slots = 5;
        config.training.batch = 8;
        let mut trainer = Trainer::new(config, 1).unwrap();
        assert!(trainer.by_ref().any(|event| matches!(event, Event::Evaluation(_))));
        let best = trainer.best().unwrap().unwrap();
        let mut state = trainer.learner.state();
        state.online.fill(1e30);
        trainer.learner.restore(state).unwrap();
        assert_eq!(trainer.next(), Some(Event::Diverged { env_steps: 40 }));
        assert!(trainer.finished() && trainer.next().is_none());
        assert!(trainer.checkpoint().is_err());
        assert_eq!(trainer.best().unwrap(), Some(best));
        let mut restored = Trainer::restore(&trainer.snapshot(), 1).unwrap();
        assert!(restored.next().is_none(), "a restored run that diverged yields no events");
    }
}
