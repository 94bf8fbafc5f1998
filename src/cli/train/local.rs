//! A training run in this process: its files, and what happens when one of them cannot be written or the run is stopped.

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use indicatif::ProgressBar;

use super::TrainArgs;
use super::curve::CurveFile;
use crate::checkpoint::Checkpoint;
use crate::cli::files::{check_distinct, check_writable, full_path, write_atomic};
use crate::cli::output::{Exit, errln, outln};
use crate::cli::policy_file::read_checkpoint;
use crate::cli::run_args::all_cores;
use crate::cli::signals::StopFlag;
use crate::cli::{progress, table};
use crate::files::partial_path;
use crate::jobs::memory;
use crate::learner::{Evaluation, Event, Summary, TrainConfig, Trainer, evaluate, layout_list, summarize};
use crate::serving::bundled;

/// Ending of snapshots, and of the default snapshot of a checkpoint.
const SNAPSHOT: &str = ".snapshot";
/// A snapshot is not taken again before this many times as long as the last one took, so that training keeps most of the time.
const SNAPSHOT_SHARE: u32 = 20;

/// Runs the training of the flags.
///
/// # Errors
/// The configuration is invalid, a file cannot be read or written, training diverges, or a signal stops the run.
pub async fn run(args: &TrainArgs) -> anyhow::Result<()> {
    let paths = Paths::check(args)?;
    let threads = args.threads.unwrap_or_else(all_cores);
    let mut trainer = match &args.resume {
        None => begin(args, threads)?,
        Some(path) => {
            let bytes = fs::read(path).with_context(|| format!("--resume {}", path.display()))?;
            let trainer = Trainer::restore(&bytes, threads).with_context(|| format!("--resume {}", path.display()))?;
            args.run.agree_with(trainer.config())?;
            trainer
        }
    };
    memory::check(trainer.config(), threads, memory::available())?;
    let stop = StopFlag::new()?;
    trainer.stop_with(Arc::clone(&stop.flag));
    let every = Duration::from_secs_f64(args.snapshot_every);
    tokio::task::spawn_blocking(move || Run::begin(trainer, paths, every)?.train(&stop, threads)).await?
}

/// A new run, from the weights of `--init` if they are given.
fn begin(args: &TrainArgs, threads: usize) -> anyhow::Result<Trainer> {
    let mut trainer = Trainer::new(args.run.resolve()?, threads)?;
    if let Some(name) = &args.init {
        let bundled = bundled::BUNDLED.iter().find(|(bundled, _)| bundled == name);
        let bytes = match bundled.filter(|_| !Path::new(name).exists()) {
            Some((_, bytes)) => bytes.to_vec(),
            None => {
                fs::read(name).with_context(|| format!("--init {name}: neither a bundled policy nor a file that can be read"))?
            }
        };
        let weights = read_checkpoint(name, &bytes).with_context(|| format!("--init {name}"))?;
        trainer.begin_with(&weights).with_context(|| format!("--init {name}"))?;
    }
    Ok(trainer)
}

/// The files of a run.
struct Paths {
    out: PathBuf,
    metrics: Option<PathBuf>,
    snapshot: PathBuf,
    resumed: bool,
}

impl Paths {
    /// The files that the flags name.
    ///
    /// # Errors
    /// A file cannot be written, two are the same, or one is the snapshot of another run.
    fn check(args: &TrainArgs) -> anyhow::Result<Self> {
        let resume = args.resume.as_deref();
        let out = args.out.clone().or_else(|| checkpoint_of(resume?)).unwrap_or_else(|| super::OUT.into());
        let snapshot = args.snapshot.as_deref().or(resume).map_or_else(|| snapshot_of(&out), Path::to_owned);
        let metrics = args.metrics.clone();
        let mut files = vec![("--out", &*out), ("--snapshot", &*snapshot)];
        files.extend(metrics.as_deref().map(|path| ("--metrics", path)));
        check_distinct(&files)?;
        if let Some(resume) = resume.filter(|resume| full_path(resume) != full_path(&snapshot)) {
            files[1] = ("--resume", resume);
            check_distinct(&files)?;
        }
        for (flag, path) in
            [("--out", &out), ("--snapshot", &snapshot)].into_iter().chain(metrics.iter().map(|m| ("--metrics", m)))
        {
            check_writable(path).context(flag)?;
        }
        let other = snapshot.exists() && resume.is_none_or(|resume| full_path(resume) != full_path(&snapshot));
        if other && !args.overwrite {
            bail!(
                "{0} exists: a run that has not finished. Continue it with --resume {0}, or replace it with --overwrite",
                snapshot.display()
            );
        }
        Ok(Self { out, metrics, snapshot, resumed: resume.is_some() })
    }
}

