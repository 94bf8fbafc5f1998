//! `POST /v1/act`: the messages of `PolicyService.Act` as JSON. Names are those of the protocol, bytes are base64;
//! what the protocol cannot leave out (coordinates, ids) has to be there, and unknown fields are errors.

use std::sync::Arc;

use axum::Json;
use axum::extract::State;
use serde::Deserialize;

use super::extract;
use super::observation::{Graph, Scene};
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
