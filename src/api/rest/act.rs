//! `POST /v1/act`: the messages of `PolicyService.Act` as JSON. Names are those of the protocol, bytes are base64;
//! what the protocol cannot leave out (coordinates, ids) has to be there, and unknown fields are errors.

use std::sync::Arc;

use axum::Json;
use axum::extract::State;
use serde::Deserialize;

use super::extract;
use super::wording::{ActReply, Base64};
use crate::api::convert::response::act_response;
use crate::service::{App, Error, act as service};
use crate::wire::v1;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Body {
    #[serde(default)]
    policy: String,
    graph: Option<Graph>,
    scene: Option<Scene>,
    session_id: Option<String>,
    recurrent_state: Option<Base64>,
    step: Option<u64>,
    run_id: Option<String>,
    #[serde(default)]
    return_q_values: bool,
    seed: Option<u64>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Graph {
    nodes: Vec<Node>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Node {
    id: String,
    kind: Kind,
    #[serde(default)]
    detections: Vec<Detection>,
    position: Option<Position>,
    aoi: Option<f64>,
}

#[derive(Clone, Copy, Debug, Deserialize)]
enum Kind {
    #[serde(rename = "NODE_KIND_UAV", alias = "uav")]
    Uav,
    #[serde(rename = "NODE_KIND_USER", alias = "user")]
    User,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Detection {
    target_id: String,
    rel_x: f64,
    rel_y: f64,
    aoi: Option<f64>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Position {
    x: f64,
    y: f64,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Scene {
    uavs: Vec<Uav>,
    #[serde(default)]
    users: Vec<User>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Uav {
    id: String,
    x: f64,
    y: f64,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct User {
    id: String,
    x: f64,
    y: f64,
    aoi: f64,
}

pub(super) async fn act(State(app): State<Arc<App>>, extract::Json(body): extract::Json<Body>) -> Result<Json<ActReply>, Error> {
    let values = body.return_q_values;
    let request = service::Request::try_from(message(body)?)?;
    let answer = service::act(&app, request, None).await?;
    Ok(Json(act_response(answer, values).into()))
}

fn message(body: Body) -> Result<v1::ActRequest, Error> {
    use v1::act_request::{Memory, Observation};
    let observation = match (body.graph, body.scene) {
        (Some(graph), None) => Some(Observation::Graph(graph.into())),
        (None, Some(scene)) => Some(Observation::Scene(scene.into())),
        (None, None) => None,
        _ => return Err(Error::Schema("graph: one of graph and scene, not both".into())),
    };
    let memory = match (body.session_id, body.recurrent_state) {
        (Some(id), None) => Some(Memory::SessionId(id)),
        (None, Some(state)) => Some(Memory::RecurrentState(state.0)),
        (None, None) => None,
        _ => return Err(Error::Schema("session_id: one of session_id and recurrent_state, not both".into())),
    };
    Ok(v1::ActRequest {
        policy: body.policy,
        observation,
        memory,
        step: body.step,
        run_id: body.run_id,
        return_q_values: body.return_q_values,
        seed: body.seed,
    })
}

impl From<Graph> for v1::Graph {
    fn from(graph: Graph) -> Self {
        let nodes = graph.nodes.into_iter().map(|node| v1::Node {
            id: node.id,
            kind: match node.kind {
                Kind::Uav => v1::NodeKind::Uav.into(),
                Kind::User => v1::NodeKind::User.into(),
            },
            detections: node.detections.into_iter().map(Into::into).collect(),
            position: node.position.map(|p| v1::Position { x: p.x, y: p.y }),
            aoi: node.aoi,
        });
        Self { nodes: nodes.collect() }
    }
}

impl From<Detection> for v1::Detection {
    fn from(d: Detection) -> Self {
        Self { target_id: d.target_id, rel_x: d.rel_x, rel_y: d.rel_y, aoi: d.aoi }
    }
}

impl From<Scene> for v1::Scene {
    fn from(scene: Scene) -> Self {
        Self {
            uavs: scene.uavs.into_iter().map(|u| v1::SceneUav { id: u.id, x: u.x, y: u.y }).collect(),
            users: scene.users.into_iter().map(|u| v1::SceneUser { id: u.id, x: u.x, y: u.y, aoi: u.aoi }).collect(),
        }
    }
}
