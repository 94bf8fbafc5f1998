//! Fleets that change: UAVs and users that are new, missing or back. A model with one entry per id predicts the memory of every UAV, and
//! what a session answers is compared, bit for bit, with a replay in which the caller keeps the memory.

use std::collections::BTreeMap;
use std::sync::Arc;

use bytes::Bytes;
use futures::FutureExt;
use proptest::prelude::*;
use proptest::test_runner::TestRunner;
use qedgix::invalid::Invalid;
use qedgix::policy::{Carry, EnvParams, FleetProfile, FleetStep, Identity, Memory, Policy, RequiredInput};
use qedgix::service::keys::Caller;
use qedgix::service::{App, Error, act, sessions};
use qedgix::serving::{FleetInput, SessionOptions};
use qedgix::train_config::{Algorithm, Preset};
use qedgix::wire::v1;
use qedgix::wire::v1::policy_service_client::PolicyServiceClient;
use tonic::Code;
use tonic::transport::Channel;

use super::harness::*;

/// Slots after which the servers of these tests forget.
const ABSENT_AFTER: u64 = 3;

/// Remembers, per UAV, how many slots it flew, and the sum of the AoI of each user. Q-values: the slots, the sum over all users that are
/// remembered, the number of UAVs, and the angle of the UAV.
struct TallyPolicy;

const ACTIONS: usize = 4;