/// The default snapshot of a checkpoint.
fn snapshot_of(out: &Path) -> PathBuf {
    let mut name = out.as_os_str().to_owned();
    name.push(SNAPSHOT);
    name.into()
}

/// The checkpoint whose default snapshot this is.
fn checkpoint_of(snapshot: &Path) -> Option<PathBuf> {
    let out = PathBuf::from(snapshot.to_str()?.strip_suffix(SNAPSHOT)?);
    out.extension().is_some_and(|extension| extension == "safetensors").then_some(out)
}

/// Writes of one file, which must not end training: a failure is told, and the next write is another try.
struct Guarded {
    path: PathBuf,
    failing: bool,
}

impl Guarded {
    fn new(path: &Path) -> Self {
        Self { path: path.to_owned(), failing: false }
    }

    /// Tells the first failure of several, and the success after them.
    fn tell(&mut self, bar: &ProgressBar, result: anyhow::Result<()>) {
        let was_failing = std::mem::replace(&mut self.failing, result.is_err());
        match result {
            Err(error) if !was_failing => say(bar, &format!("warning: {error:#}; training goes on, and it is tried again")),
            Ok(()) if was_failing => say(bar, &format!("{} is written again", self.path.display())),
            _ => {}
        }
    }
}

/// Prints a line above the bar. Without a terminal there is no bar.
fn say(bar: &ProgressBar, line: &str) {
    if bar.is_hidden() {
        errln!("{line}");
    } else {
        bar.println(line);
    }
}

/// A run and its files.
struct Run {
    trainer: Trainer,
    bar: ProgressBar,
    out: Guarded,
    snapshot: Guarded,
    curve: Option<(Guarded, CurveFile)>,
    /// Time between two snapshots.
    every: Duration,
    next_snapshot: Instant,
    /// Mean AoI of each evaluation.
    evaluations: Vec<f64>,
}

impl Run {
    fn begin(trainer: Trainer, paths: Paths, every: Duration) -> anyhow::Result<Self> {
        let Paths { out, metrics, snapshot, resumed } = paths;
        // Before the metrics: without a snapshot, an earlier curve is not replaced.
        write_atomic(&snapshot, &trainer.snapshot())?;
        let curve = metrics.map(|path| {
            let file = if resumed { CurveFile::resume(&path, trainer.env_steps()) } else { CurveFile::create(&path) };
            file.map(|file| (Guarded::new(&path), file))
        });
        errln!("{}", serde_json::to_string(trainer.config())?);
        tell_rounding(trainer.config());
        Ok(Self {
            bar: progress::bar(trainer.config().total_steps(), "steps"),
            out: Guarded::new(&out),
            snapshot: Guarded::new(&snapshot),
            curve: curve.transpose()?,
            every,
            next_snapshot: Instant::now() + every,
            evaluations: Vec::new(),
            trainer,
        })
    }

    fn train(mut self, stop: &StopFlag, threads: usize) -> anyhow::Result<()> {
        while let Some(event) = self.trainer.next() {
            if let Some((_, curve)) = &mut self.curve {
                curve.push(&event.rows());
            }
            self.show(&event);
            match event {
                Event::Evaluation(Evaluation { env_steps, .. }) => {
                    // The weights before the first update are worth less than a file that an earlier run has left.
                    let worth = env_steps > 0 || !self.out.path.exists();
                    if worth && self.trainer.best_evaluation().is_some_and(|best| best.env_steps == env_steps) {
                        let written = self.write_best();
                        self.out.tell(&self.bar, written.map(drop));
                    }
                    self.flush_curve();
                }
                Event::Diverged { env_steps } => return self.diverged(env_steps),
                _ => {}
            }
            if Instant::now() >= self.next_snapshot && !self.trainer.finished() {
                let begin = Instant::now();
                // The curve first: rows after the snapshot are computed again, rows before it are not.
                self.flush_curve();
                let written = self.write_snapshot();
                self.snapshot.tell(&self.bar, written);
                self.next_snapshot = Instant::now() + self.every.max(begin.elapsed() * SNAPSHOT_SHARE);
            }
        }
        self.bar.finish_and_clear();
        if !self.trainer.finished() {
            return Err(self.stopped(stop.code())?.into());
        }
        let best = match self.finish() {
            Ok(best) => best,
            // Everything is computed; the same run can be ended again when the file can be written.
            Err(error) => {
                let kept = self.write_snapshot();
                return Err(error.context(match kept {
                    Ok(()) => format!("the results are in {}; end the run with --resume", self.snapshot.path.display()),
                    Err(snapshot) => format!("{snapshot:#}"),
                }));
            }
        };
        report(self.trainer.config(), &best, &self.out.path, threads)
    }

