//! `Act` over gRPC: steps, repetitions, runs, expiry, memory that the caller keeps.

use std::sync::Arc;

use bytes::Bytes;
use qedgix::policy::EnvParams;
use qedgix::policy::FleetStep;
use qedgix::policy::baselines::{LIST, by_name};
use qedgix::serving::FleetInput;
use qedgix::wire::v1;
use tonic::Code;

use super::harness::*;

#[tokio::test]
async fn session_answers_steps_and_repetitions() {
    let server = Server::start().await;
    let mut client = server.grpc().await;
    let session = client.open_session(open("sweep", "s")).await.unwrap().into_inner();
    assert_eq!((session.session_id.as_str(), session.steps), ("s", 0));
    let pinned = session.policy.unwrap();
    assert_eq!((pinned.name.as_str(), pinned.version, pinned.digest.len()), ("sweep", 1, 64));
    let mut last = None;
    for step in 0..3 {
        let answer = client.act(in_session("s", Some(step), scene(3, 5, step))).await.unwrap().into_inner();
        assert_eq!(answer.step, step);
        assert_eq!(answer.actions.len(), 3);
        assert!(answer.actions.iter().all(|a| a.heading_deg == Some(45.0 * f64::from(a.heading_index)) && a.q_values.is_empty()));
        assert!(answer.recurrent_state.is_empty(), "the server keeps the memory");
        assert_eq!(answer.policy.as_ref().unwrap(), &pinned);
        assert_eq!(answer.timings.as_ref().unwrap().batch_size, 1);
        last = Some(answer);
    }
    let repeated = client.act(in_session("s", Some(2), scene(3, 5, 2))).await.unwrap().into_inner();
    assert_eq!(Some(&repeated), last.as_ref());
    let other = client.act(in_session("s", Some(2), scene(3, 5, 77))).await.unwrap().into_inner();
    assert_eq!(Some(other), last, "a repetition returns the first response, whatever it observes");
    for wrong in [0, 1, 4, u64::MAX] {
        let (code, reason, _) = refused(client.act(in_session("s", Some(wrong), scene(3, 5, 0))).await);
        assert_eq!((code, reason.as_str()), (Code::FailedPrecondition, "wrong_step"));
    }
    let closed = client.close_session(v1::CloseSessionRequest { session_id: "s".into() }).await.unwrap().into_inner();
    assert_eq!(closed.steps, 3);
    assert_eq!(refused(client.act(in_session("s", None, scene(3, 5, 3))).await).0, Code::NotFound);
}

/// Headings of `slots` slots of policy `name`, computed without a server.
fn offline(name: &str, slots: u64, seed: u64) -> Vec<Vec<u8>> {
    let policy = by_name(name, EnvParams::default()).unwrap();
    let mut memory = vec![0.0; policy.memory_len(3, 5)];
    policy.start(3, 5, seed, &mut memory);
    let decide = |step| {
        let slot = FleetInput::try_from(scene(3, 5, step)).unwrap().into_fleet_graph(&*policy).unwrap();
        let mut headings = vec![0; 3];
        policy.act(&mut [FleetStep {
            env: policy.env(),
            graph: &slot,
            profile: None,
            step,
            memory: &mut memory,
            headings: &mut headings,
            q_values: None,
        }]);
        headings
    };
    (0..slots).map(decide).collect()
}

#[tokio::test]
async fn session_and_recurrent_state_give_the_headings_of_the_policy() {
    let server = Server::start().await;
    let mut client = server.grpc().await;
    for baseline in &LIST {
        let name = baseline.name;
        client.open_session(open(name, name)).await.unwrap();
        let mut state = Bytes::new();
        for (step, expected) in offline(name, 30, 0).into_iter().enumerate() {
            let step = step as u64;
            let in_order = |answer: &v1::ActResponse| answer.actions.iter().map(|a| a.heading_index as u8).collect::<Vec<_>>();
            let kept = client.act(in_session(name, None, scene(3, 5, step))).await.unwrap().into_inner();
            assert_eq!((kept.step, in_order(&kept)), (step, expected.clone()), "{name}, session");
            let request = v1::ActRequest { step: Some(step), ..held(name, state, scene(3, 5, step)) };
            let kept = client.act(request).await.unwrap().into_inner();
            assert_eq!((kept.step, in_order(&kept)), (step, expected), "{name}, held");
            state = kept.recurrent_state;
        }
    }
}

