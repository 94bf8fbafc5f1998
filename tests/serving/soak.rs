//! Mixed load on the real binary: episodes with calls cancelled, deadlines missed, steps repeated, sessions abandoned, expired
//! and started over, while checkpoints are published, aliases move and policies are unloaded. Every answer is compared, bit
//! for bit, with the policy flown here. A few seconds by default; for longer:
//!
//!     QEDGIX_SOAK_SECONDS=600 cargo test --release --test serving -- soak --nocapture

use std::collections::{BTreeMap, HashMap};
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use bytes::Bytes;
use qedgix::checkpoint::{Checkpoint, digest, layout};
use qedgix::policy::{FleetStep, LearnedPolicy, Policy};
use qedgix::serving::Observation;
use qedgix::train_config::{Algorithm, Preset, TrainConfig};
use qedgix::wire::v1;
use qedgix::wire::v1::act_request::Observation as Sent;
use qedgix::wire::v1::act_result::Result as Told;
use qedgix::wire::v1::policy_service_client::PolicyServiceClient;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use serde_json::{Value, json};
use tokio_stream::wrappers::ReceiverStream;
use tonic::transport::Channel;
use tonic::{Code, Status};

use super::harness::{graph, held, in_session, open, scene};

/// Idle time after which sessions expire.
const TTL: Duration = Duration::from_secs(3);
/// Episodes at the same time.
const PILOTS: u64 = 24;
/// Checkpoints that are published, again and again.
const CHECKPOINTS: u64 = 12;

/// The server's process; killed when dropped.
struct Process {
    child: std::process::Child,
    grpc: String,
    rest: String,
}

impl Process {
    async fn start(dir: &Path) -> Self {
        let child = std::process::Command::new(env!("CARGO_BIN_EXE_qedgix"))
            .args(["serve", "--grpc-addr", "127.0.0.1:0", "--http-addr", "127.0.0.1:0", "--max-sessions", "2000"])
            .args(["--session-ttl", &format!("{}s", TTL.as_secs())])
            .arg("--data-dir")
            .arg(dir)
            .env("QEDGIX_LOG", "error")
            .stdout(std::process::Stdio::null())
            .spawn()
            .unwrap();
        let mut process = Self { child, grpc: String::new(), rest: String::new() };
        let begun = Instant::now();
        let told: Value = loop {
            assert!(begun.elapsed() < Duration::from_secs(60), "the server says where it listens");
            if let Ok(text) = std::fs::read(dir.join("endpoints.json")) {
                break serde_json::from_slice(&text).unwrap();
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        };
        process.grpc = format!("http://{}", told["grpc"].as_str().unwrap());
        process.rest = format!("http://{}", told["http"].as_str().unwrap());
        process
    }

    /// Resident memory in MiB.
    fn memory(&self) -> f64 {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id())).unwrap();
        let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap();
        line.trim().trim_end_matches(" kB").parse::<f64>().unwrap() / 1024.0
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// The policies that may answer, by digest.
struct Truth {
    policies: HashMap<String, Arc<LearnedPolicy>>,
    files: Vec<Vec<u8>>,
}

impl Truth {
    fn new() -> Self {
        let mut truth = Self { policies: HashMap::new(), files: Vec::new() };
        for seed in 0..CHECKPOINTS {
            let algorithm = [Algorithm::Qedgix, Algorithm::Qmix, Algorithm::Rgcn][seed as usize % 3];
            let mut config = TrainConfig::preset(algorithm, Preset::Practical);
            config.environment.reward_scale = Some(1.0);
            let mut rng = qedgix::rng::stream(seed, "soak-weights", 0);
            let weights = (0..layout(&config).len()).map(|_| rng.random_range(-0.3..0.3_f32)).collect();
            let checkpoint = Checkpoint::new(config, seed, None, weights).unwrap();
            let file = checkpoint.to_bytes();
            truth.policies.insert(digest(&file), Arc::new(checkpoint.policy()));
            truth.files.push(file);
        }
        truth
    }
}

/// One episode flown here.
struct Replay {
    policy: Arc<LearnedPolicy>,
    digest: String,
    memory: Vec<f32>,
}

impl Replay {
    fn new(truth: &Truth, digest: &str, (uavs, users): (usize, usize), seed: u64) -> Self {
        let policy = truth.policies[digest].clone();
        let mut memory = vec![0.0; policy.memory_len(uavs, users)];
        policy.start(uavs, users, seed, &mut memory);
        Self { policy, digest: digest.to_owned(), memory }
    }