impl Policy for TallyPolicy {
    fn actions(&self) -> usize {
        ACTIONS
    }
    fn needs(&self) -> RequiredInput {
        RequiredInput::Detections
    }
    fn env(&self) -> EnvParams {
        EnvParams::default()
    }
    fn check_fleet(&self, _: usize, _: usize) -> Result<(), Invalid> {
        Ok(())
    }
    fn memory_len(&self, uavs: usize, users: usize) -> usize {
        uavs * (1 + users)
    }
    fn start(&self, _: usize, _: usize, _: u64, memory: &mut [f32]) {
        memory.fill(0.0);
    }
    fn carry(&self, from: &[f32], to: &mut [f32], carry: &Carry<'_>) {
        let (len_from, len_to) = (1 + carry.from.1, 1 + carry.to.1);
        for &(a, b) in carry.uavs {
            let (from, to) = (&from[a as usize * len_from..][..len_from], &mut to[b as usize * len_to..][..len_to]);
            to[0] = from[0];
            carry.users.iter().for_each(|&(a, b)| to[1 + b as usize] = from[1 + a as usize]);
        }
    }
    fn remembers_users(&self) -> bool {
        true
    }
    fn is_cheap(&self) -> bool {
        true
    }
    fn act(&self, turns: &mut [FleetStep<'_>]) {
        for turn in turns {
            let (uavs, users) = (turn.graph.uavs(), turn.graph.users());
            for (i, row) in turn.memory.chunks_exact_mut(1 + users).enumerate() {
                row[0] += 1.0;
                row[1..].iter_mut().zip(turn.graph.aoi()).for_each(|(sum, aoi)| *sum += aoi);
                let angle = FleetProfile::sector(turn.profile, i, uavs).angle as f32;
                if let Some(q) = &mut turn.q_values {
                    q[i * ACTIONS..][..ACTIONS].copy_from_slice(&[row[0], row[1..].iter().sum(), uavs as f32, angle]);
                }
            }
            turn.headings.fill(0);
        }
    }
}

/// What a slot lists: sets of UAVs and users, as bits.
#[derive(Clone, Copy, Debug)]
struct Listing {
    uavs: u8,
    users: u8,
}

#[derive(Clone, Copy, Debug)]
enum Event {
    /// The next step.
    Step(Listing),
    /// The last step, sent again with other measurements.
    Retry,
    /// A next step whose caller gives up at once.
    Cancel(Listing),
    /// The session is idle for too long, and another one continues.
    Expire,
}

fn events() -> impl Strategy<Value = Vec<Event>> {
    // Fleets change by a few members per slot.
    let listing = || (1..32_u8, 0..32_u8).prop_map(|(uavs, users)| Listing { uavs, users });
    let usual = || prop_oneof![3 => Just(Listing { uavs: 0b1_0111, users: 0b1101 }), 2 => listing()];
    let event = prop_oneof![
        12 => usual().prop_map(Event::Step),
        3 => Just(Event::Retry),
        2 => listing().prop_map(Event::Cancel),
        1 => Just(Event::Expire),
    ];
    prop::collection::vec(event, 1..30)
}

/// The scene of a listing in a step: positions and AoI depend on both.
fn listed(listing: Listing, step: u64) -> v1::Scene {
    let mut all = scene(5, 5, step + 1000 * u64::from(listing.uavs));
    let keep = |bits: u8| (0..5).map(move |i| bits >> i & 1 == 1).collect::<Vec<_>>().into_iter();
    let (mut uavs, mut users) = (keep(listing.uavs), keep(listing.users));
    all.uavs.retain(|_| uavs.next().unwrap());
    all.users.retain(|_| users.next().unwrap());
    all
}

/// What the model knows of one UAV.
#[derive(Clone, Debug, Default)]
struct ModelUav {
    seen: u64,
    slots: f32,
    sums: BTreeMap<String, f32>,
    angle: Option<f32>,
}

#[derive(Clone, Default)]
struct Model {
    step: u64,
    uavs: BTreeMap<String, ModelUav>,
    users: BTreeMap<String, u64>,
}

impl Model {
    /// The expected Q-values of each UAV, without the angle.
    fn step(&mut self, scene: &v1::Scene) -> Vec<(String, [f32; 3])> {
        let step = self.step;
        // A member may miss as many slots, and is forgotten in the next one that does not list it.
        let missed = |listed: bool| ABSENT_AFTER + u64::from(listed);
        self.uavs.retain(|id, uav| step - uav.seen <= missed(scene.uavs.iter().any(|listed| listed.id == *id)));
        self.users.retain(|id, seen| step - *seen <= missed(scene.users.iter().any(|listed| listed.id == *id)));
        for user in &scene.users {
            self.users.insert(user.id.clone(), step);
        }
        let known = &self.users;
        for uav in self.uavs.values_mut() {
            uav.sums.retain(|user, _| known.contains_key(user));
        }
        let expected = scene.uavs.iter().map(|listed| {
            let uav = self.uavs.entry(listed.id.clone()).or_default();
            uav.seen = step;
            uav.slots += 1.0;
            for user in &scene.users {
                *uav.sums.entry(user.id.clone()).or_default() += user.aoi as f32;
            }
            (listed.id.clone(), [uav.slots, uav.sums.values().sum(), scene.uavs.len() as f32])
        });
        let expected = expected.collect();
        self.step += 1;
        expected
    }

