//! `qedgix worker`: runs one attempt of one job. Servers start it; people do not.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::Args;

use crate::jobs::worker::{self, Assignment, ENV_ATTEMPT, ENV_JOB, ENV_SERVER, ENV_TOKEN};
use crate::telemetry;

/// Flags of `worker`. The job and its token come from the environment or a file, because command lines are visible to all users.
#[derive(Args, Debug)]
#[command(
    after_help = "A server starts its workers itself and sets QEDGIX_WORKER_SERVER, QEDGIX_JOB, QEDGIX_ATTEMPT and QEDGIX_TOKEN."
)]
pub struct WorkerArgs {
    /// Exit when standard input closes, which means that the server has ended
    #[arg(long)]
    tethered: bool,
    /// File with server, job, attempt and token, as JSON, instead of the environment
    #[arg(long, value_name = "FILE")]
    assignment: Option<PathBuf>,
}

/// Set by Slurm for a job that it has queued again.
const SLURM_RESTARTS: &str = "SLURM_RESTART_COUNT";

/// Runs the attempt that the environment or the file names.
///
/// # Errors
/// A variable is missing, the file cannot be read, or the server refuses the attempt.
pub fn run(args: &WorkerArgs) -> anyhow::Result<()> {
    // Before the process has threads, because threads inherit both.
    worker::lower_priority();
    worker::confine_to_cores();
    if args.tethered {
        worker::exit_with_stdin()?;
    }
    let _logs = telemetry::init_logs(telemetry::LogConfig::default(), None)?;
    let assignment = match &args.assignment {
        Some(file) => from_file(file)?,
        None => from_environment()?,
    };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let result = runtime.block_on(worker::run(assignment));
    // Does not wait for training threads; they end with the process.
    runtime.shutdown_background();
    Ok(result?)
}

fn from_environment() -> anyhow::Result<Assignment> {
    let variable =
        |name: &str| std::env::var(name).map_err(|e| anyhow::anyhow!("{name}: {e}; servers start their workers themselves"));
    Ok(Assignment {
        server: variable(ENV_SERVER)?,
        job: variable(ENV_JOB)?,
        attempt: variable(ENV_ATTEMPT)?,
        token: variable(ENV_TOKEN)?,
    })
}

fn from_file(file: &Path) -> anyhow::Result<Assignment> {
    // The first process of the attempt may still run on a node that Slurm cannot reach. The server begins another attempt.
    if std::env::var(SLURM_RESTARTS).is_ok_and(|count| count != "0") {
        bail!("Slurm has queued this attempt again; the server begins another one");
    }
    let text = std::fs::read_to_string(file).with_context(|| format!("{}", file.display()))?;
    Ok(Assignment::from_json(&text)?)
}