    /// Flies a slot; what every UAV has to be told.
    fn fly(&mut self, seen: &Sent) -> BTreeMap<String, (u32, Vec<f32>)> {
        let observation = match seen.clone() {
            Sent::Scene(scene) => Observation::try_from(scene).unwrap(),
            Sent::Graph(graph) => Observation::try_from(graph).unwrap(),
        };
        let ids = observation.fleet.uavs.clone();
        let slot = observation.into_slot(&*self.policy).unwrap();
        let actions = self.policy.actions();
        let (mut headings, mut values) = (vec![0; ids.len()], vec![0.0; ids.len() * actions]);
        let (memory, headings_out, q_values) = (&mut self.memory[..], &mut headings[..], Some(&mut values[..]));
        self.policy.act(&mut [FleetStep { slot: &slot, step: 0, memory, headings: headings_out, q_values }]);
        let told = headings.iter().zip(values.chunks_exact(actions)).map(|(&heading, q)| (u32::from(heading), q.to_vec()));
        ids.into_iter().zip(told).collect()
    }
}

/// What happened, by name.
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

/// What goes wrong is told with what it went wrong with.
type Flown = Result<(), String>;

struct Pilot {
    client: PolicyServiceClient<Channel>,
    truth: Arc<Truth>,
    counts: Counts,
    rng: ChaCha8Rng,
    number: u64,
}

fn code(status: &Status) -> &str {
    status.metadata().get("qedgix-code").and_then(|code| code.to_str().ok()).unwrap_or("")
}

fn check(answer: &v1::ActResponse, expected: &BTreeMap<String, (u32, Vec<f32>)>, digest: &str, step: u64) -> Flown {
    let told: BTreeMap<String, (u32, Vec<f32>)> =
        answer.actions.iter().map(|a| (a.uav_id.clone(), (a.heading_index, a.q_values.clone()))).collect();
    let by = answer.policy.as_ref().map_or("", |policy| policy.digest.as_str());
    if told == *expected && by == digest && answer.step == step {
        return Ok(());
    }
    Err(format!("WRONG ANSWER at step {step}: {told:?} of {by}, step {}; expected {expected:?} of {digest}", answer.step))
}

fn unasked(what: &str) -> impl Fn(Status) -> String {
    move |status| format!("{what}: {:?} {} {}", status.code(), code(&status), status.message())
}

impl Pilot {
    fn chance(&mut self, percent: u32) -> bool {
        self.rng.random_range(0..100) < percent
    }

    fn observe(&mut self, (uavs, users): (usize, usize)) -> Sent {
        let scene = scene(uavs, users, self.rng.random());
        if self.chance(50) { Sent::Scene(scene) } else { Sent::Graph(graph(&scene, 0.28, self.rng.random())) }
    }

    async fn fly(&mut self) -> Flown {
        let size = (self.rng.random_range(1..5), self.rng.random_range(1..9));
        if self.chance(25) { self.hold(size).await } else { self.session(size).await }
    }

    /// An episode whose memory this side keeps.
    async fn hold(&mut self, size: (usize, usize)) -> Flown {
        let (seed, slots) = (self.rng.random(), self.rng.random_range(1..30));
        let (mut state, mut replay) = (Bytes::new(), None::<Replay>);
        for step in 0..slots {
            let seen = self.observe(size);
            let mut request = held("soak@live", state.clone(), v1::Scene::default());
            (request.observation, request.return_q_values) = (Some(seen.clone()), true);
            request.seed = (step == 0).then_some(seed);
            if self.chance(10) {
                self.give_up(request.clone()).await;
            }
            let answer = self.client.act(request).await.map_err(unasked("held memory"))?.into_inner();
            let digest = answer.policy.as_ref().map(|policy| policy.digest.clone()).unwrap_or_default();
            let replay = replay.get_or_insert_with(|| Replay::new(&self.truth, &digest, size, seed));
            let expected = replay.fly(&seen);
            check(&answer, &expected, &replay.digest, step)?;
            state = answer.recurrent_state;
            self.counts.add("answers with held memory");
        }
        Ok(())
    }

    /// An episode whose memory the server keeps.
    async fn session(&mut self, size: (usize, usize)) -> Flown {
        self.number += 1;
        let id = format!("s{}", self.number);
        let seed = self.rng.random();
        let mut how = open("soak@live", &id);
        how.seed = Some(seed);
        let opened = self.client.open_session(how).await.map_err(unasked("opening"))?.into_inner();
        let digest = opened.policy.unwrap_or_default().digest;
        let mut replay = Replay::new(&self.truth, &digest, size, seed);
        let mut run = None;
        loop {
            let slots = self.rng.random_range(1..40);
            if self.chance(15) && run.is_none() {
                self.stream(&id, size, slots, &mut replay).await?;
            } else {
                self.slots(&id, size, slots, &mut replay, run.as_deref()).await?;
            }
            if !self.chance(15) {
                break;
            }
            // A simulator that starts over.
            self.counts.add("new runs");
            run = Some(format!("run-{}", self.rng.random::<u32>()));
            replay = Replay::new(&self.truth, &digest, size, seed);
        }
        match self.rng.random_range(0..20) {
            0 => {
                tokio::time::sleep(TTL + TTL / 3).await;
                let late = in_session(&id, None, scene(size.0, size.1, 0));
                match self.client.act(late).await {
                    Err(status) if code(&status) == "session_expired" => self.counts.add("expired sessions"),
                    other => return Err(format!("a session that is idle for too long: {other:?}")),
                }
            }
            1..5 => self.counts.add("abandoned sessions"),
            _ => {
                let close = v1::CloseSessionRequest { session_id: id };
                self.client.close_session(close).await.map_err(unasked("closing"))?;
            }
        }
        Ok(())
    }

