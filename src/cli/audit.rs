//! `qedgix audit`: whether UAVs can decide alone by a policy, and what they need for it.

use anyhow::{Context, ensure};
use clap::Args;
use serde_json::{Map, Value, json};

use super::output::{Exit, outln};
use super::policy_file::open;
use super::run_args::all_cores;
use super::table::text_table;
use super::world_args::{WorldArgs, named_by_flag};
use crate::env::EnvConfig;
use crate::learner::layout_list;
use crate::policy::{EnvParams, Policy, Reach, RequiredInput};
use crate::serving::decentral::audit::{Audit, Trial, audit};

/// Flags of `audit`.
#[derive(Args, Debug)]
#[command(
    after_help = "Exit status: 0 if each UAV, alone with its sensors and the messages that the policy needs, takes the same actions; 1 if not.

Examples:
  qedgix audit --policy qedgix
  qedgix audit --policy my-policy.safetensors --uavs 6 --users 12
  qedgix audit --policy tour          # fails: needs all positions"
)]
pub struct AuditArgs {
    /// A checkpoint file, a bundled policy or a baseline
    #[arg(long, env = "QEDGIX_POLICY")]
    policy: String,
    /// Frozen list of layouts, not a mixed one
    #[arg(long, env = "QEDGIX_LAYOUTS", default_value = "valid-v1")]
    layouts: String,
    /// Number of layouts, from the first of the list; all if the list has fewer
    #[arg(long, env = "QEDGIX_EPISODES", default_value_t = 256)]
    episodes: usize,
    /// Number of UAVs [default: 3]
    #[arg(long, env = "QEDGIX_UAVS")]
    uavs: Option<usize>,
    #[command(flatten)]
    world: WorldArgs,
    /// Threads [default: all cores]
    #[arg(long, env = "QEDGIX_THREADS")]
    threads: Option<usize>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Runs the command.
///
/// # Errors
/// An unknown policy or list, a policy that does not fit the environment; exit status 1 if the policy does not pass.
pub fn run(args: &AuditArgs) -> anyhow::Result<()> {
    let default = EnvConfig::default();
    let base = EnvConfig { uavs: args.uavs.unwrap_or(default.uavs), ..default };
    let world = args.world.world(base, if args.uavs.is_some() { &["uavs"] } else { &[] })?;
    let list = layout_list(&args.layouts).map_err(|e| named_by_flag(e, &Map::new()))?;
    ensure!(!list.mixed, "--layouts {}: it draws the environments itself; choose a list that is not mixed", list.name);
    ensure!(args.episodes > 0, "--episodes: got 0, expected at least 1");
    let opened = open(&args.policy, &world.env)?;
    opened.warn_of_other_world(&args.policy, &world, &[]);
    let env = opened.environment(&args.policy, &world)?;
    let policy = opened.policy;
    if policy.needs() == RequiredInput::FullScene {
        let why = "it needs the positions of all UAVs and users (full information), which no UAV has";
        if args.json {
            outln!("{:#}", json!({"policy": args.policy, "passed": false, "why": why}))?;
        }
        return Err(Exit::new(1, format!("{} fails: {why}", args.policy)).into());
    }
    let threads = args.threads.unwrap_or_else(all_cores);
    let result = audit(&*policy, &env, &list.seeds(args.episodes), threads).with_context(|| format!("policy {}", args.policy))?;
    let why = failure(&result);
    if args.json {
        outln!("{:#}", report(&args.policy, &*policy, &result, why))?;
    } else {
        print(&result, &env)?;
    }
    match why {
        None if args.json => Ok(()),
        None => Ok(outln!("{} passes: each UAV alone takes the actions of the joint policy", args.policy)?),
        Some(why) => Err(Exit::new(1, format!("{} fails: {why}", args.policy)).into()),
    }
}

/// Why the policy does not pass.
fn failure(audit: &Audit) -> Option<&'static str> {
    match audit.reach {
        _ if audit.passed() => None,
        Reach::Fleet => Some("the decision of a UAV depends on all UAVs, also on those that no message over a few links reaches"),
        Reach::Links(_) => {
            Some("with the messages that it declares to need, a UAV alone decides otherwise than the joint policy")
        }
    }
}

fn share(of: u64, all: u64) -> f64 {
    of as f64 / all.max(1) as f64
}

fn print(audit: &Audit, env: &EnvConfig) -> anyhow::Result<()> {
    let all = audit.decisions;
    let row = |trial: &Trial| {
        let whose = match trial.links {
            None => "all UAVs".to_owned(),
            Some(0) => "none".to_owned(),
            Some(1) => "UAVs within 1 link".to_owned(),
            Some(links) => format!("UAVs within {links} links"),
        };
        [
            whose,
            format!("{:.2} %", 100.0 * share(trial.equal, all)),
            format!("{:.2} %", 100.0 * share(trial.same_bits, all)),
            format!("{:.2}", share(trial.received, all)),
        ]
    };
    outln!("{} decisions of {} UAVs with {} users, each taken jointly and alone", all, env.uavs, env.users)?;
    let header = ["messages from", "same heading", "same bits of Q", "messages received"];
    outln!("{}", text_table(header, audit.trials.iter().map(row)))?;
    outln!("{}", needs(audit, &EnvParams::from(env)))?;
    outln!(
        "Act with a scene, where users detect each other also unseen by UAVs: {:.2} % same headings. Mean AoI {:.2} slots.",
        100.0 * share(audit.scene_equal, all),
        audit.mean_aoi
    )?;
    Ok(())
}

/// What a UAV needs, as a sentence.
fn needs(audit: &Audit, env: &EnvParams) -> String {
    let size = format!("{:.0} bytes on average, at most {}", audit.mean_bytes, audit.max_bytes);
    match (audit.reach, audit.range) {
        (Reach::Links(0), _) => "Needs: its own sensors, no messages".to_owned(),
        (Reach::Links(1), Some(range)) => {
            format!("Needs: one message per UAV and slot ({size}), from UAVs within {range:.3}, in 1 round")
        }
        (Reach::Links(links), Some(range)) => format!(
            "Needs: one message per UAV and slot ({size}), from UAVs within {range:.3} in 1 round; or over {links} links of at most {:.3}, \
             which UAVs and users forward in {links} rounds",
            env.ranges().max()
        ),
        _ => format!("Needs: one message per UAV and slot ({size}), from all UAVs"),
    }
}

fn report(name: &str, policy: &dyn Policy, audit: &Audit, why: Option<&str>) -> Value {
    let all = audit.decisions;
    let trial = |trial: &Trial| {
        json!({
            "links": trial.links,
            "same_heading": share(trial.equal, all),
            "same_bits": share(trial.same_bits, all),
            "messages_received": share(trial.received, all),
        })
    };
    let links = if let Reach::Links(links) = audit.reach { Some(links) } else { None };
    json!({
        "policy": name,
        "passed": why.is_none(),
        "why": why,
        "decisions": all,
        "needs": {
            "own_position": policy.needs() >= RequiredInput::OwnPositions,
            "message_links": links,
            "message_range": audit.range,
            "rounds": links.map(|links| links.min(1)),
            "rounds_with_forwarding": links,
            "mean_message_bytes": audit.mean_bytes,
            "max_message_bytes": audit.max_bytes,
        },
        "trials": audit.trials.iter().map(trial).collect::<Vec<_>>(),
        "same_heading_as_with_a_scene": share(audit.scene_equal, all),
        "mean_aoi": audit.mean_aoi,
    })
}
