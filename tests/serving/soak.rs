//! Mixed load on the real binary: cancelled calls, missed deadlines, repeated steps, abandoned, expired and restarted sessions,
//! while checkpoints are published, aliases move and policies are unloaded. Every response is compared, bit for bit, with the
//! policy computed in this process. Once without API keys and TLS, and once with both. Each takes a few seconds by default; for
//! longer:
//!
//!     QEDGIX_SOAK_SECONDS=600 cargo test --release --test serving -- soak --nocapture

use std::collections::{BTreeMap, HashMap};
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use bytes::Bytes;
use qedgix::checkpoint::{Checkpoint, digest, parameter_layout};
use qedgix::policy::{FleetProfile, FleetStep, LearnedPolicy, Policy, UserCount};
use qedgix::serving::{FleetInput, ListedUsers};
use qedgix::train_config::{Algorithm, Preset, TrainConfig};
use qedgix::wire::v1;
use qedgix::wire::v1::act_request::Observation as WireObservation;
use qedgix::wire::v1::act_result::Result as SlotResult;
use qedgix::wire::v1::policy_service_client::PolicyServiceClient;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use serde_json::{Value, json};
use tokio_stream::wrappers::ReceiverStream;
use tonic::metadata::{Ascii, MetadataValue};
use tonic::service::Interceptor;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::Channel;
use tonic::{Code, Status};

use super::certificates::{self, Authority};
use super::harness::{graph, held, in_session, install_tls_provider, open, scene};
use super::process::{self, Process};

/// Idle time after which sessions expire.
const TTL: Duration = Duration::from_secs(3);
/// Concurrent callers.
const CALLERS: u64 = 24;
/// Connections that the callers share.
const CONNECTIONS: usize = 4;
/// Different checkpoints to publish, repeatedly.
const CHECKPOINTS: u64 = 12;

/// How callers reach the server.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Access {
    /// Without API keys and TLS.
    Open,
    /// Each caller with an API key, over TLS.
    KeysAndTls,
}

/// Adds the API key to every call, if there is one.
#[derive(Clone)]
struct Signed(Option<MetadataValue<Ascii>>);

impl Interceptor for Signed {
    fn call(&mut self, mut request: tonic::Request<()>) -> Result<tonic::Request<()>, Status> {
        if let Some(key) = &self.0 {
            request.metadata_mut().insert("authorization", key.clone());
        }
        Ok(request)
    }
}

type Client = PolicyServiceClient<InterceptedService<Channel, Signed>>;

/// The server, and how it is reached.
struct Subject {
    process: Process,
    rest: String,
    http: reqwest::Client,
    /// One client per connection.
    clients: Vec<Client>,
}

impl Subject {
    async fn start(dir: &Path, access: Access) -> Self {
        install_tls_provider();
        let mut command = process::serve(dir);
        command.args(["--max-sessions", "2000", "--session-ttl", &format!("{}s", TTL.as_secs())]).env("QEDGIX_LOG", "error");
        if access == Access::Open {
            let process = Process::start(command).await;
            let mut clients = Vec::new();
            for _ in 0..CONNECTIONS {
                let channel = Channel::from_shared(format!("http://{}", process.grpc)).unwrap().connect().await.unwrap();
                clients.push(PolicyServiceClient::with_interceptor(channel, Signed(None)));
            }
            return Self { rest: format!("http://{}", process.http), process, http: reqwest::Client::new(), clients };
        }
        let authority = Authority::new("soak");
        let files = certificates::write(dir, &authority.issue(), None);
        command.arg("--tls-cert").arg(files.cert).arg("--tls-key").arg(files.key);
        let bearer = |scopes| format!("Bearer {}", process::create_key(dir, scopes));
        let (admin, keys) = (bearer("admin"), [(); CONNECTIONS].map(|()| bearer("act")));
        let process = Process::start(command).await;
        let mut clients = Vec::new();
        for key in keys {
            let channel = certificates::channel(&certificates::caller(&authority, None), &process.grpc).await.unwrap();
            clients.push(PolicyServiceClient::with_interceptor(channel, Signed(Some(key.parse().unwrap()))));
        }
        let headers = [(reqwest::header::AUTHORIZATION, admin.parse().unwrap())].into_iter().collect();
        let trusted = reqwest::Certificate::from_pem(authority.pem().as_bytes()).unwrap();
        let http = reqwest::Client::builder().default_headers(headers).tls_certs_only([trusted]).build().unwrap();
        Self { rest: format!("https://{}", process.http), process, http, clients }
    }
}

