//! `qedgix worker`: started by a server's executor, not by people.

use std::process::ExitCode;

use clap::Args;

use crate::jobs::worker::{self, Assignment, ENV_ATTEMPT, ENV_JOB, ENV_SERVER, ENV_TOKEN};
use crate::telemetry;

/// Flags of `worker`. What it works at comes through the environment, because it holds a secret.
#[derive(Args, Debug)]
#[command(
    after_help = "A server starts its workers itself, with QEDGIX_SERVER, QEDGIX_JOB, QEDGIX_ATTEMPT and QEDGIX_TOKEN set."
)]
pub struct WorkerArgs {
    /// End when standard input does: whoever started this process is gone
    #[arg(long)]
    tethered: bool,
}

/// Runs one attempt at one job.
pub fn run(args: &WorkerArgs) -> ExitCode {
    match try_run(args) {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            eprintln!("error: {e:#}");
            ExitCode::FAILURE
        }
    }
}

fn try_run(args: &WorkerArgs) -> anyhow::Result<()> {
    // Before there are threads: they inherit it.
    worker::step_back();
    if args.tethered {
        worker::tether()?;
    }
    telemetry::logs(telemetry::Logs::default(), None);
    let variable =
        |name: &str| std::env::var(name).map_err(|e| anyhow::anyhow!("{name}: {e}; a server starts its workers itself"));
    let assignment = Assignment {
        server: variable(ENV_SERVER)?,
        job: variable(ENV_JOB)?,
        attempt: variable(ENV_ATTEMPT)?,
        token: variable(ENV_TOKEN)?,
    };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let done = runtime.block_on(worker::run(assignment));
    // Training may be in the middle of something; it ends with the process.
    runtime.shutdown_background();
    Ok(done?)
}
