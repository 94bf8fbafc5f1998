//! The binary as its users run it: `qedgix serve` as a process, its workers, and a client of its REST interface.
#![allow(dead_code)] // each test binary uses its part

pub mod rest;

use std::ffi::OsStr;
use std::future::Future;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::Duration;

use serde_json::Value;

/// The program under test.
pub const PROGRAM: &str = env!("CARGO_BIN_EXE_qedgix");

/// Longest time that a single step of a test may take. Only failures wait that long.
pub const TIMEOUT: Duration = Duration::from_secs(180);

/// Time between two looks at a condition.
pub const POLL: Duration = Duration::from_millis(5);

/// `qedgix serve` on free ports, with its data in `data_dir`.
pub fn serve(data_dir: &Path) -> Command {
    serve_by(Path::new(PROGRAM), data_dir)
}

/// The same by another copy of the program.
pub fn serve_by(program: &Path, data_dir: &Path) -> Command {
    let mut command = Command::new(program);
    command.args(["serve", "--grpc-addr", "127.0.0.1:0", "--http-addr", "127.0.0.1:0", "--data-dir"]).arg(data_dir);
    command
}

/// Creates an API key in `data_dir`.
pub fn create_key(data_dir: &Path, scopes: &str) -> String {
    let mut command = Command::new(PROGRAM);
    command.args(["keys", "create", "--name", "test", "--scopes", scopes, "--data-dir"]).arg(data_dir);
    let output = command.output().expect("the program exists");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).expect("a key is text").trim().to_owned()
}

/// The command, run by another program, such as `unshare`.
pub fn run_by(program: &[&str], command: &Command) -> Command {
    let mut outer = Command::new(program[0]);
    outer.args(&program[1..]).arg(command.get_program()).args(command.get_args());
    outer
}

/// A server; killed when dropped.
pub struct Process {
    child: Child,
    /// Address of gRPC, as `127.0.0.1:50051`.
    pub grpc: String,
    /// Address of REST.
    pub http: String,
}

impl Process {
    /// Starts a server and waits until it serves.
    pub async fn start(command: Command) -> Self {
        Self::try_start(command).await.expect("the server starts")
    }

    /// Starts a server and waits until it serves or has ended.
    pub async fn try_start(mut command: Command) -> Result<Self, ExitStatus> {
        let data_dir = command.get_args().skip_while(|arg| *arg != OsStr::new("--data-dir")).nth(1).expect("serve() names it");
        let endpoints = Path::new(data_dir).join(qedgix::server::ENDPOINTS);
        // Left by a killed server.
        let _ = std::fs::remove_file(&endpoints);
        let child = command.stdin(Stdio::null()).stdout(Stdio::null()).spawn().expect("the program exists");
        let mut process = Self { child, grpc: String::new(), http: String::new() };
        let text = within(async {
            loop {
                // Written atomically, so a file that exists is complete.
                if let Ok(text) = std::fs::read_to_string(&endpoints) {
                    return Ok(text);
                }
                if let Some(status) = process.ended() {
                    return Err(status);
                }
                tokio::time::sleep(POLL).await;
            }
        })
        .await?;
        let addresses: Value = serde_json::from_str(&text).expect("endpoints.json is JSON");
        let address = |name: &str| addresses[name].as_str().expect("an address").to_owned();
        (process.grpc, process.http) = (address("grpc"), address("http"));
        Ok(process)
    }

    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// The status, if the process has ended.
    pub fn ended(&mut self) -> Option<ExitStatus> {
        self.child.try_wait().expect("the child can be waited for")
    }

    /// Kills the process, and waits until it has ended.
    pub fn kill(&mut self) {
        // It may have ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }

    /// Sends SIGTERM and waits for the end.
    pub async fn terminate(&mut self) -> ExitStatus {
        assert!(signal("TERM", self.pid()));
        within(async {
            loop {
                match self.ended() {
                    Some(status) => break status,
                    None => tokio::time::sleep(POLL).await,
                }
            }
        })
        .await
    }

    /// Resident memory in MiB.
    pub fn memory(&self) -> f64 {
        self.status("VmRSS:")
    }

    /// The most resident memory that the process ever had, in MiB.
    pub fn peak_memory(&self) -> f64 {
        self.status("VmHWM:")
    }

    fn status(&self, field: &str) -> f64 {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.pid())).expect("the server runs");
        let line = status.lines().find_map(|line| line.strip_prefix(field)).expect("Linux reports memory");
        line.trim().trim_end_matches(" kB").parse::<f64>().expect("a number") / 1024.0
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        self.kill();
    }
}

/// Sends a signal. False if the process does not exist.
pub fn signal(name: &str, pid: u32) -> bool {
    let kill = Command::new("kill").args([format!("-{name}"), pid.to_string()]).stderr(Stdio::null()).status();
    kill.expect("kill exists").success()
}

/// A worker in the process table.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WorkerProcess {
    pub pid: u32,
    /// Id of its job.
    pub job: String,
    /// Whether it is stopped by a signal or has ended.
    pub halted: bool,
}

/// The workers of all servers on this machine.
pub fn worker_processes() -> Vec<WorkerProcess> {
    let of = |entry: PathBuf| {
        let pid = entry.file_name()?.to_str()?.parse().ok()?;
        let command = std::fs::read(entry.join("cmdline")).ok()?;
        // The environment is read only of workers, because this runs often.
        command.split(|&b| b == 0).nth(1).filter(|word| *word == b"worker")?;
        let environment = std::fs::read(entry.join("environ")).ok()?;
        let job = environment.split(|&b| b == 0).find_map(|variable| variable.strip_prefix(b"QEDGIX_JOB="))?;
        let stat = std::fs::read_to_string(entry.join("stat")).ok()?;
        let state = stat.rsplit_once(") ")?.1.chars().next()?;
        Some(WorkerProcess { pid, job: String::from_utf8(job.to_vec()).ok()?, halted: matches!(state, 'T' | 't' | 'Z' | 'X') })
    };
    std::fs::read_dir("/proc").expect("Linux").filter_map(|entry| of(entry.ok()?.path())).collect()
}

/// The processes of this job's workers.
pub fn workers(job: &str) -> Vec<u32> {
    worker_processes().into_iter().filter(|worker| worker.job == job).map(|worker| worker.pid).collect()
}

/// Waits until no worker of the job is left.
pub async fn no_worker(job: &str) {
    within(async {
        while !workers(job).is_empty() {
            tokio::time::sleep(POLL).await;
        }
    })
    .await;
}

/// Fails if `future` does not complete within [`TIMEOUT`].
pub async fn within<T>(future: impl Future<Output = T>) -> T {
    tokio::time::timeout(TIMEOUT, future).await.expect("nothing takes longer than the timeout")
}
