//! `qedgix server`: shows and changes a running server over REST.

use clap::{Args, Subcommand};
use serde_json::{Value, json};

use super::client::RestArgs;
use super::output::outln;

/// Flags of `server`.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  qedgix server budget           # the CPU budget, and what running jobs occupy of it
  qedgix server budget 4         # from now on, until the server stops
  qedgix server budget --server 192.0.2.7:8080 --json")]
pub struct ServerArgs {
    #[command(subcommand)]
    command: Command,
    #[command(flatten)]
    server: RestArgs,
    /// Print the response of the server as JSON
    #[arg(long, global = true)]
    json: bool,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Show or change the CPU budget of training
    Budget {
        /// Threads that all running jobs may use together, 1 to 4096; jobs that run stay. Absent: show the budget
        #[arg(value_parser = clap::value_parser!(u16).range(1..=4096))]
        threads: Option<u16>,
    },
}

/// Runs the command.
///
/// # Errors
/// The server cannot be reached or refuses the request.
pub async fn run(args: ServerArgs) -> anyhow::Result<()> {
    let client = args.server.client()?;
    let Command::Budget { threads } = args.command;
    let budget = match threads {
        None => client.get("/v1/server/budget").await?,
        Some(threads) => client.put("/v1/server/budget", &json!({"threads": threads})).await?,
    };
    if args.json {
        outln!("{budget:#}")?;
    } else {
        let number = |name: &str| budget[name].as_u64().map_or_else(|| Value::Null.to_string(), |n| n.to_string());
        outln!("CPU budget: {} (used by running jobs: {})", number("threads"), number("threads_busy"))?;
    }
    Ok(())
}
