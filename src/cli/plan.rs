//! `qedgix plan`: how many UAVs a policy needs to keep the data of so many users fresh, also if one UAV is lost.

use std::path::PathBuf;

use anyhow::{Context, ensure};
use clap::Args;
use serde_json::{Map, Value, json};

use super::figures::FigureArgs;
use super::files::write_atomic;
use super::output::{Exit, outln};
use super::policy_file::open;
use super::progress;
use super::run_args::all_cores;
use super::table::text_table;
use super::world_args::{World, WorldArgs, named_by_flag};
use crate::env::{EnvConfig, EpisodeMetrics, LostUav};
use crate::learner::{Disturbance, Failure, FleetSize, Interval, Sizing, SizingTarget, evaluate_traced, layout_list};
use crate::plot::{self, Chart, Series};

/// Flags of `plan`.
#[derive(Args, Debug)]
#[command(
    after_help = "Evaluates fleets of 1, 2, 3, ... UAVs on the same layouts until one surely meets the target. Exit status 1: none of up to
--max-uavs UAVs does.

Examples:
  qedgix plan --policy qedgix --users 12 --target-p95 10
  qedgix plan --policy sweep-shared --users 12 --target-p95 20 --failures --report plan   # plan/plan.svg, failures.svg, plan.json
  qedgix plan --policy qedgix --users 12 --target-p95 10 --report plan --figures pdf      # plan/plan.pdf, plan.json"
)]
pub struct PlanArgs {
    /// A checkpoint file, a bundled policy or a baseline, for any number of UAVs
    #[arg(long, env = "QEDGIX_POLICY")]
    policy: String,
    /// 95th percentile of AoI over users and slots that the fleet must keep, in slots
    #[arg(long, env = "QEDGIX_TARGET_P95", value_name = "SLOTS")]
    target_p95: f64,
    /// Largest fleet to try
    #[arg(long, env = "QEDGIX_MAX_UAVS", default_value_t = 12)]
    max_uavs: usize,
    /// Also loses a UAV at each of several times, of the fleet that meets the target and of the next larger one
    #[arg(long, env = "QEDGIX_FAILURES")]
    failures: bool,
    /// Frozen list of layouts, not a mixed one
    #[arg(long, env = "QEDGIX_LAYOUTS", default_value = "eval-v1")]
    layouts: String,
    /// Number of layouts, from the first of the list; all if the list has fewer
    #[arg(long, env = "QEDGIX_EPISODES", default_value_t = 128)]
    episodes: usize,
    #[command(flatten)]
    world: WorldArgs,
    /// Threads [default: all cores]
    #[arg(long, env = "QEDGIX_THREADS")]
    threads: Option<usize>,
    /// Write plan.svg, plan.json and, with --failures, failures.svg into this directory
    #[arg(long, env = "QEDGIX_REPORT", value_name = "DIR")]
    report: Option<PathBuf>,
    #[command(flatten)]
    figures: FigureArgs,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Runs the command.
///
/// # Errors
/// A policy that does not fit, flags out of range, files that cannot be written; exit status 1 if no fleet meets the target.
pub fn run(args: &PlanArgs) -> anyhow::Result<()> {
    args.target().validate().map_err(|e| named_by_flag(e, &Map::new()))?;
    ensure!(args.episodes > 0, "--episodes: got 0, expected at least 1");
    let list = layout_list(&args.layouts).map_err(|e| named_by_flag(e, &Map::new()))?;
    ensure!(!list.mixed, "--layouts {}: it draws the environments itself; choose a list that is not mixed", list.name);
    args.figures.warn_if_unused(args.report.is_some(), "--report");
    let world = args.world.world(EnvConfig::default(), &[])?;
    ensure!(!world.is_given("uavs"), "--set environment.uavs: plan tries fleets of all sizes; --max-uavs is the largest");
    open(&args.policy, &world.env)?.warn_of_other_world(&args.policy, &world, &["uavs"]);
    let plan = args.plan(&world, &list.seeds(args.episodes))?;
    let users = world.env.users;
    let document = args.document(&plan, users);
    if let Some(directory) = &args.report {
        std::fs::create_dir_all(directory).with_context(|| format!("cannot create {}", directory.display()))?;
        args.figures.write(&directory.join("plan.svg"), &args.figure(&plan, users))?;
        write_atomic(&directory.join("plan.json"), format!("{document:#}\n").as_bytes())?;
        if args.failures {
            args.figures.write(&directory.join("failures.svg"), &args.failure_figure(&plan))?;
        }
    }
    if args.json {
        outln!("{document:#}")?;
    } else {
        args.print(&plan, users)?;
    }
    match plan.uavs {
        Some(_) => Ok(()),
        None => {
            Err(Exit::new(1, format!("no fleet of up to {} UAVs keeps p95 AoI at {}", args.max_uavs, args.target_p95)).into())
        }
    }
}

impl PlanArgs {
    fn target(&self) -> SizingTarget {
        let Self { target_p95, max_uavs, failures, .. } = *self;
        SizingTarget { target_p95, max_uavs, failures }
    }