    async fn slots(&mut self, id: &str, size: (usize, usize), slots: u64, replay: &mut Replay, run: Option<&str>) -> Flown {
        let mut last = None;
        for step in 0..slots {
            let seen = self.observe(size);
            let mut request = in_session(id, Some(step), v1::Scene::default());
            (request.observation, request.return_q_values) = (Some(seen.clone()), true);
            request.run_id = run.map(str::to_owned);
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
                let malformed = v1::ActRequest { observation: Some(Sent::Scene(far)), ..request.clone() };
                match self.client.act(malformed).await {
                    Err(status) if status.code() == Code::InvalidArgument => self.counts.add("malformed requests"),
                    other => return Err(format!("a malformed request: {other:?}")),
                }
            }
            let expected = replay.fly(&seen);
            if self.chance(10) {
                self.give_up(request.clone()).await;
            }
            if self.chance(10) {
                let mut hasty = tonic::Request::new(request.clone());
                hasty.set_timeout(Duration::from_micros(self.rng.random_range(1..2000)));
                match self.client.act(hasty).await {
                    Ok(answer) => check(answer.get_ref(), &expected, &replay.digest, step)?,
                    Err(status) if matches!(status.code(), Code::DeadlineExceeded | Code::Cancelled) => {
                        self.counts.add("missed deadlines");
                    }
                    Err(status) => return Err(unasked("a short deadline")(status)),
                }
            }
            let sent = Instant::now();
            match self.client.act(request.clone()).await {
                Ok(answer) => check(answer.get_ref(), &expected, &replay.digest, step)?,
                // This machine stood still for longer than a session lives.
                Err(status) if code(&status) == "session_expired" && sent.elapsed() > TTL / 2 => return Ok(()),
                Err(status) => return Err(unasked("a slot")(status)),
            }
            self.counts.add("answers in sessions");
            last = Some((request, expected));
            if let Some((request, expected)) = last.clone().filter(|_| self.chance(5)) {
                let again = self.client.act(request).await.map_err(unasked("a repeated step"))?;
                check(again.get_ref(), &expected, &replay.digest, step)?;
                self.counts.add("repeated steps");
            }
        }
        drop(last);
        Ok(())
    }

    /// Slots over a stream; sometimes it is dropped before all is answered, and the rest asked one by one.
    async fn stream(&mut self, id: &str, size: (usize, usize), slots: u64, replay: &mut Replay) -> Flown {
        let asked: Vec<(v1::ActRequest, _)> = (0..slots)
            .map(|step| {
                let seen = self.observe(size);
                let mut request = in_session(id, Some(step), v1::Scene::default());
                (request.observation, request.return_q_values) = (Some(seen.clone()), true);
                (request, replay.fly(&seen))
            })
            .collect();
        let heard = if self.chance(30) { self.rng.random_range(0..slots) } else { slots };
        let (sender, receiver) = tokio::sync::mpsc::channel(slots as usize);
        for (request, _) in &asked {
            sender.try_send(request.clone()).unwrap();
        }
        drop(sender);
        let answers = self.client.act_stream(ReceiverStream::new(receiver)).await;
        let mut answers = answers.map_err(unasked("a stream"))?.into_inner();
        for (step, (_, expected)) in asked.iter().enumerate().take(heard as usize) {
            let answer = answers.message().await.map_err(unasked("a stream's answer"))?.ok_or("a stream ended early")?;
            match answer.result {
                Some(Told::Response(answer)) => check(&answer, expected, &replay.digest, step as u64)?,
                other => return Err(format!("a stream's answer: {other:?}")),
            }
            self.counts.add("answers of streams");
        }
        drop(answers);
        // The server may have flown further than was heard. What it flew last may be asked again, what comes next may be
        // asked; between the two is nothing.
        let Some((request, expected)) = asked.get(heard as usize) else { return Ok(()) };
        self.counts.add("dropped streams");
        match self.client.act(request.clone()).await {
            Ok(answer) => check(answer.get_ref(), expected, &replay.digest, heard),
            Err(status) if code(&status) == "wrong_step" => Ok(()),
            Err(status) => Err(unasked("after a dropped stream")(status)),
        }
    }

