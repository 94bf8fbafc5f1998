//! Training within an attempt: turns the events of the trainer into metrics, snapshots and checkpoints. It uses no network.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use tokio::sync::mpsc::Sender;

use super::early_stop::StopRule;
use super::run_report::{self, TrainedRun};
use super::{ServerHandle, StopSignal, rival};
use crate::checkpoint::{self, Checkpoint};
use crate::invalid::Invalid;
use crate::jobs::Directive;
use crate::jobs::experiment_jobs::RunReport;
use crate::jobs::metric_names::SPEED;
use crate::learner::{Evaluation, Event, TrainConfig, Trainer};
use crate::store::WorkerResult;
use crate::wire::v1::CheckpointKind;

/// Maximum number of points of a curve. Longer runs skip iterations, the same ones in every run.
const MAX_POINTS: u64 = 4000;

/// A metric: step, name, value.
pub(super) type Row = (u64, &'static str, f64);

/// A report of training to the server.
#[derive(Debug)]
pub(super) enum Report {
    /// Metrics, and the current step of training.
    Metrics { step: u64, rows: Vec<Row> },
    /// The current step of a job that has no metrics.
    Progress { step: u64 },
    /// Everything needed to resume at `step`.
    Snapshot { step: u64, bytes: Vec<u8> },
    /// A policy.
    Checkpoint { kind: CheckpointKind, step: u64, bytes: Vec<u8>, metrics: Vec<(&'static str, f64)> },
}

/// A training run.
pub(super) struct TrainingTask {
    pub config: TrainConfig,
    pub threads: usize,
    pub snapshot: Option<Vec<u8>>,
    /// The checkpoint that training begins with, if there is no snapshot; `None`: weights are drawn.
    pub initial_weights: Option<Vec<u8>>,
    pub snapshot_every: Duration,
    /// When training ends before all steps are done.
    pub stop_rule: Option<StopRule>,
    /// Whether the best checkpoint is compared with a policy of the server.
    pub rival: bool,
    /// What is evaluated after training.
    pub report: Option<RunReport>,
}

/// The queue of reports. Adding a report waits while the queue is full.
pub(super) struct ReportQueue {
    reports: Sender<Report>,
    snapshot_pending: Arc<AtomicBool>,
}

impl ReportQueue {
    pub(super) fn new(reports: Sender<Report>) -> Self {
        Self { reports, snapshot_pending: Arc::default() }
    }

    /// Whether a snapshot is queued. The sender of the queue clears it when it has uploaded the snapshot.
    pub(super) fn snapshot_pending(&self) -> Arc<AtomicBool> {
        Arc::clone(&self.snapshot_pending)
    }

    pub(super) fn push(&self, report: Report) {
        // The receiver is dropped when the process is about to end.
        let _ = self.reports.blocking_send(report);
    }

    fn snapshot(&self, trainer: &Trainer) {
        self.snapshot_pending.store(true, Ordering::Release);
        self.push(Report::Snapshot { step: trainer.env_steps(), bytes: trainer.snapshot() });
    }

    fn checkpoint(&self, kind: CheckpointKind, checkpoint: &Checkpoint) {
        let metrics = checkpoint.metrics().map_or_else(Vec::new, |metrics| {
            let rows = Event::Evaluation(Evaluation { env_steps: checkpoint.env_steps(), metrics: *metrics }).rows();
            rows.into_iter().map(|(_, name, value)| (name, value)).collect()
        });
        self.push(Report::Checkpoint { kind, step: checkpoint.env_steps(), bytes: checkpoint.to_bytes(), metrics });
    }
}

/// Trains until the end, or until `stop` is set. Returns how that ended, and the comparison with the rival as JSON if there is one.
pub(super) fn train(
    task: TrainingTask,
    reports: &ReportQueue,
    stop: &StopSignal,
    server: &ServerHandle,
) -> (WorkerResult, Option<String>) {
    let (rival, threads, report) = (task.rival, task.threads, task.report.clone());
    let trained = try_train(task, reports, stop).and_then(|(end, run)| match (run, report) {
        (Some(run), Some(report)) => {
            tracing::info!("training is done; evaluating");
            let reported = run_report::evaluate(&run, &report, threads, &stop.flag())?;
            let reported = reported.map(|reported| serde_json::to_string(&reported)).transpose()?;
            Ok((if reported.is_some() { end } else { WorkerResult::Stopped }, reported))
        }
        (Some(TrainedRun { best, .. }), None) if rival => {
            let Some(rival) = server.rival()? else { return Ok((end, None)) };
            tracing::info!(rival = rival.0, "training is done; comparing the best checkpoint");
            let compared = rival::compare(&best, &rival, threads, &stop.flag());
            let compared = compared.map(|comparison| serde_json::to_string(&comparison)).transpose()?;
            Ok((if compared.is_some() { end } else { WorkerResult::Stopped }, compared))
        }
        _ => Ok((end, None)),
    });
    match trained {
        Ok(ended) => ended,
        Err(e) => {
            // Another attempt would fail with the same configuration, snapshot or weights, but the host may have threads again.
            let permanent = e.downcast_ref::<Invalid>().is_none_or(|e| e.field != "threads");
            (WorkerResult::Failed { reason: e.to_string(), permanent }, None)
        }
    }
}

/// Trains. Returns how it ended, and the run if it has trained.
fn try_train(
    mut task: TrainingTask,
    reports: &ReportQueue,
    stop: &StopSignal,
) -> Result<(WorkerResult, Option<TrainedRun>), Box<dyn std::error::Error>> {
    let begun = Instant::now();
    let (snapshot_every, task_report) = (task.snapshot_every, task.report.is_some());
    let mut stop_rule = task.stop_rule.take();
    let mut trainer = begin(task)?;
    trainer.add_reports();
    trainer.stop_with(stop.flag());
    let mut curve = CurveSampler::new(trainer.config(), trainer.env_steps());
    let mut last_snapshot = Instant::now();
    while let Some(event) = trainer.next() {
        let rows = curve.rows(&event);
        let ends =
            stop_rule.as_mut().and_then(|rule| rows.iter().find_map(|&(step, name, value)| rule.observes(name, step, value)));
        if !rows.is_empty() {
            reports.push(Report::Metrics { step: trainer.env_steps(), rows });
        }
        match event {
            Event::Evaluation(evaluation)
                if trainer.best_evaluation().is_some_and(|best| best.env_steps == evaluation.env_steps) =>
            {
                if let Some(best) = trainer.best()? {
                    reports.checkpoint(CheckpointKind::Best, &best);
                }
            }
            // The best weights of a run that diverged are a result of an experiment, too.
            Event::Diverged { .. } if task_report => return Ok((WorkerResult::Succeeded, trained(&trainer, None, begun)?)),
            Event::Diverged { env_steps } => {
                let reason = format!("training diverged at step {env_steps}: a parameter is not finite or too large");
                return Ok((WorkerResult::Failed { reason, permanent: true }, None));
            }
            _ => {}
        }
        if let Some(reason) = ends {
            tracing::info!(step = trainer.env_steps(), "training ends early");
            let last = trainer.checkpoint()?;
            reports.checkpoint(CheckpointKind::Last, &last);
            return Ok((WorkerResult::EndedEarly { reason }, trained(&trainer, Some(last), begun)?));
        }
        if last_snapshot.elapsed() >= snapshot_every && !reports.snapshot_pending.load(Ordering::Acquire) {
            reports.snapshot(&trainer);
            last_snapshot = Instant::now();
        }
    }
    match stop.directive() {
        Directive::Cancel => Ok((WorkerResult::Stopped, None)),
        Directive::Pause if !trainer.finished() => {
            reports.snapshot(&trainer);
            Ok((WorkerResult::Stopped, None))
        }
        Directive::Pause | Directive::Continue => {
            let last = trainer.checkpoint()?;
            reports.checkpoint(CheckpointKind::Last, &last);
            Ok((WorkerResult::Succeeded, trained(&trainer, Some(last), begun)?))
        }
    }
}

/// A run that has trained; `None` without an evaluation.
fn trained(trainer: &Trainer, last: Option<Checkpoint>, begun: Instant) -> Result<Option<TrainedRun>, checkpoint::Error> {
    let (steps, seconds) = (trainer.env_steps(), begun.elapsed().as_secs_f64());
    Ok(trainer.best()?.map(|best| TrainedRun { best, last, steps, seconds }))
}

/// The run of a task: from its snapshot, from its initial weights, or anew.
fn begin(task: TrainingTask) -> Result<Trainer, Box<dyn std::error::Error>> {
    let TrainingTask { config, threads, snapshot, initial_weights, .. } = task;
    if let Some(bytes) = snapshot {
        let mut trainer = Trainer::restore(&bytes, threads)?;
        // The snapshot of a job that this one continues has the configuration of that job.
        trainer.extend_to(config.training.steps)?;
        return Ok(trainer);
    }
    let mut trainer = Trainer::new(config, threads)?;
    if let Some(bytes) = initial_weights {
        let checkpoint = Checkpoint::from_bytes(&bytes)?;
        let mixer = trainer.begin_with(&checkpoint)?;
        tracing::info!(from_step = checkpoint.env_steps(), mixer, "training begins with given weights");
    }
    Ok(trainer)
}

/// Selects the iterations that become points of a training curve, and adds the training speed to them.
struct CurveSampler {
    steps_per_iteration: u64,
    iterations_per_point: u64,
    /// Environment steps of the whole run.
    total_steps: u64,
    /// Step and time of the last point.
    last_point: (u64, Instant),
}

impl CurveSampler {
    fn new(config: &TrainConfig, step: u64) -> Self {
        let steps_per_iteration = (config.training.envs * config.environment.slots) as u64;
        let total_steps = config.training.steps;
        let iterations_per_point = total_steps.div_ceil(steps_per_iteration).div_ceil(MAX_POINTS).max(1);
        Self { steps_per_iteration, iterations_per_point, total_steps, last_point: (step, Instant::now()) }
    }

    fn rows(&mut self, event: &Event) -> Vec<Row> {
        let mut rows = event.rows();
        if let Event::Iteration(done) = event {
            let regular = (done.env_steps / self.steps_per_iteration).is_multiple_of(self.iterations_per_point);
            if !regular && done.env_steps < self.total_steps {
                return Vec::new();
            }
            let now = Instant::now();
            let seconds = (now - self.last_point.1).as_secs_f64();
            rows.push((done.env_steps, SPEED, (done.env_steps - self.last_point.0) as f64 / seconds));
            self.last_point = (done.env_steps, now);
        }
        rows
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::learner::Iteration;
    use crate::train_config::{Algorithm, Preset};

    fn curve_of(steps: u64) -> Vec<u64> {
        let mut config = TrainConfig::preset(Algorithm::Qmix, Preset::Practical);
        config.training.steps = steps;
        let (mut curve, mut points) = (CurveSampler::new(&config, 0), Vec::new());
        let iteration = curve.steps_per_iteration;
        for step in (iteration..steps + iteration).step_by(iteration as usize) {
            let done = Iteration {
                env_steps: step,
                episodes: 0,
                updates: 0,
                epsilon: 1.0,
                mean_aoi: 1.0,
                loss: None,
                grad_norm: None,
                q_tot: None,
            };
            if !curve.rows(&Event::Iteration(done)).is_empty() {
                points.push(step);
            }
        }
        points
    }

    #[test]
    fn long_run_has_at_most_max_points_and_always_the_last() {
        let short = curve_of(640 * 100);
        assert_eq!(short.len(), 100);
        let long = curve_of(640 * 9999);
        assert!(long.len() <= MAX_POINTS as usize && long.len() > 3000, "{}", long.len());
        assert_eq!(long.last(), Some(&(640 * 9999)));
    }
}
