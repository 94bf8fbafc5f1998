//! Listeners, background tasks and graceful shutdown of one server on one data directory.
//!
//! Shutdown has four steps: the server reports not ready and refuses new work; workers snapshot their jobs, which return to the
//! queue; streams end and requests in flight are answered; the listeners close and the data directory is unlocked.

mod background;
mod connections;
mod follow;
mod housekeeping;
mod http2;
mod keys;
mod lifetime;
mod permits;
mod tls;
mod write_timeout;

use std::fs::{File, TryLockError};
use std::future::Future;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::http::Request;
use futures::future::BoxFuture;
use tokio::net::TcpListener;
use tokio_util::sync::CancellationToken;
use tower::ServiceExt;

use self::background::Background;
use self::connections::{Connections, Protocol};
use self::follow::Follower;
pub use self::http2::{CONNECTION_WINDOW, KEEPALIVE_INTERVAL, STREAM_WINDOW};
use self::lifetime::LifeLimits;
use self::permits::Permits;
pub use self::tls::Tls;
use crate::api::body::{IncomingBody, TimeLimits};
use crate::api::{AllowedHosts, grpc, rest};
use crate::clock::Clock;
use crate::config::{Config, ExecutorConfig};
use crate::draining::Draining;
use crate::files;
use crate::inflight::Budget;
use crate::invalid::Invalid;
use crate::jobs::{self, Executor, LocalProcess, Scheduler, SchedulerConfig, Slurm};
use crate::service::keys::{Keyring, Rate};
use crate::service::policies::{Loads, UploadLimit};
use crate::service::webhooks::Webhooks;
use crate::service::{App, Replica, WatchLimit, operations, policies};
use crate::serving::{Engine, Environments, Limits, Registry, Sessions};
use crate::store::{self, Store};
use crate::telemetry;

/// Name of the file in the data directory that holds the addresses of the running server.
pub const ENDPOINTS: &str = "endpoints.json";

