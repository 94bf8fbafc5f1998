//! Settings of a server: defaults and validation.

use std::net::{IpAddr, SocketAddr};
use std::ops::RangeInclusive;
use std::path::PathBuf;
use std::time::Duration;

use axum::http::HeaderValue;
use rustls::ClientConfig;

use crate::inflight::Budget;
use crate::invalid::{Invalid, in_range};
use crate::jobs::SlurmConfig;
use crate::service::keys::Rate;
use crate::service::policies::Retention;
use crate::serving::{DEFAULT_MEMORY, EngineConfig};

/// Settings of a server. Every field has a flag of `qedgix serve`.
#[derive(Clone, Debug)]
pub struct Config {
    /// Address of gRPC; port 0 selects a free port.
    pub grpc_addr: SocketAddr,
    /// Address of REST; port 0 selects a free port.
    pub http_addr: SocketAddr,
    /// Directory of the database; created if missing.
    pub data_dir: PathBuf,
    /// CPU budget: threads that all running jobs may use together.
    pub cpu_budget: usize,
    /// Consecutive attempts that fail without progress after which a job fails.
    pub max_attempts: u32,
    /// Time between snapshots of a running job.
    pub snapshot_every: Duration,
    /// Time without a heartbeat after which a worker is killed and its attempt has failed.
    pub heartbeat_timeout: Duration,
    /// Program of workers; `None`: this program.
    pub worker: Option<PathBuf>,
    /// Where workers run.
    pub executor: ExecutorConfig,
    /// Address at which workers reach the server; `None`: a free port of loopback.
    pub worker_addr: Option<WorkerAddr>,
    /// Idle time after which a session expires.
    pub session_ttl: Duration,
    /// Maximum open sessions.
    pub max_sessions: usize,
    /// Memory of all sessions together, in bytes.
    pub session_memory: usize,
    /// Slots after which UAVs and users that are missing from the requests of a fleet are forgotten.
    pub absent_after: u64,
    /// Idle time after which a hosted environment expires.
    pub environment_ttl: Duration,
    /// Maximum hosted environments.
    pub max_environments: usize,
    /// Memory of all hosted environments together, in bytes.
    pub environment_memory: usize,
    /// Memory of all policies together, in bytes.
    pub policy_memory: usize,
    /// The server whose policies this one takes; `None`: it has its own.
    pub follow: Option<FollowConfig>,
    /// What the server keeps of old versions and checkpoints.
    pub retention: Retention,
    /// Maximum size of a gRPC message or HTTP body, in bytes.
    pub max_message_size: usize,
    /// Maximum open streams of job events.
    pub max_watchers: usize,
    /// Idle time after which an event stream over HTTP sends a comment.
    pub event_heartbeat: Duration,
    /// The engine that computes headings.
    pub engine: EngineConfig,
    /// Time that requests in flight have to complete when the server stops.
    pub drain_timeout: Duration,
    /// Allow non-loopback addresses although no API key exists.
    pub insecure: bool,
    /// Hosts that webhooks may be sent to besides those with public addresses: names or addresses, as in their URLs.
    pub webhook_allow: Vec<String>,
    /// Names of hosts that requests may name while there is no API key, besides those of loopback and the address of REST.
    pub allow_hosts: Vec<String>,
    /// TLS certificates of both addresses; `None`: no TLS.
    pub tls: Option<TlsFiles>,
    /// Maximum connections of both addresses together.
    pub max_connections: usize,
    /// Maximum connections of one peer: an IPv4 address or an IPv6 network (64 bits).
    pub max_connections_per_peer: usize,
    /// Maximum open streams per HTTP/2 connection.
    pub max_streams: u32,
    /// Maximum bytes of requests that have arrived and of responses that are not sent, of both addresses together.
    pub max_inflight_bytes: usize,
    /// Time for a TLS handshake, the head of an HTTP/1 request, a body and a gRPC message to arrive. Large bodies and messages
    /// have the time in addition that their bytes take at 4 KiB per second.
    pub read_timeout: Duration,
    /// Time in which a caller must take some bytes of a response.
    pub write_timeout: Duration,
    /// Time after which a connection without requests is closed.
    pub connection_idle: Duration,
    /// Age after which a connection is closed; up to 10 % more or less, so that not all callers leave at once.
    pub connection_age: Duration,
    /// Time for requests in flight on a connection that is closed.
    pub connection_grace: Duration,
    /// Requests per second of API keys without a rate of their own; `None`: unlimited.
    pub key_rate: Option<f64>,
    /// Requests at once of such keys; `None`: the requests of one second.
    pub key_burst: Option<f64>,
}

/// Where workers run.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum ExecutorConfig {
    /// As processes of this machine.
    #[default]
    Local,
    /// As jobs of a Slurm cluster.
    Slurm(SlurmConfig),
}

