//! A fleet of 1 000 UAVs and 10 000 users, as scene and as graph.

use bytes::Bytes;
use qedgix::policy::FleetStep;
use qedgix::serving::{FleetInput, Resolved};
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
