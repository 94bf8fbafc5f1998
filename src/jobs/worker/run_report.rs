//! What a job of an experiment evaluates when it has trained: its best and its last weights, and the baselines of its point.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use crate::checkpoint::Checkpoint;
use crate::env::{EnvConfig, EpisodeMetrics};
use crate::experiment::{EvaluatedWeights, RunResult};
use crate::invalid::Invalid;
use crate::jobs::experiment_jobs::{ReportedRun, RunReport};
use crate::learner::{Disturbance, evaluate_until, layout_list, layouts_per_part};
use crate::policy::{Policy, baselines};

/// A run that has trained.
pub(super) struct TrainedRun {
    pub best: Checkpoint,
    /// `None`: training diverged.
    pub last: Option<Checkpoint>,
    /// Environment steps of the run.
    pub steps: u64,
    /// Seconds of this attempt.
    pub seconds: f64,
}

/// Evaluates a run. `None`: `stop` was set meanwhile.
///
/// # Errors
/// A policy does not fit its environment.
pub(super) fn evaluate(
    run: &TrainedRun,
    report: &RunReport,
    threads: usize,
    stop: &Arc<AtomicBool>,
) -> Result<Option<ReportedRun>, Invalid> {
    let seeds = layout_list(&report.layouts)?.seeds(report.episodes);
    let on_layouts = |policy: &dyn Policy, env: &EnvConfig| -> Result<Option<Vec<EpisodeMetrics>>, Invalid> {
        let mut episodes = Vec::with_capacity(seeds.len());
        for part in seeds.chunks(layouts_per_part(env, 1)) {
            let Some(part) = evaluate_until(policy, env, part, threads, &Disturbance::default(), stop)? else { return Ok(None) };
            episodes.extend(part);
        }
        Ok(Some(episodes))
    };
    let weights = |checkpoint: &Checkpoint| -> Result<Option<EvaluatedWeights>, Invalid> {
        let episodes = on_layouts(&checkpoint.policy(), &checkpoint.config().environment)?;
        Ok(episodes.map(|episodes| EvaluatedWeights { step: checkpoint.env_steps(), episodes }))
    };
    let Some(best) = weights(&run.best)? else { return Ok(None) };
    let last = match &run.last {
        None => None,
        Some(last) => match weights(last)? {
            None => return Ok(None),
            evaluated => evaluated,
        },
    };
    let mut of_baselines = Vec::new();
    for name in &report.baselines {
        let policy = baselines::by_name(name, (&report.environment).into())
            .ok_or_else(|| Invalid::new("baselines", name, "a baseline"))?;
        let Some(episodes) = on_layouts(policy.as_ref(), &report.environment)? else { return Ok(None) };
        of_baselines.push(episodes);
    }
    let (layouts, diverged) = (report.layouts.clone(), run.last.is_none());
    let run = RunResult { layouts, steps: run.steps, diverged, best, last, seconds: run.seconds };
    Ok(Some(ReportedRun { run, baselines: of_baselines }))
}