/// How a replica reaches its primary.
#[derive(Clone, Debug)]
pub struct FollowConfig {
    /// Address of its REST, without a path: `http://primary:8080`.
    pub url: String,
    /// The header `authorization` with an API key of the primary.
    pub authorization: Option<HeaderValue>,
    /// Whom to trust, and the client certificate, for `https`.
    pub tls: ClientConfig,
}

/// An address of this machine as others know it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WorkerAddr {
    /// Host and port, as `login1:50052`.
    pub name: String,
    /// The address of the host's name.
    pub addr: SocketAddr,
}

/// PEM files of TLS. The server reads them again on SIGHUP.
#[derive(Clone, Debug)]
pub struct TlsFiles {
    /// Certificate of the server, followed by intermediate certificates.
    pub cert: PathBuf,
    /// Private key of the certificate.
    pub key: PathBuf,
    /// Certificate authorities for client certificates; `None`: clients need no certificate.
    pub client_ca: Option<PathBuf>,
}

impl Config {
    /// Default settings for `data_dir`.
    pub fn new(data_dir: impl Into<PathBuf>) -> Self {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        Self {
            grpc_addr: SocketAddr::from(([127, 0, 0, 1], 50051)),
            http_addr: SocketAddr::from(([127, 0, 0, 1], 8080)),
            data_dir: data_dir.into(),
            cpu_budget: cores,
            max_attempts: 3,
            snapshot_every: Duration::from_secs(10),
            heartbeat_timeout: Duration::from_secs(30),
            worker: None,
            executor: ExecutorConfig::Local,
            worker_addr: None,
            session_ttl: Duration::from_secs(600),
            max_sessions: 100_000,
            session_memory: 256 << 20,
            absent_after: 100,
            environment_ttl: Duration::from_secs(600),
            max_environments: 1024,
            environment_memory: 1 << 30,
            policy_memory: DEFAULT_MEMORY,
            follow: None,
            retention: Retention::default(),
            max_message_size: 16 << 20,
            max_watchers: 256,
            event_heartbeat: Duration::from_secs(15),
            engine: EngineConfig { threads: cores.min(4), queue: 4096, max_batch: 64, max_batch_delay: Duration::ZERO },
            drain_timeout: Duration::from_secs(20),
            insecure: false,
            webhook_allow: Vec::new(),
            allow_hosts: Vec::new(),
            tls: None,
            max_connections: 10_000,
            max_connections_per_peer: 1000,
            max_streams: 1024,
            max_inflight_bytes: 256 << 20,
            read_timeout: Duration::from_secs(30),
            write_timeout: Duration::from_secs(60),
            connection_idle: Duration::from_secs(300),
            connection_age: Duration::from_secs(3600),
            connection_grace: Duration::from_secs(300),
            key_rate: None,
            key_burst: None,
        }
    }

    /// The CPU budget if none is chosen: the cores of this machine, or what a cluster has at most.
    pub fn default_cpu_budget(&self) -> usize {
        match self.executor {
            ExecutorConfig::Local => self.cpu_budget,
            ExecutorConfig::Slurm(_) => MAX_CPU_BUDGET,
        }
    }

