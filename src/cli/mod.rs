//! The command line. Each command has a file; every flag is also an environment variable `QEDGIX_*`.

mod bench;
mod client;
mod comparison;
mod demo;
mod evaluate;
mod experiment;
mod files;
mod fly;
mod local;
mod policies;
mod progress;
mod report;
mod run_args;
mod serve;
mod table;
mod train;
mod worker;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

/// Trains and serves policies that fly UAV fleets for fresh data (Age of Information).
#[derive(Debug, Parser)]
#[command(name = "qedgix", version, arg_required_else_help = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Serve policies and run training jobs
    Serve(serve::ServeArgs),
    /// The whole story on an empty machine: serve, fly, train, fly what was trained
    Demo(demo::DemoArgs),
    /// Train a policy, here or as a job of a server
    Train(train::TrainArgs),
    /// Compare policies on frozen layouts
    Evaluate(evaluate::EvaluateArgs),
    /// The policies of a server: list, upload, export, aliases, load and unload
    Policies(policies::PoliciesArgs),
    /// Run, resume and draw an experiment: many training runs and what they say together
    Experiment(experiment::ExperimentArgs),
    /// Measure how fast the parts are on this machine
    Bench(bench::BenchArgs),
    /// Run one job for a server; servers start their workers themselves
    Worker(worker::WorkerArgs),
}

/// Runs the command that the process was started with.
pub fn run() -> ExitCode {
    match Cli::parse().command {
        Command::Serve(args) => block_on(serve::run(args)),
        Command::Demo(args) => block_on(demo::run(args)),
        Command::Train(args) => block_on(train::run(args)),
        Command::Evaluate(args) => block_on(evaluate::run(args)),
        Command::Policies(args) => block_on(policies::run(args)),
        Command::Experiment(args) => block_on(experiment::run(args)),
        Command::Bench(args) => block_on(bench::run(args)),
        // It begins without threads and without a runtime.
        Command::Worker(args) => worker::run(&args),
    }
}

/// Runs a command that serves or waits.
fn block_on(command: impl Future<Output = anyhow::Result<()>>) -> ExitCode {
    let runtime = match tokio::runtime::Builder::new_multi_thread().enable_all().build() {
        Ok(runtime) => runtime,
        Err(e) => {
            eprintln!("error: starting: {e}");
            return ExitCode::FAILURE;
        }
    };
    let done = runtime.block_on(command);
    // What is still being computed then ends with the process.
    runtime.shutdown_background();
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            eprintln!("error: {e:#}");
            ExitCode::FAILURE
        }
    }
}
