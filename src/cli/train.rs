//! `qedgix train`: a training run in this process, or as a job of a server.

use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;

use anyhow::{Context, bail};
use clap::Args;
use serde_json::Value;

use super::client::Client;
use super::connect::ConnectArgs;
use super::files::write_atomic;
use super::output::{errln, outln};
use super::run_args::{RunArgs, all_cores};
use super::{progress, table};
use crate::checkpoint::Checkpoint;
use crate::jobs::memory;
use crate::learner::{Evaluation, Event, Summary, TrainConfig, Trainer, evaluate, layout_list, summarize};

/// Flags of `train`.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  qedgix train --algorithm qmix --steps 400000 --out qmix.safetensors
  qedgix train --uavs 4 --users 8 --set training.learning_rate=5e-4 --metrics curve.csv
  qedgix train --steps 250000 --snapshot run.snapshot           # ctrl-c stops the run ...
  qedgix train --resume run.snapshot --snapshot run.snapshot    # ... and this resumes it, with the same result
  qedgix train --algorithm qedgix --server 127.0.0.1:8080 --name my-policy
  QEDGIX_API_KEY=... qedgix train --server https://uavs.example:8080 --ca-cert ca.pem    # a key with the scopes `read` and `jobs`")]
pub struct TrainArgs {
    #[command(flatten)]
    run: RunArgs,
    /// Number of threads; it does not change the result [default: all cores]
    #[arg(long, env = "QEDGIX_THREADS")]
    threads: Option<usize>,
    /// File for the best checkpoint
    #[arg(long, env = "QEDGIX_OUT", default_value = "policy.safetensors")]
    out: PathBuf,
    /// File for the metrics as CSV: step, name, value
    #[arg(long, env = "QEDGIX_METRICS")]
    metrics: Option<PathBuf>,
    /// File for snapshots, written at every evaluation and when ctrl-c stops the run
    #[arg(long, env = "QEDGIX_SNAPSHOT")]
    snapshot: Option<PathBuf>,
    /// Resumes the run of this snapshot, with the configuration of the snapshot
    #[arg(long, env = "QEDGIX_RESUME", conflicts_with = "server")]
    resume: Option<PathBuf>,
    /// Submits the run as a job to the server at HOST:PORT (REST) and waits for its end
    #[arg(long, env = "QEDGIX_SERVER", value_name = "HOST:PORT")]
    server: Option<String>,
    /// Name of the job and of the policy that it publishes
    #[arg(long, env = "QEDGIX_NAME", requires = "server")]
    name: Option<String>,
    #[command(flatten)]
    connect: ConnectArgs,
}

/// Runs the command.
///
/// # Errors
/// The configuration is invalid, a file cannot be read or written, or the job fails.
pub async fn run(args: TrainArgs) -> anyhow::Result<()> {
    let threads = args.threads.unwrap_or_else(all_cores);
    if let Some(address) = &args.server {
        let client = Client::new(address, &args.connect)?;
        let job = submit(&client, &args.run.job(threads, args.name.as_deref())?).await?;
        outln!("policy {}", job["policy"].as_str().unwrap_or("none"))?;
        return Ok(());
    }
    let trainer = start(&args, threads)?;
    memory::check(trainer.config(), threads, memory::available())?;
    let stop = trainer.stop_flag();
    tokio::spawn(async move {
        if tokio::signal::ctrl_c().await.is_ok() {
            stop.store(true, Ordering::Relaxed);
        }
    });
    tokio::task::spawn_blocking(move || train(&args, trainer, threads)).await?
}

/// Submits a job, shows its progress until it ends, and returns it.
///
/// # Errors
/// The server rejects the job, or the job fails.
pub async fn submit(client: &Client, job: &Value) -> anyhow::Result<Value> {
    let accepted = client.post("/v1/jobs", job).await?;
    let id = accepted["id"].as_str().context("the response of the server has no job id")?;
    let bar = progress::bar(accepted["progress"]["steps"].as_u64().unwrap_or(0), "steps");
    let ended = client
        .wait_for_job(id, |job| {
            bar.set_position(job["progress"]["step"].as_u64().unwrap_or(0));
            bar.set_message(job["state"].as_str().unwrap_or("?").to_owned());
        })
        .await;
    bar.finish_and_clear();
    ended
}

