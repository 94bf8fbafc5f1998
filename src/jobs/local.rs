//! Runs workers as child processes of the server.

use std::path::PathBuf;
use std::process::{ExitStatus, Stdio};
use std::time::Duration;

use futures::FutureExt;
use futures::future::BoxFuture;
use tokio::io::{AsyncRead, AsyncReadExt};
use tokio::process::{Child, Command};

use super::cores::{Cores, TakenCores};
use super::executor::{Executor, Launch, LogTail, WorkerExit};
use super::worker::{ENV_ATTEMPT, ENV_CORES, ENV_JOB, ENV_SERVER, ENV_TOKEN};

/// Starts `PROGRAM worker` for each attempt.
///
/// The worker's standard input is a pipe that the server holds. When the server ends in any way, the pipe closes and the
/// worker ends, too. The token is passed in the environment, because everyone on the machine can read command lines.
#[derive(Clone, Debug)]
pub struct LocalProcess {
    /// The `qedgix` binary.
    program: PathBuf,
    cores: Cores,
}

impl LocalProcess {
    /// Starts workers from the binary `program`.
    pub fn new(program: impl Into<PathBuf>) -> Self {
        Self { program: program.into(), cores: Cores::of_this_process() }
    }

    /// Starts workers from the binary of this process, even if an upgrade has replaced its file.
    ///
    /// # Errors
    /// [`std::io::Error`] when the system does not report the path of the binary.
    pub fn same_program() -> std::io::Result<Self> {
        let linux = PathBuf::from("/proc/self/exe");
        Ok(Self::new(if linux.exists() { linux } else { std::env::current_exe()? }))
    }
}

impl Executor for LocalProcess {
    fn start(&self, launch: Launch) -> BoxFuture<'_, std::io::Result<BoxFuture<'static, WorkerExit>>> {
        async move {
            let cores = self.cores.take(launch.resources.threads);
            let mut command = Command::new(&self.program);
            command
                .args(["worker", "--tethered"])
                .env(ENV_SERVER, &launch.server)
                .env(ENV_JOB, launch.lease.job_id.to_string())
                .env(ENV_ATTEMPT, launch.lease.attempt.to_string())
                .env(ENV_TOKEN, &launch.token)
                .env(ENV_CORES, cores.list())
                .stdin(Stdio::piped())
                .stdout(Stdio::piped())
                .stderr(Stdio::piped())
                .kill_on_drop(true);
            // A process group of its own: Ctrl-C in the server's terminal reaches only the server, which then drains.
            #[cfg(unix)]
            command.process_group(0).arg0("qedgix");
            let child = command.spawn()?;
            Ok(supervise(child, launch, cores).boxed())
        }
        .boxed()
    }
}

/// Time to read the remaining output after the process has ended. A child of the worker may hold the pipes open.
const OUTPUT_TIMEOUT: Duration = Duration::from_secs(1);

/// Waits for the end of a worker, whose cores are free then.
async fn supervise(mut child: Child, launch: Launch, _cores: TakenCores) -> WorkerExit {
    // Held until the process has ended: the worker ends when it is closed.
    let stdin = child.stdin.take();
    let output = (child.stdout.take(), child.stderr.take());
    let copying = tokio::spawn(async move {
        let log = &launch.log;
        tokio::join!(copy(output.0, log), copy(output.1, log));
    });
    let status = tokio::select! {
        status = child.wait() => status,
        () = launch.kill.cancelled() => {
            let killed = child.start_kill();
            if let Err(e) = killed {
                tracing::warn!(job = %launch.lease.job_id, error = %e, "the worker could not be killed");
            }
            child.wait().await
        }
    };
    drop(stdin);
    // A timeout is ignored: the output read so far is in the log.
    let _ = tokio::time::timeout(OUTPUT_TIMEOUT, copying).await;
    WorkerExit::of_worker(status.map_or_else(|e| format!("an unknown status: {e}"), describe_exit))
}

/// Copies output of a worker to its log. A worker that floods its output waits for this, instead of taking the server's time.
async fn copy(from: Option<impl AsyncRead + Unpin>, log: &LogTail) {
    /// Pause after a full buffer: at most 3 MiB per second are read.
    const PAUSE: Duration = Duration::from_millis(20);
    let Some(mut from) = from else { return };
    let mut buffer = vec![0; LogTail::LIMIT];
    while let Ok(n @ 1..) = from.read(&mut buffer).await {
        log.push(&buffer[..n]);
        if n == buffer.len() {
            tokio::time::sleep(PAUSE).await;
        }
    }
}

fn describe_exit(status: ExitStatus) -> String {
    #[cfg(unix)]
    if let Some(signal) = std::os::unix::process::ExitStatusExt::signal(&status) {
        let hint = if signal == 9 { " (SIGKILL; sent by the system when memory runs out)" } else { "" };
        return format!("killed by signal {signal}{hint}");
    }
    status.code().map_or_else(|| status.to_string(), |code| format!("exit code {code}"))
}
