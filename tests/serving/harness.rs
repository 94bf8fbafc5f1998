//! A server in this process with a manual clock, policies that wait or panic, and requests to send.

use std::collections::HashMap;
use std::future::Future;
use std::sync::{Arc, Condvar, Mutex};
use std::time::Duration;

use jiff::Timestamp;
use qedgix::clock::ManualClock;
use qedgix::config::Config;
use qedgix::env::Point;
use qedgix::invalid::Invalid;
use qedgix::policy::{FleetStep, Policy, RequiredInput};
use qedgix::server::{self, DataDir, Endpoints, Listeners};
use qedgix::service::App;
use qedgix::serving::{LoadedPolicy, PolicyRef};
use qedgix::wire::v1;
use qedgix::wire::v1::policy_service_client::PolicyServiceClient;
use rand::RngExt;
use tokio::sync::oneshot;
use tokio::task::JoinHandle;
use tonic::transport::Channel;
use tonic::{Code, Status};
use tonic_types::StatusExt;

/// Installs a TLS provider, which `reqwest` requires even for plain HTTP. Further calls have no effect.
pub fn install_tls_provider() {
    let _ = rustls::crypto::ring::default_provider().install_default();
}

pub struct Server {
    pub app: Arc<App>,
    pub endpoints: Endpoints,
    pub dir: tempfile::TempDir,
    pub time: ManualClock,
    stop: Option<oneshot::Sender<()>>,
    running: JoinHandle<Result<(), server::Error>>,
}

impl Server {
    pub async fn start() -> Self {
        Self::with(|_| {}).await
    }

    pub async fn with(change: impl FnOnce(&mut Config)) -> Self {
        Self::on(tempfile::tempdir().unwrap(), change).await
    }

    /// Waits until the server has stopped, and starts another one on its data directory.
    pub async fn restarted(self) -> Self {
        self.running.await.unwrap().unwrap();
        drop(self.app);
        Self::on(self.dir, |_| {}).await
    }

    /// Starts a server on an existing data directory.
    pub async fn on(dir: tempfile::TempDir, change: impl FnOnce(&mut Config)) -> Self {
        install_tls_provider();
        let mut config = Config::new(dir.path());
        config.grpc_addr.set_port(0);
        config.http_addr.set_port(0);
        change(&mut config);
        let time = ManualClock::new(Timestamp::UNIX_EPOCH);
        let data = DataDir::lock(dir.path()).unwrap();
        let listeners = Listeners::bind(&config).await.unwrap();
        let endpoints = listeners.endpoints().unwrap();
        let app = server::open(&config, &data, time.clock()).await.unwrap();
        let (stop, stopped) = oneshot::channel();
        let shared = app.clone();
        let running = tokio::spawn(async move {
            let shutdown = async {
                let _ = stopped.await;
            };
            server::run(&config, &data, shared, listeners, shutdown).await
        });
        Self { app, endpoints, dir, time, stop: Some(stop), running }
    }

    pub fn advance(&self, seconds: u64) {
        self.time.advance(Duration::from_secs(seconds));
    }

    pub async fn channel(&self) -> Channel {
        Channel::from_shared(format!("http://{}", self.endpoints.grpc)).unwrap().connect().await.unwrap()
    }

    pub async fn grpc(&self) -> PolicyServiceClient<Channel> {
        PolicyServiceClient::new(self.channel().await)
    }

    pub fn url(&self, path: &str) -> String {
        format!("http://{}{path}", self.endpoints.http)
    }

    pub fn begin_stop(&mut self) {
        self.stop.take().unwrap().send(()).unwrap();
    }

    /// Waits until the server has stopped, and keeps its data directory.
    pub async fn ended(&mut self) {
        (&mut self.running).await.unwrap().unwrap();
    }

    pub async fn stopped(self) {
        self.running.await.unwrap().unwrap();
    }

    /// Adds a policy called `name`.
    pub fn add(&self, name: &str, version: u64, policy: Arc<dyn Policy>) {
        let reference = PolicyRef { name: name.into(), version, digest: [version as u8; 32] };
        self.app.registry.insert(LoadedPolicy::baseline(reference, "policy of a test", policy, Timestamp::UNIX_EPOCH));
    }
}

