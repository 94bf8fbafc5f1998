//! `qedgix evaluate`: compares policies on frozen layouts, in this process or through `Act` of a server.

use std::path::PathBuf;

use anyhow::{Context, ensure};
use clap::Args;
use serde_json::Map;

use super::connect::ConnectArgs;
use super::figures::FigureArgs;
use super::output::{errln, outln};
use super::policy_file::open;
use super::world_args::{World, WorldArgs, named_by_flag};
use super::{act_client, explain, ports, progress, report, run_args::all_cores, table};
use crate::env::{EnvConfig, LostUav, UserSlots};
use crate::learner::{
    Comparison, Disturbance, LayoutList, PolicyEvaluation, TracedEvaluation, Trajectory, evaluate_list, evaluate_traced,
    layout_list,
};
use crate::policy::baselines;

/// Flags of `evaluate`.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  qedgix evaluate --policy sweep --policy nearest
  qedgix evaluate --policy qedgix --policy sweep --report report      # then open report/index.html
  qedgix evaluate --policy qedgix --policy sweep --report report --figures svg,pdf   # PDF for a paper
  qedgix evaluate --policy sweep --policy my-job:1 --server 127.0.0.1:50051 --episodes 16

Conditions that differ from training:
  qedgix evaluate --policy policy.safetensors --policy sweep --uavs 4 --users 8 --json
  qedgix evaluate --policy qedgix --policy sweep --detection-range 0.2 --user-speed 0.01
  qedgix evaluate --policy policy.safetensors --policy sweep --set environment.speed=0.08   # as in training
  qedgix evaluate --policy qedgix --policy sweep-shared --communication-range 1.5   # everywhere
  qedgix evaluate --policy qedgix --policy sweep-shared --layouts eval-mixed-v2     # drawn sizes, ranges and horizons
  qedgix evaluate --policy qedgix --policy sweep --lose-uav 1@20      # UAV 1 of 0, 1, 2 is lost from slot 20 on
  qedgix evaluate --policy qedgix --policy sweep --user-slots 0@25 --user-slots 3@0..60   # a user that appears, one that leaves
  qedgix evaluate --policy qedgix --policy sweep --position-noise 0.02")]