    /// Shows the progress, and a line for each evaluation.
    fn show(&mut self, event: &Event) {
        let training = &self.trainer.config().training;
        match event {
            Event::Iteration(i) => {
                self.bar.set_position(i.env_steps);
                self.bar.set_message(format!("epsilon {:.2}, train {:.1}", i.epsilon, i.mean_aoi));
            }
            Event::Evaluation(Evaluation { env_steps, metrics }) => {
                self.evaluations.push(metrics.mean_aoi);
                let curve = table::sparkline(&self.evaluations);
                say(&self.bar, &format!("step {env_steps:>8}  mean AoI {:6.2}  {curve}", metrics.mean_aoi));
            }
            Event::Evaluating { layouts, .. } => {
                self.bar.set_message(format!("evaluated on {layouts} of {} layouts", training.eval_episodes));
            }
            Event::Report(_) | Event::Diverged { .. } | Event::Finished { .. } => {}
        }
    }

    /// Writes the best weights so far, if there are any.
    fn write_best(&self) -> anyhow::Result<Option<Checkpoint>> {
        let best = self.trainer.best()?;
        if let Some(best) = &best {
            write_atomic(&self.out.path, &best.to_bytes())?;
        }
        Ok(best)
    }

    fn write_snapshot(&self) -> anyhow::Result<()> {
        write_atomic(&self.snapshot.path, &self.trainer.snapshot())
    }

    fn flush_curve(&mut self) {
        if let Some((file, curve)) = &mut self.curve {
            let written = curve.flush().with_context(|| format!("cannot write {}", file.path.display()));
            file.tell(&self.bar, written);
        }
    }

    /// Writes everything of a run that has ended, then removes its snapshot.
    fn finish(&mut self) -> anyhow::Result<Checkpoint> {
        let best = self.write_best()?.context("a finished run has been evaluated")?;
        if let Some((file, curve)) = &mut self.curve {
            curve.flush().with_context(|| format!("cannot write {}", file.path.display()))?;
        }
        // A snapshot that cannot be removed is no reason to call the run a failure.
        for path in [&self.snapshot.path, &partial_path(&self.snapshot.path)] {
            match fs::remove_file(path) {
                Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                    errln!("warning: cannot remove {}: {error}", path.display());
                }
                _ => {}
            }
        }
        Ok(best)
    }

    /// Ends a run that diverged: another try would diverge, too, so its snapshot is of no use.
    fn diverged(mut self, env_steps: u64) -> anyhow::Result<()> {
        self.bar.finish_and_clear();
        let best = self.finish()?.env_steps();
        bail!(
            "training diverged at step {env_steps}: a parameter is no longer finite; try a smaller learning rate. The best weights, \
             from step {best}, are in {}",
            self.out.path.display()
        )
    }

    /// Writes the snapshot of a run that a signal has stopped.
    fn stopped(mut self, code: u8) -> anyhow::Result<Exit> {
        self.flush_curve();
        let step = self.trainer.env_steps();
        self.write_snapshot().with_context(|| format!("stopped at step {step}, but its last snapshot is an older one"))?;
        let mut command = format!("qedgix train --resume {} --out {}", self.snapshot.path.display(), self.out.path.display());
        if let Some((file, _)) = &self.curve {
            let _ = write!(command, " --metrics {}", file.path.display());
        }
        Ok(Exit::new(code, format!("stopped at step {step}; to continue: {command}")))
    }
}

/// Says that more steps are trained than were asked for, because iterations are whole.
fn tell_rounding(config: &TrainConfig) {
    let (steps, total) = (config.training.steps, config.total_steps());
    if steps < total {
        let (envs, slots) = (config.training.envs, config.environment.slots);
        let iterations = total / (envs * slots) as u64;
        let plural = if iterations == 1 { "" } else { "s" };
        errln!("{steps} steps are rounded up to {total}: {iterations} iteration{plural} of {envs} environments x {slots} slots");
    }
}

/// Prints the evaluation of the best weights on eval-v1.
///
/// # Errors
/// The policy does not fit its environment, or standard output cannot be written.
pub fn report(config: &TrainConfig, checkpoint: &Checkpoint, out: &Path, threads: usize) -> anyhow::Result<()> {
    let list = layout_list("eval-v1")?;
    let episodes = evaluate(&checkpoint.policy(), &config.environment, &list.seeds(256), threads)?;
    let rows: Vec<(String, Summary)> = vec![(out.display().to_string(), summarize(&episodes)?)];
    outln!("best weights by validation, from step {}; on {}:", checkpoint.env_steps(), list.name)?;
    outln!("{}", table::policy_table(&rows))?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_snapshot_lies_beside_its_checkpoint() {
        let out = Path::new("runs/qmix.safetensors");
        assert_eq!(snapshot_of(out), Path::new("runs/qmix.safetensors.snapshot"));
        assert_eq!(checkpoint_of(&snapshot_of(out)).unwrap(), out);
        assert_eq!(checkpoint_of(Path::new("run.snapshot")), None);
    }
}
