//! `POST /v1/act`: the messages of `PolicyService.Act` as JSON. Names are those of the protocol, bytes are base64;
//! what the protocol cannot leave out (coordinates, ids) has to be there, and unknown fields are errors.

use std::sync::Arc;

use axum::Json;
use axum::extract::State;
use serde::Deserialize;
use serde_json::json;
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::extract;
use super::observation::{Graph, Scene};
use super::openapi::{BadBody, Conflict, Draining, NotFound};
use super::schemas;
use super::wording::{ActReply, Base64};
use crate::api::convert::response::act_response;
use crate::invalid::Invalid;
use crate::service::{App, Error, act as service};
use crate::wire::v1;

/// The routes.
pub(super) fn router() -> OpenApiRouter<Arc<App>> {
    OpenApiRouter::new().routes(routes!(act))
}

/// What the fleet sees in a slot, by `graph` or by `scene`, and what it remembers: a session, the `recurrent_state` of the last
/// answer, or nothing at slot 0.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = ActRequest, example = example)]
pub(super) struct Body {
    /// NAME (its newest version), NAME@ALIAS or NAME:VERSION. May be left empty when a session says it.
    #[serde(default)]
    #[schema(value_type = schemas::OptionalPolicySpec)]
    policy: String,
    graph: Option<Graph>,
    scene: Option<Scene>,
    #[schema(min_length = 1, max_length = 128)]
    session_id: Option<String>,
    recurrent_state: Option<Base64>,
    /// Slots since the episode began, from 0. Repeating the last step returns the same answer.
    step: Option<u64>,
    /// Names one run of a simulator. A new one resets the session; a former one is refused.
    #[schema(min_length = 1, max_length = 128)]
    run_id: Option<String>,
    /// Also return Q-values.
    #[serde(default)]
    return_q_values: bool,
    /// Fixes what is random about the policy, at slot 0 of memory that the caller keeps.
    seed: Option<u64>,
}

fn example() -> serde_json::Value {
    json!({
        "policy": "qedgix",
        "scene": {
            "uavs": [{"id": "a", "x": 0.5, "y": 0.5}, {"id": "b", "x": 0.5, "y": 0.5}, {"id": "c", "x": 0.5, "y": 0.5}],
            "users": [
                {"id": "u1", "x": 0.2, "y": 0.3, "aoi": 0}, {"id": "u2", "x": 0.6, "y": 0.7, "aoi": 0},
                {"id": "u3", "x": 0.9, "y": 0.1, "aoi": 0}, {"id": "u4", "x": 0.4, "y": 0.6, "aoi": 0},
                {"id": "u5", "x": 0.1, "y": 0.9, "aoi": 0}
            ]
        }
    })
}

/// One slot of one fleet: an observation in, a heading per UAV out
#[utoipa::path(
    post,
    path = "/v1/act",
    operation_id = "act",
    tag = "act",
    request_body = Body,
    responses((status = 200, description = "A heading per UAV.", body = ActReply), BadBody, NotFound, Conflict, Draining)
)]
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
        _ => return Err(Invalid::schema("graph", "graph and scene", "one of graph and scene").into()),
    };
    let memory = match (body.session_id, body.recurrent_state) {
        (Some(id), None) => Some(Memory::SessionId(id)),
        (None, Some(state)) => Some(Memory::RecurrentState(state.0)),
        (None, None) => None,
        _ => return Err(Invalid::schema("session_id", "session_id and recurrent_state", "one of them").into()),
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