pub struct EvaluateArgs {
    /// A checkpoint file, a bundled policy or a baseline; with --server, a policy of the server. May be repeated
    #[arg(long, required = true, env = "QEDGIX_POLICY", value_delimiter = ',')]
    policy: Vec<String>,
    /// Frozen list of layouts
    #[arg(long, env = "QEDGIX_LAYOUTS", default_value = "eval-v1")]
    layouts: String,
    /// Number of layouts, from the first of the list; all if the list has fewer
    #[arg(long, env = "QEDGIX_EPISODES", default_value_t = 256)]
    episodes: usize,
    /// Number of UAVs [default: 3]
    #[arg(long, env = "QEDGIX_UAVS")]
    uavs: Option<usize>,
    #[command(flatten)]
    world: WorldArgs,
    /// Distance that users move per slot, in units of the square's side; 0: users stay [default: 0]
    #[arg(long, env = "QEDGIX_USER_SPEED")]
    user_speed: Option<f64>,
    /// Index of a UAV (from 0) that is lost from a slot on: it does not move, collect or detect, and is not detected
    #[arg(long, env = "QEDGIX_LOSE_UAV", value_name = "UAV@SLOT", value_parser = lost_uav)]
    lose_uav: Option<LostUav>,
    /// Slots of a user (index from 0) that comes or goes: from a slot on, or from a slot until another; may be repeated
    #[arg(long, env = "QEDGIX_USER_SLOTS", value_name = "USER@FROM[..UNTIL]", value_parser = user_slots, value_delimiter = ',')]
    user_slots: Vec<UserSlots>,
    /// Standard deviation of the error of each observed coordinate, in units of the square's side
    #[arg(long, env = "QEDGIX_POSITION_NOISE", value_name = "SIGMA", default_value_t = 0.0)]
    position_noise: f64,
    /// Threads [default: all cores]
    #[arg(long, env = "QEDGIX_THREADS")]
    threads: Option<usize>,
    /// Evaluate through Act of the server at this gRPC address
    #[arg(long, env = "QEDGIX_GRPC_SERVER", value_name = "HOST:PORT")]
    server: Option<String>,
    #[command(flatten)]
    connect: ConnectArgs,
    /// Write a report with tables and plots into this directory: index.html, report.md, report.json, and the plots as files
    #[arg(long, env = "QEDGIX_REPORT", value_name = "DIR")]
    report: Option<PathBuf>,
    /// Index of the layout (from 0) whose trajectories the report shows
    #[arg(long, env = "QEDGIX_REPORT_LAYOUT", value_name = "N", default_value_t = 0)]
    report_layout: usize,
    /// Write into this directory, for each policy with Q-values, what speaks for and against its headings on one layout
    /// (--report-layout): explain-N-POLICY.svg and .json
    #[arg(long, env = "QEDGIX_EXPLAIN", value_name = "DIR")]
    explain: Option<PathBuf>,
    #[command(flatten)]
    figures: FigureArgs,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Runs the command.
///
/// # Errors
/// An unknown policy or list, a policy that does not fit the environment, an error of the server, a directory that cannot be
/// written.
pub async fn run(args: EvaluateArgs) -> anyhow::Result<()> {
    let (list, seeds, world) = check(&args)?;
    let env = &world.env;
    let disturbance = args.disturbance();
    // The gaps to references are in the JSON and in the report only.
    let requested = |name: &str| args.policy.iter().any(|p| p == name);
    let references: &[&str] = if args.json || args.report.is_some() { &Comparison::REFERENCES } else { &[] };
    let references = references.iter().copied().filter(|name| !requested(name) && baselines::by_name(name, env.into()).is_some());
    let names: Vec<(&str, bool)> =
        args.policy.iter().map(|name| (name.as_str(), false)).chain(references.map(|name| (name, true))).collect();

    let server = match &args.server {
        Some(address) => {
            ports::expect_grpc(address, &args.connect).await?;
            Some(act_client::connect(address, &args.connect).await?)
        }
        None => None,
    };
    let bar = progress::bar((names.len() * seeds.len()) as u64, "layouts");
    let mut evaluations = Vec::new();
    for (number, (name, reference)) in names.iter().copied().enumerate() {
        bar.set_message(format!("{name}, policy {} of {}", number + 1, names.len()));
        bar.set_position((number * seeds.len()) as u64);
        let evaluation = match &server {
            Some(server) if !reference => {
                let episodes = act_client::run_episodes(server, name, env, &seeds, &bar).await?;
                TracedEvaluation { episodes, aoi: Vec::new(), trajectory: Trajectory::default() }
            }
            _ => {
                let opened = open(name, env)?;
                bar.suspend(|| opened.warn_of_other_world(name, &world, list.drawn()));
                let env = opened.environment(name, &world)?;
                let policy = opened.policy;
                let threads = args.threads.unwrap_or_else(all_cores);
                if list.mixed {
                    let episodes = evaluate_list(policy.as_ref(), (&list, args.episodes), &env, threads)
                        .with_context(|| format!("policy {name}"))?;
                    TracedEvaluation { episodes, aoi: Vec::new(), trajectory: Trajectory::default() }
                } else {
                    evaluate_traced(policy.as_ref(), &env, &seeds, args.report_layout, &disturbance, threads)
                        .with_context(|| format!("policy {name}"))?
                }
            }
        };
        evaluations.push(PolicyEvaluation::new(name, reference, evaluation)?);
        if bar.is_hidden() && names.len() > 1 {
            errln!("{name}: policy {} of {} evaluated", number + 1, names.len());
        }
    }
    bar.finish_and_clear();
    if let Some(directory) = &args.explain {
        explain::write((directory, &args.figures), &args.policy, &world, seeds[args.report_layout])
            .with_context(|| format!("writing explanations to {}", directory.display()))?;
    }

    let comparison = Comparison { layouts: list, episodes: seeds.len(), env: world.env, disturbance, policies: evaluations };
    if let Some(directory) = &args.report {
        report::write((directory, &args.figures), &comparison, &args.command_line())
            .with_context(|| format!("writing the report to {}", directory.display()))?;
    }
    if args.json {
        outln!("{}", serde_json::to_string_pretty(&comparison.json()?)?)?;
        return Ok(());
    }
    outln!("{}; AoI in slots", comparison.conditions())?;
    let requested = comparison.policies.iter().filter(|policy| !policy.reference);
    outln!("{}", table::policy_table(&requested.map(|policy| (policy.name.clone(), policy.summary)).collect::<Vec<_>>()))?;
    if let Some(directory) = &args.report {
        outln!("Report: {}", directory.join("index.html").display())?;
    }
    Ok(())
}

/// The list of layouts, the seeds and the world of the flags, checked.
fn check(args: &EvaluateArgs) -> anyhow::Result<(LayoutList, Vec<u64>, World)> {
    let default = EnvConfig::default();
    let base = EnvConfig {
        uavs: args.uavs.unwrap_or(default.uavs),
        user_speed: args.user_speed.unwrap_or(default.user_speed),
        // A server is not told who is lost; it sees who is listed.
        lose_uav: args.lose_uav.filter(|_| args.server.is_some()),
        user_slots: args.user_slots.clone(),
        ..default
    };
    let given = [args.uavs.map(|_| "uavs"), args.user_speed.map(|_| "user_speed")];
    let world = args.world.world(base, &given.into_iter().flatten().collect::<Vec<_>>())?;
    args.disturbance().validate(&world.env).map_err(|e| named_by_flag(e, &Map::new()))?;
    ensure!(args.episodes > 0, "--episodes: got 0, expected at least 1");
    let list = layout_list(&args.layouts).map_err(|e| named_by_flag(e, &Map::new()))?;
    let seeds = list.seeds(args.episodes);
    ensure!(
        args.report_layout < seeds.len(),
        "--report-layout: got {}, expected a number from 0 to {}",
        args.report_layout,
        seeds.len() - 1
    );
    ensure!(
        args.explain.is_none() || (args.server.is_none() && !list.mixed),
        "--explain works for files, bundled policies and baselines, on lists that are not mixed; leave out --server"
    );
    let local_only = args.report.is_some() || args.disturbance() != Disturbance::default();
    ensure!(
        args.server.is_none() || !local_only,
        "--report and --position-noise work for files, bundled policies and baselines only; leave out --server"
    );
    ensure!(
        !list.mixed || (args.server.is_none() && !local_only),
        "--layouts {}: it draws the environments itself; leave out --server, --report, --lose-uav and --position-noise",
        list.name
    );
    args.figures.warn_if_unused(args.report.is_some() || args.explain.is_some(), "--report or --explain");
    Ok((list, seeds, world))
}

impl EvaluateArgs {
    fn disturbance(&self) -> Disturbance {
        Disturbance { lose: self.lose_uav.filter(|_| self.server.is_none()), position_noise: self.position_noise }
    }

