//! Listeners, background work, shutdown: one process on one data directory.
//!
//! Shutdown in order: readiness goes off, watchers of health are told and new work is refused; training jobs are snapshotted
//! and queued; streams end and requests in flight are answered; then the listeners are gone and the data directory is free for
//! another server.

mod connections;
mod keys;
mod prompt;
mod tls;

use std::fs::{File, TryLockError};
use std::future::Future;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use hyper::Request;
use hyper::body::Incoming;
use tokio::net::TcpListener;
use tokio::sync::Semaphore;
use tokio_util::sync::CancellationToken;
use tower::ServiceExt;

use self::connections::{Connections, Protocol};
pub use self::connections::{KEEPALIVE, WINDOW};
use self::prompt::PromptBody;
pub use self::tls::Tls;
use crate::api::{grpc, rest};
use crate::config::Config;
use crate::invalid::Invalid;
use crate::jobs::{Jobs, LocalProcess, Settings};
use crate::service::keys::{Keyring, Rate};
use crate::service::{App, Draining, Watchers, operations, policies};
use crate::serving::{Clock, Engine, Environments, EnvironmentsConfig, Limits, Sessions};
use crate::store::{self, Store};
use crate::telemetry;

/// Name of the file in the data directory that tells where the server listens.
pub const ENDPOINTS: &str = "endpoints.json";