    /// Checks that a UAV that stays keeps its angle, and that angles differ.
    fn check_angles(&mut self, angles: &[(String, f32)]) {
        for (id, angle) in angles {
            let known = self.uavs.get_mut(id).unwrap();
            let before = known.angle.replace(*angle);
            assert!(before.is_none_or(|before| before.to_bits() == angle.to_bits()), "{id}: {before:?}, then {angle}");
            assert!(angles.iter().all(|(other, same)| other == id || same != angle), "{angles:?}");
        }
    }
}

fn request(policy: Option<&str>, scene: v1::Scene, memory: act::MemoryLocation, step: Option<u64>) -> act::Request {
    let input = FleetInput::try_from(scene).unwrap();
    let policy = policy.map(|policy| policy.parse().unwrap());
    act::Request { policy, input, memory, step, run_id: None, seed: None, flight: None, return_motion: false, explain: false }
}

/// Calls `act`; panics if it has to wait.
async fn act_now(app: &App, request: act::Request) -> Result<act::Response, Error> {
    act::act(app, &Caller::default(), request, None).await
}

/// Ids and Q-values of all UAVs.
fn answered(response: &act::Response) -> Vec<(String, Vec<u32>)> {
    let width = response.policy.implementation.actions();
    let values = response.decision.q_values.chunks_exact(width);
    let heading = |i: usize| u32::from(response.decision.headings[i]);
    let uav =
        |(i, (id, q)): (usize, (&String, &[f32]))| (id.clone(), q.iter().map(|q| q.to_bits()).chain([heading(i)]).collect());
    response.uavs.iter().zip(values).enumerate().map(uav).collect()
}

async fn fly(app: Arc<App>, server: &Server, policy: &str, name: String, events: Vec<Event>, is_tally: bool) {
    let open = async |id: &str| {
        let options = SessionOptions { id: Some(id.into()), seed: Some(9), ..SessionOptions::default() };
        sessions::open(&app, &Caller::default(), &policy.parse().unwrap(), options).await.unwrap();
    };
    let (mut id, mut sessions_opened) = (format!("{name}-0"), 1);
    open(&id).await;
    let (mut model, mut state, mut last) = (Model::default(), Bytes::new(), None::<(Listing, act::Response)>);
    for event in events {
        let session = || act::MemoryLocation::Session(id.clone());
        match event {
            Event::Step(listing) => {
                let scene = listed(listing, model.step);
                let kept = act_now(&app, request(None, scene.clone(), session(), Some(model.step))).await.unwrap();
                let held = act::MemoryLocation::RecurrentState(state.clone());
                let mut replayed = request(Some(policy), scene.clone(), held, Some(model.step));
                replayed.seed = Some(9).filter(|_| model.step == 0);
                let replayed = act_now(&app, replayed).await.unwrap();
                assert_eq!(answered(&kept), answered(&replayed), "{policy}, step {}", model.step);
                state = replayed.recurrent_state.clone().unwrap();
                let expected = model.step(&scene);
                if is_tally {
                    let values = kept.uavs.iter().cloned().zip(kept.decision.q_values.chunks_exact(ACTIONS));
                    let (mut found, mut angles) = (Vec::new(), Vec::new());
                    for (id, q) in values {
                        found.push((id.clone(), [q[0], q[1], q[2]]));
                        angles.push((id, q[3]));
                    }
                    assert_eq!(found, expected);
                    model.check_angles(&angles);
                }
                last = Some((listing, kept));
            }
            Event::Retry => {
                let Some((listing, answer)) = &last else { continue };
                let again = listed(*listing, 77);
                let again = act_now(&app, request(None, again, session(), Some(model.step - 1))).await.unwrap();
                assert_eq!(answered(&again), answered(answer));
            }
            Event::Cancel(listing) => {
                let scene = listed(listing, model.step);
                let (app, caller) = (app.clone(), Caller::default());
                let held = app.sessions.get(caller.owner(), &id).unwrap();
                let ids = FleetInput::try_from(scene).unwrap().fleet;
                let listed = qedgix::serving::Listed { fleet: &ids, users: qedgix::serving::ListedUsers::All };
                drop(held.begin_step(listed, Some(model.step), None, ABSENT_AFTER).now_or_never().unwrap().unwrap());
            }
            Event::Expire => {
                server.advance(601);
                let scene = listed(Listing { uavs: 1, users: 1 }, 0);
                let late = act_now(&app, request(None, scene, session(), None)).await;
                assert_eq!(late.unwrap_err().code().as_str(), "session_expired");
                id = format!("{name}-{sessions_opened}");
                sessions_opened += 1;
                open(&id).await;
                (model, state, last) = (Model::default(), Bytes::new(), None);
            }
        }
    }
}

#[test]
fn changing_fleets_are_those_of_the_model_and_of_a_replay() {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap();
    let server = runtime.block_on(Server::with(|config| config.absent_after = ABSENT_AFTER));
    server.add("tally", 1, Arc::new(TallyPolicy));
    let remembering = super::published::checkpoint_with(Algorithm::Qedgix, Preset::Practical, 5, |training| {
        (training.memory, training.identity) = (Memory::Shared, Identity::Token);
    });
    runtime.block_on(super::published::publish(&server, "remembering", &remembering));
    let mut case = 0;
    let mut runner = TestRunner::new(ProptestConfig { cases: 150, failure_persistence: None, ..ProptestConfig::default() });
    let cell = std::cell::RefCell::new(&mut case);
    runner
        .run(&events(), |events| {
            let mut case = cell.borrow_mut();
            **case += 1;
            for policy in
                ["tally", "remembering", "qedgix", "qmix", "sweep", "sweep-shared", "nearest", "random", "tour", "greedy-global"]
            {
                let name = format!("{policy}-{case}");
                runtime.block_on(fly(server.app.clone(), &server, policy, name, events.clone(), policy == "tally"));
            }
            Ok(())
        })
        .unwrap();
}

/// A session in the unit square, whose scenes list all users.
struct SceneFlight {
    client: PolicyServiceClient<Channel>,
    session: &'static str,
    uavs: BTreeMap<&'static str, [f64; 2]>,
    /// Position and AoI.
    users: BTreeMap<&'static str, ([f64; 2], f64)>,
    slot: u64,
}

impl SceneFlight {
    async fn open(server: &Server, policy: &'static str, uavs: &[&'static str], users: &[(&'static str, [f64; 2])]) -> Self {
        let mut client = server.grpc().await;
        client.open_session(open(policy, policy)).await.unwrap();
        let uavs = uavs.iter().map(|&id| (id, [0.5, 0.5])).collect();
        let users = users.iter().map(|&(id, at)| (id, (at, 0.0))).collect();
        Self { client, session: policy, uavs, users, slot: 0 }
    }

    /// Flies `slots` slots. Returns the highest AoI of any user in these.
    async fn fly(&mut self, slots: u64) -> f64 {
        let mut highest = 0.0_f64;
        for _ in 0..slots {
            let uavs =
                self.uavs.iter().map(|(&id, &[x, y])| v1::SceneUav { id: id.into(), x, y, ..Default::default() }).collect();
            let users =
                self.users.iter().map(|(&id, &([x, y], aoi))| v1::SceneUser { id: id.into(), x, y, aoi, z: None }).collect();
            let request = in_session(self.session, Some(self.slot), v1::Scene { uavs, users });
            let answer = self.client.act(request).await.unwrap().into_inner();
            for (at, action) in self.uavs.values_mut().zip(&answer.actions) {
                let heading = action.heading_deg.unwrap().to_radians();
                *at = [at[0] + 0.04 * heading.cos(), at[1] + 0.04 * heading.sin()].map(|x| x.clamp(0.0, 1.0));
            }
            for (at, aoi) in self.users.values_mut() {
                let collected = self.uavs.values().any(|uav| (uav[0] - at[0]).hypot(uav[1] - at[1]) <= 0.12);
                *aoi = if collected { 0.0 } else { *aoi + 1.0 };
                highest = highest.max(*aoi);
            }
            self.slot += 1;
        }
        highest
    }
}

#[tokio::test]
async fn uavs_search_while_a_scene_lists_users_that_they_do_not_know() {
    let server = Server::start().await;
    let corner = [0.05, 0.05];
    let mut flight = SceneFlight::open(&server, "sweep", &["uav"], &[("near", [0.5, 0.6]), ("left", corner)]).await;
    flight.fly(120).await;
    flight.users.remove("left");
    flight.users.insert("new", (corner, 0.0));
    flight.fly(120).await;
    assert!(flight.users["new"].1 < 60.0);
    flight.users.remove("new");
    flight.fly(90).await;
    assert!(flight.fly(60).await <= 1.0, "the UAV knows all users and leaves them");
}

#[tokio::test]
async fn a_tour_that_is_planned_late_in_an_episode_visits_all_users() {
    let server = Server::start().await;
    let users = [("a", [0.1, 0.9]), ("b", [0.9, 0.9]), ("c", [0.9, 0.1]), ("d", [0.1, 0.1]), ("e", [0.5, 0.95])];
    let mut flight = SceneFlight::open(&server, "tour", &["uav-0", "uav-1", "uav-2"], &users).await;
    flight.fly(70).await;
    flight.uavs.remove("uav-1");
    flight.fly(100).await;
    let highest = flight.fly(200).await;
    assert!(highest < 60.0, "{highest}");
}

/// A graph that lists what a UAV detects.
fn only_detected(scene: &v1::Scene) -> v1::Graph {
    let mut graph = graph(scene, 0.28, false);
    let seen: Vec<String> =
        graph.nodes.iter().flat_map(|node| &node.detections).map(|detection| detection.target_id.clone()).collect();
    graph.nodes.retain(|node| node.kind() == v1::NodeKind::Uav || seen.contains(&node.id));
    graph
}

#[tokio::test]
async fn a_caller_lists_only_what_somebody_detects() {
    let server = Server::start().await;
    let mut client = server.grpc().await;
    for policy in ["qedgix", "qmix", "sweep", "sweep-shared", "nearest", "max-aoi", "persistent", "random"] {
        client.open_session(open(policy, policy)).await.unwrap();
        for step in 0..20 {
            let mut request = in_session(policy, Some(step), v1::Scene::default());
            let mut sent = only_detected(&scene(3, 5, step));
            sent.nodes.retain(|node| !(node.id == "uav-1" && step > 10));
            sent.nodes.iter_mut().for_each(|node| node.detections.retain(|d| !(d.target_id == "uav-1" && step > 10)));
            let uavs = sent.nodes.iter().filter(|node| node.kind() == v1::NodeKind::Uav).count();
            let seen: Vec<String> = sent.nodes.iter().flat_map(|n| &n.detections).map(|d| d.target_id.clone()).collect();
            sent.nodes.retain(|node| node.kind() == v1::NodeKind::Uav || seen.contains(&node.id));
            request.observation = Some(v1::act_request::Observation::Graph(sent));
            let answer = client.act(request).await.unwrap_or_else(|e| panic!("{policy}, step {step}: {e}")).into_inner();
            assert_eq!(answer.actions.len(), uavs);
        }
    }
}

#[tokio::test]
async fn a_policy_with_a_place_for_each_node_says_so() {
    let server = Server::start().await;
    let mut client = server.grpc().await;
    let flat = super::published::checkpoint(Algorithm::Qedgix, Preset::Paper, 7);
    super::published::publish(&server, "flat", &flat).await;
    client.open_session(open("flat", "s")).await.unwrap();
    let first = client.act(held("flat", Bytes::new(), scene(3, 5, 0))).await.unwrap().into_inner();
    client.act(in_session("s", None, scene(3, 5, 0))).await.unwrap();
    for (uavs, users, field) in [(2, 5, "uavs"), (4, 5, "uavs"), (3, 4, "users"), (3, 6, "users")] {
        let (code, _, found) = refused(client.act(in_session("s", None, scene(uavs, users, 1))).await);
        assert_eq!((code, found.as_str()), (Code::InvalidArgument, field), "{uavs} UAVs, {users} users");
    }
    let mut other = scene(3, 5, 1);
    other.uavs[1].id = "another".into();
    assert_invalid(client.act(in_session("s", None, other.clone())).await, "uavs", "\"another\" instead of \"uav-1\"");
    assert_invalid(client.act(held("flat", first.recurrent_state, other)).await, "uavs", "3 uavs with other ids");
    client.act(in_session("s", Some(1), scene(3, 5, 1))).await.unwrap();
}

/// A simulator as people have them: 3 km by 2 km in metres, three speeds, errors of 5 m, a UAV that is lost, a user that appears and one that
/// leaves. It lists only what a UAV detects.
struct MetricSimulator {
    uavs: Vec<(&'static str, [f64; 2], f64)>,
    users: Vec<(String, [f64; 2], f64)>,
    time: f64,
    rng: rand_chacha::ChaCha8Rng,
    exact: bool,
}

const SLOT: f64 = 8.0;
const AREA: [f64; 2] = [3000.0, 2000.0];

impl MetricSimulator {
    fn new(exact: bool) -> Self {
        let mut rng = qedgix::rng::stream(1, "metric-simulator", 0);
        let users = (0..5).map(|j| (format!("sensor-{j}"), AREA.map(|side| rng.random_range(0.0..side)), 0.0)).collect();
        let uavs = [("drone-0", 12.0), ("drone-1", 15.0), ("drone-2", 20.0)];
        Self { uavs: uavs.map(|(id, speed)| (id, [1500.0, 1000.0], speed)).to_vec(), users, time: 0.0, rng, exact }
    }

