//! Observations: a graph and a scene of the same slot are the same slot, and nothing that can be sent panics.

use proptest::prelude::*;
use qedgix::policy::EnvParams;
use qedgix::policy::baselines::{LIST, by_name};
use qedgix::policy::{FleetGraph, FleetStep, Policy, RequiredInput};
use qedgix::service::act;
use qedgix::serving::{FleetInput, Sensing};
use qedgix::wire::v1;

use super::harness::*;

fn slot_of(input: FleetInput, policy: &dyn Policy) -> FleetGraph {
    input.into_fleet_graph(policy).unwrap()
}

fn decide(policy: &dyn Policy, graph: &FleetGraph) -> Vec<u8> {
    let (uavs, users) = (graph.uavs(), graph.users());
    let mut memory = vec![0.0; policy.memory_len(uavs, users)];
    policy.start(uavs, users, 3, &mut memory);
    let mut headings = vec![0; uavs];
    let mut q_values = vec![0.0; uavs * policy.actions()];
    policy.act(&mut [FleetStep {
        env: policy.env(),
        graph,
        profile: None,
        step: 0,
        memory: &mut memory,
        headings: &mut headings,
        q_values: Some(&mut q_values),
    }]);
    headings
}

fn detections(graph: &FleetGraph) -> Vec<Vec<qedgix::policy::Detection>> {
    (0..graph.uavs() + graph.users()).map(|i| graph.detections(i).to_vec()).collect()
}

#[test]
fn a_graph_and_a_scene_of_the_same_slot_are_the_same_slot() {
    let mut seen = 0;
    for seed in 0..400 {
        let (uavs, users) = (1 + seed as usize % 6, 1 + seed as usize % 13);
        let scene = scene(uavs, users, seed);
        for baseline in LIST.iter().filter(|b| b.needs != RequiredInput::FullScene) {
            let policy = by_name(baseline.name, EnvParams::default()).unwrap();
            let range = policy.env().detection_range;
            let by_scene = slot_of(scene.clone().try_into().unwrap(), &*policy);
            let mut sent = graph(&scene, range, true);
            sent.nodes.reverse();
            sent.nodes.iter_mut().for_each(|node| node.detections.reverse());
            let by_graph = slot_of(sent.try_into().unwrap(), &*policy);
            assert_eq!(detections(&by_graph), detections(&by_scene), "seed {seed}");
            assert_eq!(by_graph.aoi(), by_scene.aoi());
            assert_eq!(by_graph.uav_positions(), by_scene.uav_positions());
            assert_eq!(decide(&*policy, &by_graph), decide(&*policy, &by_scene), "seed {seed}, {}", baseline.name);
            seen += detections(&by_scene).iter().map(Vec::len).sum::<usize>();

            let without_detections = slot_of(graph(&scene, range, false).try_into().unwrap(), &*policy);
            assert_eq!(decide(&*policy, &without_detections), decide(&*policy, &by_scene), "seed {seed}, {}", baseline.name);
            check_derived(&without_detections, &by_scene);
        }
    }
    assert!(seen > 10_000, "the slots are not empty");
}

/// What users see, derived from UAVs: exactly the users that some UAV sees together with them, up to rounding.
fn check_derived(derived: &FleetGraph, whole: &FleetGraph) {
    let uavs = whole.uavs();
    let sees = |graph: &FleetGraph, i: usize, j: usize| graph.detections(i).iter().find(|d| d.target == j as u32).map(|d| d.rel);
    for i in 0..uavs {
        assert_eq!(derived.detections(i), whole.detections(i));
    }
    for j in uavs..uavs + whole.users() {
        for k in (0..uavs + whole.users()).filter(|&k| k != j) {
            let together = k < uavs || (0..uavs).any(|i| sees(whole, i, j).is_some() && sees(whole, i, k).is_some());
            let (expected, found) = (sees(whole, j, k).filter(|_| together), sees(derived, j, k));
            match (expected, found) {
                (Some(a), Some(b)) => assert!((a[0] - b[0]).abs() < 1e-6 && (a[1] - b[1]).abs() < 1e-6),
                (a, b) => assert_eq!(a, b, "user {j} and node {k}"),
            }
        }
    }
}

