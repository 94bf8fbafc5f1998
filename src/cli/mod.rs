//! The command line. Each command has a file; every flag is also an environment variable `QEDGIX_*`.

mod serve;

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
