//! A fleet of 1 000 UAVs and 10 000 users, as scene and as graph.

use bytes::Bytes;
use qedgix::policy::FleetStep;
use qedgix::serving::{FleetInput, Resolved};
use qedgix::threads;
use qedgix::wire::v1;

use super::harness::*;

/// The detection range, in sides of the square.
const RANGE: f64 = 0.05;

/// A scene in which `range` is slightly more than [`RANGE`] sides of the square. Coordinates are multiples of 2^-17, so that
/// their sums and differences are exact.
fn wide_scene(uavs: usize, users: usize, range: f64) -> v1::Scene {
    let mut scene = scene(uavs, users, 5);
    let side = (2.0 * range / RANGE).floor() / 2.0;
    let place = |x: &mut f64| *x = (*x * 65536.0).round() / 65536.0 * side;
    scene.uavs.iter_mut().for_each(|u| [&mut u.x, &mut u.y].into_iter().for_each(place));
    scene.users.iter_mut().for_each(|u| [&mut u.x, &mut u.y].into_iter().for_each(place));
    scene
}

#[tokio::test(flavor = "multi_thread")]
async fn thousand_uavs_and_ten_thousand_users_are_answered() {
    let server = Server::start().await;
    let found = server.app.registry.resolve(&"qedgix".parse().unwrap()).unwrap();
    let Resolved::InMemory(loaded) = found else { panic!("it was published by this server") };
    let policy = &loaded.implementation;
    let (uavs, users) = (1000, 10_000);
    let scene = wide_scene(uavs, users, policy.env().detection_range);
    let graph = graph(&scene, policy.env().detection_range, false);
    let slot = FleetInput::try_from(graph.clone()).unwrap().into_fleet_graph(&**policy).unwrap();
    let whole = FleetInput::try_from(scene.clone()).unwrap().into_fleet_graph(&**policy).unwrap();
    let split = threads::allow(3, || FleetInput::try_from(graph.clone()).unwrap().into_fleet_graph(&**policy).unwrap());
    assert!(slot == split, "as on one thread");
    // UAVs have the same detections in both forms. Users detect the nodes that the detections of UAVs imply.
    for uav in 0..uavs {
        assert_eq!(slot.detections(uav), whole.detections(uav), "UAV {uav}");
    }
    for user in (uavs..uavs + users).step_by(61) {
        let sees = |i: usize, k: u32| slot.detections(i).binary_search_by_key(&k, |d| d.target).is_ok();
        let shared = |k: u32| (0..uavs).any(|i| sees(i, user as u32) && sees(i, k));
        let expected: Vec<_> =
            whole.detections(user).iter().copied().filter(|d| (d.target as usize) < uavs || shared(d.target)).collect();
        assert_eq!(slot.detections(user), expected, "node {user}");
    }

    let mut memory = vec![0.0; policy.memory_len(uavs, users)];
    policy.start(uavs, users, 0, &mut memory);
    let mut expected = vec![0; uavs];
    policy.act(&mut [FleetStep {
        env: policy.env(),
        graph: &slot,
        profile: None,
        step: 0,
        memory: &mut memory,
        headings: &mut expected,
        q_values: None,
    }]);
    let mut request = held("qedgix", Bytes::new(), v1::Scene::default());
    request.observation = Some(v1::act_request::Observation::Graph(graph));
    let answer = server.grpc().await.act(request).await.unwrap().into_inner();
    // The canonical order of the harness's ids is the order of their numbers.
    let served: Vec<u8> = answer.actions.iter().map(|a| a.heading_index as u8).collect();
    assert_eq!(served, expected);
    assert!(served.iter().any(|heading| *heading != served[0]), "headings differ");
    let by_scene = server.grpc().await.act(held("qedgix", Bytes::new(), scene)).await.unwrap().into_inner();
    assert_eq!(by_scene.actions.len(), uavs);
}

#[tokio::test(flavor = "multi_thread")]
async fn memory_of_a_large_fleet_is_small_and_is_taken_back() {
    let server = Server::start().await;
    let mut client = server.grpc().await;
    for policy in ["sweep", "sweep-shared", "qedgix"] {
        client.open_session(open(policy, policy)).await.unwrap();
        let mut state = Bytes::new();
        for step in 0..3 {
            let scene = scene(100, 500, step);
            let mut request = held(policy, state, scene.clone());
            request.seed = (step == 0).then_some(0);
            let answer = client.act(request).await.unwrap().into_inner();
            let in_session = client.act(in_session(policy, Some(step), scene)).await.unwrap().into_inner();
            assert_eq!(headings(&answer), headings(&in_session), "{policy}, step {step}");
            state = answer.recurrent_state;
            // Every UAV has at most five numbers per user, and 20 for the ground; or 65 numbers of a network.
            assert!(state.len() < 400_000, "{policy}: {} bytes", state.len());
        }
    }
    // Another user has appeared.
    let state = client.act(held("sweep", Bytes::new(), scene(100, 500, 0))).await.unwrap().into_inner().recurrent_state;
    let answer = client.act(held("sweep", state, scene(100, 501, 1))).await.unwrap().into_inner();
    assert_eq!(answer.actions.len(), 100);
}

#[tokio::test(flavor = "multi_thread")]
async fn state_that_no_request_could_return_is_not_handed_out() {
    let server = Server::with(|config| config.max_message_size = 64 << 10).await;
    let mut client = server.grpc().await;
    let (status, code, _) = refused(client.act(held("qedgix", Bytes::new(), scene(300, 20, 0))).await);
    assert_eq!((status, code.as_str()), (tonic::Code::ResourceExhausted, "too_large"));
    client.open_session(open("qedgix", "s")).await.unwrap();
    client.act(in_session("s", None, scene(300, 20, 0))).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn memory_of_all_sessions_is_bounded() {
    let server = Server::with(|config| config.session_memory = 1 << 20).await;
    let mut client = server.grpc().await;
    let mut served = 0;
    let (status, code) = loop {
        let name = format!("s{served}");
        client.open_session(open("qedgix", &name)).await.unwrap();
        match client.act(in_session(&name, Some(0), scene(200, 20, 0))).await {
            Ok(_) => served += 1,
            refusal => {
                let (status, code, _) = refused(refusal);
                break (status, code);
            }
        }
    };
    assert_eq!((status, code.as_str()), (tonic::Code::ResourceExhausted, "resource_exhausted"));
    assert!((2..20).contains(&served), "{served} sessions");
    assert!(server.app.sessions.memory_used() <= 1 << 20);
    // Open sessions continue, and a closed one makes room.
    client.act(in_session("s0", Some(1), scene(200, 20, 1))).await.unwrap();
    client.close_session(v1::CloseSessionRequest { session_id: "s1".into() }).await.unwrap();
    client.act(in_session(&format!("s{served}"), Some(0), scene(200, 20, 0))).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn dense_scene_is_refused_only_by_policies_that_need_its_detections() {
    let server = Server::start().await;
    let mut client = server.grpc().await;
    let dense = scene(100, 10_000, 0);
    assert_invalid(client.act(held("qedgix", Bytes::new(), dense.clone())).await, "scene", "more than");
    for policy in ["random", "nearest"] {
        client.act(held(policy, Bytes::new(), dense.clone())).await.unwrap();
    }
    // Each UAV would receive what all others know of ten thousand users.
    let mut close = wide_scene(1000, 10_000, 0.28);
    close.uavs.iter_mut().for_each(|uav| (uav.x, uav.y) = (0.5, 0.5));
    assert_invalid(client.act(held("qedgix", Bytes::new(), close)).await, "scene", "1000 UAVs in communication range");
}