    fn plan(&self, world: &World, seeds: &[u64]) -> anyhow::Result<Sizing> {
        let slots = world.env.slots;
        let bar = progress::bar(self.target().evaluations(slots) as u64, "fleets");
        let sizing = self.target().run(slots, |uavs, lose| {
            let episodes = self.evaluate(world, (uavs, lose), seeds)?;
            bar.inc(1);
            Ok::<_, anyhow::Error>(Some(episodes))
        })?;
        bar.finish_and_clear();
        sizing.context("the plan was stopped")
    }

    fn evaluate(
        &self,
        world: &World,
        (uavs, lose): (usize, Option<LostUav>),
        seeds: &[u64],
    ) -> anyhow::Result<Vec<EpisodeMetrics>> {
        let opened = open(&self.policy, &EnvConfig { uavs, ..world.env.clone() })?;
        let env = EnvConfig { uavs, ..opened.environment(&self.policy, world)? };
        env.validate()?;
        let policy = opened.policy;
        let disturbance = Disturbance { lose, ..Disturbance::default() };
        let threads = self.threads.unwrap_or_else(all_cores);
        let evaluation = evaluate_traced(&*policy, &env, seeds, 0, &disturbance, threads);
        Ok(evaluation.with_context(|| format!("policy {} with {uavs} UAVs", self.policy))?.episodes)
    }

    fn print(&self, plan: &Sizing, users: usize) -> anyhow::Result<()> {
        let mut before = None;
        let rows = plan.sizes.iter().map(|size| {
            let gain =
                before.replace(size.p95.mean).map_or_else(String::new, |before: f64| format!("{:.2}", before - size.p95.mean));
            [size.uavs.to_string(), cell(&size.p95), gain, cell(&size.mean_aoi)]
        });
        outln!("{users} users, {}, AoI in slots, mean and 95 % interval over layouts", self.policy)?;
        outln!("{}", text_table(["UAVs", "p95 AoI", "gain by the last UAV", "mean AoI"], rows))?;
        if let Some(uavs) = plan.uavs {
            let [low, high] =
                plan.interval.map(|end| end.map_or_else(|| format!("more than {}", self.max_uavs), |end| end.to_string()));
            outln!("{uavs} UAVs keep p95 AoI at {} or less (95 % interval: {low} to {high} UAVs)", self.target_p95)?;
            if !plan.failures.is_empty() {
                let rows = plan.failures.iter().map(|failure| {
                    let [smaller, larger] = failure.sizes.map(|size| cell(&size.p95));
                    [failure.slot.to_string(), smaller, larger]
                });
                let header = ["a UAV lost at slot".to_owned(), format!("p95 AoI, {uavs} UAVs"), format!("{} UAVs", uavs + 1)];
                outln!("{}", text_table(header, rows))?;
            }
        }
        Ok(())
    }

    fn figure(&self, plan: &Sizing, users: usize) -> String {
        let points = |of: fn(&FleetSize) -> Interval| -> (Vec<[f64; 2]>, Option<Vec<[f64; 2]>>) {
            let ends = |size: &FleetSize| [of(size).low, of(size).high];
            let points = plan.sizes.iter().map(|size| [size.uavs as f64, of(size).mean]).collect();
            (points, Some(plan.sizes.iter().map(ends).collect()))
        };
        let (p95, mean) = (points(|size| size.p95), points(|size| size.mean_aoi));
        plot::lines(&Chart {
            title: format!("{}: fleets for {users} users", self.policy),
            x: "UAVs".into(),
            y: "AoI (slots)".into(),
            series: vec![
                Series { name: "p95 AoI".into(), points: p95.0, band: p95.1 },
                Series { name: "mean AoI".into(), points: mean.0, band: mean.1 },
            ],
            levels: vec![("target of p95".into(), self.target_p95)],
            note: "Whiskers are 95 % intervals over layouts.".into(),
            markers: true,
            log_x: false,
        })
    }

    fn failure_figure(&self, plan: &Sizing) -> String {
        let series = |which: usize| {
            let of = |failure: &Failure| failure.sizes[which];
            Series {
                name: format!("{} UAVs", plan.failures.first().map_or(0, |failure| of(failure).uavs)),
                points: plan.failures.iter().map(|failure| [failure.slot as f64, of(failure).p95.mean]).collect(),
                band: Some(plan.failures.iter().map(|failure| [of(failure).p95.low, of(failure).p95.high]).collect()),
            }
        };
        plot::lines(&Chart {
            title: format!("{}: a UAV is lost", self.policy),
            x: "slot of the loss".into(),
            y: "p95 AoI (slots)".into(),
            series: vec![series(0), series(1)],
            levels: vec![("target".into(), self.target_p95)],
            note: "Whiskers are 95 % intervals over layouts.".into(),
            markers: true,
            log_x: false,
        })
    }

    fn document(&self, plan: &Sizing, users: usize) -> Value {
        let mut document = json!({
            "policy": self.policy,
            "users": users,
            "target_p95": self.target_p95,
            "layouts": self.layouts,
            "episodes": self.episodes,
        });
        plan.add_to(&mut document);
        document
    }
}

fn cell(interval: &Interval) -> String {
    format!("{:.2} ({:.2} to {:.2})", interval.mean, interval.low, interval.high)
}
