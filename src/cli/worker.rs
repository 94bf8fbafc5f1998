//! `qedgix worker`: runs one attempt of one job. Servers start it; people do not.

use clap::Args;

use crate::jobs::worker::{self, Assignment, ENV_ATTEMPT, ENV_JOB, ENV_SERVER, ENV_TOKEN};
use crate::telemetry;

/// Flags of `worker`. The job and its token come from the environment, because command lines are visible to all users.
#[derive(Args, Debug)]
#[command(
    after_help = "A server starts its workers itself and sets QEDGIX_WORKER_SERVER, QEDGIX_JOB, QEDGIX_ATTEMPT and QEDGIX_TOKEN."
)]
pub struct WorkerArgs {
    /// Exit when standard input closes, which means that the server has ended
    #[arg(long)]
    tethered: bool,
}

/// Runs the attempt that the environment names.
///
/// # Errors
/// A variable is missing, or the server refuses the attempt.
pub fn run(args: &WorkerArgs) -> anyhow::Result<()> {
    // Before the process has threads, because threads inherit both.
    worker::lower_priority();
    worker::confine_to_cores();
    if args.tethered {
        worker::exit_with_stdin()?;
    }
    telemetry::init_logs(telemetry::LogConfig::default(), None);
    let variable =
        |name: &str| std::env::var(name).map_err(|e| anyhow::anyhow!("{name}: {e}; servers start their workers themselves"));
    let assignment = Assignment {
        server: variable(ENV_SERVER)?,
        job: variable(ENV_JOB)?,
        attempt: variable(ENV_ATTEMPT)?,
        token: variable(ENV_TOKEN)?,
    };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let result = runtime.block_on(worker::run(assignment));
    // Does not wait for training threads; they end with the process.
    runtime.shutdown_background();
    Ok(result?)
}
