//! The commands of Slurm, each with a time limit and a limit of output: any of them can hang while a daemon of the cluster does.

use std::io;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncReadExt, AsyncWriteExt};
use tokio::process::Command;

/// Most bytes of output that are read: a busy cluster lists some ten thousand jobs.
const MAX_OUTPUT: u64 = 256 << 20;
/// Most bytes of standard error that are read.
const MAX_ERRORS: u64 = 64 << 10;

/// Why a command failed.
#[derive(Debug, thiserror::Error)]
pub(super) enum CommandError {
    /// It is not installed, or the system cannot start it.
    #[error("{0}: {1}")]
    Start(String, io::Error),
    /// It did not end in time.
    #[error("{program} has not ended within {} s", .limit.as_secs_f64())]
    Timeout {
        /// The command.
        program: String,
        /// Its time limit.
        limit: Duration,
    },
    /// It reported an error.
    #[error("{0}: {1}")]
    Failed(String, String),
}

/// Where the commands are, and how long each may take.
#[derive(Clone, Debug)]
pub(super) struct Commands {
    /// The directory of the commands; `None`: those of `PATH`.
    pub(super) directory: Option<PathBuf>,
    /// Time limit of a command.
    pub(super) timeout: Duration,
}

impl Commands {
    /// The standard output of a command that succeeds.
    pub(super) async fn run(&self, name: &str, arguments: &[String], input: &str) -> Result<Vec<u8>, CommandError> {
        let program = self.directory.as_ref().map_or_else(|| PathBuf::from(name), |directory| directory.join(name));
        tokio::time::timeout(self.timeout, run(&program, arguments, input))
            .await
            .unwrap_or_else(|_| Err(CommandError::Timeout { program: name.into(), limit: self.timeout }))
    }
}

async fn run(program: &Path, arguments: &[String], input: &str) -> Result<Vec<u8>, CommandError> {
    let name = program.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let start = |error| CommandError::Start(name.clone(), error);
    let mut child = Command::new(program)
        .args(arguments)
        // An array would start several workers for one attempt.
        .env_remove("SBATCH_ARRAY_INX")
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .kill_on_drop(true)
        // Ctrl-C in the server's terminal reaches only the server.
        .process_group(0)
        .spawn()
        .map_err(start)?;
    let (stdin, stdout, stderr) = (child.stdin.take(), child.stdout.take(), child.stderr.take());
    let write = async {
        // A command that does not read its input says why on standard error.
        if let Some(mut stdin) = stdin {
            let _ = stdin.write_all(input.as_bytes()).await;
        }
    };
    let ((), output, errors) = tokio::join!(write, read(stdout, MAX_OUTPUT), read(stderr, MAX_ERRORS));
    let status = child.wait().await.map_err(start)?;
    if status.success() {
        return Ok(output);
    }
    let text = String::from_utf8_lossy(&errors);
    let lines: Vec<&str> = text.lines().map(str::trim).filter(|line| !line.is_empty()).collect();
    Err(CommandError::Failed(name, if lines.is_empty() { status.to_string() } else { lines.join("; ") }))
}

/// The first `limit` bytes.
async fn read(from: Option<impl AsyncRead + Unpin>, limit: u64) -> Vec<u8> {
    let mut bytes = Vec::new();
    if let Some(from) = from {
        // What was read before an error counts.
        let _ = from.take(limit).read_to_end(&mut bytes).await;
    }
    bytes
}