/// A policy for tests.
pub enum TestPolicy {
    /// Decides heading (seed + slot) mod 9, with the Q-values 0, 1, ...
    Count,
    /// Panics.
    Panic,
    /// Decides like `Count`, and panics when constraints change a heading.
    PanicOverruled,
    /// Waits until the gate is open, then decides like `Count`.
    Wait(Arc<Gate>),
}

/// Blocks policies until the test opens it.
#[derive(Default)]
pub struct Gate {
    /// Number of policies that have reached the gate, and whether it is open.
    state: Mutex<(usize, bool)>,
    changed: Condvar,
}

impl Gate {
    pub fn open(&self) {
        self.state.lock().unwrap().1 = true;
        self.changed.notify_all();
    }

    /// Waits until `calls` calls of policies have reached the gate.
    pub async fn reached(self: &Arc<Self>, calls: usize) {
        let gate = self.clone();
        let wait = move || drop(gate.changed.wait_while(gate.state.lock().unwrap(), |s| s.0 < calls).unwrap());
        tokio::task::spawn_blocking(wait).await.unwrap();
    }

    fn pass(&self) {
        let mut state = self.state.lock().unwrap();
        state.0 += 1;
        self.changed.notify_all();
        drop(self.changed.wait_while(state, |s| !s.1).unwrap());
    }
}

