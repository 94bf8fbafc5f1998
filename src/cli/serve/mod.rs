//! `qedgix serve`: flags, signals, and the run of one server.

mod executor;
mod follow;
mod open_files;

use std::net::{SocketAddr, ToSocketAddrs};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use clap::{Args, ValueEnum};
use tokio::signal::unix::{SignalKind, signal};

use self::executor::ExecutorArgs;
use self::follow::FollowArgs;
use super::output::{OutputError, outln};
use super::signals::StopSignals;
use crate::clock::Clock;
use crate::config::{Config, TlsFiles};
use crate::server::{self, DataDir, Endpoints, Listeners, Tls};
use crate::service::policies::Retention;
use crate::serving::{DEFAULT_MEMORY, EngineConfig};
use crate::telemetry::{self, LogConfig, TraceExporter};

/// Flags of `serve`.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  qedgix serve
  qedgix serve --grpc-addr 127.0.0.1:0 --http-addr 127.0.0.1:0 --data-dir /var/lib/qedgix   # free ports, written to endpoints.json
  QEDGIX_CPU_BUDGET=2 QEDGIX_LOG=debug qedgix serve --log-format json

A replica, which takes its policies from another server:
  QEDGIX_FOLLOW_API_KEY=qdx_... qedgix serve --follow https://primary:8080

Training on a cluster:
  qedgix serve --executor slurm --worker-addr login1.cluster:50052 --slurm-dir /home/lab/qedgix --slurm-partition cpu --slurm-time 8h

Remote access with API keys and TLS:
  qedgix keys create --name fleet --scopes read,act
  qedgix serve --grpc-addr 0.0.0.0:50051 --http-addr 0.0.0.0:8080 --tls-cert cert.pem --tls-key key.pem
  qedgix serve --tls-cert cert.pem --tls-key key.pem --tls-client-ca clients.pem --key-rate 500 --max-connections 2000

