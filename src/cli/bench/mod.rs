//! `qedgix bench`: measures the speed of `Act` and of the learner on this machine.

mod act;
mod matmul_time;

use std::time::Instant;

use clap::{Args, Subcommand};
use serde_json::json;

use super::output::outln;
use super::run_args::{RunArgs, all_cores};
use crate::learner::{Episodes, Learner, Rollout, TrainConfig};
use crate::nn::VectorWidth;
use crate::policy::mixer::MixerKind;

/// Flags of `bench`.
#[derive(Args, Debug)]
pub struct BenchArgs {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand, Debug)]
enum What {
    /// Measure the learner: time per update and per rollout, environment steps per second, and the time of the matrix products
    ///
    /// The matrix products of an update are also measured alone, with the same shapes and threads. Fields that --set
    /// does not change differ from the preset as follows: flat observation without own position, one-hot identity, mean
    /// aggregation, qmix mixer, a batch of 128 episodes, one update per rollout of 8.
    Learner(LearnerArgs),
    /// Measure gRPC Act: throughput and latencies, next to those of a plain gRPC echo service
    ///
    /// Each session runs real episodes. Rounds of Act alternate with rounds of an echo service that returns messages of the
    /// same size, so other load on the machine slows both. Read the ratios first.
    Act(act::ActArgs),
    /// The echo service in a process of its own; `bench act --server` starts it
    #[command(hide = true)]
    Echo,
}

/// Flags of `bench learner`.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  qedgix bench learner --algorithm qedgix --json
  qedgix bench learner --algorithm qmix --threads 1 --set training.batch=32 --set training.observation=set")]
pub struct LearnerArgs {
    #[command(flatten)]
    run: RunArgs,
    /// Threads of the update [default: all cores]
    #[arg(long, env = "QEDGIX_THREADS")]
    threads: Option<usize>,
    /// Repetitions of each measurement; the median is printed
    #[arg(long, default_value_t = 7, value_name = "TIMES", value_parser = clap::value_parser!(u32).range(1..=10_000))]
    repeat: u32,
    /// Print JSON instead of text
    #[arg(long)]
    json: bool,
}

/// The measured configuration, where it differs from the preset `practical`.
const CONFIGURATION: [&str; 6] = [
    "training.observation=flat",
    "training.identity=onehot",
    "training.self_position=false",
    "training.aggregation=mean",
    "training.batch=128",
    "training.updates_per_iteration=1",
];

/// Runs the command.
///
/// # Errors
/// The configuration is invalid, the server cannot be reached, or an Act is refused.
pub async fn run(args: BenchArgs) -> anyhow::Result<()> {
    match args.what {
        What::Learner(args) => learner(args),
        What::Act(args) => act::run(args).await,
        What::Echo => act::echo().await,
    }
}

fn learner(mut args: LearnerArgs) -> anyhow::Result<()> {
    let threads = args.threads.unwrap_or_else(all_cores);
    let mut set: Vec<String> = CONFIGURATION.map(str::to_owned).to_vec();
    let (algorithm, preset) = (args.run.algorithm.unwrap_or_default(), args.run.preset.unwrap_or_default());
    if !matches!(TrainConfig::preset(algorithm, preset).training.mixer, MixerKind::Vdn | MixerKind::None) {
        set.push("training.mixer=qmix".to_owned());
    }
    set.append(&mut args.run.set);
    args.run.set = set;
    let config = args.run.resolve()?;
    let (t, repeat) = (&config.training, args.repeat as usize);

    let mut learner = Learner::new(&config, threads)?;
    let batch = random_episodes(&config, &learner)?;
    let update_s = median_seconds(repeat, || {
        learner.update(std::slice::from_ref(&batch), config.training.learning_rate);
    });
    let mut rollout = Rollout::new(&config, &config.environment, learner.agent())?;
    let rollout_s = median_seconds(repeat, || {
        rollout.collect(learner.agent(), learner.agent_parameters(), 0.1, 0);
    });
    let matmul = matmul_time::measure(learner.agent(), &batch, threads, repeat);
    let steps = (t.envs * config.environment.slots) as f64;
    let env_steps_per_s = steps / (rollout_s + update_s * t.updates_per_iteration as f64);
    if args.json {
        let metrics = json!({
            "algorithm": config.algorithm,
            "threads": threads,
            "vector_width": VectorWidth::current().name(),
            "update_s": update_s,
            "rollout_s": rollout_s,
            "env_steps_per_s": env_steps_per_s,
            "update_gflop": matmul.gflop,
            "matmul_gflop_per_s": matmul.gflop / matmul.seconds,
            "floor_s": matmul.seconds,
            "config": config,
        });
        outln!("{metrics}")?;
    } else {
        outln!("update of {} episodes   {:.2} ms", t.batch, update_s * 1e3)?;
        outln!(
            "  matrix products alone  {:.2} ms   ({:.1} GFLOP at {:.0} GFLOP/s; the update takes {:.2} times as long)",
            matmul.seconds * 1e3,
            matmul.gflop,
            matmul.gflop / matmul.seconds,
            update_s / matmul.seconds
        )?;
        outln!("rollout of {} episodes    {:.2} ms", t.envs, rollout_s * 1e3)?;
        outln!(
            "environment steps per s  {env_steps_per_s:.0}   ({} updates per rollout, {threads} threads, {})",
            t.updates_per_iteration,
            VectorWidth::current().name()
        )?;
    }
    Ok(())
}

/// A batch of episodes with random headings.
fn random_episodes(config: &TrainConfig, learner: &Learner) -> anyhow::Result<Episodes> {
    let mut config = config.clone();
    config.training.envs = config.training.batch;
    let mut rollout = Rollout::new(&config, &config.environment, learner.agent())?;
    Ok(rollout.collect(learner.agent(), learner.agent_parameters(), 1.0, 0).clone())
}

/// Median time of `repeat` calls in seconds, after one call to warm up.
fn median_seconds(repeat: usize, mut call: impl FnMut()) -> f64 {
    call();
    let mut seconds: Vec<f64> = (0..repeat)
        .map(|_| {
            let begin = Instant::now();
            call();
            begin.elapsed().as_secs_f64()
        })
        .collect();
    seconds.sort_by(f64::total_cmp);
    seconds[repeat / 2]
}
