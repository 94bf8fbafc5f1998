//! The command line. Each command has a file; every flag is also an environment variable `QEDGIX_*`.

mod bench;
mod client;
mod demo;
mod evaluate;
mod fly;
mod progress;
mod run_args;
mod serve;
mod table;
mod train;

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
    /// Measure how fast the parts are on this machine
    Bench(bench::BenchArgs),
}

/// Runs the command that the process was started with.
pub fn run() -> ExitCode {
    let Cli { command } = Cli::parse();
    let runtime = match tokio::runtime::Builder::new_multi_thread().enable_all().build() {
        Ok(runtime) => runtime,
        Err(e) => {
            eprintln!("error: starting: {e}");
            return ExitCode::FAILURE;
        }
    };
    let done = runtime.block_on(async {
        match command {
            Command::Serve(args) => serve::run(args).await,
            Command::Demo(args) => demo::run(args).await,
            Command::Train(args) => train::run(args).await,
            Command::Evaluate(args) => evaluate::run(args).await,
            Command::Bench(args) => bench::run(args),
        }
    });
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            eprintln!("error: {e:#}");
            ExitCode::FAILURE
        }
    }
}