    /// Asks and leaves after a moment.
    async fn give_up(&mut self, request: v1::ActRequest) {
        let patience = Duration::from_micros(self.rng.random_range(0..1000));
        if tokio::time::timeout(patience, self.client.act(request)).await.is_err() {
            self.counts.add("cancelled calls");
        }
    }
}

/// Publishes, moves aliases, unloads and loads, until `end`.
async fn administer(rest: String, truth: Arc<Truth>, counts: Counts, end: Instant) -> Flown {
    let http = reqwest::Client::new();
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
        let which = rng.random_range(0..truth.files.len());
        let published = upload("soak", &truth.files[which]).await?;
        counts.add("published checkpoints");
        let version = published["ref"]["version"].as_u64().ok_or_else(|| format!("no version: {published}"))?;
        let alias = http.put(format!("{rest}/v1/policies/soak/aliases/live")).json(&json!({"version": version}));
        send(alias, "moving an alias").await?;
        counts.add("moved aliases");
        send(http.post(format!("{rest}/v1/policies/spare/unload")), "unloading").await?;
        let gone = http.post(format!("{rest}/v1/sessions")).json(&json!({"policy": "spare"})).send().await;
        let status = gone.map_err(|e| e.to_string())?.status().as_u16();
        if ![404, 409].contains(&status) {
            return Err(format!("a session of an unloaded policy: {status}"));
        }
        send(http.post(format!("{rest}/v1/policies/spare/load")), "loading").await?;
        let there = send(http.post(format!("{rest}/v1/sessions")).json(&json!({"policy": "spare"})), "a loaded policy").await?;
        let id = there["session_id"].as_str().unwrap_or_default();
        send(http.delete(format!("{rest}/v1/sessions/{id}")), "closing").await?;
        counts.add("policies unloaded and loaded");
        tokio::time::sleep(Duration::from_millis(rng.random_range(0..60))).await;
    }
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_answer_is_the_offline_policys_whatever_goes_on() {
    let seconds = std::env::var("QEDGIX_SOAK_SECONDS").map_or(5, |text| text.parse().expect("QEDGIX_SOAK_SECONDS: seconds"));
    let dir = tempfile::tempdir().unwrap();
    let process = Process::start(dir.path()).await;
    let (truth, counts) = (Arc::new(Truth::new()), Counts::default());
    let http = reqwest::Client::new();
    for name in ["soak", "spare"] {
        let upload = http.post(format!("{}/v1/policies/{name}/versions?alias=live", process.rest));
        let upload = upload.header("content-type", "application/octet-stream").body(truth.files[0].clone());
        let response = upload.send().await.unwrap();
        assert!(response.status().is_success(), "{}", response.text().await.unwrap());
    }
    let begun = Instant::now();
    let end = begun + Duration::from_secs(seconds);
    let mut work = tokio::task::JoinSet::new();
    work.spawn(administer(process.rest.clone(), truth.clone(), counts.clone(), end));
    let mut channels = Vec::new();
    for _ in 0..4 {
        channels.push(Channel::from_shared(process.grpc.clone()).unwrap().connect().await.unwrap());
    }
    for pilot in 0..PILOTS {
        let mut pilot = Pilot {
            client: PolicyServiceClient::new(channels[pilot as usize % channels.len()].clone()),
            truth: truth.clone(),
            counts: counts.clone(),
            rng: qedgix::rng::stream(pilot, "soak-pilot", 0),
            number: pilot << 32,
        };
        work.spawn(async move {
            while Instant::now() < end {
                pilot.fly().await?;
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
        assert!(begun.elapsed() < Duration::from_secs(seconds + 120), "everything ends: {} left", work.len());
    }
    for (what, count) in counts.0.lock().unwrap().iter() {
        println!("{count:>10}  {what}");
    }
    println!("resident memory in MiB, second by second: {memory:.1?}");
    assert!(wrong.is_empty(), "{} of {PILOTS} pilots stopped: {wrong:#?}", wrong.len());
    for what in ["answers in sessions", "answers with held memory", "cancelled calls", "moved aliases", "published checkpoints"] {
        assert!(counts.of(what) > 0, "{what}");
    }
    // What fills up in the first minute (buffers, names of expired sessions) is done by then.
    if memory.len() >= 240 {
        let mean = |part: &[f64]| part.iter().sum::<f64>() / part.len() as f64;
        let (early, late) = (mean(&memory[60..120]), mean(&memory[memory.len() - 60..]));
        assert!(late < early * 1.1 + 4.0, "memory grows: {early:.1} MiB, then {late:.1}");
    }
}