/// Why a server does not start or stopped.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A setting that cannot be used.
    #[error(transparent)]
    Config(#[from] Invalid),
    /// A file of the data directory.
    #[error("{path}: {cause}")]
    File {
        /// Which.
        path: PathBuf,
        /// What happened.
        cause: std::io::Error,
    },
    /// Another server works on the data directory.
    #[error("{0} is in use by another qedgix server; stop it, or choose another --data-dir")]
    InUse(PathBuf),
    /// The address is taken or not this machine's.
    #[error("cannot listen on {addr}: {cause}")]
    Bind {
        /// Where.
        addr: SocketAddr,
        /// What happened.
        cause: std::io::Error,
    },
    /// The database.
    #[error(transparent)]
    Store(#[from] store::Error),
    /// API keys could not be read.
    #[error("reading API keys: {0}")]
    Keys(#[source] crate::service::Error),
    /// Policies could not be loaded.
    #[error("loading policies: {0}")]
    Policies(#[source] crate::service::Error),
    /// The system does not tell which program this is, so no worker can be started.
    #[error("finding the program of workers: {0}")]
    Worker(#[source] std::io::Error),
    /// The system refuses a thread.
    #[error("starting the engine: {0}")]
    Engine(#[source] std::io::Error),
    /// The system does not know where a listener listens.
    #[error("listening: {0}")]
    Listener(#[source] std::io::Error),
}

/// Where a server listens.
#[derive(Debug)]
pub struct Listeners {
    /// gRPC.
    pub grpc: TcpListener,
    /// REST.
    pub http: TcpListener,
    /// `WorkerService` alone, for the workers of this machine: neither certificates nor the number of callers come between
    /// them and the server. On the loopback, without TLS.
    workers: TcpListener,
    tls: Option<Arc<Tls>>,
}

/// The addresses of [`Listeners`], ports chosen.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
pub struct Endpoints {
    /// gRPC.
    pub grpc: SocketAddr,
    /// REST.
    pub http: SocketAddr,
}

impl Listeners {
    /// Listens where `config` says.
    ///
    /// # Errors
    /// A file of TLS that cannot be used, an address that is taken or not this machine's.
    pub async fn bind(config: &Config) -> Result<Self, Error> {
        let bind = async |addr| TcpListener::bind(addr).await.map_err(|cause| Error::Bind { addr, cause });
        let tls = config.tls.clone().map(Tls::open).transpose()?.map(Arc::new);
        let workers = bind((Ipv4Addr::LOCALHOST, 0).into()).await?;
        Ok(Self { grpc: bind(config.grpc_addr).await?, http: bind(config.http_addr).await?, workers, tls })
    }

    /// TLS, if they speak it.
    pub fn tls(&self) -> Option<Arc<Tls>> {
        self.tls.clone()
    }

    /// Where they listen.
    ///
    /// # Errors
    /// The system does not know.
    pub fn endpoints(&self) -> std::io::Result<Endpoints> {
        Ok(Endpoints { grpc: self.grpc.local_addr()?, http: self.http.local_addr()? })
    }
}

/// A data directory that this process works on until it is dropped.
#[derive(Debug)]
pub struct DataDir {
    path: PathBuf,
    /// Held for its lock, which the system releases however the process ends.
    _lock: File,
}

impl DataDir {
    /// Takes the directory, which is created if need be.
    ///
    /// # Errors
    /// Another server has it, or it cannot be written.
    pub fn take(path: &Path) -> Result<Self, Error> {
        let failed = |path: &Path| {
            let path = path.to_owned();
            move |cause| Error::File { path, cause }
        };
        std::fs::create_dir_all(path).map_err(failed(path))?;
        let file = path.join("lock");
        let lock = File::options().create(true).truncate(false).write(true).open(&file).map_err(failed(&file))?;
        match lock.try_lock() {
            Ok(()) => Ok(Self { path: path.to_owned(), _lock: lock }),
            Err(TryLockError::WouldBlock) => Err(Error::InUse(path.to_owned())),
            Err(TryLockError::Error(cause)) => Err(failed(&file)(cause)),
        }
    }

    /// Writes where the server listens, whole or not at all.
    fn publish(&self, endpoints: Endpoints) -> Result<(), Error> {
        let (path, part) = (self.path.join(ENDPOINTS), self.path.join(".endpoints.json.part"));
        let text = serde_json::to_string(&endpoints).expect("addresses are plain data") + "\n";
        let written = std::fs::write(&part, text).and_then(|()| std::fs::rename(&part, &path));
        written.map_err(|cause| Error::File { path, cause })
    }

    fn withdraw(&self) {
        // Whoever reads it afterwards finds nobody listening either way.
        let _ = std::fs::remove_file(self.path.join(ENDPOINTS));
    }
}

/// Opens everything that use cases work with.
///
/// # Errors
/// The database or a policy in it cannot be read.
pub async fn open(config: &Config, data: &DataDir, clock: Clock) -> Result<Arc<App>, Error> {
    config.validate()?;
    // Before anything keeps a handle of a metric.
    telemetry::metrics();
    let sessions = Limits { ttl: config.session_ttl, max: config.max_sessions };
    let limits = Limits { ttl: config.environment_ttl, max: config.max_environments };
    let environments = EnvironmentsConfig { limits, memory: config.environment_memory };
    let store = Store::open(&data.path).await?;
    let executor = match &config.worker {
        Some(program) => LocalProcess { program: program.clone() },
        None => LocalProcess::same_program().map_err(Error::Worker)?,
    };
    let settings = Settings {
        max_attempts: config.max_attempts,
        snapshot_every: config.snapshot_every,
        pause_grace: config.drain_timeout,
        ..Settings::new(config.cpu_budget)
    };
    let keys = Keyring::new(config.key_rate.map(|rate| Rate::new(rate, config.key_burst)));
    keys.refresh(&store).await.map_err(Error::Keys)?;
    config.validate_reach(keys.required())?;
    if config.tls.is_none() && config.validate_reach(false).is_err() {
        tracing::warn!(
            "others can reach this server, and nothing is encrypted: who listens on the way sees API keys (--tls-cert)"
        );
    }
    let app = App {
        keys,
        jobs: Jobs::open(store.clone(), settings, Arc::new(executor)).await?,
        store,
        registry: Arc::default(),
        sessions: Sessions::new(sessions, clock.clone()),
        environments: Environments::new(environments, clock.clone()),
        engine: Engine::start(config.engine).map_err(Error::Engine)?,
        watchers: Watchers::new(config.max_watchers, config.heartbeat),
        clock,
        draining: Draining::default(),
    };
    policies::load(&app).await.map_err(Error::Policies)?;
    Ok(Arc::new(app))
}

/// Serves until `shutdown` resolves, then drains.
///
/// # Errors
/// A listener fails.
pub async fn run(
    config: &Config,
    data: &DataDir,
    app: Arc<App>,
    listeners: Listeners,
    shutdown: impl Future<Output = ()>,
) -> Result<(), Error> {
    let endpoints = listeners.endpoints().map_err(Error::Listener)?;
    let workers = listeners.workers.local_addr().map_err(Error::Listener)?;
    telemetry::metrics();
    let stop = CancellationToken::new();
    let health = grpc::Health::new(stop.clone());
    health.report(operations::vitals(&app).await);

    let connections = Connections {
        permits: Arc::new(Semaphore::new(config.max_connections)),
        tls: listeners.tls,
        patience: config.read_timeout,
        max_streams: config.max_streams,
        stop: stop.clone(),
    };
    let own = Connections { permits: Arc::new(Semaphore::new(WORKERS)), tls: None, ..connections.clone() };
    // A stream of gRPC may be silent for as long as its connection answers pings, a body of REST may not.
    let grpc = |services: grpc::Services| services.map_request(|r: Request<Incoming>| r.map(tonic::body::Body::new));
    let services = grpc::services(&app, &health, config.max_message_size, stop.clone());
    let patience = config.read_timeout;
    let router = rest::router(app.clone(), telemetry::render, config.max_message_size);
    let router =
        router.map_request(move |r: Request<Incoming>| r.map(|body| axum::body::Body::new(PromptBody::new(body, patience))));
    let serve_workers =
        own.serve(listeners.workers, Protocol::Grpc, grpc(grpc::worker_services(&app, config.max_message_size, stop.clone())));
    let serve_grpc = connections.clone().serve(listeners.grpc, Protocol::Grpc, grpc(services));
    let serve_rest = connections.serve(listeners.http, Protocol::Http, router);

    let scheduling = tokio::spawn(app.jobs.clone().run(format!("http://{workers}")));
    let housekeeping = tokio::spawn(housekeeping(app.clone(), config.session_ttl.min(config.environment_ttl)));
    let monitoring = tokio::spawn(health.clone().follow(app.clone()));
    let following = tokio::spawn(keys::follow(app.clone()));
    data.publish(endpoints)?;
    tracing::info!(grpc = %endpoints.grpc, http = %endpoints.http, policies = app.registry.len(), "serving");

    let drain = async {
        shutdown.await;
        tracing::info!("draining");
        app.draining.begin();
        health.drain();
        // Workers send their snapshots, so they are waited for while everything still answers.
        app.jobs.drain(config.drain_timeout + Duration::from_secs(5)).await;
        stop.cancel();
        tokio::time::sleep(config.drain_timeout).await;
        tracing::warn!(after = ?config.drain_timeout, "gave up on requests in flight");
    };
    let serve = async { tokio::join!(serve_grpc, serve_rest, serve_workers) };
    tokio::select! {
        _ = serve => {}
        () = drain => {}
    }
    scheduling.abort();
    housekeeping.abort();
    monitoring.abort();
    following.abort();
    keys::keep_last_uses(&app).await;
    data.withdraw();
    tracing::info!("stopped");
    Ok(())
}

/// Most connections of workers: far more than jobs that run at the same time.
const WORKERS: usize = 4096;

/// What has to be done now and then, however quiet it is.
async fn housekeeping(app: Arc<App>, ttl: Duration) {
    let mut sweep = tokio::time::interval((ttl / 4).clamp(Duration::from_secs(1), Duration::from_secs(30)));
    // Times that were recorded wait in memory until they are put into their buckets.
    let mut upkeep = tokio::time::interval(Duration::from_secs(5));
    loop {
        tokio::select! {
            _ = sweep.tick() => {
                app.sessions.sweep();
                app.environments.table().sweep();
            }
            _ = upkeep.tick() => telemetry::metrics().run_upkeep(),
        }
    }
}