    /// The command that repeats this evaluation, including values from environment variables.
    fn command_line(&self) -> String {
        let (default, world) = (EnvConfig::default(), &self.world);
        let mut words = vec!["qedgix evaluate".to_owned()];
        let mut add = |flag: &str, value: String| words.push(format!("--{flag} {}", quoted(&value)));
        for policy in &self.policy {
            add("policy", policy.clone());
        }
        add("layouts", self.layouts.clone());
        add("episodes", self.episodes.to_string());
        for (flag, value, default) in
            [("uavs", self.uavs, default.uavs), ("users", world.users, default.users), ("slots", world.slots, default.slots)]
        {
            if let Some(value) = value.filter(|value| *value != default) {
                add(flag, value.to_string());
            }
        }
        for (flag, value, default) in [
            ("detection-range", world.detection_range, default.detection_range),
            ("transmission-range", world.transmission_range, default.transmission_range),
            ("user-speed", self.user_speed, default.user_speed),
            ("position-noise", Some(self.position_noise), 0.0),
        ] {
            if let Some(value) = value.filter(|value| *value != default) {
                add(flag, value.to_string());
            }
        }
        if let Some(range) = world.communication_range {
            add("communication-range", range.to_string());
        }
        for item in &world.set {
            add("set", item.clone());
        }
        if let Some(LostUav { uav, slot }) = self.lose_uav {
            add("lose-uav", format!("{uav}@{slot}"));
        }
        for UserSlots { user, from, until } in &self.user_slots {
            let until = until.map_or_else(String::new, |until| format!("..{until}"));
            add("user-slots", format!("{user}@{from}{until}"));
        }
        if self.report_layout > 0 {
            add("report-layout", self.report_layout.to_string());
        }
        if let Some(directory) = &self.report {
            add("report", directory.display().to_string());
        }
        if let Some(figures) = self.figures.value() {
            add("figures", figures);
        }
        words.join(" ")
    }
}

/// `UAV@SLOT`, both counted from 0.
fn lost_uav(text: &str) -> Result<LostUav, String> {
    let parts = text.split_once('@').and_then(|(uav, slot)| Some((uav.parse().ok()?, slot.parse().ok()?)));
    let (uav, slot) = parts.ok_or("expected UAV@SLOT, two whole numbers counted from 0, as in 1@20")?;
    Ok(LostUav { uav, slot })
}

/// `USER@FROM` or `USER@FROM..UNTIL`, counted from 0.
fn user_slots(text: &str) -> Result<UserSlots, String> {
    let parse = || {
        let (user, slots) = text.split_once('@')?;
        let (from, until) = slots.split_once("..").map_or((slots, None), |(from, until)| (from, Some(until)));
        let until = until.map(str::parse).transpose().ok()?;
        Some(UserSlots { user: user.parse().ok()?, from: from.parse().ok()?, until })
    };
    parse().ok_or_else(|| "expected USER@FROM or USER@FROM..UNTIL, whole numbers counted from 0, as in 3@10..60".to_owned())
}

/// `word` quoted for a shell.
fn quoted(word: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "_-./:@=+%".contains(c);
    if !word.is_empty() && word.chars().all(plain) { word.to_owned() } else { format!("'{}'", word.replace('\'', "'\\''")) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(clap::Parser)]
    struct Line {
        #[command(flatten)]
        args: EvaluateArgs,
    }

    fn parse(words: &[&str]) -> Result<EvaluateArgs, String> {
        use clap::Parser;
        let words = ["x", "--policy", "sweep"].iter().chain(words);
        Line::try_parse_from(words).map(|line| line.args).map_err(|e| e.to_string())
    }

    #[test]
    fn errors_name_the_flag() {
        for (words, hint) in [
            (vec!["--lose-uav", "1"], "UAV@SLOT"),
            (vec!["--lose-uav", "one@3"], "UAV@SLOT"),
            (vec!["--lose-uav", "3@0"], "--lose-uav, uav: got 3"),
            (vec!["--lose-uav", "0@80"], "--lose-uav, slot: got 80"),
            (vec!["--position-noise", "nan"], "--position-noise: got NaN"),
            (vec!["--position-noise", "2"], "--position-noise: got 2"),
            (vec!["--user-speed=-1"], "--user-speed: got -1"),
            (vec!["--user-speed", "3"], "--user-speed: got 3"),
            (vec!["--transmission-range", "0.5"], "--detection-range: got 0.28"),
            (vec!["--layouts", "eval-v0"], "--layouts: got"),
            (vec!["--set", "environment.speed=2"], "--set environment.speed: got 2"),
            (vec!["--set", "environment.t=0.5"], "--detection-range: got 0.28"),
            (vec!["--set", "environment.sped=0.5"], "--set environment.sped: unknown field"),
            (vec!["--set", "training.batch=5"], "nothing is trained"),
            (vec!["--set", "speed=0.5"], "environment.FIELD"),
            (vec!["--report-layout", "256"], "from 0 to 255"),
            (vec!["--report", "r", "--server", "localhost:1"], "leave out --server"),
            (vec!["--position-noise", "0.1", "--server", "localhost:1"], "leave out --server"),
            (vec!["--user-slots", "5@0"], "--user-slots, user: got 5"),
            (vec!["--user-slots", "1@9..3"], "--user-slots, until: got 3"),
            (vec!["--user-slots", "1@x"], "USER@FROM"),
        ] {
            let refused = parse(&words).and_then(|args| check(&args).map(|_| ()).map_err(|e| format!("{e:#}")));
            let error = refused.expect_err("must be refused");
            assert!(error.contains(hint), "{words:?}: {error}");
        }
    }

    #[test]
    fn any_field_of_the_world_can_be_set_and_the_last_word_is_that_of_set() {
        let world = |words: &[&str]| check(&parse(words).expect("flags parse")).expect("valid").2.env;
        assert_eq!(world(&[]), EnvConfig::default());
        let words = ["--users", "4", "--uavs", "2", "--set", "environment.speed=0.08", "--set", "environment.users=6"];
        assert_eq!(world(&words), EnvConfig { uavs: 2, users: 6, speed: 0.08, ..EnvConfig::default() });
    }

    #[test]
    fn the_command_line_contains_the_flags() {
        let words = ["--policy", "it's mine.safetensors", "--uavs", "4", "--lose-uav", "1@20", "--position-noise", "0.02"];
        let words = [&words[..], &["--set", "environment.v=0.08"]].concat();
        let line = parse(&words).expect("flags parse").command_line();
        assert_eq!(
            line,
            "qedgix evaluate --policy sweep --policy 'it'\\''s mine.safetensors' --layouts eval-v1 --episodes 256 --uavs 4 \
             --position-noise 0.02 --set environment.v=0.08 --lose-uav 1@20"
        );
    }
}
