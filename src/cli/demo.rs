//! `qedgix demo`: starts a server on an empty data directory, runs the bundled policies and the baselines through gRPC `Act`, trains a
//! policy by a job over REST, runs it through the same `Act`, and prints one table. Nothing is left behind.

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::Context;
use clap::Args;
use serde_json::{Value, json};

use super::act_client::PolicyClient;
use super::client::Client;
use super::connect::ConnectArgs;
use super::in_process_server::InProcessServer;
use super::output::{Exit, outln};
use super::run_args::{all_cores, count};
use super::signals::StopSignals;
use super::{act_client, progress, table, train};
use crate::env::EnvConfig;
use crate::learner::{Algorithm, Summary, difference, layout_list, summarize};
use crate::policy::baselines;
use crate::serving::bundled;

/// Flags of `demo`.
#[derive(Args, Debug)]
#[command(after_help = "Examples:\n  qedgix demo\n  qedgix demo --keep     # the server keeps running")]
pub struct DemoArgs {
    /// Keep the server running until ctrl-c
    #[arg(long)]
    keep: bool,
    /// Environment steps of the training job
    #[arg(long, env = "QEDGIX_STEPS", default_value_t = 220_000, value_name = "STEPS", value_parser = count)]
    steps: u64,
    /// Number of layouts of eval-v1 on which policies are compared
    #[arg(long, env = "QEDGIX_EPISODES", default_value_t = 256, value_name = "LAYOUTS")]
    episodes: usize,
    /// Data directory of the server [default: a temporary directory, removed at the end]
    #[arg(long, env = "QEDGIX_DATA_DIR", value_name = "DIR")]
    data_dir: Option<PathBuf>,
}

/// Name of the job and of the policy that it publishes.
const JOB: &str = "demo-job";

/// Runs the command. ctrl-c and SIGTERM stop the server and remove what was made, as the end of the demo does.
///
/// # Errors
/// The server cannot be started, a request fails, or the job fails.
pub async fn run(args: DemoArgs) -> anyhow::Result<()> {
    let mut signals = StopSignals::new()?;
    let temporary = || std::env::temp_dir().join(format!("qedgix-demo-{}", uuid::Uuid::now_v7()));
    let data_dir = args.data_dir.clone().unwrap_or_else(temporary);
    let server = InProcessServer::start(&data_dir).await;
    if server.is_err() && args.data_dir.is_none() {
        std::fs::remove_dir_all(&data_dir).ok();
    }
    let server = server?;
    let mut result = tokio::select! {
        shown = show(&args, &server, &data_dir) => shown,
        code = signals.next() => Err(Exit::new(code, "").into()),
    };
    if args.keep && result.is_ok() {
        signals.next().await;
    }
    // A second signal ends the process at once.
    let stopped = tokio::select! {
        stopped = server.stop() => stopped,
        code = signals.next() => Err(Exit::new(code, "").into()),
    };
    result = result.and(stopped);
    if args.data_dir.is_none() {
        result = result.and(std::fs::remove_dir_all(&data_dir).with_context(|| format!("cannot remove {}", data_dir.display())));
    }
    result
}