A TIME is a number of seconds or a number with a unit: 500us, 2ms, 90s, 10m, 2h.")]
pub struct ServeArgs {
    /// Address of gRPC; port 0 selects a free port
    #[arg(long, env = "QEDGIX_GRPC_ADDR", default_value = "127.0.0.1:50051", value_parser = address, value_name = "HOST:PORT")]
    grpc_addr: SocketAddr,
    /// Address of REST; port 0 selects a free port
    #[arg(long, env = "QEDGIX_HTTP_ADDR", default_value = "127.0.0.1:8080", value_parser = address, value_name = "HOST:PORT")]
    http_addr: SocketAddr,
    /// Directory of the database; created if missing
    #[arg(long, env = "QEDGIX_DATA_DIR", default_value = "./qedgix-data", value_name = "DIR")]
    data_dir: PathBuf,
    /// CPU budget: threads that all running training jobs may use together [default: all cores; 4096 with Slurm]
    #[arg(long, env = "QEDGIX_CPU_BUDGET", value_name = "THREADS")]
    cpu_budget: Option<usize>,
    /// Failed attempts, without a new snapshot between them, after which a job fails
    #[arg(long, env = "QEDGIX_MAX_ATTEMPTS", default_value_t = 3, value_name = "ATTEMPTS")]
    max_attempts: u32,
    /// Time between two snapshots of a running job; after a crash the job continues from its last snapshot
    #[arg(long, env = "QEDGIX_SNAPSHOT_EVERY", default_value = "10s", value_parser = duration, value_name = "TIME")]
    snapshot_every: Duration,
    /// Time without a heartbeat after which a worker is killed and its job starts again from the last snapshot, 2 s to 1 h
    #[arg(long, env = "QEDGIX_HEARTBEAT_TIMEOUT", default_value = "30s", value_parser = duration, value_name = "TIME")]
    heartbeat_timeout: Duration,
    /// Idle time after which a session expires
    #[arg(long, env = "QEDGIX_SESSION_TTL", default_value = "10m", value_parser = duration, value_name = "TIME")]
    session_ttl: Duration,
    /// Maximum open sessions
    #[arg(long, env = "QEDGIX_MAX_SESSIONS", default_value_t = 100_000, value_name = "SESSIONS")]
    max_sessions: usize,
    /// Maximum memory of all sessions together, in bytes
    #[arg(long, env = "QEDGIX_SESSION_MEMORY", default_value_t = 256 << 20, value_name = "BYTES")]
    session_memory: usize,
    /// Slots after which a UAV or user that is missing from the requests of its fleet is forgotten; until then it keeps its memory
    #[arg(long, env = "QEDGIX_ABSENT_AFTER", default_value_t = 100, value_name = "SLOTS")]
    absent_after: u64,
    /// Idle time after which a hosted environment expires
    #[arg(long, env = "QEDGIX_ENVIRONMENT_TTL", default_value = "10m", value_parser = duration, value_name = "TIME")]
    environment_ttl: Duration,
    /// Maximum hosted environments
    #[arg(long, env = "QEDGIX_MAX_ENVIRONMENTS", default_value_t = 1024, value_name = "ENVIRONMENTS")]
    max_environments: usize,
    /// Maximum memory of all hosted environments together, in bytes
    #[arg(long, env = "QEDGIX_ENVIRONMENT_MEMORY", default_value_t = 1 << 30, value_name = "BYTES")]
    environment_memory: usize,
    /// Maximum memory of all policies together, in bytes. A policy version is read when it is asked for; those that were not used for
    /// the longest time leave memory
    #[arg(long, env = "QEDGIX_POLICY_MEMORY", default_value_t = DEFAULT_MEMORY, value_name = "BYTES")]
    policy_memory: usize,
    /// Checkpoints to keep of each job that has ended, the best one first; 0: all
    #[arg(long, env = "QEDGIX_KEEP_CHECKPOINTS", default_value_t = 0, value_name = "CHECKPOINTS")]
    keep_checkpoints: u32,
    /// Newest versions to keep of each policy, besides those with an alias; older ones are deleted; 0: all
    #[arg(long, env = "QEDGIX_KEEP_VERSIONS", default_value_t = 0, value_name = "VERSIONS")]
    keep_versions: usize,
    /// Newest jobs to keep of those that have ended; older ones are deleted with their metrics, logs and checkpoints, but not the
    /// versions that they published; 0: all
    #[arg(long, env = "QEDGIX_KEEP_JOBS", default_value_t = 0, value_name = "JOBS")]
    keep_jobs: usize,
    /// Time after its end for which a job is kept, as 30m or 720h; 0: forever
    #[arg(long, env = "QEDGIX_KEEP_JOBS_FOR", default_value = "0s", value_parser = duration, value_name = "TIME")]
    keep_jobs_for: Duration,
    /// Maximum size of a gRPC message or HTTP body, in bytes
    #[arg(long, env = "QEDGIX_MAX_MESSAGE_SIZE", default_value_t = 16 << 20, value_name = "BYTES")]
    max_message_size: usize,
    /// Threads that compute headings [default: all cores, at most 4]
    #[arg(long, env = "QEDGIX_ENGINE_THREADS", value_name = "THREADS")]
    engine_threads: Option<usize>,
    /// Maximum open streams of job events; further streams are refused
    #[arg(long, env = "QEDGIX_MAX_WATCHERS", default_value_t = 256, value_name = "STREAMS")]
    max_watchers: usize,
    /// Idle time after which an event stream over HTTP sends a comment, so that proxies keep it open
    #[arg(long, env = "QEDGIX_EVENT_HEARTBEAT", default_value = "15s", value_parser = duration, value_name = "TIME")]
    event_heartbeat: Duration,
    /// Maximum fleets in the queue of the engine; further requests are refused
    #[arg(long, env = "QEDGIX_ENGINE_QUEUE", default_value_t = 4096, value_name = "FLEETS")]
    engine_queue: usize,
    /// Maximum fleets computed in one forward pass
    #[arg(long, env = "QEDGIX_MAX_BATCH", default_value_t = 64, value_name = "FLEETS")]
    max_batch: usize,
    /// Maximum time that the oldest fleet of a batch waits for further fleets, at most 10 s
    #[arg(long, env = "QEDGIX_MAX_BATCH_DELAY", default_value = "0s", value_parser = duration, value_name = "TIME")]
    max_batch_delay: Duration,
    /// Time that requests in flight have to complete when the server stops, at most 24 h
    #[arg(long, env = "QEDGIX_DRAIN_TIMEOUT", default_value = "20s", value_parser = duration, value_name = "TIME")]
    drain_timeout: Duration,
    /// Allow addresses other than loopback without any API key. Does not switch off existing keys
    #[arg(long, help_heading = SECURITY, env = "QEDGIX_INSECURE")]
    insecure: bool,
    /// Host name by which callers reach this server, besides loopback names and its address, such as that of a proxy; repeatable. Needed only without API keys, when requests that name another host are refused [default: none]
    #[arg(long = "allow-host", help_heading = SECURITY, env = "QEDGIX_ALLOW_HOST", value_delimiter = ',', value_name = "HOST")]
    allow_hosts: Vec<String>,
    /// Host that webhooks of jobs may be sent to although its address is not public, as in their URLs: hooks.lan, 127.0.0.1; repeatable
    /// [default: none]
    #[arg(long = "webhook-allow", help_heading = SECURITY, env = "QEDGIX_WEBHOOK_ALLOW", value_delimiter = ',', value_name = "HOST")]
    webhook_allow: Vec<String>,
    #[command(flatten)]
    executor: ExecutorArgs,
    #[command(flatten)]
    follow: FollowArgs,
    #[command(flatten)]
    security: SecurityArgs,
    /// Format of the logs on standard error
    #[arg(long, env = "QEDGIX_LOG_FORMAT", default_value = "text", value_enum, value_name = "FORMAT")]
    log_format: LogFormat,
    /// Log every request, with the target qedgix::access
    #[arg(long, env = "QEDGIX_ACCESS_LOG")]
    access_log: bool,
    /// Export traces by OTLP over gRPC to this collector, such as http://127.0.0.1:4317 [default: no export]
    #[arg(long, env = "QEDGIX_OTLP_ENDPOINT", value_name = "URL")]
    otlp_endpoint: Option<String>,
}

