//! Runs several training runs at a time, one thread each. If fewer runs than threads are left, they get several threads each.
//!
//! Training is bit-exact for any number of threads, so a run may change its number of threads at an evaluation.

use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Instant;

use anyhow::Context;
use indicatif::{MultiProgress, ProgressBar};

use super::folder::{RunFolder, RunProgress};
use crate::cli::output::errln;
use crate::cli::progress;
use crate::experiment::{EvaluatedWeights, Experiment, Run, RunResult};
use crate::learner::{Event, Trainer, evaluate};

/// Runs the runs of an experiment.
pub struct Runner<'a> {
    experiment: &'a Experiment,
    root: &'a Path,
    threads: usize,
    stop: &'a AtomicBool,
    next: AtomicUsize,
    unfinished: AtomicUsize,
    bars: MultiProgress,
    overall: ProgressBar,
}

impl<'a> Runner<'a> {
    /// A runner of this experiment with its files below `root`. When `stop` is set, it saves the runs in progress and returns.
    pub fn new(experiment: &'a Experiment, root: &'a Path, threads: usize, stop: &'a AtomicBool) -> Self {
        let bars = MultiProgress::new();
        let overall =
            progress::bar_among(&bars, experiment.runs.iter().map(|run| run.config.training.steps).sum(), "steps of all runs");
        Self {
            experiment,
            root,
            threads: threads.max(1),
            stop,
            next: AtomicUsize::new(0),
            unfinished: AtomicUsize::new(0),
            bars,
            overall,
        }
    }