    fn open(policy: &str) -> v1::OpenSessionRequest {
        let frame = v1::Frame { width: Some(AREA[0]), height: Some(AREA[1]), ..Default::default() };
        let world = v1::World {
            slot_seconds: Some(SLOT),
            speed: Some(15.0),
            transmission_range: Some(360.0),
            detection_range: Some(840.0),
            ..Default::default()
        };
        v1::OpenSessionRequest { policy: policy.into(), frame: Some(frame), world: Some(world), ..Default::default() }
    }

    fn noisy(&mut self, [x, y]: [f64; 2]) -> [f64; 2] {
        let mut error = || if self.exact { 0.0 } else { self.rng.random_range(-8.0..8.0) };
        [x + error(), y + error()]
    }

    fn graph(&mut self, one_sided: bool) -> v1::Graph {
        let (uavs, users, time) = (self.uavs.clone(), self.users.clone(), self.time);
        let apart = |a: [f64; 2], b: [f64; 2]| (a[0] - b[0]).hypot(a[1] - b[1]);
        let seen: Vec<usize> =
            (0..users.len()).filter(|&j| uavs.iter().any(|(_, at, _)| apart(*at, users[j].1) <= 840.0)).collect();
        let mut nodes = Vec::new();
        for (i, (id, at, speed)) in uavs.iter().enumerate() {
            let mut node =
                v1::Node { id: (*id).into(), kind: v1::NodeKind::Uav.into(), speed: Some(*speed), ..Default::default() };
            let [x, y] = self.noisy(*at);
            node.position = Some(v1::Position { x, y, z: Some(120.0) });
            let others = uavs.iter().enumerate().filter(|(k, _)| if one_sided { i < *k } else { i != *k });
            let others = others.map(|(_, (id, to, _))| ((*id).to_owned(), *to, None));
            let sensors = seen.iter().map(|&j| (users[j].0.clone(), users[j].1, Some((time - users[j].2) / SLOT)));
            for (target_id, to, aoi) in others.chain(sensors).filter(|(_, to, _)| apart(*at, *to) <= 840.0) {
                let [rel_x, rel_y] = self.noisy([to[0] - at[0], to[1] - at[1]]);
                node.detections.push(v1::Detection { target_id, rel_x, rel_y, aoi, rel_z: Some(-120.0) });
            }
            nodes.push(node);
        }
        let kind = v1::NodeKind::User.into();
        nodes.extend(seen.iter().map(|&j| v1::Node { id: users[j].0.clone(), kind, ..Default::default() }));
        v1::Graph { nodes }
    }