#[tokio::test]
async fn recurrent_state_is_checked() {
    let server = Server::start().await;
    let mut client = server.grpc().await;
    let first = client.act(held("sweep", Bytes::new(), scene(3, 5, 0))).await.unwrap().into_inner();
    let state = first.recurrent_state.clone();
    let repeated = client.act(held("sweep", Bytes::new(), scene(3, 5, 0))).await.unwrap().into_inner();
    assert_eq!(repeated.recurrent_state, state, "equal requests have equal responses");

    let late = v1::ActRequest { step: Some(1), ..held("sweep", Bytes::new(), scene(3, 5, 1)) };
    assert_eq!(refused(client.act(late).await).1, "wrong_step");
    let early = v1::ActRequest { step: Some(0), ..held("sweep", state.clone(), scene(3, 5, 1)) };
    assert_eq!(refused(client.act(early).await).1, "wrong_step");

    let mut damaged = state.to_vec();
    damaged[50] ^= 4;
    let wrong = [
        held("nearest", state.clone(), scene(3, 5, 1)),
        held("sweep", state.slice(..state.len() - 4), scene(3, 5, 1)),
        held("sweep", damaged.into(), scene(3, 5, 1)),
        held("sweep", Bytes::from_static(b"hello"), scene(3, 5, 1)),
    ];
    for request in wrong {
        let (code, _, field) = refused(client.act(request).await);
        assert_eq!((code, field.as_str()), (Code::InvalidArgument, "recurrent_state"));
    }
    assert_invalid(client.act(held("", state, scene(3, 5, 1))).await, "policy", "");
}

#[tokio::test]
async fn episode_stays_on_its_version() {
    let server = Server::start().await;
    server.add("p", 1, Arc::new(TestPolicy::Count));
    server.app.registry.set_alias("p", "prod", 1);
    let mut client = server.grpc().await;
    client.open_session(open("p@prod", "s")).await.unwrap();
    let first = client.act(held("p", Bytes::new(), scene(3, 5, 0))).await.unwrap().into_inner();
    server.add("p", 2, Arc::new(TestPolicy::Count));
    server.app.registry.set_alias("p", "prod", 2);
    let version = |answer: v1::ActResponse| answer.policy.unwrap().version;
    let pinned = v1::ActRequest { policy: "p@prod".into(), ..in_session("s", None, scene(3, 5, 0)) };
    assert_eq!(version(client.act(pinned).await.unwrap().into_inner()), 1);
    let continued = client.act(held("p", first.recurrent_state.clone(), scene(3, 5, 1))).await.unwrap().into_inner();
    assert_eq!(version(continued), 1);
    assert_eq!(version(client.act(held("p", Bytes::new(), scene(3, 5, 0))).await.unwrap().into_inner()), 2);
    assert_eq!(refused(client.act(held("p:2", first.recurrent_state, scene(3, 5, 1))).await).0, Code::InvalidArgument);
    for other in ["p:2", "sweep"] {
        let request = v1::ActRequest { policy: other.into(), ..in_session("s", None, scene(3, 5, 0)) };
        assert_invalid(client.act(request).await, "policy", other);
    }
}

#[tokio::test]
async fn ids_may_come_in_any_order() {
    let server = Server::start().await;
    let mut client = server.grpc().await;
    for id in ["straight", "shuffled"] {
        client.open_session(open("sweep", id)).await.unwrap();
    }
    // With eleven UAVs, bytewise order would put uav-10 before uav-2.
    for step in 0..12 {
        let straight = scene(11, 6, step);
        let mut shuffled = straight.clone();
        shuffled.uavs.rotate_left(1 + step as usize % 10);
        shuffled.users.reverse();
        let order: Vec<String> = shuffled.uavs.iter().map(|u| u.id.clone()).collect();
        let a = client.act(in_session("straight", Some(step), straight)).await.unwrap().into_inner();
        let b = client.act(in_session("shuffled", Some(step), shuffled)).await.unwrap().into_inner();
        assert_eq!(headings(&a), headings(&b), "step {step}");
        assert_eq!(b.actions.iter().map(|a| a.uav_id.clone()).collect::<Vec<_>>(), order, "in the order of the request");
    }
    let mut changed = scene(11, 6, 11);
    changed.uavs[3].id = "stranger".into();
    let response = client.act(in_session("straight", Some(11), changed)).await;
    assert_invalid(response, "uavs", "\"stranger\" instead of \"uav-3\"");
    client.act(in_session("straight", Some(12), scene(11, 6, 12))).await.unwrap();
}

#[tokio::test]
async fn new_run_restarts_the_session_and_fences_the_former_run() {
    let server = Server::start().await;
    let mut client = server.grpc().await;
    client.open_session(open("sweep", "s")).await.unwrap();
    let run = |run: &str, step| v1::ActRequest { run_id: Some(run.into()), ..in_session("s", Some(step), scene(3, 5, step)) };
    let first = client.act(run("a", 0)).await.unwrap().into_inner();
    client.act(run("a", 1)).await.unwrap();
    assert_eq!(refused(client.act(run("b", 2)).await).1, "wrong_step");
    let restarted = client.act(run("b", 0)).await.unwrap().into_inner();
    assert_eq!(headings(&restarted), headings(&first));
    let (code, reason, _) = refused(client.act(run("a", 2)).await);
    assert_eq!((code, reason.as_str()), (Code::FailedPrecondition, "run_fenced"));
    client.act(run("b", 1)).await.unwrap();
}

