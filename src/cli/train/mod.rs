//! `qedgix train`: a training run in this process, or as a job of a server.

mod curve;
mod local;
mod remote;

use std::path::PathBuf;

use clap::Args;

use super::connect::ConnectArgs;
use super::run_args::RunArgs;

pub use self::remote::run_job;

/// The default of `--out`.
const OUT: &str = "policy.safetensors";

/// Flags of `train`.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  qedgix train --algorithm qmix --steps 4e5 --out qmix.safetensors       # ctrl-c or SIGTERM stops the run ...
  qedgix train --resume qmix.safetensors.snapshot                        # ... and this continues it, with the same result
  qedgix train --init qmix.safetensors --algorithm qmix --steps 1e5 --set training.epsilon_anneal=1   # without random headings
  qedgix train --uavs 4 --users 8 --set training.learning_rate=5e-4 --metrics curve.csv

As a job of a server, with the same files at the end:
  qedgix train --algorithm qmix --steps 4e5 --out qmix.safetensors --server 127.0.0.1:8080 --name my-policy
  QEDGIX_API_KEY=... qedgix train --server https://uavs.example:8080 --ca-cert ca.pem    # a key with the scopes `read` and `jobs`

Exit status: 0 the run is finished; 1 an error; 130 or 143 stopped by ctrl-c or SIGTERM. With --server: 0 the job succeeded; 1 an
error; 3 the job failed; 4 the job was cancelled; 130 or 143 this command was stopped, and the job goes on.")]
pub struct TrainArgs {
    #[command(flatten)]
    run: RunArgs,
    /// Number of threads; it does not change the result [default: all cores; with --server: 1]
    #[arg(long, env = "QEDGIX_THREADS")]
    threads: Option<usize>,
    /// File for the best checkpoint, written at every better evaluation; with --server, when the job has ended [default:
    /// policy.safetensors; with --resume FILE.safetensors.snapshot: FILE.safetensors]
    #[arg(long, env = "QEDGIX_OUT")]
    out: Option<PathBuf>,
    /// File for the metrics as CSV: step, name, value; with --server, written when the job has ended [default: none]
    #[arg(long, env = "QEDGIX_METRICS")]
    metrics: Option<PathBuf>,
    /// File for snapshots, written while training runs and when ctrl-c or SIGTERM stops it, and removed when it has finished
    /// [default: the file of --resume, or that of --out with .snapshot appended]
    #[arg(long, env = "QEDGIX_SNAPSHOT", conflicts_with = "server")]
    snapshot: Option<PathBuf>,
    /// Seconds between two snapshots; more if a snapshot takes longer than a twentieth of them
    #[arg(long, env = "QEDGIX_SNAPSHOT_EVERY", value_name = "SECONDS", default_value_t = 10.0, value_parser = seconds)]
    snapshot_every: f64,
    /// Continues the run of this snapshot. Flags of the run may be left out, and must not differ from the snapshot
    #[arg(long, env = "QEDGIX_RESUME", value_name = "FILE", conflicts_with = "server")]
    resume: Option<PathBuf>,
    /// Begins with the weights of this checkpoint file or bundled policy, with --server of a policy or a checkpoint id of the server.
    /// The agents must have the same architecture; a mixer that differs begins anew [default: weights are drawn]
    #[arg(long, env = "QEDGIX_INIT", value_name = "FILE_OR_POLICY", conflicts_with = "resume")]
    init: Option<String>,
    /// Replaces a snapshot that another run has left
    #[arg(long, conflicts_with = "server")]
    overwrite: bool,
    /// Runs as a job of the server at this REST address, and follows it until its end
    #[arg(long, env = "QEDGIX_SERVER", value_name = "HOST:PORT")]
    server: Option<String>,
    /// Name of the job and of the policy that it publishes
    #[arg(long, env = "QEDGIX_NAME", requires = "server")]
    name: Option<String>,
    #[command(flatten)]
    connect: ConnectArgs,
}

/// A time in seconds, from 0 to 10^9.
fn seconds(text: &str) -> Result<f64, String> {
    let expected = "expected seconds from 0 to 1e9";
    text.parse().ok().filter(|seconds| (0.0..=1e9).contains(seconds)).ok_or_else(|| expected.to_owned())
}

/// Runs the command.
///
/// # Errors
/// The configuration is invalid, a file cannot be read or written, the run fails or is stopped, or the job fails.
pub async fn run(args: TrainArgs) -> anyhow::Result<()> {
    match &args.server {
        Some(address) => remote::run(&args, address).await,
        None => local::run(&args).await,
    }
}