    fn scene(&mut self) -> v1::Scene {
        let (uavs, users, time) = (self.uavs.clone(), self.users.clone(), self.time);
        let uav = |(id, at, speed): (&str, [f64; 2], f64)| {
            let [x, y] = self.noisy(at);
            v1::SceneUav { id: id.into(), x, y, z: None, speed: Some(speed), ..Default::default() }
        };
        let uavs = uavs.into_iter().map(uav).collect();
        let user = |(id, at, last): (String, [f64; 2], f64)| {
            let [x, y] = self.noisy(at);
            v1::SceneUser { id, x, y, aoi: (time - last) / SLOT, z: None }
        };
        v1::Scene { uavs, users: users.into_iter().map(user).collect() }
    }

    /// Flies every UAV for a slot, and checks the answer. Returns the mean AoI in seconds.
    fn fly(&mut self, answer: &v1::ActResponse) -> f64 {
        assert_eq!(answer.actions.len(), self.uavs.len());
        for (uav, action) in self.uavs.iter_mut().zip(&answer.actions) {
            let heading = action.heading_deg.unwrap().to_radians();
            let velocity = action.velocity.unwrap();
            assert!((velocity.x - uav.2 * heading.cos()).abs() < 1e-9 && (velocity.y - uav.2 * heading.sin()).abs() < 1e-9);
            let to = action.waypoint.unwrap();
            let flown = [uav.1[0] + SLOT * velocity.x, uav.1[1] + SLOT * velocity.y];
            uav.1 = [flown[0].clamp(0.0, AREA[0]), flown[1].clamp(0.0, AREA[1])];
            assert!((uav.1[0] - to.x).abs() <= 8.001 && (uav.1[1] - to.y).abs() <= 8.001, "{:?}, waypoint {to:?}", uav.1);
        }
        self.time += SLOT;
        for (_, at, last) in &mut self.users {
            if self.uavs.iter().any(|(_, uav, _)| (uav[0] - at[0]).hypot(uav[1] - at[1]) <= 360.0) {
                *last = self.time;
            }
        }
        self.users.iter().map(|(_, _, last)| self.time - last).sum::<f64>() / self.users.len() as f64
    }
}

#[tokio::test]
async fn a_simulator_in_metres_gets_every_slot_answered() {
    let server = Server::start().await;
    let mut client = server.grpc().await;
    for policy in ["qedgix", "qmix", "sweep", "nearest"] {
        let mut means = Vec::new();
        for mode in ["exact", "graph", "one-sided", "scene"] {
            let session = client.open_session(MetricSimulator::open(policy)).await.unwrap().into_inner();
            // 120 m per slot are 0.04 of 3 km, as in training; the area is no square.
            assert_eq!(session.warnings.iter().map(|warning| warning.field.as_str()).collect::<Vec<_>>(), ["frame"]);
            let mut simulator = MetricSimulator::new(mode == "exact");
            let mut sum = 0.0;
            for step in 0..80 {
                match simulator.time as u64 {
                    304 => drop(simulator.uavs.remove(1)),
                    200 => simulator.users.push(("sensor-late".into(), [400.0, 400.0], 200.0)),
                    504 => drop(simulator.users.remove(2)),
                    _ => {}
                }
                let observation = if mode == "scene" {
                    v1::act_request::Observation::Scene(simulator.scene())
                } else {
                    v1::act_request::Observation::Graph(simulator.graph(mode == "one-sided"))
                };
                let request = v1::ActRequest {
                    observation: Some(observation),
                    memory: Some(v1::act_request::Memory::SessionId(session.session_id.clone())),
                    step: Some(step),
                    return_velocity: true,
                    return_waypoint: true,
                    ..Default::default()
                };
                let answer =
                    client.act(request).await.unwrap_or_else(|e| panic!("{policy}, {mode}, step {step}: {e}")).into_inner();
                sum += simulator.fly(&answer);
            }
            means.push(sum / 80.0);
        }
        println!("{policy}: mean AoI {means:.0?} s (exact, graph, one-sided, scene)");
    }
}

#[tokio::test]
async fn coordinates_in_other_units_need_a_frame() {
    let server = Server::start().await;
    let mut client = server.grpc().await;
    let mut metres = scene(3, 5, 0);
    metres.uavs.iter_mut().for_each(|uav| (uav.x, uav.y) = (uav.x * 3000.0, uav.y * 3000.0));
    metres.users.iter_mut().for_each(|user| (user.x, user.y) = (user.x * 3000.0, user.y * 3000.0));
    assert_invalid(
        client.act(held("sweep", Bytes::new(), metres.clone())).await,
        "scene.uavs[0].x",
        &metres.uavs[0].x.to_string(),
    );
    let framed = |frame: v1::Frame| v1::ActRequest { frame: Some(frame), ..held("sweep", Bytes::new(), metres.clone()) };
    let square = v1::Frame { side: Some(3000.0), ..Default::default() };
    let plain = client.act(held("sweep", Bytes::new(), scene(3, 5, 0))).await.unwrap().into_inner();
    let answer = client.act(framed(square)).await.unwrap().into_inner();
    assert_eq!(headings(&answer), headings(&plain), "the same place in other units");
    // The same area, seen from axes that are turned.
    let turned = |(x, y): (f64, f64)| (-y + 100.0, x - 50.0);
    let mut other = metres.clone();
    other.uavs.iter_mut().for_each(|uav| (uav.x, uav.y) = turned((uav.x, uav.y)));
    other.users.iter_mut().for_each(|user| (user.x, user.y) = turned((user.x, user.y)));
    let origin = Some(v1::Position { x: 100.0, y: -50.0, z: None });
    let frame = v1::Frame { side: Some(3000.0), origin, rotation_deg: 90.0, ..Default::default() };
    let request = v1::ActRequest { frame: Some(frame), ..held("sweep", Bytes::new(), other) };
    let rotated = client.act(request).await.unwrap().into_inner();
    for (a, b) in plain.actions.iter().zip(&rotated.actions) {
        assert_eq!((a.heading_index, a.heading_deg.map(|deg| (deg + 90.0) % 360.0)), (b.heading_index, b.heading_deg));
    }
    for (frame, field) in [
        (v1::Frame::default(), "frame.side"),
        (v1::Frame { width: Some(1.0), ..Default::default() }, "frame.height"),
        (v1::Frame { side: Some(f64::NAN), ..Default::default() }, "frame.side"),
        (v1::Frame { side: Some(0.0), ..Default::default() }, "frame.side"),
        (v1::Frame { side: Some(3000.0), width: Some(3000.0), ..Default::default() }, "frame.width"),
        (v1::Frame { side: Some(3000.0), height: Some(2000.0), ..Default::default() }, "frame.height"),
        (v1::Frame { side: Some(3000.0), rotation_deg: 1e9, ..Default::default() }, "frame.rotation_deg"),
        (v1::Frame { side: Some(30.0), ..Default::default() }, "frame"),
    ] {
        let (code, _, found) = refused(client.act(framed(frame)).await);
        assert_eq!((code, found.as_str()), (Code::InvalidArgument, field), "{frame:?}");
    }
    let world = |world: v1::World| v1::OpenSessionRequest { world: Some(world), ..open("sweep", "s") };
    for (of, field) in [
        (v1::World { speed: Some(2.0), ..Default::default() }, "world.speed"),
        (v1::World { slot_seconds: Some(0.0), ..Default::default() }, "world.slot_seconds"),
        (v1::World { detection_range: Some(0.1), ..Default::default() }, "world.detection_range"),
        (v1::World { slots: Some(0), ..Default::default() }, "world.slots"),
        (v1::World { boundary: 7, ..Default::default() }, "world.boundary"),
    ] {
        let (code, _, found) = refused(client.open_session(world(of)).await);
        assert_eq!((code, found.as_str()), (Code::InvalidArgument, field));
    }
    let slow = v1::World { speed: Some(0.01), ..Default::default() };
    let session = client.open_session(world(slow)).await.unwrap().into_inner();
    assert_eq!(session.warnings.iter().map(|warning| warning.field.as_str()).collect::<Vec<_>>(), ["world.speed"]);
    let (code, reason, _) = refused(client.open_session(open("sweep", "s")).await);
    assert_eq!((code, reason.as_str()), (Code::AlreadyExists, "already_exists"), "another world is another session");
    let framed = v1::ActRequest { symmetric: Some(true), ..in_session("s", None, scene(3, 5, 0)) };
    assert_invalid(client.act(framed).await, "symmetric", "a value");
    let policy = client.get_policy(v1::GetPolicyRequest { policy: "qedgix".into() }).await.unwrap().into_inner();
    let of = policy.world.unwrap();
    assert_eq!((of.speed, of.detection_range, of.slots, of.boundary()), (Some(0.04), Some(0.28), Some(80), v1::Boundary::Clamp));
}