#[tokio::test]
async fn idle_session_expires_with_its_own_error() {
    let server = Server::start().await;
    let mut client = server.grpc().await;
    client.open_session(open("sweep", "s")).await.unwrap();
    server.advance(599);
    client.act(in_session("s", Some(0), scene(3, 5, 0))).await.unwrap();
    server.advance(601);
    let (code, reason, _) = refused(client.act(in_session("s", Some(1), scene(3, 5, 1))).await);
    assert_eq!((code, reason.as_str()), (Code::FailedPrecondition, "session_expired"));
    let closing = client.close_session(v1::CloseSessionRequest { session_id: "s".into() }).await;
    assert_eq!(refused(closing).1, "session_expired");
    assert_eq!(refused(client.act(in_session("never", None, scene(3, 5, 1))).await).0, Code::NotFound);
}

#[tokio::test]
async fn q_values_are_optional_and_hovering_has_no_degrees() {
    let server = Server::start().await;
    server.add("p", 1, Arc::new(TestPolicy::Count));
    let mut client = server.grpc().await;
    client.open_session(v1::OpenSessionRequest { seed: Some(8), ..open("p", "s") }).await.unwrap();
    let request = v1::ActRequest { return_q_values: true, ..in_session("s", Some(0), scene(2, 1, 0)) };
    let answer = client.act(request).await.unwrap().into_inner();
    assert_eq!((answer.actions[1].heading_index, answer.actions[1].heading_deg), (8, None));
    assert_eq!(answer.actions[1].q_values, (9..18).map(|q| q as f32).collect::<Vec<_>>());
    let answer = client.act(in_session("s", Some(1), scene(2, 1, 0))).await.unwrap().into_inner();
    assert_eq!((answer.actions[0].heading_index, answer.actions[0].heading_deg), (0, Some(0.0)));
    assert!(answer.actions[0].q_values.is_empty());
    assert_invalid(client.act(in_session("s", Some(2), scene(4, 1, 0))).await, "uavs", "4");
    let seeded = v1::ActRequest { seed: Some(1), ..in_session("s", Some(2), scene(2, 1, 0)) };
    assert_invalid(client.act(seeded).await, "seed", "1");
}

