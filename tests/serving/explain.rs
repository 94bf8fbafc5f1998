//! Explanations of `Act`: the change of a Q-value is that of a request without the detection or message.

use std::collections::BTreeMap;

use qedgix::wire::v1;
use serde_json::json;
use tonic::Code;

use crate::harness::{Server, graph, refused, scene};
use crate::rest::Rest;

fn request(policy: &str, graph: v1::Graph) -> v1::ActRequest {
    v1::ActRequest {
        policy: policy.into(),
        observation: Some(v1::act_request::Observation::Graph(graph)),
        return_q_values: true,
        symmetric: Some(false),
        ..Default::default()
    }
}

fn q_of_heading(action: &v1::Action, heading: u32) -> f32 {
    action.q_values[heading as usize]
}

#[tokio::test(flavor = "multi_thread")]
async fn an_influence_is_the_change_without_the_detection_or_message() {
    let server = Server::start().await;
    let mut client = server.grpc().await;
    let graph = graph(&scene(4, 12, 3), 0.45, false);
    let explained = v1::ActRequest { explain: true, ..request("qmix", graph.clone()) };
    let world = Some(v1::World { detection_range: Some(0.45), ..Default::default() });
    let explained = v1::ActRequest { world, ..explained };
    let actions = client.act(explained.clone()).await.unwrap().into_inner().actions;
    let plain = v1::ActRequest { explain: false, ..explained };
    let same = client.act(plain.clone()).await.unwrap().into_inner().actions;
    assert!(same.iter().zip(&actions).all(|(a, b)| a.influences.is_empty() && a.q_values == b.q_values));
    let mut checked = 0;
    for (i, action) in actions.iter().enumerate() {
        let changes: Vec<f32> = action.influences.iter().map(|of| of.change.abs()).collect();
        assert!(changes.is_sorted_by(|a, b| a >= b), "the strongest first: {changes:?}");
        let sensed: BTreeMap<_, _> =
            action.influences.iter().filter(|of| !of.message).map(|of| (of.node_id.clone(), of.change)).collect();
        assert_eq!(sensed.len(), graph.nodes[i].detections.len());
        for (node_id, change) in sensed {
            let mut without = graph.clone();
            without.nodes[i].detections.retain(|detection| detection.target_id != node_id);
            let request = v1::ActRequest { observation: Some(v1::act_request::Observation::Graph(without)), ..plain.clone() };
            let other = client.act(request).await.unwrap().into_inner().actions;
            assert_eq!(q_of_heading(action, action.heading_index) - q_of_heading(&other[i], action.heading_index), change);
            checked += 1;
        }
    }
    assert!(checked > 10);

    // Messages: as a UAV that decides alone without them.
    let ids = |kind: v1::NodeKind| graph.nodes.iter().filter(|n| n.kind == i32::from(kind)).map(|n| n.id.clone()).collect();
    let mut encoded = Vec::new();
    for node in &graph.nodes[..4] {
        let request = v1::EncodeRequest {
            policy: "qmix".into(),
            uav_ids: ids(v1::NodeKind::Uav),
            user_ids: ids(v1::NodeKind::User),
            observation: Some(node.clone()),
            world,
            ..Default::default()
        };
        encoded.push(client.encode(request).await.unwrap().into_inner());
    }
    let mut messages = 0;
    for (i, action) in actions.iter().enumerate() {
        for of in action.influences.iter().filter(|of| of.message) {
            let heard = |k: &usize| graph.nodes[*k].id != of.node_id;
            let request = v1::DecideRequest {
                policy: "qmix".into(),
                state: encoded[i].state.clone(),
                messages: (0..4).filter(heard).map(|k| encoded[k].message.clone()).collect(),
                return_q_values: true,
                world,
                ..Default::default()
            };
            let alone = client.decide(request).await.unwrap().into_inner().action.unwrap();
            assert_eq!(q_of_heading(action, action.heading_index) - q_of_heading(&alone, action.heading_index), of.change);
            messages += 1;
        }
    }
    assert!(messages > 0);
}

#[tokio::test(flavor = "multi_thread")]
async fn explanations_are_bounded_and_empty_without_q_values() {
    let server = Server::start().await;
    let mut client = server.grpc().await;
    let few = graph(&scene(3, 5, 1), 0.28, false);
    let rule = v1::ActRequest { explain: true, ..request("sweep", few.clone()) };
    assert!(client.act(rule).await.unwrap().into_inner().actions.iter().all(|action| action.influences.is_empty()));
    let many = graph(&scene(100, 100, 1), 0.28, false);
    let refusal = refused(client.act(v1::ActRequest { explain: true, ..request("qedgix", many) }).await);
    assert_eq!((refusal.0, refusal.2.as_str()), (Code::InvalidArgument, "explain"));
    let body = json!({"policy": "qedgix", "explain": true, "graph": {"nodes": [
        {"id": "a", "kind": "uav", "position": {"x": 0.5, "y": 0.5},
         "detections": [{"target_id": "u", "rel_x": 0.1, "rel_y": 0.1, "aoi": 3}]},
        {"id": "u", "kind": "user"}]}});
    let (_, answer) = Rest::new(&server).post("/v1/act", &body).await;
    assert_eq!(answer["actions"][0]["influences"][0]["node_id"], "u", "{answer}");
}
