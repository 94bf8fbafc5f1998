//! `POST /v1/encode` and `POST /v1/decide`: one UAV decides alone.

use std::sync::Arc;

use axum::Json;
use axum::extract::State;
use serde::{Deserialize, Serialize};
use serde_json::json;
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::act::Action;
use super::extract;
use super::openapi::{BadBody, Conflict, Draining, NotFound};
use super::policies::PolicyRef;
use super::scene_graph::Node;
use super::schemas::{self, Base64};
use crate::api::convert::decentral;
use crate::api::convert::response::Wanted;
use crate::api::flight::{self, Frame, World};
use crate::api::json;
use crate::invalid::Invalid;
use crate::service::decentral as service;
use crate::service::keys::Caller;
use crate::service::{App, Error};

/// The routes.
pub(super) fn router() -> OpenApiRouter<Arc<App>> {
    OpenApiRouter::new().routes(routes!(encode)).routes(routes!(decide))
}

/// What one UAV observes itself, and its state.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(example = example)]
struct EncodeRequest {
    /// NAME, NAME@ALIAS or NAME:VERSION. All UAVs of a fleet use the same version. Not one that needs a scene.
    #[schema(schema_with = schemas::policy_spec)]
    policy: String,
    /// The ids of all UAVs of the fleet, the same for all of them. Required without a state, left out with one.
    #[serde(default)]
    #[schema(max_items = 20000)]
    uav_ids: Vec<String>,
    /// The ids of all users, the same for all UAVs. Their positions need not be known.
    #[serde(default)]
    #[schema(max_items = 20000)]
    user_ids: Vec<String>,
    /// This UAV, and what it detects itself.
    observation: Node,
    /// The state after `decide` in the previous slot. Absent: the UAV begins.
    state: Option<Base64>,
    /// Seed of the random choices of the policy, the same for all UAVs. Used without a state. Default: 0.
    #[serde(default, deserialize_with = "json::optional_integer")]
    seed: Option<u64>,
    /// Index of the slot. Default: 0 without a state, else the next one.
    #[serde(default, deserialize_with = "json::optional_integer")]
    step: Option<u64>,
    /// The area and the world, the same for all UAVs in every slot.
    frame: Option<Frame>,
    world: Option<World>,
}

fn example() -> serde_json::Value {
    json!({
        "policy": "qedgix",
        "uav_ids": ["a", "b"],
        "user_ids": ["u1", "u2"],
        "observation": {
            "id": "a", "kind": "uav", "position": {"x": 0.5, "y": 0.5},
            "detections": [{"target_id": "b", "rel_x": 0.1, "rel_y": 0}, {"target_id": "u1", "rel_x": 0, "rel_y": -0.1, "aoi": 3}]
        }
    })
}

impl TryFrom<EncodeRequest> for service::EncodeRequest {
    type Error = Invalid;

    fn try_from(request: EncodeRequest) -> Result<Self, Invalid> {
        let EncodeRequest { policy, uav_ids, user_ids, observation, state, seed, step, frame, world } = request;
        let flight = flight::fields(frame, world, None, None)?.options()?;
        let state = state.map(|state| state.0).unwrap_or_default();
        let observation = observation.into_domain();
        Ok(Self { policy: policy.parse()?, uav_ids, user_ids, observation, state, seed, step, flight })
    }
}

#[derive(Debug, Serialize, ToSchema)]
struct EncodeResponse {
    /// The state for `decide`.
    state: Base64,
    /// The message to other UAVs, for this slot.
    message: Base64,
    policy: PolicyRef,
    step: u64,
    /// `decide` needs the messages of the UAVs within so many links; absent: those of all UAVs.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    message_links: Option<u32>,
    /// Distance within which all these UAVs are, in units of the caller; absent: any distance.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    message_range: Option<f64>,
}

/// Begin the slot of one UAV that decides alone
///
/// Takes what the UAV observes itself and its state, returns its message to other UAVs.
#[utoipa::path(
    post, path = "/v1/encode", operation_id = "encode", tag = "act", request_body = EncodeRequest,
    responses((status = 200, description = "The message.", body = EncodeResponse), BadBody, NotFound, Conflict, Draining)
)]
async fn encode(
    State(app): State<Arc<App>>,
    caller: Caller,
    extract::Json(request): extract::Json<EncodeRequest>,
) -> Result<Json<EncodeResponse>, Error> {
    let encoded = service::encode(&app, &caller, request.try_into()?, None).await?;
    let service::Encoded { policy, step, state, message, message_links, message_range } = encoded;
    let (state, message, policy) = (Base64(state), Base64(message), (&policy.reference).into());
    Ok(Json(EncodeResponse { state, message, policy, step, message_links, message_range }))
}

/// The state of a UAV after `encode`, and the messages that it received.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
struct DecideRequest {
    /// The policy of the state.
    #[schema(schema_with = schemas::policy_spec)]
    policy: String,
    /// The state after `encode`.
    state: Base64,
    /// Messages of other UAVs for this slot, in any order. The own one and repeated ones are ignored.
    #[serde(default)]
    #[schema(max_items = 4096)]
    messages: Vec<Base64>,
    /// Whether to return Q-values.
    #[serde(default)]
    return_q_values: bool,
    /// Whether to return the velocity of the UAV.
    #[serde(default)]
    return_velocity: bool,
    /// Whether to return where the UAV should be after the slot, if its position is known.
    #[serde(default)]
    return_waypoint: bool,
    /// As in `encode`.
    frame: Option<Frame>,
    world: Option<World>,
}

#[derive(Debug, Serialize, ToSchema)]
struct DecideResponse {
    action: Action,
    /// The state for `encode` in the next slot.
    state: Base64,
    policy: PolicyRef,
    step: u64,
    /// Ids of UAVs that this UAV detects and whose messages are missing. The heading may differ from that of `act`.
    missing_uav_ids: Vec<String>,
}

/// Decide the heading of one UAV that decides alone
///
/// With the messages that `encode` asks for, the heading has the bits of `act` for the whole fleet.
#[utoipa::path(
    post, path = "/v1/decide", operation_id = "decide", tag = "act", request_body = DecideRequest,
    responses((status = 200, description = "The heading.", body = DecideResponse), BadBody, NotFound, Conflict, Draining)
)]
async fn decide(
    State(app): State<Arc<App>>,
    caller: Caller,
    extract::Json(request): extract::Json<DecideRequest>,
) -> Result<Json<DecideResponse>, Error> {
    let DecideRequest { policy, state, messages, return_q_values, return_velocity, return_waypoint, frame, world } = request;
    let wanted = Wanted { q_values: return_q_values, velocity: return_velocity, waypoint: return_waypoint };
    let messages = messages.into_iter().map(|message| message.0).collect();
    let request = decentral::decide(&policy, state.0, messages, flight::fields(frame, world, None, None)?)?;
    let decided = service::decide(&app, &caller, request, None).await?;
    let action = decentral::action(&decided, wanted).into();
    let service::Decided { policy, step, state, missing, .. } = decided;
    Ok(Json(DecideResponse { action, state: Base64(state), policy: (&policy.reference).into(), step, missing_uav_ids: missing }))
}