#[tokio::test]
async fn policies_are_listed_in_pages() {
    let server = Server::start().await;
    let mut client = server.grpc().await;
    server.add("sweep", 2, Arc::new(TestPolicy::Count));
    server.app.registry.set_alias("sweep", "old", 1);
    let mut names = Vec::new();
    let mut token = String::new();
    loop {
        let request = v1::ListPoliciesRequest { page_size: 2, page_token: token };
        let page = client.list_policies(request).await.unwrap().into_inner();
        assert!(page.policies.len() <= 2);
        names.extend(page.policies.into_iter().map(|p| p.r#ref.unwrap().name));
        token = page.next_page_token;
        if token.is_empty() {
            break;
        }
    }
    let bundled = qedgix::serving::bundled::BUNDLED.iter().map(|(name, _)| *name);
    let mut expected: Vec<&str> = LIST.iter().map(|baseline| baseline.name).chain(bundled).collect();
    expected.sort_unstable();
    assert_eq!(names, expected);
    let mut get = async |policy: &str| client.get_policy(v1::GetPolicyRequest { policy: policy.into() }).await;
    let newest = get("sweep").await.unwrap().into_inner();
    assert_eq!((newest.r#ref.unwrap().version, newest.versions, newest.aliases.len()), (2, vec![1, 2], 0));
    let old = get("sweep@old").await.unwrap().into_inner();
    assert_eq!((old.r#ref.as_ref().unwrap().version, old.headings, old.detection_range), (1, 8, 0.28));
    assert_eq!(
        (old.kind(), old.needs(), old.aliases.as_slice()),
        (v1::PolicyKind::Baseline, v1::Needs::OwnPositions, &["old".to_owned()][..])
    );
    assert_eq!(get("greedy-global").await.unwrap().into_inner().needs(), v1::Needs::FullScene);
    for unknown in ["sweep:3", "sweep@new", "swoop"] {
        assert_eq!(refused(get(unknown).await).0, Code::NotFound, "{unknown}");
    }
    for malformed in ["", "sweep:", "sweep:zero", "a b"] {
        assert_eq!(refused(get(malformed).await).0, Code::InvalidArgument, "{malformed}");
    }
}

#[tokio::test]
async fn errors_name_the_field_and_have_the_units_of_the_caller() {
    let server = Server::start().await;
    let mut client = server.grpc().await;
    let frame = Some(v1::Frame { side: Some(1000.0), ..Default::default() });
    let world = |world: v1::World| Some(v1::World { slot_seconds: Some(2.0), ..world });
    let metres = || {
        let mut scene = scene(3, 5, 0);
        scene.uavs.iter_mut().for_each(|uav| (uav.x, uav.y) = (1000.0 * uav.x, 1000.0 * uav.y));
        scene.users.iter_mut().for_each(|user| (user.x, user.y) = (1000.0 * user.x, 1000.0 * user.y));
        scene
    };
    let fast = world(v1::World { speed: Some(501.0), ..Default::default() });
    let request = v1::ActRequest { frame, world: fast, ..held("sweep", Bytes::new(), metres()) };
    let status = client.act(request).await.unwrap_err();
    assert_eq!(status.message(), "world.speed: got 501, expected a number from 0 to 500");

    let mut own = metres();
    own.uavs.reverse();
    own.uavs[0].speed = Some(501.0);
    let slow = world(v1::World { speed: Some(10.0), ..Default::default() });
    let request = v1::ActRequest { frame, world: slow, ..held("sweep", Bytes::new(), own) };
    let status = client.act(request).await.unwrap_err();
    assert_eq!(status.message(), "scene.uavs[0].speed: got 501, expected a number from 0 to 500");

    let far = v1::Detection { target_id: "b".into(), rel_x: 0.0, rel_y: 900.0, ..Default::default() };
    let node =
        |id: &str, detections| v1::Node { id: id.into(), kind: v1::NodeKind::Uav.into(), detections, ..Default::default() };
    let graph = v1::Graph { nodes: vec![node("b", vec![]), node("a", vec![far])] };
    let graph = Some(v1::act_request::Observation::Graph(graph));
    let request = v1::ActRequest { frame, observation: graph.clone(), ..held("random", Bytes::new(), metres()) };
    let status = client.act(request).await.unwrap_err();
    assert_eq!(
        status.message(),
        "graph.nodes[1].detections[0].rel_y: got (0, 900), expected a position within about the detection range (280); for another \
         sensor describe a world"
    );
    let constraints = Some(v1::Constraints { min_separation: Some(1.0), ..Default::default() });
    let request =
        v1::ActRequest { constraints: constraints.clone(), observation: graph, ..held("random", Bytes::new(), metres()) };
    assert_invalid(client.act(request).await, "graph.nodes[1].position", "");

    client.open_session(open("sweep", "s")).await.unwrap();
    for (request, field) in [
        (v1::ActRequest { frame, ..in_session("s", None, metres()) }, "frame"),
        (v1::ActRequest { world: slow, ..in_session("s", None, metres()) }, "world"),
        (v1::ActRequest { constraints: constraints.clone(), ..in_session("s", None, metres()) }, "constraints"),
    ] {
        assert_invalid(client.act(request).await, field, "a value");
    }
    let status = client.open_session(v1::OpenSessionRequest { constraints, ..open("sweep", "s") }).await.unwrap_err();
    assert!(status.message().contains("constraints"), "{}", status.message());

    let late = v1::ActRequest { step: Some(5), ..held("sweep", Bytes::new(), scene(3, 5, 0)) };
    let status = client.act(late).await.unwrap_err();
    assert!(status.message().ends_with("a first request begins at step 0"), "{}", status.message());
    for (policy, expected) in [
        ("sweep:2", "policy sweep has no version 2"),
        ("sweep@live", "policy sweep has no alias live"),
        ("swep:2", "no policy \"swep:2\"; did you mean sweep?"),
    ] {
        let status = client.act(held(policy, Bytes::new(), scene(3, 5, 0))).await.unwrap_err();
        assert_eq!((status.code(), status.message()), (Code::NotFound, expected));
    }
}

#[tokio::test]
async fn a_session_is_told_when_a_rule_decides_instead_of_its_policy() {
    let server = Server::start().await;
    let mut client = server.grpc().await;
    for (policy, range, rule) in [("qedgix", 0.15, true), ("qedgix", 0.22, false), ("qedgix-onboard", 0.15, false)] {
        let world = Some(v1::World { detection_range: Some(range), communication_range: Some(0.28), ..Default::default() });
        let request = v1::OpenSessionRequest { world, session_id: String::new(), ..open(policy, "") };
        let session = client.open_session(request).await.unwrap().into_inner();
        let [warning] = &session.warnings[..] else { panic!("{:?}", session.warnings) };
        assert_eq!(
            (warning.field.as_str(), warning.message.contains("as the rule sweep-shared")),
            ("world.detection_range", rule)
        );
    }
}