/// The run of the flags: a new one, or the one of `--resume`.
fn start(args: &TrainArgs, threads: usize) -> anyhow::Result<Trainer> {
    let Some(path) = &args.resume else { return Ok(Trainer::new(args.run.resolve()?, threads)?) };
    let bytes = fs::read(path).with_context(|| format!("--resume {}", path.display()))?;
    Trainer::restore(&bytes, threads).with_context(|| format!("--resume {}", path.display()))
}

fn train(args: &TrainArgs, mut trainer: Trainer, threads: usize) -> anyhow::Result<()> {
    let config = trainer.config().clone();
    errln!("{}", serde_json::to_string(&config)?);
    let mut curve = args.metrics.as_deref().map(|path| CurveWriter::open(path, args.resume.is_some())).transpose()?;
    let bar = progress::bar(config.training.steps, "steps");
    let mut evaluations = Vec::new();
    let mut finished = false;
    while let Some(event) = trainer.next() {
        if let Some(curve) = &mut curve {
            curve.write(&event)?;
        }
        match event {
            Event::Iteration(i) => {
                bar.set_position(i.env_steps.min(config.training.steps));
                bar.set_message(format!("epsilon {:.2}, train {:.1}", i.epsilon, i.mean_aoi));
            }
            Event::Evaluation(Evaluation { env_steps, metrics }) => {
                evaluations.push(metrics.mean_aoi);
                let line = format!("step {env_steps:>8}  mean AoI {:6.2}  {}", metrics.mean_aoi, table::sparkline(&evaluations));
                // Without a terminal there is no bar.
                if bar.is_hidden() {
                    errln!("{line}");
                } else {
                    bar.println(line);
                }
                if let Some(path) = &args.snapshot {
                    write_atomic(path, &trainer.snapshot())?;
                }
            }
            Event::Evaluating { layouts, .. } => {
                bar.set_message(format!("evaluated on {layouts} of {} layouts", config.training.eval_episodes));
            }
            Event::Report(_) => {}
            Event::Diverged { env_steps } => {
                bail!("training diverged at step {env_steps}: a parameter is no longer finite; try a smaller learning rate")
            }
            Event::Finished { .. } => finished = true,
        }
    }
    bar.finish_and_clear();
    if !finished {
        let Some(path) = &args.snapshot else { bail!("stopped; without --snapshot, the run is lost") };
        write_atomic(path, &trainer.snapshot())?;
        outln!("stopped; resume with --resume {}", path.display())?;
        return Ok(());
    }
    let best = trainer.best()?.context("a finished run has been evaluated")?;
    report(&config, &best, &args.out, threads)
}

/// Writes the checkpoint and prints its evaluation on eval-v1.
fn report(config: &TrainConfig, checkpoint: &Checkpoint, out: &Path, threads: usize) -> anyhow::Result<()> {
    write_atomic(out, &checkpoint.to_bytes())?;
    let list = layout_list("eval-v1")?;
    let episodes = evaluate(&checkpoint.policy(), &config.environment, &list.seeds(256), threads)?;
    let rows: Vec<(String, Summary)> = vec![(out.display().to_string(), summarize(&episodes)?)];
    outln!("best weights by validation, from step {}; on {}:", checkpoint.env_steps(), list.name)?;
    outln!("{}", table::policy_table(&rows))?;
    Ok(())
}

/// Writes metrics as CSV.
struct CurveWriter(std::io::BufWriter<fs::File>);

impl CurveWriter {
    fn open(path: &Path, append: bool) -> anyhow::Result<Self> {
        let file = fs::OpenOptions::new().create(true).write(true).append(append).truncate(!append).open(path);
        let file = file.with_context(|| format!("cannot write {}", path.display()))?;
        let fresh = file.metadata()?.len() == 0;
        let mut curve = Self(std::io::BufWriter::new(file));
        if fresh {
            writeln!(curve.0, "step,name,value")?;
        }
        Ok(curve)
    }

    fn write(&mut self, event: &Event) -> anyhow::Result<()> {
        for (step, name, value) in event.rows() {
            writeln!(self.0, "{step},{name},{value}")?;
        }
        // The file can be read while training runs.
        if matches!(event, Event::Evaluation(_) | Event::Finished { .. }) {
            self.0.flush()?;
        }
        Ok(())
    }
}
