//! Training as an attempt does it: the trainer's events become rows, snapshots and checkpoints. No network here.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use tokio::sync::mpsc::UnboundedSender;

use super::Orders;
use crate::checkpoint::Checkpoint;
use crate::env::EpisodeMetrics;
use crate::jobs::Directive;
use crate::learner::{Event, TrainConfig, Trainer, evaluate, layouts};
use crate::wire::v1::CheckpointKind;

/// The layouts that a job's first and published policies are compared on; training never sees them.
const REFERENCE: &str = "eval-v1";
/// The row that says so.
const REFERENCE_ROW: &str = "eval-v1/mean_aoi";
/// Most points of a curve: a longer run leaves out iterations in between, always the same ones.
const POINTS: u64 = 4000;

/// A row: step, name, value.
pub(super) type Row = (u64, &'static str, f64);

/// What training tells the server.
#[derive(Debug)]
pub(super) enum Item {
    /// Figures, and the step training is at.
    Metrics { step: u64, rows: Vec<Row> },
    /// Everything needed to go on from `step`.
    Snapshot { step: u64, bytes: Vec<u8> },
    /// A policy.
    Checkpoint { kind: CheckpointKind, step: u64, bytes: Vec<u8>, metrics: Vec<(&'static str, f64)> },
}

/// How training ended.
#[derive(Debug)]
pub(super) enum End {
    /// All steps are done and everything is told.
    Finished,
    /// Stopped as ordered.
    Stopped,
    /// It cannot go on.
    Failed { reason: String, permanent: bool },
}

/// What to do.
pub(super) struct Task {
    pub config: TrainConfig,
    pub threads: usize,
    pub snapshot: Option<Vec<u8>>,
    pub snapshot_every: Duration,
}

/// Where training puts what it tells; it never waits for anybody.
pub(super) struct Outbox {
    items: UnboundedSender<Item>,
    snapshot_pending: Arc<AtomicBool>,
}

impl Outbox {
    pub(super) fn new(items: UnboundedSender<Item>) -> Self {
        Self { items, snapshot_pending: Arc::default() }
    }

    /// Whether a snapshot is on its way; whoever sends it clears this.
    pub(super) fn snapshot_pending(&self) -> Arc<AtomicBool> {
        Arc::clone(&self.snapshot_pending)
    }

    fn put(&self, item: Item) {
        // Nobody listens any more where the process is about to end.
        let _ = self.items.send(item);
    }

    fn snapshot(&self, trainer: &Trainer) {
        self.snapshot_pending.store(true, Ordering::Release);
        self.put(Item::Snapshot { step: trainer.step(), bytes: trainer.snapshot() });
    }

    fn checkpoint(&self, kind: CheckpointKind, checkpoint: &Checkpoint) {
        let metrics = checkpoint.metrics().map_or_else(Vec::new, |metrics| {
            let rows = Event::Evaluation { step: checkpoint.step(), metrics: *metrics }.rows();
            rows.into_iter().map(|(_, name, value)| (name, value)).collect()
        });
        self.put(Item::Checkpoint { kind, step: checkpoint.step(), bytes: checkpoint.to_bytes(), metrics });
    }
}

/// Trains until the end or an order to stop.
pub(super) fn train(task: Task, outbox: &Outbox, orders: &Orders) -> End {
    match try_train(task, outbox, orders) {
        Ok(end) => end,
        // The same configuration, snapshot or weights would be refused again.
        Err(e) => End::Failed { reason: e.to_string(), permanent: true },
    }
}

fn try_train(task: Task, outbox: &Outbox, orders: &Orders) -> Result<End, Box<dyn std::error::Error>> {
    let Task { config, threads, snapshot, snapshot_every } = task;
    let mut trainer = match &snapshot {
        Some(bytes) => Trainer::restore(bytes, threads)?,
        None => Trainer::new(config, threads)?,
    };
    drop(snapshot);
    if trainer.step() == 0 {
        let untrained = reference(&trainer.checkpoint()?, threads)?;
        outbox.put(Item::Metrics { step: 0, rows: vec![(0, REFERENCE_ROW, untrained)] });
    }
    let mut curve = Curve::new(trainer.config(), trainer.step());
    let mut saved = Instant::now();
    while orders.read() == Directive::Continue
        && let Some(event) = trainer.next()
    {
        let rows = curve.rows(&event);
        if !rows.is_empty() {
            outbox.put(Item::Metrics { step: trainer.step(), rows });
        }
        match event {
            Event::Evaluation { step, .. } if trainer.best_evaluation().is_some_and(|best| best.step == step) => {
                if let Some(best) = trainer.best()? {
                    outbox.checkpoint(CheckpointKind::Best, &best);
                }
            }
            Event::Diverged { step } => {
                let reason = format!("training diverged at step {step}: a weight left the range of sensible numbers");
                return Ok(End::Failed { reason, permanent: true });
            }
            Event::Iteration(_) | Event::Evaluation { .. } | Event::Finished { .. } => {}
        }
        if saved.elapsed() >= snapshot_every && !outbox.snapshot_pending.load(Ordering::Acquire) {
            outbox.snapshot(&trainer);
            saved = Instant::now();
        }
    }
    match orders.read() {
        Directive::Cancel => Ok(End::Stopped),
        Directive::Pause if !trainer.finished() => {
            outbox.snapshot(&trainer);
            Ok(End::Stopped)
        }
        Directive::Pause | Directive::Continue => {
            outbox.checkpoint(CheckpointKind::Last, &trainer.checkpoint()?);
            let best = trainer.best()?.ok_or("no policy was ever evaluated")?;
            let step = trainer.step();
            outbox.put(Item::Metrics { step, rows: vec![(step, REFERENCE_ROW, reference(&best, threads)?)] });
            Ok(End::Finished)
        }
    }
}

/// Mean AoI of a policy on the reference layouts.
fn reference(checkpoint: &Checkpoint, threads: usize) -> Result<f64, Box<dyn std::error::Error>> {
    let seeds = layouts(REFERENCE)?.seeds(usize::MAX);
    let flown = evaluate(&checkpoint.policy(), &checkpoint.config().environment, &seeds, threads)?;
    Ok(EpisodeMetrics::mean(&flown).mean_aoi)
}

/// Which iterations become points of a curve, and how fast they went.
struct Curve {
    /// Environment steps of an iteration.
    iteration: u64,
    /// Of so many iterations, one becomes a point.
    stride: u64,
    /// Environment steps of the run.
    steps: u64,
    /// The last point.
    point: (u64, Instant),
}

impl Curve {
    fn new(config: &TrainConfig, step: u64) -> Self {
        let iteration = (config.training.envs * config.environment.slots) as u64;
        let steps = config.training.steps;
        let stride = steps.div_ceil(iteration).div_ceil(POINTS).max(1);
        Self { iteration, stride, steps, point: (step, Instant::now()) }
    }

    fn rows(&mut self, event: &Event) -> Vec<Row> {
        let mut rows = event.rows();
        if let Event::Iteration(done) = event {
            let regular = (done.step / self.iteration).is_multiple_of(self.stride);
            if !regular && done.step < self.steps {
                return Vec::new();
            }
            let now = Instant::now();
            let seconds = (now - self.point.1).as_secs_f64();
            rows.push((done.step, "env_steps_per_s", (done.step - self.point.0) as f64 / seconds));
            self.point = (done.step, now);
        }
        rows
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::learner::Iteration;
    use crate::recipe::{Algorithm, Preset};

    fn curve_of(steps: u64) -> Vec<u64> {
        let mut config = TrainConfig::preset(Algorithm::Qmix, Preset::Practical);
        config.training.steps = steps;
        let (mut curve, mut points) = (Curve::new(&config, 0), Vec::new());
        let iteration = curve.iteration;
        for step in (iteration..steps + iteration).step_by(iteration as usize) {
            let done = Iteration {
                step,
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
    fn a_long_run_has_few_points_and_always_its_last() {
        let short = curve_of(640 * 100);
        assert_eq!(short.len(), 100);
        let long = curve_of(640 * 9999);
        assert!(long.len() <= POINTS as usize && long.len() > 3000, "{}", long.len());
        assert_eq!(long.last(), Some(&(640 * 9999)));
    }
}