/// Everything between the start of the server and its end.
async fn show(args: &DemoArgs, server: &InProcessServer, data_dir: &Path) -> anyhow::Result<()> {
    let begin = Instant::now();
    outln!(
        "Server on an empty data directory\n  gRPC       {}\n  REST       http://{http}\n  dashboard  http://{http}/\n  data       {}\n",
        server.grpc,
        data_dir.display(),
        http = server.http,
    )?;

    let local = ConnectArgs::default();
    let env = EnvConfig::default();
    let seeds = layout_list("eval-v1")?.seeds(args.episodes);
    outln!(
        "1. Policies on {} layouts of {} UAVs and {} users, {} slots each; every slot is one gRPC Act",
        seeds.len(),
        env.uavs,
        env.users,
        env.slots
    )?;
    let mut comparison = Comparison {
        server: act_client::connect(&server.grpc.to_string(), &local).await?,
        env,
        seeds,
        rows: Vec::new(),
        episodes: Vec::new(),
    };
    for (name, _) in bundled::BUNDLED {
        comparison.run(name).await?;
    }
    for baseline in baselines::LIST {
        comparison.run(baseline.name).await?;
    }

    let client = Client::new(&server.http.to_string(), &local)?;
    let job = json!({
        "name": JOB,
        "algorithm": Algorithm::Qmix,
        "preset": "practical",
        "environment": {},
        "training": {
            "steps": args.steps,
            "eval_every": (args.steps / 11).max(1),
            "epsilon_anneal": (args.steps / 4).max(1),
        },
        "threads": all_cores(),
    });
    outln!("\n2. A training job over REST: POST /v1/jobs {job}")?;
    let ended = train::run_job(&client, &job).await?;
    let id = ended["id"].as_str().context("the job has no id")?;
    print_curve(&client, id).await?;
    let policy = ended["policy"].as_str().context("the job published no policy")?;

    outln!("\n3. The trained policy {policy} on the same layouts")?;
    comparison.run(policy).await?;

    outln!("\nMean AoI in slots (lower is better)\n{}", table::policy_table(&comparison.rows))?;
    comparison.print_differences(policy)?;
    outln!("Finished in {:.0} s.", begin.elapsed().as_secs_f64())?;
    if args.keep {
        outln!(
            "\nThe server keeps running; stop it with ctrl-c. Watch {policy} fly beside the best rule:\n  \
             http://{http}/#/player?policy={policy}&against={RULE}\nthe curve of its training:\n  http://{http}/#/jobs/{id}",
            http = server.http
        )?;
    }
    Ok(())
}

/// The best rule that knows no more than the trained policy: what UAVs detect, and share within the communication range.
const RULE: &str = "sweep-shared";

/// The policies that have run so far.
struct Comparison {
    server: PolicyClient,
    env: EnvConfig,
    seeds: Vec<u64>,
    rows: Vec<(String, Summary)>,
    episodes: Vec<(String, Vec<crate::env::EpisodeMetrics>)>,
}

impl Comparison {
    /// Runs a policy on all layouts and prints its mean AoI.
    async fn run(&mut self, policy: &str) -> anyhow::Result<()> {
        let begin = Instant::now();
        let bar = progress::bar(self.seeds.len() as u64, "layouts").with_message(policy.to_owned());
        let episodes = act_client::run_episodes(&self.server, policy, &self.env, &self.seeds, &bar).await?;
        bar.finish_and_clear();
        let acts = (self.seeds.len() * self.env.slots) as f64;
        let summary = summarize(&episodes)?;
        let rate = acts / begin.elapsed().as_secs_f64();
        outln!("   {policy:<16} mean AoI {:5.2}   {rate:6.0} Acts per second", summary.mean_aoi.mean)?;
        self.rows.push((policy.to_owned(), summary));
        self.episodes.push((policy.to_owned(), episodes));
        Ok(())
    }

    /// Prints how much better or worse the trained policy is than rules that know no more, and than chance.
    fn print_differences(&self, policy: &str) -> anyhow::Result<()> {
        let episodes = |name: &str| self.episodes.iter().find(|(policy, _)| policy == name).map(|(_, episodes)| episodes);
        for rule in [RULE, "sweep", "random"] {
            let Some((trained, others)) = episodes(policy).zip(episodes(rule)) else { continue };
            let d = difference(trained, others)?.mean_aoi;
            outln!("{policy} minus {rule:<12} {:+7.2}   (95 % interval {:+.2} to {:+.2}, same layouts)", d.mean, d.low, d.high)?;
        }
        Ok(())
    }
}

/// Prints the validation curve of the job.
async fn print_curve(client: &Client, id: &str) -> anyhow::Result<()> {
    let response = client.get(&format!("/v1/jobs/{id}/metrics?name=eval/mean_aoi")).await?;
    let values: Vec<f64> =
        response["metrics"].as_array().into_iter().flatten().filter_map(|row: &Value| row["value"].as_f64()).collect();
    let (first, last) = values.first().zip(values.last()).context("the job reported no evaluation")?;
    outln!("   job {id} succeeded; validation mean AoI {first:.1} {} {last:.1}", table::sparkline(&values))?;
    Ok(())
}
