//! A server's settings, checked once.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use crate::invalid::{Invalid, in_range};
use crate::serving::EngineConfig;

/// Everything that a server is told when it starts.
#[derive(Clone, Debug)]
pub struct Config {
    /// Where gRPC listens; port 0 picks a free one.
    pub grpc_addr: SocketAddr,
    /// Where REST listens; port 0 picks a free one.
    pub http_addr: SocketAddr,
    /// Where everything durable is; created if need be.
    pub data_dir: PathBuf,
    /// Cores that training may use together.
    pub cpu_budget: usize,
    /// Failed attempts after which a job has failed.
    pub max_attempts: u32,
    /// Time between snapshots of a running job.
    pub snapshot_every: Duration,
    /// The binary that workers run; absent: this one.
    pub worker: Option<PathBuf>,
    /// A session idle for longer expires.
    pub session_ttl: Duration,
    /// Most open sessions.
    pub max_sessions: usize,
    /// A hosted environment idle for longer expires.
    pub environment_ttl: Duration,
    /// Most hosted environments.
    pub max_environments: usize,
    /// Memory that all hosted environments may take together, in bytes.
    pub environment_memory: usize,
    /// Largest gRPC message and HTTP body, in bytes.
    pub max_message_size: usize,
    /// Most streams of jobs' events that are open at a time.
    pub max_watchers: usize,
    /// Silence after which a stream of events over HTTP gives a sign of life.
    pub heartbeat: Duration,
    /// The engine that computes headings.
    pub engine: EngineConfig,
    /// Time that requests in flight are given when the server stops.
    pub drain_timeout: Duration,
    /// Whether it may listen where others can reach it, although nobody has to say who they are.
    pub insecure: bool,
}

impl Config {
    /// The defaults, with everything durable in `data_dir`.
    pub fn new(data_dir: impl Into<PathBuf>) -> Self {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        Self {
            grpc_addr: SocketAddr::from(([127, 0, 0, 1], 50051)),
            http_addr: SocketAddr::from(([127, 0, 0, 1], 8080)),
            data_dir: data_dir.into(),
            cpu_budget: cores,
            max_attempts: 3,
            snapshot_every: Duration::from_secs(10),
            worker: None,
            session_ttl: Duration::from_secs(600),
            max_sessions: 100_000,
            environment_ttl: Duration::from_secs(600),
            max_environments: 1024,
            environment_memory: 1 << 30,
            max_message_size: 4 << 20,
            max_watchers: 256,
            heartbeat: Duration::from_secs(15),
            engine: EngineConfig { threads: cores.min(4), queue: 4096, max_batch: 64, max_batch_delay: Duration::ZERO },
            drain_timeout: Duration::from_secs(20),
            insecure: false,
        }
    }

    /// Checks every setting.
    ///
    /// # Errors
    /// The first one that cannot be used.
    pub fn validate(&self) -> Result<(), Invalid> {
        in_range("--cpu-budget", self.cpu_budget, 1..=4096)?;
        in_range("--max-attempts", self.max_attempts, 1..=1000)?;
        in_range("--snapshot-every (seconds)", self.snapshot_every.as_secs_f64(), 0.0..=1e9)?;
        in_range("--session-ttl (seconds)", self.session_ttl.as_secs_f64(), 0.001..=1e9)?;
        in_range("--max-sessions", self.max_sessions, 1..=100_000_000)?;
        in_range("--environment-ttl (seconds)", self.environment_ttl.as_secs_f64(), 0.001..=1e9)?;
        in_range("--max-environments", self.max_environments, 1..=100_000_000)?;
        in_range("--environment-memory", self.environment_memory, 1 << 20..=1 << 40)?;
        in_range("--max-message-size", self.max_message_size, 1024..=1 << 30)?;
        in_range("--max-watchers", self.max_watchers, 1..=100_000)?;
        in_range("--event-heartbeat (seconds)", self.heartbeat.as_secs_f64(), 0.001..=3600.0)?;
        in_range("--engine-threads", self.engine.threads, 1..=1024)?;
        in_range("--engine-queue", self.engine.queue, 1..=10_000_000)?;
        in_range("--max-batch", self.engine.max_batch, 1..=65_536)?;
        in_range("--max-batch-delay (seconds)", self.engine.max_batch_delay.as_secs_f64(), 0.0..=10.0)?;
        for (flag, addr) in [("--grpc-addr", self.grpc_addr), ("--http-addr", self.http_addr)] {
            if !addr.ip().is_loopback() && !self.insecure {
                let expected = "a loopback address such as 127.0.0.1, or --insecure: whoever reaches this server may use it";
                return Err(Invalid::new(flag, addr, expected));
            }
        }
        Ok(())
    }
}
