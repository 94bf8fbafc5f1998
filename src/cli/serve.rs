//! `qedgix serve`.

use std::net::{SocketAddr, ToSocketAddrs};
use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, ValueEnum};
use tokio::signal::unix::{SignalKind, signal};

use crate::config::Config;
use crate::server::{self, DataDir, Listeners};
use crate::serving::{Clock, EngineConfig};
use crate::telemetry::{self, Logs, Traces};

/// Flags of `serve`.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  qedgix serve
  qedgix serve --grpc-addr 127.0.0.1:0 --http-addr 127.0.0.1:0 --data-dir /var/lib/qedgix   # free ports, see endpoints.json
  QEDGIX_CPU_BUDGET=2 QEDGIX_LOG=debug qedgix serve --log-format json")]
pub struct ServeArgs {
    /// Where gRPC listens; port 0 picks a free one
    #[arg(long, env = "QEDGIX_GRPC_ADDR", default_value = "127.0.0.1:50051", value_parser = address, value_name = "HOST:PORT")]
    grpc_addr: SocketAddr,
    /// Where REST listens; port 0 picks a free one
    #[arg(long, env = "QEDGIX_HTTP_ADDR", default_value = "127.0.0.1:8080", value_parser = address, value_name = "HOST:PORT")]
    http_addr: SocketAddr,
    /// Where everything durable is; created if need be
    #[arg(long, env = "QEDGIX_DATA_DIR", default_value = "./qedgix-data", value_name = "DIR")]
    data_dir: PathBuf,
    /// Cores that training jobs may use together [default: all]
    #[arg(long, env = "QEDGIX_CPU_BUDGET", value_name = "CORES")]
    cpu_budget: Option<usize>,
    /// Failed attempts after which a job has failed
    #[arg(long, env = "QEDGIX_MAX_ATTEMPTS", default_value_t = 3)]
    max_attempts: u32,
    /// Time between snapshots of a running job; after a crash it goes on from the last one
    #[arg(long, env = "QEDGIX_SNAPSHOT_EVERY", default_value = "10s", value_parser = duration)]
    snapshot_every: Duration,
    /// A session idle for longer expires: seconds, or 90s, 10m, 2h
    #[arg(long, env = "QEDGIX_SESSION_TTL", default_value = "10m", value_parser = duration)]
    session_ttl: Duration,
    /// Most open sessions
    #[arg(long, env = "QEDGIX_MAX_SESSIONS", default_value_t = 100_000)]
    max_sessions: usize,
    /// A hosted environment idle for longer expires: seconds, or 90s, 10m, 2h
    #[arg(long, env = "QEDGIX_ENVIRONMENT_TTL", default_value = "10m", value_parser = duration)]
    environment_ttl: Duration,
    /// Most hosted environments
    #[arg(long, env = "QEDGIX_MAX_ENVIRONMENTS", default_value_t = 1024)]
    max_environments: usize,
    /// Memory that all hosted environments may take together, in bytes
    #[arg(long, env = "QEDGIX_ENVIRONMENT_MEMORY", default_value_t = 1 << 30, value_name = "BYTES")]
    environment_memory: usize,
    /// Largest gRPC message and HTTP body, in bytes
    #[arg(long, env = "QEDGIX_MAX_MESSAGE_SIZE", default_value_t = 4 << 20, value_name = "BYTES")]
    max_message_size: usize,
    /// Threads that compute headings [default: all cores, at most 4]
    #[arg(long, env = "QEDGIX_ENGINE_THREADS", value_name = "THREADS")]
    engine_threads: Option<usize>,
    /// Streams of jobs' events that may be open at a time; more are refused
    #[arg(long, env = "QEDGIX_MAX_WATCHERS", default_value_t = 256, value_name = "STREAMS")]
    max_watchers: usize,
    /// Silence after which a stream of events over HTTP gives a sign of life
    #[arg(long, env = "QEDGIX_EVENT_HEARTBEAT", default_value = "15s", value_parser = duration)]
    event_heartbeat: Duration,
    /// Fleets that may wait to be computed; more are refused
    #[arg(long, env = "QEDGIX_ENGINE_QUEUE", default_value_t = 4096, value_name = "FLEETS")]
    engine_queue: usize,
    /// Most fleets computed together; they gather while the engine is busy
    #[arg(long, env = "QEDGIX_MAX_BATCH", default_value_t = 64, value_name = "FLEETS")]
    max_batch: usize,
    /// How long a fleet may wait for company, counted from the oldest of a batch: seconds, or 500us, 2ms
    #[arg(long, env = "QEDGIX_MAX_BATCH_DELAY", default_value = "0s", value_parser = duration)]
    max_batch_delay: Duration,
    /// Time that requests in flight are given when the server stops
    #[arg(long, env = "QEDGIX_DRAIN_TIMEOUT", default_value = "20s", value_parser = duration)]
    drain_timeout: Duration,
    /// Listen on addresses that others can reach, although nobody has to say who they are
    #[arg(long, env = "QEDGIX_INSECURE")]
    insecure: bool,
    /// How logs are written to standard error
    #[arg(long, env = "QEDGIX_LOG_FORMAT", default_value = "text", value_enum)]
    log_format: LogFormat,
    /// Log every request, however it went, under the target qedgix::access
    #[arg(long, env = "QEDGIX_ACCESS_LOG")]
    access_log: bool,
    /// Export traces by OTLP over gRPC to this collector, as http://127.0.0.1:4317 [default: no traces]
    #[arg(long, env = "QEDGIX_OTLP_ENDPOINT", value_name = "URL")]
    otlp_endpoint: Option<String>,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum LogFormat {
    Text,
    Json,
}

/// Serves until ctrl-c or SIGTERM, then drains; a second one ends the process at once.
///
/// # Errors
/// A setting that cannot be used, an address or data directory that is taken, a database that cannot be read.
pub async fn run(args: ServeArgs) -> anyhow::Result<()> {
    let traces = args.otlp_endpoint.as_deref().map(Traces::start).transpose()?;
    let logs = Logs { json: matches!(args.log_format, LogFormat::Json), access: args.access_log };
    telemetry::logs(logs, traces.as_ref());
    let config = args.config();
    config.validate()?;
    let data = DataDir::take(&config.data_dir)?;
    let listeners = Listeners::bind(&config).await?;
    // Signals are caught before anybody is told that the server is there.
    let shutdown = told_to_stop()?;
    let app = server::open(&config, &data, Clock::system()).await?;
    let endpoints = listeners.endpoints()?;
    println!("qedgix {}", env!("CARGO_PKG_VERSION"));
    println!("gRPC  {}", endpoints.grpc);
    println!("REST  http://{}", endpoints.http);
    println!("data  {}", config.data_dir.display());
    let served = server::run(&config, &data, app, listeners, shutdown).await;
    if let Some(traces) = traces {
        traces.end(config.drain_timeout.min(LAST_SPANS)).await;
    }
    Ok(served?)
}

/// Time that the last spans are given to reach their collector.
const LAST_SPANS: Duration = Duration::from_secs(5);

/// Resolves on the first ctrl-c or SIGTERM. The second one ends the process, whatever is still being done: what was
/// acknowledged is on the disk, and workers end with the server.
fn told_to_stop() -> std::io::Result<impl Future<Output = ()>> {
    let (mut interrupt, mut terminate) = (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?);
    let mut next = async move || {
        tokio::select! {
            _ = interrupt.recv() => 130,
            _ = terminate.recv() => 143,
        }
    };
    Ok(async move {
        next().await;
        tokio::spawn(async move {
            let code = next().await;
            tracing::warn!("told to stop again; ending at once");
            std::process::exit(code);
        });
    })
}

impl ServeArgs {
    fn config(&self) -> Config {
        let default = Config::new(&self.data_dir);
        Config {
            grpc_addr: self.grpc_addr,
            http_addr: self.http_addr,
            cpu_budget: self.cpu_budget.unwrap_or(default.cpu_budget),
            max_attempts: self.max_attempts,
            snapshot_every: self.snapshot_every,
            session_ttl: self.session_ttl,
            max_sessions: self.max_sessions,
            environment_ttl: self.environment_ttl,
            max_environments: self.max_environments,
            environment_memory: self.environment_memory,
            max_message_size: self.max_message_size,
            max_watchers: self.max_watchers,
            heartbeat: self.event_heartbeat,
            engine: EngineConfig {
                threads: self.engine_threads.unwrap_or(default.engine.threads),
                queue: self.engine_queue,
                max_batch: self.max_batch,
                max_batch_delay: self.max_batch_delay,
            },
            drain_timeout: self.drain_timeout,
            insecure: self.insecure,
            ..default
        }
    }
}

fn address(text: &str) -> Result<SocketAddr, String> {
    let mut found = text.to_socket_addrs().map_err(|e| format!("{e}; expected HOST:PORT, such as 127.0.0.1:0"))?;
    found.next().ok_or_else(|| "the host has no address".to_owned())
}

/// A time as people write it: seconds, or a number with a unit.
///
/// # Errors
/// What would be one.
pub(super) fn duration(text: &str) -> Result<Duration, String> {
    let seconds = text.parse::<f64>().ok().and_then(|seconds| Duration::try_from_secs_f64(seconds).ok());
    let friendly = || text.parse::<jiff::SignedDuration>().ok().and_then(|duration| Duration::try_from(duration).ok());
    seconds.or_else(friendly).ok_or_else(|| "expected seconds, or a number with a unit: 500ms, 90s, 10m, 2h".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn durations_and_addresses_as_people_write_them() {
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