    /// Runs all unfinished runs. Returns whether all runs are finished.
    ///
    /// # Errors
    /// The error of the first run that fails. The other runs are saved.
    pub fn run(&self) -> anyhow::Result<bool> {
        let mut pending = Vec::new();
        for run in &self.experiment.runs {
            if RunFolder::new(self.root, run).result(self.experiment)?.is_none() {
                pending.push(run);
            }
        }
        let left: u64 = pending.iter().map(|run| run.config.training.steps).sum();
        self.overall.set_position(self.overall.length().unwrap_or(left) - left);
        self.overall.reset_eta();
        self.count(pending.len());
        self.unfinished.store(pending.len(), Ordering::Relaxed);
        let workers = self.threads.min(pending.len());
        let ended: Vec<anyhow::Result<()>> = std::thread::scope(|scope| {
            let workers: Vec<_> = (0..workers).map(|_| scope.spawn(|| self.work(&pending))).collect();
            workers.into_iter().map(|w| w.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))).collect()
        });
        self.overall.finish_and_clear();
        ended.into_iter().collect::<anyhow::Result<()>>()?;
        Ok(self.unfinished.load(Ordering::Relaxed) == 0)
    }

    fn stopped(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    /// Threads of each unfinished run.
    fn threads_per_run(&self) -> usize {
        (self.threads / self.unfinished.load(Ordering::Relaxed).max(1)).max(1)
    }

    fn work(&self, pending: &[&Run]) -> anyhow::Result<()> {
        while let Some(run) = pending.get(self.next.fetch_add(1, Ordering::Relaxed)).filter(|_| !self.stopped()) {
            let label = self.experiment.label(run);
            let bar = progress::bar_among(&self.bars, run.config.training.steps, "steps");
            bar.set_message(label.clone());
            let ended = self.run_one(run, &label, &bar).with_context(|| format!("{label} ({})", run.folder));
            bar.finish_and_clear();
            self.bars.remove(&bar);
            // Stops the other runs, as the command ends with an error anyway.
            if ended.is_err() {
                self.stop.store(true, Ordering::Relaxed);
            }
            if let Some(result) = ended? {
                self.count(self.unfinished.fetch_sub(1, Ordering::Relaxed) - 1);
                let aoi = result.best.episodes.iter().map(|e| e.mean_aoi).sum::<f64>() / result.best.episodes.len() as f64;
                let note = if result.diverged { "  (diverged)" } else { "" };
                self.print(&format!("done  {label}: mean AoI {aoi:.2} on {}{note}", result.layouts));
            }
        }
        Ok(())
    }

    fn count(&self, unfinished: usize) {
        let all = self.experiment.runs.len();
        self.overall.set_message(format!("{} of {all} runs done", all - unfinished));
    }

    /// Prints a line above the bars, or on standard error if there are no bars.
    fn print(&self, line: &str) {
        if self.overall.is_hidden() {
            errln!("{line}");
        } else {
            self.overall.println(line);
        }
    }

    /// Trains and evaluates a run. Returns `None` if it was stopped.
    fn run_one(&self, run: &Run, label: &str, bar: &ProgressBar) -> anyhow::Result<Option<RunResult>> {
        let folder = RunFolder::new(self.root, run);
        folder.create(run)?;
        if !folder.progress()?.trained && !self.train(run, &folder, label, bar)? {
            return Ok(None);
        }
        let progress = folder.progress()?;
        let evaluate_weights = |checkpoint: &crate::checkpoint::Checkpoint| -> anyhow::Result<EvaluatedWeights> {
            let seeds = &self.experiment.layout_seeds;
            let episodes = evaluate(&checkpoint.policy(), &run.config.environment, seeds, self.threads_per_run())?;
            Ok(EvaluatedWeights { step: checkpoint.env_steps(), episodes })
        };
        let result = RunResult {
            layouts: self.experiment.layouts.clone(),
            steps: progress.step,
            diverged: progress.diverged,
            best: evaluate_weights(&folder.best()?)?,
            last: if progress.diverged { None } else { Some(evaluate_weights(&folder.last()?)?) },
            seconds: progress.seconds,
        };
        folder.finish(&result)?;
        Ok(Some(result))
    }

    /// Trains a run. Returns whether training has ended; false if it was stopped.
    fn train(&self, run: &Run, folder: &RunFolder, label: &str, bar: &ProgressBar) -> anyhow::Result<bool> {
        let mut threads = self.threads_per_run();
        let (mut trainer, mut curve, before) = folder.restore(run, threads)?;
        let begun = Instant::now();
        let progress = |trainer: &Trainer, trained, diverged| RunProgress {
            step: trainer.env_steps(),
            seconds: before + begun.elapsed().as_secs_f64(),
            trained,
            diverged,
        };
        let steps = run.config.training.steps;
        let mut reported = trainer.env_steps().min(steps);
        bar.set_position(reported);
        bar.reset_eta();
        self.overall.inc(reported);
        while let Some(event) = trainer.next() {
            for (step, name, value) in event.rows() {
                curve.push(step, name, value);
            }
            let step = trainer.env_steps().min(steps);
            bar.set_position(step);
            self.overall.inc(step - std::mem::replace(&mut reported, step));
            let evaluated = if let Event::Evaluation(e) = event { Some((e.env_steps, e.metrics.mean_aoi)) } else { None };
            if evaluated.is_none() && !self.stopped() {
                continue;
            }
            let snapshot = trainer.snapshot();
            folder.save(&snapshot, &curve, &progress(&trainer, false, false))?;
            if let Some((step, aoi)) = evaluated {
                bar.set_message(format!("{label}: mean AoI {aoi:.2}"));
                if bar.is_hidden() {
                    errln!("{label}: step {step}, mean AoI {aoi:.2}");
                }
            }
            if self.stopped() {
                return Ok(false);
            }
            if self.threads_per_run() > threads {
                threads = self.threads_per_run();
                trainer = Trainer::restore(&snapshot, threads)?;
            }
        }
        let best = trainer.best()?.context("a finished run has been evaluated")?;
        // The last weights of a diverged run are not a valid checkpoint.
        let last = trainer.checkpoint().ok();
        folder.save_weights(&best, last.as_ref(), &curve, &progress(&trainer, true, last.is_none()))?;
        Ok(true)
    }
}
