//! `POST /v1/act`: the headings of one fleet in one slot.

use std::sync::Arc;

use axum::Json;
use axum::extract::State;
use serde::{Deserialize, Serialize};
use serde_json::json;
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::extract;
use super::json;
use super::observation::{Graph, Scene};
use super::openapi::{BadBody, Conflict, Draining, NotFound};
use super::policies::PolicyRef;
use super::schemas::{self, Base64, Seconds};
use crate::api::convert::request::ActFields;
use crate::api::convert::response::{self, actions, degrees};
use crate::api::offload;
use crate::invalid::Invalid;
use crate::service::{App, Error, act};
use crate::serving::{Decision, Observation, Timings};

/// The routes.
pub(super) fn router() -> OpenApiRouter<Arc<App>> {
    OpenApiRouter::new().routes(routes!(decide))
}

/// What the fleet observes in a slot, as `graph` or as `scene`, and its memory: a session, the `recurrent_state` of the previous
/// response, or nothing in slot 0.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(example = example)]
struct ActRequest {
    /// NAME (its newest version), NAME@ALIAS or NAME:VERSION. May be empty with a session.
    #[serde(default)]
    #[schema(schema_with = schemas::optional_policy_spec)]
    policy: String,
    graph: Option<Graph>,
    scene: Option<Scene>,
    #[schema(min_length = 1, max_length = 128)]
    session_id: Option<String>,
    recurrent_state: Option<Base64>,
    /// Slots since the episode began, from 0. Repeating the last step returns the same response.
    #[serde(default, deserialize_with = "json::optional_integer")]
    step: Option<u64>,
    /// Identifies one run of a simulator. A new one resets the session; an old one is refused.
    #[schema(min_length = 1, max_length = 128)]
    run_id: Option<String>,
    /// Also return Q-values.
    #[serde(default)]
    return_q_values: bool,
    /// Fixes what is random about the policy, in slot 0 of memory that the caller keeps.
    #[serde(default, deserialize_with = "json::optional_integer")]
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

impl ActRequest {
    fn is_large(&self) -> bool {
        self.graph.as_ref().map_or(0, Graph::len) + self.scene.as_ref().map_or(0, Scene::len) >= act::INLINE_NODES
    }
}

impl TryFrom<ActRequest> for act::Request {
    type Error = Invalid;

    fn try_from(request: ActRequest) -> Result<Self, Invalid> {
        let ActRequest { policy, graph, scene, session_id, recurrent_state, step, run_id, return_q_values: _, seed } = request;
        let observation = match (graph, scene) {
            (Some(graph), None) => Some(Observation::try_from(graph)?),
            (None, Some(scene)) => Some(Observation::try_from(scene)?),
            (None, None) => None,
            _ => return Err(Invalid::schema("graph", "graph and scene", "one of graph and scene")),
        };
        if session_id.is_some() && recurrent_state.is_some() {
            return Err(Invalid::schema("session_id", "session_id and recurrent_state", "one of them"));
        }
        let recurrent_state = recurrent_state.map(|state| state.0).unwrap_or_default();
        ActFields { policy, session_id, recurrent_state, step, run_id, seed }.request(observation)
    }
}

#[derive(Debug, Serialize, ToSchema)]
struct ActReply {
    /// One per UAV, in the order of the request.
    actions: Vec<Action>,
    policy: PolicyRef,
    /// The step that was answered.
    step: u64,
    /// Memory for the next slot, for callers that keep it.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    recurrent_state: Option<Base64>,
    #[schema(value_type = Durations)]
    timings: Durations,
}

#[derive(Debug, Serialize, ToSchema)]
struct Action {
    uav_id: String,
    /// Heading h of 45 h degrees; 8 hovers, where the policy allows it.
    #[schema(maximum = 8)]
    heading_index: u8,
    /// Degrees counter-clockwise from +x; absent when hovering.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    heading_deg: Option<f64>,
    /// Value of each heading, if requested and if the policy has values.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    q_values: Vec<f32>,
}

#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Timings)]
struct Durations {
    /// Waiting for the engine.
    queue: Seconds,
    /// Computing.
    compute: Seconds,
    /// Fleets computed together.
    batch_size: u32,
}

impl ActReply {
    fn new(mut response: act::Response, q_values: bool) -> Self {
        let action = |action: response::Action| Action {
            heading_index: action.heading,
            heading_deg: degrees(action.heading),
            uav_id: action.uav_id,
            q_values: action.q_values,
        };
        let actions = actions(&mut response, q_values).map(action).collect();
        let Decision { step, timings: Timings { queue, compute, batch_size, .. }, .. } = response.decision;
        Self {
            actions,
            policy: (&response.policy.reference).into(),
            step,
            recurrent_state: response.recurrent_state.filter(|state| !state.is_empty()).map(Base64),
            timings: Durations { queue: Seconds(queue), compute: Seconds(compute), batch_size },
        }
    }
}

/// Choose a heading for every UAV of a fleet in one slot
#[utoipa::path(
    post, path = "/v1/act", operation_id = "act", tag = "act", request_body = ActRequest,
    responses((status = 200, description = "A heading per UAV.", body = ActReply), BadBody, NotFound, Conflict, Draining)
)]
async fn decide(State(app): State<Arc<App>>, extract::Json(request): extract::Json<ActRequest>) -> Result<Json<ActReply>, Error> {
    let q_values = request.return_q_values;
    let request = offload(request.is_large(), move || act::Request::try_from(request)).await??;
    Ok(Json(ActReply::new(act::act(&app, request, None).await?, q_values)))
}