/// Why a server did not start, or failed.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A setting is invalid.
    #[error(transparent)]
    Config(#[from] Invalid),
    /// A file of the data directory cannot be read or written.
    #[error("{path}: {cause}")]
    File {
        /// Path of the file.
        path: PathBuf,
        /// Error of the operating system.
        cause: std::io::Error,
    },
    /// Another server uses the data directory.
    #[error("{0} is in use by another qedgix server; stop it, or choose another --data-dir")]
    InUse(PathBuf),
    /// The address is in use, or does not belong to this machine.
    #[error("{flag}: cannot listen on {addr}: {cause}")]
    Bind {
        /// The flag that sets the address.
        flag: &'static str,
        /// The address.
        addr: SocketAddr,
        /// Error of the operating system.
        cause: std::io::Error,
    },
    /// The database failed.
    #[error(transparent)]
    Store(#[from] store::Error),
    /// API keys cannot be read.
    #[error("cannot read API keys: {path}: {}", cause.reason())]
    Keys {
        /// The database.
        path: PathBuf,
        /// What the service says.
        cause: crate::service::Error,
    },
    /// Policies cannot be loaded.
    #[error("cannot load policies: {path}: {}", cause.reason())]
    Policies {
        /// The database.
        path: PathBuf,
        /// What the service says.
        cause: crate::service::Error,
    },
    /// The path of this program is unknown, so workers cannot be started.
    #[error("cannot find the program of workers: {0}")]
    Worker(#[source] std::io::Error),
    /// The client of the primary cannot be made.
    #[error("cannot follow a primary: {0}")]
    Follow(#[source] reqwest::Error),
    /// The threads of the engine cannot be started.
    #[error("cannot start the engine: {0}")]
    Engine(#[source] std::io::Error),
    /// The background thread cannot be started.
    #[error("cannot start the background thread: {0}")]
    Background(#[source] std::io::Error),
    /// The address of a listener cannot be read.
    #[error("cannot read the address of a listener: {0}")]
    Listener(#[source] std::io::Error),
}

/// The bound listeners of a server.
#[derive(Debug)]
pub struct Listeners {
    /// gRPC.
    pub grpc: TcpListener,
    /// REST.
    pub http: TcpListener,
    /// Serves only `WorkerService`: without TLS, outside the connection limit, on loopback if workers run on this machine.
    workers: TcpListener,
    tls: Option<Arc<Tls>>,
}

/// Addresses of [`Listeners`], with their actual ports.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
pub struct Endpoints {
    /// gRPC.
    pub grpc: SocketAddr,
    /// REST.
    pub http: SocketAddr,
}

impl Listeners {
    /// Binds the addresses of `config`.
    ///
    /// # Errors
    /// [`Error::Config`] when a TLS file cannot be used, [`Error::Bind`] when an address cannot be bound.
    pub async fn bind(config: &Config) -> Result<Self, Error> {
        let bind = async |flag, addr| TcpListener::bind(addr).await.map_err(|cause| Error::Bind { flag, addr, cause });
        let tls = config.tls.clone().map(Tls::open).transpose()?.map(Arc::new);
        let loopback = (Ipv4Addr::LOCALHOST, 0).into();
        let workers = bind("--worker-addr", config.worker_addr.as_ref().map_or(loopback, |worker| worker.addr)).await?;
        let grpc = bind("--grpc-addr", config.grpc_addr).await?;
        let http = bind("--http-addr", config.http_addr).await?;
        Ok(Self { grpc, http, workers, tls })
    }

    /// The TLS configuration, if TLS is on.
    pub fn tls(&self) -> Option<Arc<Tls>> {
        self.tls.clone()
    }

    /// Addresses of the listeners.
    ///
    /// # Errors
    /// The error of the operating system when it does not know an address.
    pub fn endpoints(&self) -> std::io::Result<Endpoints> {
        Ok(Endpoints { grpc: self.grpc.local_addr()?, http: self.http.local_addr()? })
    }
}

/// Time to wait for the lock of a data directory.
const LOCK_PATIENCE: Duration = Duration::from_secs(1);

/// Locks the file, and waits up to [`LOCK_PATIENCE`] for another process to release it.
fn lock_patiently(file: &File) -> Result<(), TryLockError> {
    let began = Instant::now();
    loop {
        match file.try_lock() {
            Err(TryLockError::WouldBlock) if began.elapsed() < LOCK_PATIENCE => std::thread::sleep(LOCK_PATIENCE / 50),
            result => return result,
        }
    }
}

/// A data directory, locked by this process until the value is dropped.
#[derive(Debug)]
pub struct DataDir {
    path: PathBuf,
    /// Holds the locks of the directory itself, which nobody can remove while it is in use, and of the file `lock`, which earlier
    /// versions lock. The operating system releases them when the process ends, for whatever reason.
    _locks: [File; 2],
}

impl DataDir {
    /// Locks the directory and creates it if missing. Waits up to [`LOCK_PATIENCE`] for another process to release it: a server that was
    /// killed while it started a worker leaves its locks for a moment to the process that becomes that worker.
    ///
    /// # Errors
    /// [`Error::InUse`] when another server holds the lock, [`Error::File`] when the directory cannot be written.
    pub fn lock(path: &Path) -> Result<Self, Error> {
        let failed = |path: &Path| {
            let path = path.to_owned();
            move |cause| Error::File { path, cause }
        };
        files::create_private_dir(path).map_err(failed(path))?;
        let directory = File::open(path).map_err(failed(path))?;
        match lock_patiently(&directory) {
            Err(TryLockError::WouldBlock) => return Err(Error::InUse(path.to_owned())),
            // Some file systems lock only files.
            Err(TryLockError::Error(error)) => tracing::debug!(%error, "the data directory cannot be locked, only a file in it"),
            Ok(()) => {}
        }
        let file = path.join("lock");
        let lock = files::private_file().truncate(false).open(&file).map_err(failed(&file))?;
        files::give_to_owner_of_directory(&file);
        match lock_patiently(&lock) {
            Ok(()) => Ok(Self { path: path.to_owned(), _locks: [directory, lock] }),
            Err(TryLockError::WouldBlock) => Err(Error::InUse(path.to_owned())),
            Err(TryLockError::Error(cause)) => Err(failed(&file)(cause)),
        }
    }

    /// Writes `endpoints.json` atomically.
    fn write_endpoints(&self, endpoints: Endpoints) -> Result<(), Error> {
        let path = self.path.join(ENDPOINTS);
        let text = serde_json::to_string(&endpoints).expect("addresses are plain data") + "\n";
        files::write_private(&path, text.as_bytes()).map_err(|cause| Error::File { path, cause })
    }

    /// Takes access from other users of the machine, which earlier versions left them.
    fn make_private(&self) {
        let files = store::FILES.iter().chain([&"lock", &ENDPOINTS]).map(|name| self.path.join(name));
        for path in std::iter::once(self.path.clone()).chain(files) {
            match files::make_private(&path) {
                Ok(false) => {}
                Ok(true) => tracing::info!(path = %path.display(), "other users could read this; now only its owner can"),
                Err(error) => tracing::warn!(path = %path.display(), %error, "other users can read this"),
            }
        }
    }

    fn remove_endpoints(&self) {
        // A stale file is harmless: nothing listens at its addresses.
        let _ = std::fs::remove_file(self.path.join(ENDPOINTS));
    }
}

/// Opens the database, loads policies and keys, and starts the engine.
///
/// # Errors
/// [`Error::Config`] when a setting is invalid, [`Error::Store`], [`Error::Keys`] or [`Error::Policies`] when the database or a
/// policy in it cannot be read.
pub fn open<'a>(config: &'a Config, data: &'a DataDir, clock: Clock) -> BoxFuture<'a, Result<Arc<App>, Error>> {
    // Every crate that awaits the body of an async fn compiles it again, but not that of a boxed future.
    Box::pin(open_app(config, data, clock))
}

async fn open_app(config: &Config, data: &DataDir, clock: Clock) -> Result<Arc<App>, Error> {
    config.validate()?;
    // The recorder must exist before anything creates a metric.
    telemetry::install_metrics();
    let sessions = Limits { ttl: config.session_ttl, max: config.max_sessions, memory: config.session_memory };
    let environments = Limits { ttl: config.environment_ttl, max: config.max_environments, memory: config.environment_memory };
    data.make_private();
    let store = Store::open(&data.path).await?;
    housekeeping::prepare_file(&store, &data.path).await?;
    let executor = executor(config, data)?;
    let scheduler = SchedulerConfig {
        max_attempts: config.max_attempts,
        snapshot_every: config.snapshot_every,
        heartbeat_timeout: config.heartbeat_timeout,
        pause_grace: config.drain_timeout,
        // The nodes of a cluster may have more memory than this machine, and Slurm knows which.
        memory: if executor.is_cluster() { u64::MAX } else { jobs::memory::available() },
        ..SchedulerConfig::new(config.cpu_budget)
    };
    let keys = Keyring::new(config.key_rate.map(|rate| Rate::new(rate, config.key_burst)));
    keys.refresh(&store).await.map_err(|cause| Error::Keys { path: data.path.join(store::FILE), cause })?;
    config.validate_exposure(keys.required())?;
    if config.tls.is_none() && config.validate_exposure(false).is_err() {
        tracing::warn!("this server accepts remote connections without TLS: API keys travel unencrypted (see --tls-cert)");
    }
    let draining = Draining::default();
    let replica = match &config.follow {
        Some(follow) => Some(Replica::open(follow.url.clone(), &store, &clock).await?),
        None => None,
    };
    let app = App {
        keys,
        uploads: UploadLimit::default(),
        scheduler: Scheduler::open(store.clone(), scheduler, executor, clock.clone(), draining.clone()).await?,
        store,
        registry: Arc::new(Registry::new(config.policy_memory)),
        loads: Loads::default(),
        replica,
        retention: config.retention,
        sessions: Sessions::new(sessions, clock.clone()),
        absent_after: config.absent_after,
        environments: Environments::new(environments, clock.clone()),
        engine: Engine::start(config.engine).map_err(Error::Engine)?,
        watchers: WatchLimit::new(config.max_watchers, config.event_heartbeat),
        webhooks: Webhooks::new(&config.webhook_allow),
        clock,
        max_message_size: config.max_message_size,
        draining,
    };
    policies::fill_registry(&app).await.map_err(|cause| Error::Policies { path: data.path.join(store::FILE), cause })?;
    Ok(Arc::new(app))
}

/// What starts workers.
fn executor(config: &Config, data: &DataDir) -> Result<Arc<dyn Executor>, Error> {
    let program = config.worker.clone();
    Ok(match &config.executor {
        ExecutorConfig::Local => Arc::new(match program {
            Some(program) => LocalProcess::new(program),
            None => LocalProcess::same_program().map_err(Error::Worker)?,
        }),
        ExecutorConfig::Slurm(slurm) => {
            let program = program.map_or_else(std::env::current_exe, Ok).map_err(Error::Worker)?;
            let path = slurm.directory.clone().unwrap_or_else(|| data.path.join("slurm"));
            Arc::new(Slurm::new(slurm.clone(), program, path.clone()).map_err(|cause| Error::File { path, cause })?)
        }
    })
}

/// Serves until `shutdown` resolves, then drains.
///
/// # Errors
/// [`Error::Listener`] when the address of a listener cannot be read, [`Error::Background`] when a thread cannot be started,
/// [`Error::Follow`] when the client of the primary cannot be made.
pub fn run<'a>(
    config: &'a Config,
    data: &'a DataDir,
    app: Arc<App>,
    listeners: Listeners,
    shutdown: impl Future<Output = ()> + Send + 'a,
) -> BoxFuture<'a, Result<(), Error>> {
    Box::pin(serve(config, data, app, listeners, Box::pin(shutdown)))
}

async fn serve(
    config: &Config,
    data: &DataDir,
    app: Arc<App>,
    listeners: Listeners,
    shutdown: BoxFuture<'_, ()>,
) -> Result<(), Error> {
    let endpoints = listeners.endpoints().map_err(Error::Listener)?;
    let workers = match &config.worker_addr {
        Some(worker) if worker.addr.port() != 0 => worker.name.clone(),
        _ => listeners.workers.local_addr().map_err(Error::Listener)?.to_string(),
    };
    telemetry::install_metrics();
    if let Some(tls) = &listeners.tls {
        tls.report_expiry();
    }
    let stop = CancellationToken::new();
    let health = grpc::Health::new(app.draining.clone(), stop.clone());
    health.report(operations::server_health(&app).await);

    let follower = config.follow.as_ref().map(Follower::new).transpose().map_err(Error::Follow)?;
    let background = Background::start().map_err(Error::Background)?;
    let connections = connections(config, &listeners, &app, (&stop, &background));
    // Workers share nothing with other callers: no caller can keep them out.
    let worker_connections = Connections {
        permits: Permits::new(MAX_WORKER_CONNECTIONS, MAX_WORKER_CONNECTIONS, Budget::new(WORKER_INFLIGHT_BYTES)),
        tls: None,
        life: LifeLimits { idle: Duration::MAX / 4, age: Duration::MAX / 4, ..connections.life },
        ..connections.clone()
    };
    let services = grpc::services(&app, &health, config.max_message_size, background.handle(), stop.clone());
    let hosts = AllowedHosts::new(endpoints.http.ip(), &config.allow_hosts);
    let router = rest::router(app.clone(), telemetry::render_metrics, config.max_message_size, hosts, background.handle());
    let router = router.map_request(|mut request: Request<IncomingBody>| {
        let exchange = request.body().exchange().clone();
        request.extensions_mut().insert(exchange);
        request.map(axum::body::Body::new)
    });
    let serve_workers = worker_connections.serve(
        listeners.workers,
        Protocol::Grpc,
        grpc::worker_services(&app, config.max_message_size, background.handle(), stop.clone()),
    );
    let budget = connections.permits.budget().clone();
    let serve_grpc = connections.clone().serve(listeners.grpc, Protocol::Grpc, services);
    let serve_rest = connections.serve(listeners.http, Protocol::Http, router);

    let upkeep = tokio::spawn(app.store.clone().upkeep());
    let jobs = match follower {
        // A replica starts no jobs.
        Some(follower) => tokio::spawn(follower.run(app.clone())),
        None => tokio::spawn(app.scheduler.clone().run(format!("http://{workers}"))),
    };
    let housekeeper = tokio::spawn(housekeeping::run(app.clone(), config.session_ttl.min(config.environment_ttl), budget));
    let health_reporter = tokio::spawn(health.clone().follow(app.clone()));
    let key_follower = tokio::spawn(keys::follow(app.clone()));
    // The server works without the file, for instance while the disk is full.
    if let Err(error) = data.write_endpoints(endpoints) {
        tracing::error!(%error, "the addresses of the server cannot be written to the data directory");
    }
    tracing::info!(grpc = %endpoints.grpc, http = %endpoints.http, policies = app.registry.len(), "serving");

    let drain = async {
        shutdown.await;
        tracing::info!("draining");
        app.draining.begin();
        // Workers need the server to upload their snapshots, so it keeps answering until they are done.
        app.scheduler.drain(config.drain_timeout + Duration::from_secs(5)).await;
        stop.cancel();
        tokio::time::sleep(config.drain_timeout).await;
        tracing::warn!(after = ?config.drain_timeout, "drain timeout: closing requests in flight");
    };
    let serve = async { tokio::join!(serve_grpc, serve_rest, serve_workers) };
    tokio::select! {
        _ = serve => {}
        () = drain => {}
    }
    for task in [upkeep, jobs, housekeeper, health_reporter, key_follower] {
        task.abort();
    }
    keys::save_last_used(&app).await;
    app.store.close().await;
    data.remove_endpoints();
    tracing::info!("stopped");
    Ok(())
}

/// What the connections of both public listeners share.
fn connections(
    config: &Config,
    listeners: &Listeners,
    app: &App,
    (stop, background): (&CancellationToken, &Background),
) -> Connections {
    let limits = TimeLimits { read: config.read_timeout, write: config.write_timeout };
    let shortest = limits.read.min(limits.write).min(config.connection_idle).min(config.connection_grace);
    let life = LifeLimits {
        idle: config.connection_idle,
        age: config.connection_age,
        grace: config.connection_grace,
        tick: (shortest / 4).clamp(Duration::from_millis(20), Duration::from_secs(5)),
    };
    Connections {
        permits: Permits::new(config.max_connections, config.max_connections_per_peer, Budget::new(config.max_inflight_bytes)),
        tls: listeners.tls.clone(),
        limits,
        life,
        max_streams: config.max_streams,
        clock: app.clock.clone(),
        stop: stop.clone(),
        background: background.handle(),
    }
}

/// Maximum connections of workers: far more than jobs can run at once.
const MAX_WORKER_CONNECTIONS: usize = 4096;
/// Budget of bytes in flight of workers: chunks of all jobs.
const WORKER_INFLIGHT_BYTES: usize = 1 << 30;
