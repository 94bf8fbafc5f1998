//! Each UAV decides alone: with `Encode` and `Decide`, messages and its own state, it takes the actions of the joint `Act`.

use bytes::Bytes;
use qedgix::env::{BatchEnv, EnvConfig, Point, points};
use qedgix::learner::layout_list;
use qedgix::policy::baselines::by_name;
use qedgix::policy::{EnvParams, Policy, Reach};
use qedgix::serving::bundled::BUNDLED;
use qedgix::serving::decentral::audit::audit;
use qedgix::wire::v1;
use qedgix::wire::v1::policy_service_client::PolicyServiceClient;
use rand::RngExt;
use sha2::{Digest, Sha256};
use tonic::Code;
use tonic::transport::Channel;

use crate::harness::{Server, assert_invalid, graph, open, refused};

const DETECTION_RANGE: f64 = 0.28;

fn bundled(name: &str) -> impl Policy {
    let (_, bytes) = BUNDLED.iter().find(|(bundled, _)| *bundled == name).unwrap();
    qedgix::checkpoint::Checkpoint::from_bytes(bytes).unwrap().policy()
}

#[test]
fn alone_uavs_decide_with_the_bits_of_the_joint_policy_on_256_layouts() {
    let env = EnvConfig { slots: 24, ..EnvConfig::default() };
    let seeds = layout_list("valid-v1").unwrap().seeds(256);
    for (name, links) in [("qmix", 1), ("qedgix", 3), ("qedgix-onboard", 3), ("qedgix-paper", 3)] {
        let result = audit(&bundled(name), &env, &seeds, 2).unwrap();
        assert!(result.passed(), "{name}: {result:?}");
        assert_eq!((result.reach, result.decisions), (Reach::Links(links), 256 * 24 * 3));
        // Without messages it would not: the test can fail.
        assert!(result.trials[0].equal < result.decisions);
    }
}

#[test]
fn larger_fleets_and_rules_pass_or_fail_by_what_they_need() {
    let seeds = layout_list("valid-v1").unwrap().seeds(4);
    let env = EnvConfig { uavs: 7, users: 12, slots: 30, communication_range: Some(0.15), ..EnvConfig::default() };
    for name in ["qmix", "qedgix"] {
        assert!(audit(&bundled(name), &env, &seeds, 1).unwrap().passed(), "{name}");
    }
    let rule = |name: &str| by_name(name, EnvParams::from(&env)).unwrap();
    for (name, passes) in [("random", true), ("sweep", true), ("sweep-shared", true), ("nearest", false)] {
        assert_eq!(audit(&*rule(name), &env, &seeds, 1).unwrap().passed(), passes, "{name}");
    }
    for name in ["tour", "greedy-global"] {
        assert_eq!(audit(&*rule(name), &env, &seeds, 1).unwrap_err().field, "policy", "{name}");
    }
}

/// A fleet that flies over gRPC.
struct Fleet {
    client: PolicyServiceClient<Channel>,
    policy: &'static str,
    env: BatchEnv,
    /// What each UAV keeps between calls.
    states: Vec<Bytes>,
}

impl Fleet {
    async fn start(server: &Server, policy: &'static str, seed: u64) -> Self {
        let config = EnvConfig::default();
        let mut env = BatchEnv::new(&config, 1).unwrap();
        env.reset(&[seed]);
        Self { client: server.grpc().await, policy, env, states: vec![Bytes::new(); config.uavs] }
    }

    fn graph(&self) -> v1::Graph {
        let uavs: Vec<Point> = points(self.env.uav_xy()).collect();
        let users: Vec<Point> = points(self.env.user_xy()).collect();
        let uav = |(i, [x, y]): (usize, &Point)| v1::SceneUav { id: format!("uav-{i}"), x: *x, y: *y, ..Default::default() };
        let user = |(j, ([x, y], aoi)): (usize, (&Point, &f32))| v1::SceneUser {
            id: format!("user-{j}"),
            x: *x,
            y: *y,
            aoi: f64::from(*aoi),
            z: None,
        };
        let scene = v1::Scene {
            uavs: uavs.iter().enumerate().map(uav).collect(),
            users: users.iter().zip(self.env.aoi()).enumerate().map(user).collect(),
        };
        graph(&scene, DETECTION_RANGE, false)
    }

