//! `qedgix evaluate`: policies side by side on frozen layouts (spec 7), here or through a server's `Act`.

use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, ensure};
use clap::Args;
use serde_json::{Value, json};

use super::{fly, progress, run_args::all_cores, table};
use crate::checkpoint::Checkpoint;
use crate::env::{EnvConfig, EpisodeMetrics};
use crate::learner::{Summary, difference, evaluate, layouts, summarize};
use crate::policy::{Policy, baselines};
use crate::serving::bundled;

/// Flags of `evaluate`.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  qedgix evaluate --policy sweep --policy nearest
  qedgix evaluate --policy policy.safetensors --policy sweep --uavs 4 --users 8 --json
  qedgix evaluate --policy sweep --policy my-job:1 --server 127.0.0.1:50051 --episodes 16")]
pub struct EvaluateArgs {
    /// A checkpoint file, a bundled policy or a baseline; with --server, any policy it serves. May be repeated
    #[arg(long, required = true, env = "QEDGIX_POLICY", value_delimiter = ',')]
    policy: Vec<String>,
    /// Frozen list of layouts
    #[arg(long, env = "QEDGIX_LAYOUTS", default_value = "eval-v1")]
    layouts: String,
    /// How many of them, from the first [default: 256, or fewer where the list is shorter]
    #[arg(long, env = "QEDGIX_EPISODES", default_value_t = 256)]
    episodes: usize,
    /// Number of UAVs
    #[arg(long, env = "QEDGIX_UAVS", default_value_t = 3)]
    uavs: usize,
    /// Number of users
    #[arg(long, env = "QEDGIX_USERS", default_value_t = 5)]
    users: usize,
    /// Slots per episode
    #[arg(long, env = "QEDGIX_SLOTS", default_value_t = 80)]
    slots: usize,
    /// Detection range, in units of the square's side
    #[arg(long, env = "QEDGIX_DETECTION_RANGE", default_value_t = 0.28)]
    detection_range: f64,
    /// Threads [default: all cores]
    #[arg(long, env = "QEDGIX_THREADS")]
    threads: Option<usize>,
    /// Fly through gRPC Act of the server at HOST:PORT
    #[arg(long, env = "QEDGIX_SERVER", value_name = "HOST:PORT")]
    server: Option<String>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Runs the command.
///
/// # Errors
/// An unknown policy or list, a policy that does not fit, a server that refuses.
pub async fn run(args: EvaluateArgs) -> anyhow::Result<()> {
    let mut env = EnvConfig {
        uavs: args.uavs,
        users: args.users,
        slots: args.slots,
        detection_range: args.detection_range,
        ..EnvConfig::default()
    };
    env.validate()?;
    ensure!(args.episodes > 0, "--episodes: 0 is not valid; expected at least 1");
    let list = layouts(&args.layouts)?;
    let seeds = list.seeds(args.episodes);
    let bar = progress::bar(args.policy.len() as u64, "policies");
    let mut flown = Vec::new();
    let mut server = match &args.server {
        Some(address) => Some(fly::connect(address).await?),
        None => None,
    };
    for name in &args.policy {
        bar.set_message(name.clone());
        let episodes = if let Some(server) = &mut server {
            fly::episodes(server, name, &env, &seeds).await?
        } else {
            let policy = open(name, &env)?;
            env.hover = policy.actions() > EnvConfig::COMPASS;
            evaluate(policy.as_ref(), &env, &seeds, args.threads.unwrap_or_else(all_cores))
                .with_context(|| format!("policy {name}"))?
        };
        flown.push((name.clone(), episodes));
        bar.inc(1);
    }
    bar.finish_and_clear();
    let rows: Vec<(String, Summary)> =
        flown.iter().map(|(name, episodes)| Ok((name.clone(), summarize(episodes)?))).collect::<anyhow::Result<_>>()?;
    if args.json {
        let report = json!({
            "layouts": list.name,
            "episodes": seeds.len(),
            "environment": env,
            "policies": rows.iter().map(|(name, summary)| json!({"policy": name, "summary": summary})).collect::<Vec<_>>(),
            "differences": differences(&flown)?,
        });
        println!("{}", serde_json::to_string_pretty(&report)?);
    } else {
        println!("{} of {}, {} UAVs, {} users, {} slots; AoI in slots", seeds.len(), list.name, env.uavs, env.users, env.slots);
        println!("{}", table::of_policies(&rows));
    }
    Ok(())
}

/// Every pair of policies on the same layouts: first minus second.
fn differences(flown: &[(String, Vec<EpisodeMetrics>)]) -> anyhow::Result<Vec<Value>> {
    let mut pairs = Vec::new();
    for (i, (first, a)) in flown.iter().enumerate() {
        for (second, b) in &flown[i + 1..] {
            pairs.push(json!({"first": first, "second": second, "difference": difference(a, b)?}));
        }
    }
    Ok(pairs)
}

/// A policy by what it is called on the command line: a file, a bundled policy or a baseline.
///
/// # Errors
/// No such thing, or a file that is no checkpoint.
pub fn open(name: &str, env: &EnvConfig) -> anyhow::Result<Arc<dyn Policy>> {
    if let Some(policy) = baselines::by_name(name, env.into()) {
        return Ok(policy);
    }
    let bytes = match bundled::BUNDLED.iter().find(|(bundled, _)| *bundled == name) {
        Some((_, bytes)) => bytes.to_vec(),
        None => std::fs::read(Path::new(name)).with_context(|| {
            let known = baselines::LIST.iter().map(|b| b.name).chain(bundled::BUNDLED.iter().map(|(name, _)| *name));
            format!("{name} is neither a checkpoint file nor one of {}", known.collect::<Vec<_>>().join(", "))
        })?,
    };
    let checkpoint = Checkpoint::from_bytes(&bytes).with_context(|| format!("{name} is no checkpoint"))?;
    Ok(Arc::new(checkpoint.policy()))
}