    /// Checks that every setting is in range.
    ///
    /// # Errors
    /// [`Invalid`] for the first setting that is not.
    pub fn validate(&self) -> Result<(), Invalid> {
        if self.http_addr == self.grpc_addr && self.http_addr.port() != 0 {
            return Err(Invalid::new("--http-addr", self.http_addr, "another address than that of --grpc-addr"));
        }
        in_range("--cpu-budget", self.cpu_budget, 1..=MAX_CPU_BUDGET)?;
        in_range("--max-attempts", self.max_attempts, 1..=1000)?;
        in_seconds("--snapshot-every", self.snapshot_every, 0.0..=1e9)?;
        // Workers send a heartbeat every 0.4 s.
        in_seconds("--heartbeat-timeout", self.heartbeat_timeout, 2.0..=3600.0)?;
        self.validate_executor()?;
        if self.follow.is_some() {
            if self.executor != ExecutorConfig::Local {
                return Err(Invalid::new("--executor", "slurm", "local with --follow: a replica runs no jobs"));
            }
            if self.retention.versions > 0 {
                let expected = "0 with --follow: a replica keeps the versions that its primary keeps";
                return Err(Invalid::new("--keep-versions", self.retention.versions, expected));
            }
        }
        in_seconds("--session-ttl", self.session_ttl, 0.001..=1e9)?;
        in_range("--max-sessions", self.max_sessions, 1..=100_000_000)?;
        in_range("--session-memory", self.session_memory, 1 << 20..=1 << 40)?;
        in_range("--absent-after", self.absent_after, 0..=1_000_000)?;
        in_seconds("--environment-ttl", self.environment_ttl, 0.001..=1e9)?;
        in_range("--max-environments", self.max_environments, 1..=100_000_000)?;
        in_range("--environment-memory", self.environment_memory, 1 << 20..=1 << 40)?;
        in_range("--policy-memory", self.policy_memory, 1 << 20..=1 << 40)?;
        in_range("--keep-checkpoints", self.retention.checkpoints, 0..=1_000_000)?;
        in_range("--keep-versions", self.retention.versions, 0..=1_000_000)?;
        in_range("--keep-jobs", self.retention.jobs, 0..=100_000_000)?;
        in_seconds("--keep-jobs-for", self.retention.jobs_for, 0.0..=1e9)?;
        in_range("--max-message-size", self.max_message_size, 1024..=1 << 30)?;
        in_range("--max-watchers", self.max_watchers, 1..=100_000)?;
        in_seconds("--event-heartbeat", self.event_heartbeat, 0.001..=3600.0)?;
        in_range("--engine-threads", self.engine.threads, 1..=1024)?;
        in_range("--engine-queue", self.engine.queue, 1..=10_000_000)?;
        in_range("--max-batch", self.engine.max_batch, 1..=65_536)?;
        in_seconds("--max-batch-delay", self.engine.max_batch_delay, 0.0..=10.0)?;
        in_seconds("--drain-timeout", self.drain_timeout, 0.0..=86_400.0)?;
        in_range("--max-connections", self.max_connections, 1..=1_000_000)?;
        in_range("--max-streams", self.max_streams, 1..=1_000_000)?;
        in_range("--max-connections-per-peer", self.max_connections_per_peer, 1..=1_000_000)?;
        in_range("--max-inflight-bytes", self.max_inflight_bytes, Budget::MIN..=1 << 40)?;
        in_seconds("--read-timeout", self.read_timeout, 0.001..=3600.0)?;
        in_seconds("--write-timeout", self.write_timeout, 0.001..=3600.0)?;
        in_seconds("--connection-idle", self.connection_idle, 0.001..=1e9)?;
        in_seconds("--connection-age", self.connection_age, 0.001..=1e9)?;
        in_seconds("--connection-grace", self.connection_grace, 0.001..=1e9)?;
        for (flag, hosts) in [("--allow-host", &self.allow_hosts), ("--webhook-allow", &self.webhook_allow)] {
            let name = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
            let is_host = |host: &String| !host.is_empty() && (host.chars().all(name) || host.parse::<IpAddr>().is_ok());
            if let Some(host) = hosts.iter().find(|host| !is_host(host)) {
                return Err(Invalid::new(flag, format!("{host:?}"), "the name of a host, without scheme and port"));
            }
        }
        if let Some(rate) = self.key_rate {
            in_range("--key-rate", rate, Rate::PER_SECOND)?;
        }
        if let Some(burst) = self.key_burst {
            in_range("--key-burst", burst, Rate::BURST)?;
        }
        Ok(())
    }

    fn validate_executor(&self) -> Result<(), Invalid> {
        let ExecutorConfig::Slurm(slurm) = &self.executor else { return Ok(()) };
        if self.worker_addr.as_ref().is_none_or(|addr| addr.addr.port() == 0) {
            let value = self.worker_addr.as_ref().map_or("none", |addr| &addr.name);
            let expected = "host and port at which the nodes of the cluster reach this machine, such as login1:50052";
            return Err(Invalid::new("--worker-addr", value, expected));
        }
        slurm.validate()
    }

    /// Checks that a server without API keys listens on loopback addresses only. `has_keys`: whether an API key exists.
    ///
    /// # Errors
    /// [`Invalid`] for the first address that is not loopback, unless keys exist or `insecure` is set.
    pub fn validate_exposure(&self, has_keys: bool) -> Result<(), Invalid> {
        for (flag, addr) in [("--grpc-addr", self.grpc_addr), ("--http-addr", self.http_addr)] {
            if !addr.ip().is_loopback() && !has_keys && !self.insecure {
                let expected = "a loopback address such as 127.0.0.1. Other addresses require an API key (qedgix keys create) or \
                                --insecure, which lets everyone use this server";
                return Err(Invalid::new(flag, addr, expected));
            }
        }
        Ok(())
    }
}

/// Largest CPU budget.
const MAX_CPU_BUDGET: usize = 4096;

/// Checks that `time` lies in `range`, which is in seconds. The bounds keep sums of times from overflowing.
fn in_seconds(flag: &str, time: Duration, range: RangeInclusive<f64>) -> Result<(), Invalid> {
    if range.contains(&time.as_secs_f64()) {
        return Ok(());
    }
    let expected = format!("a time from {} to {} seconds", range.start(), range.end());
    Err(Invalid::new(flag, format!("{} s", time.as_secs_f64()), expected))
}
