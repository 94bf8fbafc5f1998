//! Listeners, background work, shutdown: one process on one data directory.
//!
//! Shutdown in order: readiness goes off, watchers of health are told and new work is refused; training jobs are snapshotted
//! and queued; streams end and requests in flight are answered; then the listeners are gone and the data directory is free for
//! another server.

use std::fs::{File, TryLockError};
use std::future::Future;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use axum::serve::ListenerExt;
use tokio::net::TcpListener;
use tokio_util::sync::CancellationToken;
use tonic::transport::server::TcpIncoming;

use crate::api::{grpc, rest};
use crate::config::Config;
use crate::invalid::Invalid;
use crate::jobs::{Jobs, LocalProcess, Settings};
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
    /// Policies could not be loaded.
    #[error("loading policies: {0}")]
    Policies(#[source] crate::service::Error),
    /// The system does not tell which program this is, so no worker can be started.
    #[error("finding the program of workers: {0}")]
    Worker(#[source] std::io::Error),
    /// The system refuses a thread.
    #[error("starting the engine: {0}")]
    Engine(#[source] std::io::Error),
    /// The HTTP listener failed.
    #[error("REST: {0}")]
    Rest(#[source] std::io::Error),
    /// The gRPC listener failed.
    #[error("gRPC: {0}")]
    Grpc(#[from] tonic::transport::Error),
}

/// Where a server listens.
#[derive(Debug)]
pub struct Listeners {
    /// gRPC.
    pub grpc: TcpListener,
    /// REST.
    pub http: TcpListener,
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
    /// An address that is taken or not this machine's.
    pub async fn bind(config: &Config) -> Result<Self, Error> {
        let bind = async |addr| TcpListener::bind(addr).await.map_err(|cause| Error::Bind { addr, cause });
        Ok(Self { grpc: bind(config.grpc_addr).await?, http: bind(config.http_addr).await? })
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
    let app = App {
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
    let endpoints = listeners.endpoints().map_err(Error::Rest)?;
    telemetry::metrics();
    let stop = CancellationToken::new();
    let health = grpc::Health::new(stop.clone());
    health.report(operations::vitals(&app).await);

    let serve_grpc = transport()
        .layer(grpc::envelope(stop.clone()))
        .add_routes(grpc::routes(&app, &health, config.max_message_size))
        .serve_with_incoming_shutdown(incoming(listeners.grpc), stop.clone().cancelled_owned());
    let http = listeners.http.tap_io(|stream| {
        // Only latency is lost where it cannot be set.
        let _ = stream.set_nodelay(true);
    });
    let router = rest::router(app.clone(), telemetry::render, config.max_message_size);
    let serve_rest = axum::serve(http, router).with_graceful_shutdown(stop.clone().cancelled_owned());

    let scheduling = tokio::spawn(app.jobs.clone().run(format!("http://{}", from_here(endpoints.grpc))));
    let housekeeping = tokio::spawn(housekeeping(app.clone(), config.session_ttl.min(config.environment_ttl)));
    let monitoring = tokio::spawn(health.clone().follow(app.clone()));
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
    let serve = async {
        tokio::try_join!(async { serve_grpc.await.map_err(Error::from) }, async { serve_rest.await.map_err(Error::Rest) })
    };
    let served = tokio::select! {
        served = serve => served.map(|_| ()),
        () = drain => Ok(()),
    };
    scheduling.abort();
    housekeeping.abort();
    monitoring.abort();
    data.withdraw();
    tracing::info!("stopped");
    served
}

/// What a connection may send before the server has read it, in bytes: a large fleet's observation.
const WINDOW: u32 = 4 << 20;

/// gRPC's transport with this server's settings.
pub fn transport() -> tonic::transport::Server {
    tonic::transport::Server::builder()
        .http2_keepalive_interval(Some(Duration::from_secs(30)))
        .max_concurrent_streams(1024)
        .initial_stream_window_size(WINDOW)
        .initial_connection_window_size(WINDOW)
}

/// Connections of gRPC: nothing waits for a packet to fill.
pub fn incoming(listener: TcpListener) -> TcpIncoming {
    TcpIncoming::from(listener).with_nodelay(Some(true))
}

/// How a process on this machine reaches a listener: one on all addresses is reached on the loopback.
fn from_here(mut addr: SocketAddr) -> SocketAddr {
    if addr.ip().is_unspecified() {
        addr.set_ip(if addr.is_ipv4() { Ipv4Addr::LOCALHOST.into() } else { Ipv6Addr::LOCALHOST.into() });
    }
    addr
}

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
