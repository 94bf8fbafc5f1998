//! `qedgix demo`: the whole story on an empty machine. A server on an empty data directory; a trained policy and the baselines
//! flown through gRPC `Act`; a training job over REST; its checkpoint, served by the same `Act`; one table.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::Context;
use clap::Args;
use serde_json::{Value, json};

use super::act_client::PolicyClient;
use super::client::Client;
use super::connect::ConnectArgs;
use super::in_process_server::InProcessServer;
use super::output::outln;
use super::run_args::all_cores;
use super::{act_client, progress, table, train};
use crate::env::EnvConfig;
use crate::learner::{Algorithm, Summary, difference, layout_list, summarize};
use crate::policy::baselines;
use crate::serving::bundled;

/// Flags of `demo`; none is needed.
#[derive(Args, Debug)]
#[command(after_help = "Examples:\n  qedgix demo\n  qedgix demo --keep     # leaves the server running, to look around")]
pub struct DemoArgs {
    /// Leave the server running until ctrl-c
    #[arg(long)]
    keep: bool,
    /// Environment steps of the training job
    #[arg(long, env = "QEDGIX_STEPS", default_value_t = 100_000)]
    steps: u64,
    /// Layouts of eval-v1 that every policy flies
    #[arg(long, env = "QEDGIX_EPISODES", default_value_t = 32)]
    episodes: usize,
    /// Where the server keeps its data [default: a new temporary directory, removed afterwards]
    #[arg(long, env = "QEDGIX_DATA_DIR")]
    data_dir: Option<PathBuf>,
}

/// Name of the job and of the policy that it becomes.
const JOB: &str = "demo-job";

/// Runs the command.
///
/// # Errors
/// Anything that does not go as told.
pub async fn run(args: DemoArgs) -> anyhow::Result<()> {
    let temporary = args.data_dir.is_none();
    let data_dir =
        args.data_dir.clone().unwrap_or_else(|| std::env::temp_dir().join(format!("qedgix-demo-{}", uuid::Uuid::now_v7())));
    let outcome = story(&args, data_dir.clone()).await;
    if temporary {
        std::fs::remove_dir_all(&data_dir).ok();
    }
    outcome
}

async fn story(args: &DemoArgs, data_dir: PathBuf) -> anyhow::Result<()> {
    let begin = Instant::now();
    let server = InProcessServer::start(&data_dir).await?;
    outln!(
        "A server on an empty data directory\n  gRPC  {}\n  REST  http://{}\n  data  {}\n",
        server.grpc,
        server.http,
        data_dir.display()
    )?;

    let here = ConnectArgs::default();
    let env = EnvConfig::default();
    let seeds = layout_list("eval-v1")?.seeds(args.episodes);
    outln!(
        "1. {} UAVs collect the data of {} users, {} slots, {} layouts; every slot is one gRPC Act",
        env.uavs,
        env.users,
        env.slots,
        seeds.len()
    )?;
    let mut flight = Flight {
        server: act_client::connect(&server.grpc.to_string(), &here).await?,
        env,
        seeds,
        rows: Vec::new(),
        flown: Vec::new(),
    };
    for (name, _) in bundled::BUNDLED {
        flight.fly(name).await?;
    }
    for baseline in baselines::LIST {
        flight.fly(baseline.name).await?;
    }

    let client = Client::new(&server.http.to_string(), &here)?;
    let job = json!({
        "name": JOB,
        "algorithm": Algorithm::Qmix,
        "preset": "practical",
        "environment": {},
        "training": {"steps": args.steps, "eval_every": (args.steps / 12).max(1)},
        "threads": all_cores(),
    });
    outln!("\n2. A training job over REST: POST /v1/jobs {job}")?;
    let ended = train::submit(&client, &job).await?;
    let id = ended["id"].as_str().context("the job has no id")?;
    tell_curve(&client, id).await?;
    let policy = ended["policy"].as_str().context("the job published no policy")?;

    outln!("\n3. Its checkpoint, policy {policy}, served by the same Act")?;
    flight.fly(policy).await?;

    outln!("\nMean AoI in slots; lower is fresher\n{}", table::policy_table(&flight.rows))?;
    if let [(first, trained), .., (last, fresh)] = &flight.flown[..] {
        let d = difference(fresh, trained)?.mean_aoi;
        outln!("{last} minus {first} on the same layouts: {:+.2} (95 % interval {:+.2} to {:+.2})", d.mean, d.low, d.high)?;
    }
    outln!("Done in {:.0} s.", begin.elapsed().as_secs_f64())?;
    if args.keep {
        outln!(
            "\nThe server stays: gRPC {}, REST http://{} (try /v1/jobs, /v1/policies). ctrl-c ends it.",
            server.grpc,
            server.http
        )?;
        tokio::signal::ctrl_c().await?;
    }
    server.stop().await
}

/// Policies flown so far.
struct Flight {
    server: PolicyClient,
    env: EnvConfig,
    seeds: Vec<u64>,
    rows: Vec<(String, Summary)>,
    flown: Vec<(String, Vec<crate::env::EpisodeMetrics>)>,
}

impl Flight {
    async fn fly(&mut self, policy: &str) -> anyhow::Result<()> {
        let begin = Instant::now();
        let bar = progress::spinner(policy);
        let episodes = act_client::run_episodes(&mut self.server, policy, &self.env, &self.seeds).await?;
        bar.finish_and_clear();
        let acts = (self.seeds.len() * self.env.slots) as f64;
        let summary = summarize(&episodes)?;
        let each = begin.elapsed().as_secs_f64() / acts * 1e3;
        outln!("   {policy:<16} mean AoI {:5.2}   {each:.2} ms per Act, round trip", summary.mean_aoi.mean)?;
        self.rows.push((policy.to_owned(), summary));
        self.flown.push((policy.to_owned(), episodes));
        Ok(())
    }
}

/// Prints what the job's metrics say.
async fn tell_curve(client: &Client, id: &str) -> anyhow::Result<()> {
    let answer = client.get(&format!("/v1/jobs/{id}/metrics?name=eval/mean_aoi")).await?;
    let values: Vec<f64> =
        answer["metrics"].as_array().into_iter().flatten().filter_map(|row: &Value| row["value"].as_f64()).collect();
    let (first, last) = values.first().zip(values.last()).context("the job reported no evaluation")?;
    outln!("   job {id} succeeded; validation mean AoI {first:.1} {} {last:.1}", table::sparkline(&values))?;
    Ok(())
}