#[test]
fn what_one_side_reports_is_mirrored() {
    let policy = by_name("nearest", EnvParams::default()).unwrap();
    for seed in 0..100 {
        let scene = scene(4, 8, seed);
        let whole = slot_of(graph(&scene, 0.28, true).try_into().unwrap(), &*policy);
        let mut half = graph(&scene, 0.28, true);
        for (i, node) in half.nodes.iter_mut().enumerate() {
            let me = i;
            // Node i keeps what it sees of nodes after it.
            node.detections.retain(|d| {
                let (kind, number) = d.target_id.split_once('-').unwrap();
                number.parse::<usize>().unwrap() + if kind == "user" { 4 } else { 0 } > me
            });
        }
        // A user whose list became empty counts as left out, which can only add what a UAV tells; here it adds nothing new.
        let mirrored = slot_of(half.try_into().unwrap(), &*policy);
        for i in 0..12 {
            let ids = |graph: &FleetGraph| graph.detections(i).iter().map(|d| d.target).collect::<Vec<_>>();
            assert_eq!(ids(&mirrored), ids(&whole), "seed {seed}, node {i}");
        }
    }
}

#[test]
fn every_node_keeps_its_own_measurements() {
    let policy = by_name("nearest", EnvParams::default()).unwrap();
    let (uav, user) = (v1::NodeKind::Uav, v1::NodeKind::User);
    let node = |id: &str, kind: v1::NodeKind, x: f64, detections: &[(&str, f64, Option<f64>)]| v1::Node {
        id: id.into(),
        kind: kind.into(),
        position: (kind == uav).then_some(v1::Position { x, y: 0.5, z: None }),
        detections: detections
            .iter()
            .map(|&(target, rel_x, aoi)| v1::Detection { target_id: target.into(), rel_x, rel_y: 0.0, aoi, rel_z: None })
            .collect(),
        ..Default::default()
    };
    let sent = v1::Graph {
        nodes: vec![
            node("a", uav, 0.4, &[("b", 0.11, None), ("u", 0.05, Some(7.0))]),
            node("b", uav, 0.5, &[("a", -0.09, None), ("c", 0.29, None), ("u", -0.06, Some(6.0))]),
            node("c", uav, 0.78, &[]),
            node("u", user, 0.0, &[]),
        ],
    };
    let input = FleetInput::try_from(sent).unwrap();
    let rels = |graph: &FleetGraph, i: usize| graph.detections(i).iter().map(|d| (d.target, d.rel[0])).collect::<Vec<_>>();
    let graph = slot_of(input.clone(), &*policy);
    assert_eq!(rels(&graph, 0), [(1, 0.11), (3, 0.05)]);
    assert_eq!(rels(&graph, 1), [(0, -0.09), (2, 0.29), (3, -0.06)], "a little further than the range");
    assert_eq!(rels(&graph, 2), [(1, -0.29)], "mirrored");
    assert_eq!(graph.aoi(), [6.0], "the latest collection that anybody knows of");
    let sensing = Sensing { symmetric: false, ..Sensing::of(&*policy) };
    let graph = input.content.into_fleet_graph((3, 1), &*policy, sensing).unwrap();
    assert_eq!(rels(&graph, 1), [(0, -0.09), (2, 0.29), (3, -0.06)]);
    assert_eq!(rels(&graph, 2), [], "not mirrored");
}

fn number() -> impl Strategy<Value = f64> {
    prop_oneof![
        4 => -0.3..0.3_f64,
        1 => 0.0..90.0_f64,
        1 => prop::sample::select(vec![0.0, -0.0, 1.0, -1.0, f64::NAN, f64::INFINITY, f64::MIN, f64::MAX, f64::MIN_POSITIVE, 1e30]),
    ]
}

fn id() -> impl Strategy<Value = String> {
    prop_oneof![8 => "[a-d]", 1 => "\\PC{0,4}", 1 => Just(String::new()), 1 => Just("x".repeat(200))]
}

