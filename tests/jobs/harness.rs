//! A server in this process, on free ports. The test plays its workers.

use std::net::SocketAddr;
use std::ops::Deref;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use futures::FutureExt;
use futures::future::BoxFuture;
use qedgix::clock::Clock;
use qedgix::config::Config;
use qedgix::draining::Draining;
use qedgix::jobs::{Executor, Launch, Scheduler, SchedulerConfig, WorkerExit};
use qedgix::server::{self, DataDir, Listeners};
use qedgix::service::keys::Keyring;
use qedgix::service::policies::{Loads, Retention, UploadLimit};
use qedgix::service::webhooks::Webhooks;
use qedgix::service::{App, WatchLimit};
use qedgix::serving::{Engine, EngineConfig, Environments, Limits, Sessions};
use qedgix::store::Store;
use qedgix::wire::v1::job_service_client::JobServiceClient;
use qedgix::wire::v1::worker_service_client::WorkerServiceClient;
use serde_json::{Value, json};
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinHandle;
use tonic::metadata::MetadataValue;
use tonic::transport::Channel;

pub use super::process::rest::{Rest, expect};
pub use super::process::{TIMEOUT, within};

/// Most watches of a server in these tests.
pub const MAX_WATCHERS: usize = 4;

/// A worker that the scheduler has started, played by the test.
pub struct Worker {
    pub launch: Launch,
    exit: oneshot::Sender<WorkerExit>,
}

impl Worker {
    /// Ends the process.
    pub fn exit(self, how: &str) {
        self.exit.send(WorkerExit::of_worker(how)).expect("the scheduler waits for the exit");
    }

    /// Waits until the scheduler kills the process.
    pub async fn killed(self) {
        within(self.launch.kill.cancelled()).await;
        self.exit("killed by signal 9");
    }

    pub fn job(&self) -> String {
        self.launch.lease.job_id.to_string()
    }
}

/// Passes every worker to the test.
struct Manual(mpsc::UnboundedSender<Worker>);

impl Executor for Manual {
    fn start(&self, launch: Launch) -> BoxFuture<'_, std::io::Result<BoxFuture<'static, WorkerExit>>> {
        let (exit, ended) = oneshot::channel();
        self.0.send(Worker { launch, exit }).expect("the test receives workers");
        async move { Ok(async move { ended.await.unwrap_or(WorkerExit::of_worker("dropped by the test")) }.boxed()) }.boxed()
    }
}

pub struct Server {
    pub app: Arc<App>,
    pub rest: Rest,
    pub grpc: String,
    pub workers: mpsc::UnboundedReceiver<Worker>,
    running: JoinHandle<()>,
}

impl Deref for Server {
    type Target = Rest;

    fn deref(&self) -> &Rest {
        &self.rest
    }
}

impl Server {
    pub async fn start(data_dir: &Path, cpu_budget: usize) -> Self {
        Self::start_with(data_dir, cpu_budget, |_| {}).await
    }

    pub async fn start_with(data_dir: &Path, cpu_budget: usize, adjust: impl FnOnce(&mut SchedulerConfig)) -> Self {
        Self::start_on(data_dir, cpu_budget, adjust, None).await
    }

    /// With workers of `executor`, or else with workers that the test plays.
    pub async fn start_on(
        data_dir: &Path,
        cpu_budget: usize,
        adjust: impl FnOnce(&mut SchedulerConfig),
        executor: Option<Arc<dyn Executor>>,
    ) -> Self {
        let free = SocketAddr::from(([127, 0, 0, 1], 0));
        let (max_watchers, event_heartbeat) = (MAX_WATCHERS, Duration::from_millis(20));
        let config = Config { grpc_addr: free, http_addr: free, max_watchers, event_heartbeat, ..Config::new(data_dir) };
        let data = DataDir::lock(data_dir).unwrap();
        let listeners = Listeners::bind(&config).await.unwrap();
        let endpoints = listeners.endpoints().unwrap();
        let (sender, workers) = mpsc::unbounded_channel();
        let executor = executor.unwrap_or_else(|| Arc::new(Manual(sender)));
        let store = Store::open(data_dir).await.unwrap();
        let mut scheduler = SchedulerConfig::new(cpu_budget);
        adjust(&mut scheduler);
        let (clock, draining) = (Clock::system(), Draining::default());
        let limits = Limits { ttl: config.session_ttl, max: 1, memory: 1 << 20 };
        let app = Arc::new(App {
            max_message_size: config.max_message_size,
            scheduler: Scheduler::open(store.clone(), scheduler, executor, clock.clone(), draining.clone()).await.unwrap(),
            store,
            registry: Arc::default(),
            loads: Loads::default(),
            replica: None,
            retention: Retention::default(),
            sessions: Sessions::new(limits, clock.clone()),
            absent_after: config.absent_after,
            environments: Environments::new(limits, clock.clone()),
            engine: Engine::start(EngineConfig { threads: 1, queue: 1, max_batch: 1, max_batch_delay: Duration::ZERO }).unwrap(),
            keys: Keyring::new(None),
            uploads: UploadLimit::default(),
            watchers: WatchLimit::new(config.max_watchers, config.event_heartbeat),
            webhooks: Webhooks::new(&["127.0.0.1".to_owned()]).retrying_after(Duration::from_millis(5)),
            clock,
            draining,
        });
        let serving = Arc::clone(&app);
        let running = tokio::spawn(async move {
            server::run(&config, &data, serving, listeners, std::future::pending()).await.unwrap();
        });
        Self {
            app,
            rest: Rest::new(format!("http://{}", endpoints.http)),
            grpc: format!("http://{}", endpoints.grpc),
            workers,
            running,
        }
    }

    /// Ends the server without any clean-up.
    pub async fn crash(&mut self) {
        self.running.abort();
        // The result is that it was aborted.
        let _ = (&mut self.running).await;
    }

    /// The next worker that the scheduler starts.
    pub async fn worker(&mut self) -> Worker {
        within(self.workers.recv()).await.expect("the scheduler lives")
    }

    pub async fn jobs(&self) -> JobServiceClient<Channel> {
        JobServiceClient::connect(self.grpc.clone()).await.unwrap()
    }

    pub async fn worker_client(&self) -> WorkerServiceClient<Channel> {
        WorkerServiceClient::connect(self.grpc.clone()).await.unwrap()
    }
}

/// A job of a second.
pub fn tiny() -> Value {
    json!({
        "algorithm": "vdn",
        "environment": {"slots": 10, "uavs": 2, "users": 2},
        "training": {"steps": 400, "envs": 2, "batch": 2, "buffer": 20, "eval_every": 200, "eval_episodes": 2},
    })
}

/// The tiny job with this name.
pub fn named(name: &str) -> Value {
    with(&json!({"name": name}))
}

/// The tiny job with these fields.
pub fn with(fields: &Value) -> Value {
    let mut job = tiny();
    job.as_object_mut().unwrap().extend(fields.as_object().unwrap().clone());
    job
}

/// A request with the credentials of an attempt.
pub fn signed<T>(launch: &Launch, token: &str, message: T) -> tonic::Request<T> {
    let mut request = tonic::Request::new(message);
    let metadata = request.metadata_mut();
    let text = |text: String| -> MetadataValue<_> { text.parse().unwrap() };
    metadata.insert("qedgix-job", text(launch.lease.job_id.to_string()));
    metadata.insert("qedgix-attempt", text(launch.lease.attempt.to_string()));
    metadata.insert("authorization", text(format!("Bearer {token}")));
    request
}