/// The policies of all checkpoints, by digest, and the checkpoint files.
struct Policies {
    by_digest: HashMap<String, Arc<LearnedPolicy>>,
    files: Vec<Vec<u8>>,
}

impl Policies {
    fn new() -> Self {
        let mut all = Self { by_digest: HashMap::new(), files: Vec::new() };
        for seed in 0..CHECKPOINTS {
            let algorithm = [Algorithm::Qedgix, Algorithm::Qmix, Algorithm::Rgcn][seed as usize % 3];
            let mut config = TrainConfig::preset(algorithm, Preset::Practical);
            config.environment.reward_scale = Some(1.0);
            let mut rng = qedgix::rng::stream(seed, "soak-weights", 0);
            let weights = (0..parameter_layout(&config).len()).map(|_| rng.random_range(-0.3..0.3_f32)).collect();
            let checkpoint = Checkpoint::new(config, seed, None, weights).unwrap();
            let file = checkpoint.to_bytes();
            all.by_digest.insert(digest(&file), Arc::new(checkpoint.policy()));
            all.files.push(file);
        }
        all
    }
}

/// The policy of one episode, computed in this process.
struct Reference {
    policy: Arc<LearnedPolicy>,
    digest: String,
    step: u64,
    /// The first graph listed only users that a UAV detected.
    open: bool,
    memory: Vec<f32>,
}

impl Reference {
    fn new(policies: &Policies, digest: &str, (uavs, users): (usize, usize), seed: u64) -> Self {
        let policy = policies.by_digest[digest].clone();
        let mut memory = vec![0.0; policy.memory_len(uavs, users)];
        policy.start(uavs, users, seed, &mut memory);
        Self { policy, digest: digest.to_owned(), step: 0, open: false, memory }
    }

    /// The expected heading and Q-values of every UAV in the next slot.
    fn decide(&mut self, observation: &WireObservation) -> BTreeMap<String, (u32, Vec<f32>)> {
        let observation = match observation.clone() {
            WireObservation::Scene(scene) => FleetInput::try_from(scene).unwrap(),
            WireObservation::Graph(graph) => FleetInput::try_from(graph).unwrap(),
        };
        let listed = observation.content.listed_users();
        if self.step == 0 {
            self.open = listed == ListedUsers::Detected;
        }
        let users = match listed {
            _ if !self.open => UserCount::Fixed,
            ListedUsers::All => UserCount::Listed(observation.fleet.users.len()),
            _ => UserCount::Unknown,
        };
        let profile = FleetProfile { users, ..FleetProfile::default() };
        let ids = observation.fleet.uavs.clone();
        let slot = observation.into_fleet_graph(&*self.policy).unwrap();
        let actions = self.policy.actions();
        let (mut headings, mut values) = (vec![0; ids.len()], vec![0.0; ids.len() * actions]);
        let (memory, headings_out, q_values) = (&mut self.memory[..], &mut headings[..], Some(&mut values[..]));
        self.policy.act(&mut [FleetStep {
            env: self.policy.env(),
            graph: &slot,
            profile: Some(&profile),
            step: self.step,
            memory,
            headings: headings_out,
            q_values,
        }]);
        self.step += 1;
        let decisions = headings.iter().zip(values.chunks_exact(actions)).map(|(&heading, q)| (u32::from(heading), q.to_vec()));
        ids.into_iter().zip(decisions).collect()
    }
}

