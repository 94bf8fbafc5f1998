//! `qedgix experiment`: runs or resumes an experiment described in a TOML file, and writes tables and plots of its results.
//!
//! This file owns the flags and writes the results. `crate::experiment` resolves the file and summarizes the results.

mod folder;
mod runner;

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::Args;
use serde_json::{Value, json};

use self::folder::RunFolder;
use self::runner::Runner;
use super::figures::FigureArgs;
use super::files::write_atomic;
use super::run_args::{self, all_cores, count};
use super::signals::StopFlag;
use super::toml_file;
use crate::cli::output::{Exit, outln};
use crate::env::EpisodeMetrics;
use crate::experiment::{Experiment, ExperimentSummary, Overrides, PlotKind, RunResult, TrainingCurve, plots, readme};
use crate::learner::{Disturbance, Interval, evaluate, evaluate_traced};
use crate::plot::Trajectories;
use crate::policy::baselines;

/// Flags of `experiment`.
#[derive(Args, Debug)]
#[command(after_help = "Exit status: 0 all runs are finished; 1 an error; 130 or 143 stopped by ctrl-c or SIGTERM.

Examples:
  qedgix experiment experiments/convergence.toml --dry-run      # lists the runs and their progress
  qedgix experiment experiments/convergence.toml                # ctrl-c stops it; the same command resumes it
  qedgix experiment experiments/range.toml --seeds 1 --steps 50000 --point '4 xi' --point '9 xi' --out quick")]
pub struct ExperimentArgs {
    /// The experiment as a TOML file
    #[arg(env = "QEDGIX_EXPERIMENT")]
    file: PathBuf,
    /// Directory for runs, tables and plots [default: results/NAME OF THE FILE]
    #[arg(long, env = "QEDGIX_OUT")]
    out: Option<PathBuf>,
    /// Number of threads; each trains one run at a time [default: all cores]
    #[arg(long, env = "QEDGIX_THREADS")]
    threads: Option<usize>,
    /// Environment steps of every run; overrides the file
    #[arg(long, env = "QEDGIX_STEPS", value_parser = count)]
    steps: Option<u64>,
    /// Seeds; override those of the file
    #[arg(long, env = "QEDGIX_SEEDS", value_delimiter = ',')]
    seeds: Option<Vec<u64>>,
    /// Number of seeds: the first of the file, and beyond them the next numbers [default: all of the file]
    #[arg(long, env = "QEDGIX_NUM_SEEDS", value_name = "NUMBER", conflicts_with = "seeds", value_parser = clap::value_parser!(u16).range(1..=1000))]
    num_seeds: Option<u16>,
    /// Runs only the series with this name; may be repeated
    #[arg(long, env = "QEDGIX_SERIES", value_name = "NAME", value_delimiter = ';')]
    series: Vec<String>,
    /// Runs only the point with this name; may be repeated
    #[arg(long, env = "QEDGIX_POINT", value_name = "NAME", value_delimiter = ';')]
    point: Vec<String>,
    /// Overrides one field of every run, unless the points set it; may be repeated
    #[arg(long = "set", value_name = "SECTION.FIELD=VALUE")]
    set: Vec<String>,
    /// Lists the runs and their progress without running them
    #[arg(long)]
    dry_run: bool,
    #[command(flatten)]
    figures: FigureArgs,
}

/// Runs the command.
///
/// # Errors
/// The file is not a valid experiment, a run fails, or a signal stops the command: exit status 130 or 143.
pub async fn run(args: ExperimentArgs) -> anyhow::Result<()> {
    let experiment = read(&args)?;
    let out = match &args.out {
        Some(out) => out.clone(),
        None => Path::new("results").join(args.file.file_stem().context("the file has no name")?),
    };
    if args.dry_run {
        return list(&experiment, &out);
    }
    let stop = StopFlag::new()?;
    tokio::task::spawn_blocking(move || {
        fs::create_dir_all(&out).with_context(|| format!("cannot create {}", out.display()))?;
        let lock = fs::File::create(out.join(".lock")).with_context(|| format!("cannot write to {}", out.display()))?;
        if lock.try_lock().is_err() {
            bail!("{} is in use by another process", out.display());
        }
        let threads = args.threads.unwrap_or_else(all_cores);
        if !Runner::new(&experiment, &out, threads, &stop.flag).run()? {
            return Err(Exit::new(stop.code(), "stopped; the same command resumes the experiment").into());
        }
        write_results(&experiment, (&out, &args.figures), threads, &command(&args))
    })
    .await?
}

/// The experiment of the file, with the overrides of the flags.
fn read(args: &ExperimentArgs) -> anyhow::Result<Experiment> {
    let name = args.file.display().to_string();
    let text = fs::read_to_string(&args.file).with_context(|| name.clone())?;
    let document = toml_file::parse(&name, &text)?;
    let mut overrides = Overrides {
        seeds: args.seeds.clone(),
        num_seeds: args.num_seeds.map(usize::from),
        series: args.series.clone(),
        points: args.point.clone(),
        origin: "on the command line, ".into(),
        ..Overrides::default()
    };
    run_args::set(&args.set, &mut overrides.environment, &mut overrides.training)?;
    if let Some(steps) = args.steps {
        overrides.training.insert("steps".into(), steps.into());
    }
    Experiment::resolve(document, &overrides).context(name)
}