impl Policy for TestPolicy {
    fn actions(&self) -> usize {
        9
    }
    fn needs(&self) -> RequiredInput {
        RequiredInput::OwnPositions
    }
    fn env(&self) -> qedgix::policy::EnvParams {
        qedgix::policy::EnvParams::default()
    }
    fn check_fleet(&self, uavs: usize, _: usize) -> Result<(), Invalid> {
        if uavs <= 3 { Ok(()) } else { Err(Invalid::new("uavs", uavs, "at most 3")) }
    }
    fn memory_len(&self, _: usize, _: usize) -> usize {
        1
    }
    fn start(&self, _: usize, _: usize, seed: u64, memory: &mut [f32]) {
        memory[0] = (seed % 9) as f32;
    }
    fn overrule(&self, _: &mut [f32], _: usize, _: u8) {
        assert!(!matches!(self, Self::PanicOverruled), "a policy of the tests panics");
    }
    fn act(&self, turns: &mut [FleetStep<'_>]) {
        match self {
            Self::Count | Self::PanicOverruled => {}
            Self::Panic => panic!("a policy of the tests panics"),
            Self::Wait(gate) => gate.pass(),
        }
        for turn in turns {
            turn.headings.fill(turn.memory[0] as u8 % 9);
            turn.memory[0] += 1.0;
            if let Some(q) = &mut turn.q_values {
                q.iter_mut().enumerate().for_each(|(i, q)| *q = i as f32);
            }
        }
    }
}

/// A random scene of `uavs` UAVs and `users` users.
pub fn scene(uavs: usize, users: usize, seed: u64) -> v1::Scene {
    let mut rng = qedgix::rng::stream(seed, "test-scene", 0);
    v1::Scene {
        uavs: (0..uavs)
            .map(|i| v1::SceneUav { id: format!("uav-{i}"), x: rng.random(), y: rng.random(), ..Default::default() })
            .collect(),
        users: (0..users)
            .map(|j| v1::SceneUser {
                id: format!("user-{j}"),
                x: rng.random(),
                y: rng.random(),
                aoi: f64::from(rng.random_range(0..80_u32)),
                z: None,
            })
            .collect(),
    }
}

/// The graph of a scene: detections within `range`. The detections of users are left out unless `of_users`.
pub fn graph(scene: &v1::Scene, range: f64, of_users: bool) -> v1::Graph {
    let uavs = scene.uavs.iter().map(|u| (u.id.clone(), [u.x, u.y], None));
    let all: Vec<(String, Point, Option<f64>)> =
        uavs.chain(scene.users.iter().map(|u| (u.id.clone(), [u.x, u.y], Some(u.aoi)))).collect();
    let nodes = all.iter().map(|(id, at, aoi)| {
        let detections =
            all.iter().filter(|(other, _, _)| other != id && (aoi.is_none() || of_users)).filter_map(|(target, p, aoi)| {
                let (x, y) = (p[0] - at[0], p[1] - at[1]);
                let within = x * x + y * y <= range * range;
                within.then(|| v1::Detection { target_id: target.clone(), rel_x: x, rel_y: y, aoi: *aoi, rel_z: None })
            });
        v1::Node {
            id: id.clone(),
            kind: if aoi.is_none() { v1::NodeKind::Uav.into() } else { v1::NodeKind::User.into() },
            detections: detections.collect(),
            position: aoi.is_none().then_some(v1::Position { x: at[0], y: at[1], z: None }),
            aoi: *aoi,
            ..Default::default()
        }
    });
    v1::Graph { nodes: nodes.collect() }
}

/// A request with memory in a session.
pub fn in_session(id: &str, step: Option<u64>, scene: v1::Scene) -> v1::ActRequest {
    v1::ActRequest {
        observation: Some(v1::act_request::Observation::Scene(scene)),
        memory: Some(v1::act_request::Memory::SessionId(id.into())),
        step,
        ..Default::default()
    }
}

/// A request with memory that the caller keeps.
pub fn held(policy: &str, state: bytes::Bytes, scene: v1::Scene) -> v1::ActRequest {
    v1::ActRequest {
        policy: policy.into(),
        observation: Some(v1::act_request::Observation::Scene(scene)),
        memory: Some(v1::act_request::Memory::RecurrentState(state)),
        ..Default::default()
    }
}

/// A request to open session `id`, with seed 0.
pub fn open(policy: &str, id: &str) -> v1::OpenSessionRequest {
    v1::OpenSessionRequest { policy: policy.into(), session_id: id.into(), run_id: None, seed: Some(0), ..Default::default() }
}

/// Heading index of each UAV by id.
pub fn headings(answer: &v1::ActResponse) -> HashMap<String, u32> {
    answer.actions.iter().map(|a| (a.uav_id.clone(), a.heading_index)).collect()
}

/// The gRPC status of an error, its code, and the field that is not accepted (empty if the error is about no field).
pub fn refused<T>(response: Result<tonic::Response<T>, Status>) -> (Code, String, String) {
    let status = response.map(|_| ()).expect_err("the request must be refused");
    let code = status.metadata().get("qedgix-code").map_or("", |code| code.to_str().unwrap()).to_owned();
    let details = status.get_error_details();
    if let Some(info) = details.error_info() {
        assert_eq!((info.reason.to_lowercase(), info.domain.as_str()), (code.clone(), "qedgix"));
    }
    let field = details.bad_request().map(|request| request.field_violations[0].field.clone());
    (status.code(), code, field.unwrap_or_default())
}

/// Checks that the request is refused with `invalid_argument` because `field` has a value that starts with `value`; an empty
/// `value` means that the field is missing.
#[track_caller]
pub fn assert_invalid<T>(response: Result<tonic::Response<T>, Status>, field: &str, value: &str) {
    let status = response.map(|_| ()).expect_err("the request must be refused");
    let details = status.get_error_details();
    let received = details.error_info().and_then(|info| info.metadata.get("value")).cloned().unwrap_or_default();
    assert!(received.starts_with(value) && value.is_empty() == received.is_empty(), "{value:?}: {status:?}");
    let (grpc, code, found) = refused::<()>(Err(status));
    assert_eq!((grpc, found.as_str()), (Code::InvalidArgument, field));
    assert!(code == "invalid_argument" || code == "invalid_schema", "{code}");
}

/// Fails if `future` does not complete within a minute.
pub async fn with_timeout<T>(future: impl Future<Output = T>) -> T {
    tokio::time::timeout(Duration::from_secs(60), future).await.expect("completes within a minute")
}

/// The hosts of a server on loopback.
pub fn localhost() -> qedgix::api::AllowedHosts {
    qedgix::api::AllowedHosts::new(std::net::Ipv4Addr::LOCALHOST.into(), &[])
}