    fn encode(&self, i: usize) -> v1::EncodeRequest {
        let graph = self.graph();
        let begins = self.states[i].is_empty();
        let ids = |kind: v1::NodeKind| {
            let of_kind = graph.nodes.iter().filter(|node| begins && node.kind == i32::from(kind));
            of_kind.map(|node| node.id.clone()).collect()
        };
        v1::EncodeRequest {
            policy: self.policy.into(),
            uav_ids: ids(v1::NodeKind::Uav),
            user_ids: ids(v1::NodeKind::User),
            observation: Some(graph.nodes[i].clone()),
            state: self.states[i].clone(),
            seed: begins.then_some(5),
            ..Default::default()
        }
    }

    fn decide(&self, state: &Bytes, messages: Vec<Bytes>) -> v1::DecideRequest {
        v1::DecideRequest {
            policy: self.policy.into(),
            state: state.clone(),
            messages,
            return_q_values: true,
            ..Default::default()
        }
    }

    /// One slot, in which every UAV hears those within the range that it asks for.
    async fn slot(&mut self) -> Vec<v1::Action> {
        let mut encoded = Vec::new();
        for i in 0..self.states.len() {
            let request = self.encode(i);
            let first = self.client.encode(request.clone()).await.unwrap().into_inner();
            // A UAV that restarts before it has decided gets the same again.
            assert_eq!(self.client.encode(request).await.unwrap().into_inner(), first);
            encoded.push(first);
        }
        let at: Vec<Point> = points(self.env.uav_xy()).collect();
        let mut actions = Vec::new();
        for i in 0..self.states.len() {
            let range = encoded[i].message_range.unwrap();
            let near = |k: &usize| (at[*k][0] - at[i][0]).hypot(at[*k][1] - at[i][1]) <= range;
            // The own message and repeated ones have no effect, and neither has the order.
            let mut messages: Vec<Bytes> = (0..at.len()).filter(near).map(|k| encoded[k].message.clone()).collect();
            messages.reverse();
            messages.extend(messages.first().cloned());
            let request = self.decide(&encoded[i].state, messages);
            let decided = self.client.decide(request.clone()).await.unwrap().into_inner();
            assert_eq!(self.client.decide(request).await.unwrap().into_inner(), decided);
            assert!(decided.missing_uav_ids.is_empty());
            actions.push(decided.action.unwrap());
            self.states[i] = decided.state;
        }
        actions
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_fleet_without_a_centre_flies_as_one_with_a_session() {
    let server = Server::start().await;
    for (policy, seed) in [("qedgix", 1), ("qedgix-paper", 2), ("qmix", 3), ("sweep-shared", 4)] {
        let mut fleet = Fleet::start(&server, policy, 20_000 + seed).await;
        let session = v1::OpenSessionRequest { seed: Some(5), ..open(policy, policy) };
        fleet.client.open_session(session).await.unwrap();
        for step in 0..20 {
            let request = v1::ActRequest {
                observation: Some(v1::act_request::Observation::Graph(fleet.graph())),
                memory: Some(v1::act_request::Memory::SessionId(policy.into())),
                step: Some(step),
                return_q_values: true,
                ..Default::default()
            };
            let joint = fleet.client.act(request).await.unwrap().into_inner().actions;
            let alone = fleet.slot().await;
            assert_eq!(alone, joint, "{policy}, step {step}");
            fleet.env.step(&joint.iter().map(|action| action.heading_index as u8).collect::<Vec<_>>());
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn lost_messages_are_named_and_wrong_ones_refused() {
    let server = Server::start().await;
    let mut fleet = Fleet::start(&server, "qedgix", 20_000).await;
    let encoded = fleet.client.encode(fleet.encode(0)).await.unwrap().into_inner();
    let other = fleet.client.encode(fleet.encode(1)).await.unwrap().into_inner();
    assert_eq!((encoded.message_links, encoded.step), (Some(3), 0));
    // All start at one place, so each UAV detects the others.
    let decided = fleet.client.decide(fleet.decide(&encoded.state, vec![other.message.clone()])).await.unwrap().into_inner();
    assert_eq!(decided.missing_uav_ids, ["uav-2"]);

    let mut client = fleet.client.clone();
    let mut damaged = other.message.to_vec();
    damaged[30] ^= 1;
    let size = format!("{} bytes", damaged.len());
    assert_invalid(client.decide(fleet.decide(&encoded.state, vec![damaged.into()])).await, "messages[0]", &size);
    fleet.states[0] = decided.state.clone();
    let next = client.encode(fleet.encode(0)).await.unwrap().into_inner();
    assert_invalid(
        client.decide(fleet.decide(&next.state, vec![other.message.clone()])).await,
        "messages[0]",
        "a message of step 0",
    );
    let foreign = v1::EncodeRequest { seed: Some(6), ..Fleet::start(&server, "qedgix", 20_000).await.encode(1) };
    let foreign = client.encode(foreign).await.unwrap().into_inner();
    assert_invalid(
        client.decide(fleet.decide(&encoded.state, vec![foreign.message])).await,
        "messages[0]",
        "a message of another",
    );

    // States of the wrong half of a slot, of another UAV, step or policy.
    assert_invalid(client.decide(fleet.decide(&decided.state, vec![])).await, "state", "a state after Decide");
    let with_state = |state: &Bytes| v1::EncodeRequest { state: state.clone(), ..fleet.encode(0) };
    assert_invalid(client.encode(with_state(&encoded.state)).await, "state", "a state after Encode");
    assert_invalid(client.encode(with_state(&decided.state.slice(..40))).await, "state", "40 bytes");
    let of_other = v1::EncodeRequest { state: decided.state.clone(), ..fleet.encode(1) };
    let of_other = v1::EncodeRequest { uav_ids: vec![], user_ids: vec![], seed: None, ..of_other };
    assert_invalid(client.encode(of_other).await, "observation.id", "\"uav-1\"");
    let late = v1::EncodeRequest { step: Some(7), ..with_state(&decided.state) };
    assert_eq!(refused(client.encode(late).await).1, "wrong_step");
    let other_policy = v1::EncodeRequest { policy: "qmix".into(), ..with_state(&decided.state) };
    assert_invalid(client.encode(other_policy).await, "state", "the state of another policy");
}

/// `body` with a valid checksum.
fn sealed(mut body: Vec<u8>) -> Bytes {
    let sum = Sha256::digest(&body);
    body.extend_from_slice(&sum[..8]);
    body.into()
}

#[tokio::test(flavor = "multi_thread")]
async fn forged_states_and_messages_are_refused_or_used_and_never_panic() {
    let server = Server::start().await;
    let fleet = Fleet::start(&server, "qedgix", 20_000).await;
    let mut client = fleet.client.clone();
    let encoded = client.encode(fleet.encode(0)).await.unwrap().into_inner();
    let message = client.encode(fleet.encode(1)).await.unwrap().into_inner().message;
    let mut rng = qedgix::rng::stream(3, "forged", 0);
    let mut forge = |bytes: &Bytes| {
        let mut body = bytes[..bytes.len() - 8].to_vec();
        for _ in 0..rng.random_range(1..4_u32) {
            let at = rng.random_range(5..body.len());
            body[at] = if rng.random_bool(0.3) { u8::MAX } else { rng.random() };
        }
        body.truncate(if rng.random_bool(0.2) { rng.random_range(5..body.len()) } else { body.len() });
        sealed(body)
    };
    for _ in 0..400 {
        for request in
            [fleet.decide(&forge(&encoded.state), vec![message.clone()]), fleet.decide(&encoded.state, vec![forge(&message)])]
        {
            if let Err(status) = client.decide(request).await {
                assert_eq!(status.code(), Code::InvalidArgument, "{status:?}");
            }
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn observations_are_checked() {
    let server = Server::start().await;
    let fleet = Fleet::start(&server, "qedgix", 20_000).await;
    let mut client = fleet.client.clone();
    let first = fleet.encode(0);
    let observed = |change: &dyn Fn(&mut v1::Node)| {
        let mut request = first.clone();
        change(request.observation.as_mut().unwrap());
        request
    };
    for (request, field, value) in [
        (v1::EncodeRequest { policy: "tour".into(), ..first.clone() }, "policy", "a policy with full information"),
        (v1::EncodeRequest { observation: None, ..first.clone() }, "observation", ""),
        (v1::EncodeRequest { uav_ids: vec![], ..first.clone() }, "uav_ids", "no UAV"),
        (v1::EncodeRequest { uav_ids: vec!["uav-0".into(); 2], ..first.clone() }, "uav_ids[1]", "\"uav-0\""),
        (v1::EncodeRequest { user_ids: vec!["uav-0".into()], ..first.clone() }, "user_ids[0]", "\"uav-0\""),
        (observed(&|node| node.id = "uav-9".into()), "observation.id", "\"uav-9\""),
        (observed(&|node| node.kind = 2), "observation.kind", "a user"),
        (observed(&|node| node.position = None), "observation.position", ""),
        (observed(&|node| node.position.as_mut().unwrap().x = f64::NAN), "observation.position.x", "NaN"),
        (observed(&|node| node.position.as_mut().unwrap().x = 700.0), "observation.position.x", "700"),
        (observed(&|node| node.detections[0].target_id = "x".into()), "observation.detections[0].target_id", "\"x\""),
        (observed(&|node| node.detections[0].rel_x = 40.0), "observation.detections[0].rel_x", "(40"),
        (observed(&|node| node.detections[0].aoi = Some(1.0)), "observation.detections[0].aoi", "1"),
    ] {
        assert_invalid(client.encode(request).await, field, value);
    }
    let many = v1::EncodeRequest { user_ids: (0..300).map(|j| format!("u{j}")).collect(), ..first.clone() };
    let many = v1::EncodeRequest {
        uav_ids: (0..4000).map(|i| format!("uav-{i}")).collect(),
        observation: Some(v1::Node { detections: vec![], ..first.observation.clone().unwrap() }),
        ..many
    };
    assert_invalid(client.encode(many).await, "uav_ids", "4000 UAVs");
    let unknown = v1::EncodeRequest { policy: "nobody".into(), ..first };
    assert_eq!(refused(client.encode(unknown).await).0, Code::NotFound);
}

#[tokio::test(flavor = "multi_thread")]
async fn metres_go_in_and_out() {
    let server = Server::start().await;
    let fleet = Fleet::start(&server, "qmix", 20_000).await;
    let mut client = fleet.client.clone();
    let frame = v1::Frame { side: Some(1000.0), ..Default::default() };
    let plain = fleet.encode(0);
    let mut metres = v1::EncodeRequest { frame: Some(frame), ..plain.clone() };
    let node = metres.observation.as_mut().unwrap();
    let position = node.position.as_mut().unwrap();
    (position.x, position.y) = (1000.0 * position.x, 1000.0 * position.y);
    for detection in &mut node.detections {
        (detection.rel_x, detection.rel_y) = (1000.0 * detection.rel_x, 1000.0 * detection.rel_y);
    }
    let encoded = client.encode(metres).await.unwrap().into_inner();
    assert_eq!(encoded.message_range, Some(280.0));
    let request = v1::DecideRequest {
        frame: Some(frame),
        return_waypoint: true,
        return_velocity: true,
        ..fleet.decide(&encoded.state, vec![])
    };
    let action = client.decide(request).await.unwrap().into_inner().action.unwrap();
    let (waypoint, velocity) = (action.waypoint.unwrap(), action.velocity.unwrap());
    assert!((waypoint.x - 500.0 - velocity.x).abs() < 1e-6 && (waypoint.y - 500.0 - velocity.y).abs() < 1e-6);
    assert!((velocity.x.hypot(velocity.y) - 40.0).abs() < 1e-6);
    let encoded = client.encode(plain).await.unwrap().into_inner();
    let action_in_square = client.decide(fleet.decide(&encoded.state, vec![])).await.unwrap().into_inner().action.unwrap();
    assert_eq!(action.heading_index, action_in_square.heading_index);
}
