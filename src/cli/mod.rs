//! The command line. Each command has its own file. Most flags are also environment variables `QEDGIX_*`; `--help` shows them.

mod act_client;
mod audit;
mod backup;
mod bench;
mod client;
mod connect;
mod demo;
mod evaluate;
mod experiment;
mod explain;
mod figures;
mod files;
mod in_process_server;
mod jobs;
mod keys;
mod manual;
mod numbers;
mod output;
mod plan;
mod policies;
mod policy_file;
mod ports;
mod progress;
mod report;
mod rest;
mod run_args;
mod serve;
mod server;
mod signals;
mod table;
mod toml_file;
mod train;
mod upload;
mod variables;
mod worker;
mod world_args;

use std::process::ExitCode;

use anyhow::Context;
use clap::error::ErrorKind;
use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};

use crate::nn::{VECTOR_WIDTH_VARIABLE, VectorWidth};

/// Trains and serves policies that steer UAV fleets to keep data fresh (Age of Information)
#[derive(Debug, Parser)]
#[command(name = "qedgix", version, arg_required_else_help = true)]
#[command(after_help = "Environment:
  QEDGIX_VECTOR_WIDTH  widest vector units used: portable, neon, avx2 or avx512 [default: the processor's widest]")]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
#[allow(clippy::large_enum_variant, reason = "one value per process")]
enum Command {
    /// Serve policies and run training jobs
    Serve(serve::ServeArgs),
    /// Start a server, run policies on it, train a policy, and compare them all
    Demo(demo::DemoArgs),
    /// Train a policy in this process or as a job of a server
    Train(train::TrainArgs),
    /// Submit, list, watch, stop, compare and export jobs of a server
    Jobs(jobs::JobsArgs),
    /// Compare policies on fixed layouts
    Evaluate(evaluate::EvaluateArgs),
    /// Check whether UAVs can decide alone by a policy, and what they need for it
    Audit(audit::AuditArgs),
    /// Find the number of UAVs that a policy needs for so many users
    Plan(plan::PlanArgs),
    /// List, upload, export, load and unload policies of a server, and move aliases
    Policies(policies::PoliciesArgs),
    /// Show or change a running server: its CPU budget
    Server(server::ServerArgs),
    /// Run or resume an experiment: many training runs, with tables and plots of the results
    Experiment(experiment::ExperimentArgs),
    /// Create, list, rotate and revoke the API keys of a server
    Keys(keys::KeysArgs),
    /// Copy the database of a server, which may be running, to one file
    Backup(backup::BackupArgs),
    /// Put a backup into the data directory of a server that is stopped
    Restore(backup::RestoreArgs),
    /// Measure the speed of Act and of the learner on this machine
    Bench(bench::BenchArgs),
    /// Print the completions of a shell
    Completions(manual::CompletionsArgs),
    /// Write the manual pages
    Man(manual::ManArgs),
    /// Run one job for a server (servers start their workers themselves)
    Worker(worker::WorkerArgs),
}

/// Runs the command of the command line.
pub fn run() -> ExitCode {
    let parsed = numbers::with_negative(Cli::command()).try_get_matches();
    let cli = match parsed.and_then(|matches| Cli::from_arg_matches(&matches)).map_err(numbers::explained) {
        Ok(cli) => cli,
        Err(message) => return output::print_usage(&message),
    };
    if let Err(value) = VectorWidth::cap() {
        let names = VectorWidth::ALL.map(VectorWidth::name).join(", ");
        let message = format!("{VECTOR_WIDTH_VARIABLE}={value}: expected one of {names}\n");
        return output::print_usage(&Cli::command().error(ErrorKind::InvalidValue, message));
    }
    variables::warn_of_misspelled(&Cli::command());
    match cli.command {
        Command::Serve(args) => block_on(serve::run(args)),
        Command::Demo(args) => block_on(demo::run(args)),
        Command::Train(args) => block_on(train::run(args)),
        Command::Jobs(args) => block_on(jobs::run(args)),
        Command::Evaluate(args) => block_on(evaluate::run(args)),
        Command::Audit(args) => output::exit_code(audit::run(&args)),
        Command::Plan(args) => output::exit_code(plan::run(&args)),
        Command::Policies(args) => block_on(policies::run(args)),
        Command::Server(args) => block_on(server::run(args)),
        Command::Experiment(args) => block_on(experiment::run(args)),
        Command::Keys(args) => block_on(keys::run(args)),
        Command::Backup(args) => block_on(backup::backup(args)),
        Command::Restore(args) => block_on(backup::restore(args)),
        Command::Bench(args) => block_on(bench::run(args)),
        Command::Completions(args) => output::exit_code(manual::completions(&args, &mut Cli::command())),
        Command::Man(args) => output::exit_code(manual::man(&args, Cli::command())),
        // A worker lowers its priority before it has threads, so it creates its own runtime.
        Command::Worker(args) => output::exit_code(worker::run(&args)),
    }
}

/// Runs a command on a multi-threaded runtime.
fn block_on(command: impl Future<Output = anyhow::Result<()>>) -> ExitCode {
    let runtime = match tokio::runtime::Builder::new_multi_thread().enable_all().build() {
        Ok(runtime) => runtime,
        Err(error) => return output::exit_code(Err(error).context("cannot start the runtime")),
    };
    let result = runtime.block_on(command);
    // Does not wait for tasks that still compute; they end with the process.
    runtime.shutdown_background();
    output::exit_code(result)
}