/// Numbers of events, by name.
#[derive(Clone, Default)]
struct Counts(Arc<Mutex<BTreeMap<&'static str, u64>>>);

impl Counts {
    fn add(&self, what: &'static str) {
        *self.0.lock().unwrap().entry(what).or_default() += 1;
    }

    fn of(&self, what: &str) -> u64 {
        self.0.lock().unwrap().get(what).copied().unwrap_or(0)
    }
}

/// The error describes the first response that is not as expected.
type CheckResult = Result<(), String>;

/// One caller, which runs episodes one after another.
struct SoakCaller {
    client: Client,
    policies: Arc<Policies>,
    counts: Counts,
    rng: ChaCha8Rng,
    /// Number of the last session; the upper half identifies the caller.
    sessions: u64,
}

/// The request for slot `step` of session `id`.
fn slot(id: &str, run: Option<&str>, step: u64, observation: &WireObservation) -> v1::ActRequest {
    let request = in_session(id, Some(step), v1::Scene::default());
    let (observation, run_id) = (Some(observation.clone()), run.map(str::to_owned));
    v1::ActRequest { observation, run_id, return_q_values: true, ..request }
}

fn code(status: &Status) -> &str {
    status.metadata().get("qedgix-code").and_then(|code| code.to_str().ok()).unwrap_or("")
}

fn check(answer: &v1::ActResponse, expected: &BTreeMap<String, (u32, Vec<f32>)>, digest: &str, step: u64) -> CheckResult {
    let received: BTreeMap<String, (u32, Vec<f32>)> =
        answer.actions.iter().map(|a| (a.uav_id.clone(), (a.heading_index, a.q_values.clone()))).collect();
    let by = answer.policy.as_ref().map_or("", |policy| policy.digest.as_str());
    if received == *expected && by == digest && answer.step == step {
        return Ok(());
    }
    Err(format!("wrong response at step {step}: {received:?} of {by}, step {}; expected {expected:?} of {digest}", answer.step))
}

fn unexpected(what: &str) -> impl Fn(Status) -> String {
    move |status| format!("{what}: {:?} {} {}", status.code(), code(&status), status.message())
}

impl SoakCaller {
    fn chance(&mut self, percent: u32) -> bool {
        self.rng.random_range(0..100) < percent
    }

    fn observe(&mut self, (uavs, users): (usize, usize)) -> WireObservation {
        let scene = scene(uavs, users, self.rng.random());
        if self.chance(50) {
            WireObservation::Scene(scene)
        } else {
            WireObservation::Graph(graph(&scene, 0.28, self.rng.random()))
        }
    }

    async fn run_episode(&mut self) -> CheckResult {
        let size = (self.rng.random_range(1..5), self.rng.random_range(1..9));
        if self.chance(25) { self.stateless_episode(size).await } else { self.session_episode(size).await }
    }

    /// An episode whose memory the caller keeps.
    async fn stateless_episode(&mut self, size: (usize, usize)) -> CheckResult {
        let (seed, slots) = (self.rng.random(), self.rng.random_range(1..30));
        let (mut state, mut reference) = (Bytes::new(), None::<Reference>);
        for step in 0..slots {
            let observation = self.observe(size);
            let mut request = held("soak@live", state.clone(), v1::Scene::default());
            (request.observation, request.return_q_values) = (Some(observation.clone()), true);
            request.seed = (step == 0).then_some(seed);
            if self.chance(10) {
                self.cancel(request.clone()).await;
            }
            let answer = self.client.act(request).await.map_err(unexpected("recurrent_state"))?.into_inner();
            let digest = answer.policy.as_ref().map(|policy| policy.digest.clone()).unwrap_or_default();
            let reference = reference.get_or_insert_with(|| Reference::new(&self.policies, &digest, size, seed));
            let expected = reference.decide(&observation);
            check(&answer, &expected, &reference.digest, step)?;
            state = answer.recurrent_state;
            self.counts.add("responses with recurrent_state");
        }
        Ok(())
    }

    /// An episode whose memory the server keeps.
    async fn session_episode(&mut self, size: (usize, usize)) -> CheckResult {
        self.sessions += 1;
        let id = format!("s{}", self.sessions);
        let seed = self.rng.random();
        let mut request = open("soak@live", &id);
        request.seed = Some(seed);
        let opened = self.client.open_session(request).await.map_err(unexpected("opening"))?.into_inner();
        let digest = opened.policy.unwrap_or_default().digest;
        let mut reference = Reference::new(&self.policies, &digest, size, seed);
        // A request without a run id continues the run that is current when it arrives: a cancelled one could arrive in the next run. So
        // callers that have several runs name all of them.
        let mut run = self.chance(50).then(|| "run".to_owned());
        let mut streams = true;
        loop {
            let slots = self.rng.random_range(1..40);
            if self.chance(15) && streams {
                self.stream(&id, size, slots, &mut reference, run.as_deref()).await?;
            } else {
                self.slots(&id, size, slots, &mut reference, run.as_deref()).await?;
            }
            if run.is_none() || !self.chance(30) {
                break;
            }
            streams = false;
            // Like a simulator that restarts.
            self.counts.add("new runs");
            run = Some(format!("run-{}", self.rng.random::<u32>()));
            reference = Reference::new(&self.policies, &digest, size, seed);
        }
        match self.rng.random_range(0..20) {
            0 => {
                tokio::time::sleep(TTL + TTL / 3).await;
                let late = in_session(&id, None, scene(size.0, size.1, 0));
                match self.client.act(late).await {
                    Err(status) if code(&status) == "session_expired" => self.counts.add("expired sessions"),
                    other => return Err(format!("a session after its time to live: {other:?}")),
                }
            }
            1..5 => self.counts.add("abandoned sessions"),
            _ => {
                let close = v1::CloseSessionRequest { session_id: id };
                self.client.close_session(close).await.map_err(unexpected("closing"))?;
            }
        }
        Ok(())
    }

    async fn slots(
        &mut self,
        id: &str,
        size: (usize, usize),
        slots: u64,
        reference: &mut Reference,
        run: Option<&str>,
    ) -> CheckResult {
        for step in 0..slots {
            let observation = self.observe(size);
            let request = slot(id, run, step, &observation);
            if self.chance(3) {
                let wrong = v1::ActRequest { step: Some(step + 7), ..request.clone() };
                match self.client.act(wrong).await {
                    Err(status) if code(&status) == "wrong_step" => self.counts.add("wrong steps"),
                    other => return Err(format!("a step that does not follow: {other:?}")),
                }
            }
            if self.chance(2) {
                let mut far = scene(size.0, size.1, 0);
                far.uavs[0].x = f64::NAN;
                let malformed = v1::ActRequest { observation: Some(WireObservation::Scene(far)), ..request.clone() };
                match self.client.act(malformed).await {
                    Err(status) if status.code() == Code::InvalidArgument => self.counts.add("malformed requests"),
                    other => return Err(format!("a malformed request: {other:?}")),
                }
            }
            let expected = reference.decide(&observation);
            if self.chance(10) {
                self.cancel(request.clone()).await;
            }
            if self.chance(10) {
                let mut urgent = tonic::Request::new(request.clone());
                urgent.set_timeout(Duration::from_micros(self.rng.random_range(1..2000)));
                match self.client.act(urgent).await {
                    Ok(answer) => check(answer.get_ref(), &expected, &reference.digest, step)?,
                    Err(status) if matches!(status.code(), Code::DeadlineExceeded | Code::Cancelled) => {
                        self.counts.add("missed deadlines");
                    }
                    // The queue cannot reach it in time.
                    Err(status) if code(&status) == "resource_exhausted" => self.counts.add("deadlines refused at once"),
                    Err(status) => return Err(unexpected("a short deadline")(status)),
                }
            }
            let sent = Instant::now();
            match self.client.act(request.clone()).await {
                Ok(answer) => check(answer.get_ref(), &expected, &reference.digest, step)?,
                // The machine was suspended for longer than the time to live.
                Err(status) if code(&status) == "session_expired" && sent.elapsed() > TTL / 2 => return Ok(()),
                Err(status) => return Err(unexpected("a slot")(status)),
            }
            self.counts.add("responses in sessions");
            if self.chance(5) {
                let again = self.client.act(request).await.map_err(unexpected("a repeated step"))?;
                check(again.get_ref(), &expected, &reference.digest, step)?;
                self.counts.add("repeated steps");
            }
        }
        Ok(())
    }

    /// Slots over a stream, which is sometimes dropped before all responses have arrived.
    async fn stream(
        &mut self,
        id: &str,
        size: (usize, usize),
        slots: u64,
        reference: &mut Reference,
        run: Option<&str>,
    ) -> CheckResult {
        let requests: Vec<(v1::ActRequest, _)> = (0..slots)
            .map(|step| {
                let observation = self.observe(size);
                (slot(id, run, step, &observation), reference.decide(&observation))
            })
            .collect();
        let received = if self.chance(30) { self.rng.random_range(0..slots) } else { slots };
        let (sender, receiver) = tokio::sync::mpsc::channel(slots as usize);
        for (request, _) in &requests {
            sender.try_send(request.clone()).unwrap();
        }
        drop(sender);
        let answers = self.client.act_stream(ReceiverStream::new(receiver)).await;
        let mut answers = answers.map_err(unexpected("a stream"))?.into_inner();
        for (step, (_, expected)) in requests.iter().enumerate().take(received as usize) {
            let answer = answers.message().await.map_err(unexpected("a stream's response"))?.ok_or("a stream ended early")?;
            match answer.result {
                Some(SlotResult::Response(answer)) => check(&answer, expected, &reference.digest, step as u64)?,
                other => return Err(format!("a stream's response: {other:?}")),
            }
            self.counts.add("responses of streams");
        }
        drop(answers);
        // The server may have computed more slots than were received. It accepts its last step and the next one.
        let Some((request, expected)) = requests.get(received as usize) else { return Ok(()) };
        self.counts.add("dropped streams");
        match self.client.act(request.clone()).await {
            Ok(answer) => check(answer.get_ref(), expected, &reference.digest, received),
            Err(status) if code(&status) == "wrong_step" => Ok(()),
            Err(status) => Err(unexpected("after a dropped stream")(status)),
        }
    }

    /// Sends a request and cancels it after a random time.
    async fn cancel(&mut self, request: v1::ActRequest) {
        let timeout = Duration::from_micros(self.rng.random_range(0..1000));
        if tokio::time::timeout(timeout, self.client.act(request)).await.is_err() {
            self.counts.add("cancelled calls");
        }
    }
}

/// Publishes, moves aliases, unloads and loads, until `end`.
async fn administer(http: reqwest::Client, rest: String, policies: Arc<Policies>, counts: Counts, end: Instant) -> CheckResult {
    let send = async |request: reqwest::RequestBuilder, what: &str| -> Result<Value, String> {
        let response = request.send().await.map_err(|e| format!("{what}: {e}"))?;
        let (status, text) = (response.status(), response.text().await.map_err(|e| format!("{what}: {e}"))?);
        if status.is_success() { Ok(serde_json::from_str(&text).unwrap_or_default()) } else { Err(format!("{what}: {text}")) }
    };
    let upload = async |name: &str, file: &[u8]| {
        let request = http.post(format!("{rest}/v1/policies/{name}/versions"));
        send(request.header("content-type", "application/octet-stream").body(file.to_vec()), "publishing").await
    };
    let mut rng = qedgix::rng::stream(7, "soak-admin", 0);
    while Instant::now() < end {
        let which = rng.random_range(0..policies.files.len());
        let published = upload("soak", &policies.files[which]).await?;
        counts.add("published checkpoints");
        let version = published["ref"]["version"].as_u64().ok_or_else(|| format!("no version: {published}"))?;
        let alias = http.put(format!("{rest}/v1/policies/soak/aliases/live")).json(&json!({"version": version}));
        send(alias, "moving an alias").await?;
        counts.add("moved aliases");
        send(http.post(format!("{rest}/v1/policies/spare/unload")), "unloading").await?;
        let rejected = http.post(format!("{rest}/v1/sessions")).json(&json!({"policy": "spare"})).send().await;
        let status = rejected.map_err(|e| e.to_string())?.status().as_u16();
        if ![404, 409].contains(&status) {
            return Err(format!("a session of an unloaded policy: {status}"));
        }
        send(http.post(format!("{rest}/v1/policies/spare/load")), "loading").await?;
        let opened = send(http.post(format!("{rest}/v1/sessions")).json(&json!({"policy": "spare"})), "a loaded policy").await?;
        let id = opened["session_id"].as_str().unwrap_or_default();
        send(http.delete(format!("{rest}/v1/sessions/{id}")), "closing").await?;
        counts.add("policies unloaded and loaded");
        tokio::time::sleep(Duration::from_millis(rng.random_range(0..60))).await;
    }
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn all_responses_match_the_policy_under_mixed_load() {
    soak(Access::Open).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn all_responses_match_the_policy_under_mixed_load_with_keys_and_tls() {
    soak(Access::KeysAndTls).await;
}

async fn soak(access: Access) {
    let seconds = std::env::var("QEDGIX_SOAK_SECONDS").map_or(5, |text| text.parse().expect("QEDGIX_SOAK_SECONDS: seconds"));
    let dir = tempfile::tempdir().unwrap();
    let Subject { process, rest, http, clients } = Subject::start(dir.path(), access).await;
    let (policies, counts) = (Arc::new(Policies::new()), Counts::default());
    for name in ["soak", "spare"] {
        let upload = http.post(format!("{rest}/v1/policies/{name}/versions?alias=live"));
        let upload = upload.header("content-type", "application/octet-stream").body(policies.files[0].clone());
        let response = upload.send().await.unwrap();
        assert!(response.status().is_success(), "{}", response.text().await.unwrap());
    }
    let started = Instant::now();
    let end = started + Duration::from_secs(seconds);
    let mut work = tokio::task::JoinSet::new();
    work.spawn(administer(http, rest, policies.clone(), counts.clone(), end));
    for number in 0..CALLERS {
        let mut caller = SoakCaller {
            client: clients[number as usize % clients.len()].clone(),
            policies: policies.clone(),
            counts: counts.clone(),
            rng: qedgix::rng::stream(number, "soak-caller", 0),
            sessions: number << 32,
        };
        work.spawn(async move {
            while Instant::now() < end {
                caller.run_episode().await?;
            }
            Ok(())
        });
    }
    let mut memory = Vec::new();
    let mut wrong = Vec::new();
    while !work.is_empty() {
        tokio::select! {
            Some(done) = work.join_next() => wrong.extend(done.unwrap().err()),
            () = tokio::time::sleep(Duration::from_secs(1)) => memory.push(process.memory()),
        }
        assert!(started.elapsed() < Duration::from_secs(seconds + 120), "all callers stop: {} left", work.len());
    }
    for (what, count) in counts.0.lock().unwrap().iter() {
        println!("{count:>10}  {what}");
    }
    println!("resident memory in MiB, second by second: {memory:.1?}");
    assert!(wrong.is_empty(), "{} of {CALLERS} callers failed: {wrong:#?}", wrong.len());
    for what in
        ["responses in sessions", "responses with recurrent_state", "cancelled calls", "moved aliases", "published checkpoints"]
    {
        assert!(counts.of(what) > 0, "{what}");
    }
    // Buffers and names of expired sessions fill up in the first minute.
    if memory.len() >= 240 {
        let mean = |part: &[f64]| part.iter().sum::<f64>() / part.len() as f64;
        let (early, late) = (mean(&memory[60..120]), mean(&memory[memory.len() - 60..]));
        assert!(late < early * 1.1 + 4.0, "memory grows: {early:.1} MiB, then {late:.1}");
    }
}
