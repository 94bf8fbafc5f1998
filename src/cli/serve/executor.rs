//! Flags of `serve` for where training jobs run.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, ValueEnum};

use super::{address, duration};
use crate::config::{ExecutorConfig, WorkerAddr};
use crate::jobs::SlurmConfig;

/// Heading of these flags in the help.
const JOBS: &str = "Where jobs run";

/// Flags of `serve` for where training jobs run.
#[derive(Args, Debug)]
pub(super) struct ExecutorArgs {
    /// Where workers run: as processes of this machine, or as jobs of the Slurm cluster whose commands this machine has
    #[arg(long, help_heading = JOBS, env = "QEDGIX_EXECUTOR", default_value = "local", value_enum, value_name = "EXECUTOR")]
    executor: Executor,
    /// Address at which workers reach this server, with a port that stays the same: workers of a cluster outlive a restart of the
    /// server. It answers only workers, by the token of each attempt, without TLS [default: a free port of loopback; required with Slurm]
    #[arg(long, help_heading = JOBS, env = "QEDGIX_WORKER_ADDR", value_parser = worker_addr, value_name = "HOST:PORT")]
    worker_addr: Option<WorkerAddr>,
    /// Partition of Slurm [default: that of the cluster]
    #[arg(long, help_heading = JOBS, env = "QEDGIX_SLURM_PARTITION", value_name = "PARTITION")]
    slurm_partition: Option<String>,
    /// Account of Slurm [default: that of the user]
    #[arg(long, help_heading = JOBS, env = "QEDGIX_SLURM_ACCOUNT", value_name = "ACCOUNT")]
    slurm_account: Option<String>,
    /// Time limit of each attempt in Slurm, 1 min to 365 days, rounded up to minutes; a job continues from its last snapshot in the next attempt [default: that of the
    /// partition]
    #[arg(long, help_heading = JOBS, env = "QEDGIX_SLURM_TIME", value_parser = slurm_time, value_name = "TIME")]
    slurm_time: Option<Duration>,
    /// Further flag of sbatch in one word, such as --slurm-extra=--qos=long; repeatable, or several separated by spaces
    #[arg(long, help_heading = JOBS, env = "QEDGIX_SLURM_EXTRA", value_delimiter = ' ', allow_hyphen_values = true, value_name = "FLAG")]
    slurm_extra: Vec<String>,
    /// Directory that this machine shares with the nodes under the same path, for tokens (mode 0600) and the output of workers
    /// [default: slurm in the data directory]
    #[arg(long, help_heading = JOBS, env = "QEDGIX_SLURM_DIR", value_name = "DIR")]
    slurm_dir: Option<PathBuf>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Executor {
    Local,
    Slurm,
}

impl ExecutorArgs {
    pub(super) fn config(&self) -> (ExecutorConfig, Option<WorkerAddr>) {
        let executor = match self.executor {
            Executor::Local => ExecutorConfig::Local,
            Executor::Slurm => ExecutorConfig::Slurm(SlurmConfig {
                partition: self.slurm_partition.clone(),
                account: self.slurm_account.clone(),
                time: self.slurm_time,
                extra: self.slurm_extra.iter().filter(|flag| !flag.is_empty()).cloned().collect(),
                directory: self.slurm_dir.clone(),
                ..SlurmConfig::default()
            }),
        };
        (executor, self.worker_addr.clone())
    }
}

/// Checked here, so that a wrong time is refused whatever the executor is.
fn slurm_time(text: &str) -> Result<Duration, String> {
    let time = duration(text)?;
    let range = Duration::from_secs(60)..=Duration::from_secs(365 * 86_400);
    if range.contains(&time) { Ok(time) } else { Err("expected 1 min to 365 days".to_owned()) }
}

fn worker_addr(text: &str) -> Result<WorkerAddr, String> {
    let addr: SocketAddr = address(text)?;
    Ok(WorkerAddr { name: text.to_owned(), addr })
}