prop_compose! {
    fn detection()(target_id in id(), rel_x in number(), rel_y in number(), aoi in prop::option::of(number())) -> v1::Detection {
        v1::Detection { target_id, rel_x, rel_y, aoi, rel_z: None }
    }
}

prop_compose! {
    fn node()(
        id in id(),
        kind in prop_oneof![4 => 1..3_i32, 1 => any::<i32>()],
        detections in prop::collection::vec(detection(), 0..4),
        position in prop::option::of((number(), number())),
        aoi in prop::option::weighted(0.2, number()),
    ) -> v1::Node {
        v1::Node { id, kind, detections, position: position.map(|(x, y)| v1::Position { x, y, z: None }), aoi, ..Default::default() }
    }
}

fn observation() -> impl Strategy<Value = v1::act_request::Observation> {
    use v1::act_request::Observation;
    let graph = prop::collection::vec(node(), 0..5).prop_map(|nodes| Observation::Graph(v1::Graph { nodes }));
    let uav = (id(), number(), number()).prop_map(|(id, x, y)| v1::SceneUav { id, x, y, ..Default::default() });
    let user = (id(), number(), number(), number()).prop_map(|(id, x, y, aoi)| v1::SceneUser { id, x, y, aoi, z: None });
    let scene = (prop::collection::vec(uav, 0..3), prop::collection::vec(user, 0..4))
        .prop_map(|(uavs, users)| Observation::Scene(v1::Scene { uavs, users }));
    prop_oneof![graph, scene]
}

prop_compose! {
    fn request()(
        policy in prop_oneof![Just("sweep".to_owned()), id()],
        observation in prop::option::weighted(0.95, observation()),
        state in prop::option::of(prop::collection::vec(any::<u8>(), 0..120)),
        step in prop::option::of(any::<u64>()),
        run_id in prop::option::of(id()),
    ) -> v1::ActRequest {
        let memory = state.map(|state| v1::act_request::Memory::RecurrentState(state.into()));
        v1::ActRequest { policy, observation, memory, step, run_id, return_q_values: true, ..Default::default() }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 4000, failure_persistence: None, ..ProptestConfig::default() })]

    /// Whatever is sent is refused with the name of a field, or is a slot that every policy it fits can decide.
    #[test]
    fn arbitrary_messages_are_refused_or_flown(message in request()) {
        match act::Request::try_from(message) {
            Err(e) => prop_assert!(!e.field.is_empty() && !e.expected.is_empty()),
            Ok(request) => for baseline in &LIST {
                let policy = by_name(baseline.name, EnvParams::default()).unwrap();
                let (uavs, users) = (request.input.uavs(), request.input.users());
                if let Ok(graph) = request.input.clone().into_fleet_graph(&*policy) {
                    prop_assert_eq!((graph.uavs(), graph.users()), (uavs, users));
                    let headings = decide(&*policy, &graph);
                    prop_assert!(headings.iter().all(|&h| usize::from(h) < policy.actions()));
                }
            }
        }
    }

    /// Callers may forge the memory that they keep.
    #[test]
    fn arbitrary_memory_is_flown(values in prop::collection::vec(number(), 400), step in any::<u64>(), seed in 0..50_u64) {
        let sent: FleetInput = scene(3, 5, seed).try_into().unwrap();
        for baseline in &LIST {
            let policy = by_name(baseline.name, EnvParams::default()).unwrap();
            let graph = slot_of(sent.clone(), &*policy);
            let len = policy.memory_len(3, 5);
            let mut memory: Vec<f32> = values.iter().cycle().take(len).map(|&x| x as f32).collect();
            let mut headings = vec![0; 3];
            policy.act(&mut [FleetStep { env: policy.env(), graph: &graph, profile: None, step, memory: &mut memory, headings: &mut headings, q_values: None }]);
            prop_assert!(headings.iter().all(|&h| usize::from(h) < policy.actions()));
        }
    }

    #[test]
    fn arbitrary_documents_never_panic(body in "\\PC{0,60}") {
        let _ = qedgix::api::rest::extract::parse::<serde_json::Value>(body.as_bytes());
    }
}