/// Heading of the security flags in the help.
const SECURITY: &str = "Security";

/// Flags of `serve` for TLS and limits per caller.
#[derive(Args, Debug)]
struct SecurityArgs {
    /// Certificate of the server (PEM, followed by intermediate certificates); turns TLS on; SIGHUP reloads it [default: no TLS]
    #[arg(long, help_heading = SECURITY, env = "QEDGIX_TLS_CERT", value_name = "FILE", requires = "tls_key")]
    tls_cert: Option<PathBuf>,
    /// Private key of the certificate (PEM)
    #[arg(long, help_heading = SECURITY, env = "QEDGIX_TLS_KEY", value_name = "FILE", requires = "tls_cert")]
    tls_key: Option<PathBuf>,
    /// Require client certificates that these authorities issued (PEM) [default: no client certificates]
    #[arg(long, help_heading = SECURITY, env = "QEDGIX_TLS_CLIENT_CA", value_name = "FILE", requires = "tls_cert")]
    tls_client_ca: Option<PathBuf>,
    /// Maximum connections of both addresses together; beyond, only probes get in
    #[arg(long, help_heading = SECURITY, env = "QEDGIX_MAX_CONNECTIONS", default_value_t = 10_000, value_name = "CONNECTIONS")]
    max_connections: usize,
    /// Maximum connections of one IPv4 address or IPv6 network (/64); beyond, only probes get in
    #[arg(long, help_heading = SECURITY, env = "QEDGIX_MAX_CONNECTIONS_PER_PEER", default_value_t = 1000, value_name = "CONNECTIONS")]
    max_connections_per_peer: usize,
    /// Maximum bytes of requests that have arrived and of responses that are not sent yet, of both addresses together; beyond,
    /// requests are refused (RESOURCE_EXHAUSTED, 503)
    #[arg(long, help_heading = SECURITY, env = "QEDGIX_MAX_INFLIGHT_BYTES", default_value_t = 256 << 20, value_name = "BYTES")]
    max_inflight_bytes: usize,
    /// Maximum streams (calls in flight) per HTTP/2 connection
    #[arg(long, help_heading = SECURITY, env = "QEDGIX_MAX_STREAMS", default_value_t = 1024, value_name = "STREAMS")]
    max_streams: u32,
    /// Time for a TLS handshake, the head of an HTTP/1 request, a body and a gRPC message to arrive, at most 1 h. Bodies and
    /// messages may take longer while at least 4 KiB arrive per second
    #[arg(long, help_heading = SECURITY, env = "QEDGIX_READ_TIMEOUT", default_value = "30s", value_parser = duration, value_name = "TIME")]
    read_timeout: Duration,
    /// Time in which a caller must take some bytes of a response, at most 1 h
    #[arg(long, help_heading = SECURITY, env = "QEDGIX_WRITE_TIMEOUT", default_value = "60s", value_parser = duration, value_name = "TIME")]
    write_timeout: Duration,
    /// Time after which an HTTP/2 connection without requests is closed, even if it answers pings
    #[arg(long, help_heading = SECURITY, env = "QEDGIX_CONNECTION_IDLE", default_value = "5m", value_parser = duration, value_name = "TIME")]
    connection_idle: Duration,
    /// Age after which a connection is closed, so that callers spread over several servers; up to 10 % more or less
    #[arg(long, help_heading = SECURITY, env = "QEDGIX_CONNECTION_AGE", default_value = "1h", value_parser = duration, value_name = "TIME")]
    connection_age: Duration,
    /// Time for requests and streams in flight on a connection that is closed because of its age
    #[arg(long, help_heading = SECURITY, env = "QEDGIX_CONNECTION_GRACE", default_value = "5m", value_parser = duration, value_name = "TIME")]
    connection_grace: Duration,
    /// Maximum requests per second of an API key without a rate of its own [default: unlimited]
    #[arg(long, help_heading = SECURITY, env = "QEDGIX_KEY_RATE", value_name = "PER_SECOND")]
    key_rate: Option<f64>,
    /// Maximum requests at once of such a key, after a pause [default: the requests of one second]
    #[arg(long, help_heading = SECURITY, env = "QEDGIX_KEY_BURST", value_name = "REQUESTS", requires = "key_rate")]
    key_burst: Option<f64>,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum LogFormat {
    Text,
    Json,
}

/// Serves until ctrl-c or SIGTERM, then drains. A second signal ends the process at once.
///
/// # Errors
/// A setting is invalid, an address or the data directory is in use, or the database cannot be read.
pub async fn run(args: ServeArgs) -> anyhow::Result<()> {
    let traces = args.otlp_endpoint.as_deref().map(TraceExporter::start).transpose()?;
    let logs = LogConfig { json: matches!(args.log_format, LogFormat::Json), access: args.access_log };
    // Until the end, and not longer: what is printed about an error comes after the log.
    let _logs = telemetry::init_logs(logs, traces.as_ref())?;
    refuse_huge_pages();
    let mut config = Config { follow: args.follow.config()?, ..args.config() };
    config.validate()?;
    config.max_connections = open_files::make_room(config.max_connections);
    let data = DataDir::lock(&config.data_dir)?;
    let listeners = Listeners::bind(&config).await?;
    // Signal handlers exist before the server announces its addresses.
    let shutdown = stop_signal()?;
    reload_on_hangup(listeners.tls())?;
    let app = server::open(&config, &data, Clock::system()).await?;
    let endpoints = listeners.endpoints()?;
    // The server works without its standard output, for instance while the disk of a file behind it is full.
    if let Err(error) = print_start(&config, endpoints) {
        tracing::warn!(%error, grpc = %endpoints.grpc, http = %endpoints.http, "the addresses cannot be printed");
    }
    let served = server::run(&config, &data, app, listeners, shutdown).await;
    if let Some(traces) = traces {
        traces.shutdown(config.drain_timeout.min(SPAN_FLUSH_TIMEOUT)).await;
    }
    Ok(served?)
}

/// Memory that requests leave is given back to the system page by page. A huge page of 2 MiB would stay as long as one allocation
/// in it lives, so after a peak a server would keep what it needed at the peak. Where the system has none, this changes nothing.
fn refuse_huge_pages() {
    #[cfg(target_os = "linux")]
    if let Err(error) = rustix::thread::disable_transparent_huge_pages(true) {
        tracing::debug!(%error, "cannot switch off transparent huge pages");
    }
}

fn print_start(config: &Config, endpoints: Endpoints) -> Result<(), OutputError> {
    outln!("qedgix {}", env!("CARGO_PKG_VERSION"))?;
    outln!("gRPC       {}", endpoints.grpc)?;
    let scheme = if config.tls.is_some() { "https" } else { "http" };
    outln!("REST       {scheme}://{}", endpoints.http)?;
    outln!("dashboard  {scheme}://{}/", endpoints.http)?;
    if let Some(follow) = &config.follow {
        outln!("replica of {}", follow.url)?;
    }
    outln!("data       {}", config.data_dir.display())
}

/// Maximum time to send the last spans to the collector.
const SPAN_FLUSH_TIMEOUT: Duration = Duration::from_secs(5);

/// Reloads certificates on SIGHUP. Without TLS, SIGHUP changes nothing; its default action would end the process without a drain.
fn reload_on_hangup(tls: Option<Arc<Tls>>) -> std::io::Result<()> {
    let mut hangup = signal(SignalKind::hangup())?;
    tokio::spawn(async move {
        while hangup.recv().await.is_some() {
            match &tls {
                Some(tls) => tls.reload(),
                None => tracing::info!("SIGHUP: no certificate to reload"),
            }
        }
    });
    Ok(())
}

/// Time for the last log line.
const LAST_LINE: Duration = Duration::from_millis(50);

/// Resolves on the first ctrl-c or SIGTERM. The second signal ends the process at once. No acknowledged change is lost, because
/// it is committed to the database; workers end with the server.
fn stop_signal() -> std::io::Result<impl Future<Output = ()>> {
    let mut signals = StopSignals::new()?;
    Ok(async move {
        signals.next().await;
        tokio::spawn(async move {
            let code = signals.next().await;
            tracing::warn!("second stop signal: ending at once");
            tokio::time::sleep(LAST_LINE).await;
            std::process::exit(code.into());
        });
    })
}

impl ServeArgs {
    fn config(&self) -> Config {
        let (executor, worker_addr) = self.executor.config();
        let default = Config { executor, worker_addr, ..Config::new(&self.data_dir) };
        Config {
            grpc_addr: self.grpc_addr,
            http_addr: self.http_addr,
            cpu_budget: self.cpu_budget.unwrap_or_else(|| default.default_cpu_budget()),
            max_attempts: self.max_attempts,
            snapshot_every: self.snapshot_every,
            heartbeat_timeout: self.heartbeat_timeout,
            session_ttl: self.session_ttl,
            max_sessions: self.max_sessions,
            session_memory: self.session_memory,
            absent_after: self.absent_after,
            environment_ttl: self.environment_ttl,
            max_environments: self.max_environments,
            environment_memory: self.environment_memory,
            policy_memory: self.policy_memory,
            retention: Retention {
                checkpoints: self.keep_checkpoints,
                versions: self.keep_versions,
                jobs: self.keep_jobs,
                jobs_for: self.keep_jobs_for,
            },
            max_message_size: self.max_message_size,
            max_watchers: self.max_watchers,
            event_heartbeat: self.event_heartbeat,
            engine: EngineConfig {
                threads: self.engine_threads.unwrap_or(default.engine.threads),
                queue: self.engine_queue,
                max_batch: self.max_batch,
                max_batch_delay: self.max_batch_delay,
            },
            drain_timeout: self.drain_timeout,
            insecure: self.insecure,
            webhook_allow: self.webhook_allow.clone(),
            allow_hosts: self.allow_hosts.clone(),
            tls: self.security.tls_files(),
            max_connections: self.security.max_connections,
            max_connections_per_peer: self.security.max_connections_per_peer,
            max_streams: self.security.max_streams,
            max_inflight_bytes: self.security.max_inflight_bytes,
            read_timeout: self.security.read_timeout,
            write_timeout: self.security.write_timeout,
            connection_idle: self.security.connection_idle,
            connection_age: self.security.connection_age,
            connection_grace: self.security.connection_grace,
            key_rate: self.security.key_rate,
            key_burst: self.security.key_burst,
            ..default
        }
    }
}

impl SecurityArgs {
    fn tls_files(&self) -> Option<TlsFiles> {
        let (cert, key) = self.tls_cert.clone().zip(self.tls_key.clone())?;
        Some(TlsFiles { cert, key, client_ca: self.tls_client_ca.clone() })
    }
}

fn address(text: &str) -> Result<SocketAddr, String> {
    let mut found = text.to_socket_addrs().map_err(|e| format!("{e}; expected HOST:PORT, such as 127.0.0.1:0"))?;
    found.next().ok_or_else(|| "the host has no address".to_owned())
}

/// Parses a time: a number of seconds, or a number with a unit.
///
/// # Errors
/// A description of the expected format.
pub(super) fn duration(text: &str) -> Result<Duration, String> {
    let seconds = text.parse::<f64>().ok().and_then(|seconds| Duration::try_from_secs_f64(seconds).ok());
    let with_unit = || text.parse::<jiff::SignedDuration>().ok().and_then(|duration| Duration::try_from(duration).ok());
    seconds
        .or_else(with_unit)
        .ok_or_else(|| "expected a number of seconds, or a number with a unit such as 500ms, 90s, 10m or 2h".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(clap::Parser)]
    struct Line {
        #[command(flatten)]
        serve: ServeArgs,
    }

    fn config(words: &[&str]) -> Result<Config, String> {
        use clap::Parser;
        let line = Line::try_parse_from([&["x"], words].concat()).map_err(|error| error.to_string())?;
        let config = line.serve.config();
        config.validate().map_err(|error| error.to_string()).map(|()| config)
    }

    #[test]
    fn every_duration_flag_refuses_a_time_that_is_too_long() {
        use clap::CommandFactory;
        let has_time = |arg: &&clap::Arg| arg.get_value_names().is_some_and(|names| names == ["TIME"]);
        let flags: Vec<String> =
            Line::command().get_arguments().filter(has_time).map(|arg| format!("--{}", arg.get_long().unwrap())).collect();
        assert!(flags.len() >= 7, "{flags:?}");
        assert!(config(&[]).is_ok());
        for flag in &flags {
            for time in ["1e19", "1e300", "-1s", "9e9"] {
                let error = config(&[&format!("{flag}={time}")]).unwrap_err();
                assert!(error.contains(flag.as_str()), "{flag}={time}: {error}");
            }
        }
    }

    #[test]
    fn the_addresses_of_grpc_and_rest_differ() {
        let addr = "127.0.0.1:50051";
        let error = config(&["--grpc-addr", addr, "--http-addr", addr]).unwrap_err();
        assert!(error.starts_with("--http-addr: got 127.0.0.1:50051") && error.contains("--grpc-addr"), "{error}");
        assert!(config(&["--grpc-addr", "127.0.0.1:0", "--http-addr", "127.0.0.1:0"]).is_ok());
    }

    #[test]
    fn durations_and_addresses_are_parsed() {
        assert_eq!(duration("90"), Ok(Duration::from_secs(90)));
        assert_eq!(duration("0.5"), Ok(Duration::from_millis(500)));
        assert_eq!(duration("10m"), Ok(Duration::from_secs(600)));
        assert_eq!(duration("500ms"), Ok(Duration::from_millis(500)));
        for wrong in ["", "-1", "-5s", "soon", "nan", "1e300"] {
            assert!(duration(wrong).is_err(), "{wrong}");
        }
        assert_eq!(address("127.0.0.1:0").unwrap().port(), 0);
        assert!(address("127.0.0.1").is_err());
    }
}