/// The command that repeats the experiment, from the same directory.
fn command(args: &ExperimentArgs) -> String {
    let here = std::env::current_dir().unwrap_or_default();
    let file = args.file.strip_prefix(here).unwrap_or(&args.file);
    let mut words = vec!["qedgix experiment".to_owned(), file.display().to_string()];
    if let Some(steps) = args.steps {
        words.push(format!("--steps {steps}"));
    }
    if let Some(seeds) = &args.seeds {
        words.push(format!("--seeds {}", seeds.iter().map(u64::to_string).collect::<Vec<_>>().join(",")));
    }
    words.extend(args.num_seeds.map(|number| format!("--num-seeds {number}")));
    words.extend(args.series.iter().map(|name| format!("--series '{name}'")));
    words.extend(args.point.iter().map(|name| format!("--point '{name}'")));
    words.extend(args.set.iter().map(|item| format!("--set '{item}'")));
    words.extend(args.figures.value().map(|figures| format!("--figures {figures}")));
    words.join(" ")
}

/// Prints the runs and their progress.
fn list(experiment: &Experiment, out: &Path) -> anyhow::Result<()> {
    outln!("{}: {} runs below {}", experiment.title, experiment.runs.len(), out.display())?;
    for run in &experiment.runs {
        let folder = RunFolder::new(out, run);
        let (steps, progress) = (run.config.training.steps, folder.progress()?);
        let state = match progress.step {
            _ if folder.result(experiment)?.is_some() => "done".to_owned(),
            _ if progress.trained => "trained".to_owned(),
            0 => "to do".to_owned(),
            step => format!("at step {step}"),
        };
        outln!("  {:<32} {steps:>9} steps  {state:<16} {}", experiment.label(run), run.folder)?;
    }
    Ok(())
}

/// Writes and prints the results: results.json, README.md and plots; and timing.json, which differs between repetitions.
fn write_results(
    experiment: &Experiment,
    (out, figures): (&Path, &FigureArgs),
    threads: usize,
    command: &str,
) -> anyhow::Result<()> {
    let mut results: Vec<RunResult> = Vec::new();
    let mut curves: Vec<TrainingCurve> = Vec::new();
    for run in &experiment.runs {
        let folder = RunFolder::new(out, run);
        results.push(folder.result(experiment)?.with_context(|| format!("{} has no result", run.folder))?);
        curves.push(folder.curve()?);
    }
    let summary = ExperimentSummary::new(experiment, &results, &evaluate_baselines(experiment, threads)?);
    let files = plots(experiment, &summary, &curves, &trajectories(experiment, out)?);
    let names: Vec<String> = files.iter().map(|(name, _)| figures.shown(name)).collect();
    for (name, svg) in &files {
        figures.write(&out.join(name), svg)?;
    }
    let seconds: Vec<Value> = (experiment.runs.iter().zip(&results))
        .map(|(run, result)| json!({"folder": run.folder, "training_seconds": result.seconds}))
        .collect();
    write_atomic(&out.join("timing.json"), &serde_json::to_vec_pretty(&seconds)?)?;
    write_atomic(&out.join("results.json"), &serde_json::to_vec_pretty(&summary)?)?;
    let page = readme(experiment, &summary, command, &names);
    write_atomic(&out.join("README.md"), page.as_bytes())?;
    for row in &summary.series_summaries {
        let Interval { mean, low, high } = row.mean_aoi;
        let name = [row.point.as_str(), row.series.as_str()].join(" ");
        outln!("{:<32} mean AoI {mean:6.2}  ({low:.2} to {high:.2})", name.trim_start())?;
    }
    outln!("{}", out.join("README.md").display())?;
    Ok(())
}

/// Per point and baseline, the metrics of the episodes.
fn evaluate_baselines(experiment: &Experiment, threads: usize) -> anyhow::Result<Vec<Vec<Vec<EpisodeMetrics>>>> {
    let mut all = Vec::new();
    for point in &experiment.points {
        let mut evaluated = Vec::new();
        for name in &experiment.baselines {
            let policy = baselines::by_name(name, (&point.environment).into()).context("checked when the file was read")?;
            evaluated.push(evaluate(policy.as_ref(), &point.environment, &experiment.layout_seeds, threads)?);
        }
        all.push(evaluated);
    }
    Ok(all)
}

/// Trajectories of the best weights of the first seed on the first layout, if the experiment plots trajectories.
fn trajectories(experiment: &Experiment, out: &Path) -> anyhow::Result<Vec<Trajectories>> {
    if experiment.plot != PlotKind::Trajectories {
        return Ok(Vec::new());
    }
    let first = experiment.runs.iter().take(experiment.series.len() * experiment.points.len());
    let trajectory = |run: &crate::experiment::Run| {
        let policy = RunFolder::new(out, run).best()?.policy();
        let env = &run.config.environment;
        let trajectory = evaluate_traced(&policy, env, &experiment.layout_seeds[..1], 0, &Disturbance::default(), 1)?.trajectory;
        let users = trajectory.users.iter().filter_map(|path| path.first().copied()).collect();
        let note = format!(
            "Layout 0 of {} (seed {}), flown with the best weights of seed {}.",
            experiment.layouts, experiment.layout_seeds[0], run.config.seed
        );
        Ok(Trajectories { uavs: trajectory.uavs, users, transmission_range: env.transmission_range, note })
    };
    first.map(trajectory).collect()
}
