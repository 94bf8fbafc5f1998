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
use super::openapi::{BadBody, Conflict, Draining, NotFound};
use super::policies::PolicyRef;
use super::scene_graph::{Graph, Scene};
use super::schemas::{self, Base64, Seconds};
use crate::api::convert::request::ActFields;
use crate::api::convert::response::{self, Wanted, actions};
use crate::api::flight::{self, Constraints, Frame, Overruled, World};
use crate::api::json;
use crate::env::Point;
use crate::invalid::Invalid;
use crate::service::keys::Caller;
use crate::service::{App, Error, act};
use crate::serving::{self, Decision, FleetInput};

/// The routes.
pub(super) fn router() -> OpenApiRouter<Arc<App>> {
    OpenApiRouter::new().routes(routes!(decide))
}

/// The scene or the graph of a fleet in one slot, and its recurrent state: a session, the `recurrent_state` of the previous
/// response, or neither in slot 0.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(example = example)]
#[allow(clippy::struct_excessive_bools, reason = "independent switches of a request")]
struct ActRequest {
    /// NAME (its newest version), NAME@ALIAS or NAME:VERSION. Optional with a session; if set, it must name the policy of the
    /// session.
    #[serde(default)]
    #[schema(schema_with = schemas::optional_policy_spec)]
    policy: String,
    graph: Option<Graph>,
    scene: Option<Scene>,
    #[schema(min_length = 1, max_length = 128)]
    session_id: Option<String>,
    recurrent_state: Option<Base64>,
    /// Index of the slot in the session or episode, from 0. Default: the next step. In a session, repeating the last step
    /// returns the same response.
    #[serde(default, deserialize_with = "json::optional_integer")]
    step: Option<u64>,
    /// Identifies one run of a simulator. A new `run_id` restarts the session; an earlier `run_id` is rejected (`run_fenced`).
    /// Ignored without a session.
    #[schema(min_length = 1, max_length = 128)]
    run_id: Option<String>,
    /// Whether to return Q-values.
    #[serde(default)]
    return_q_values: bool,
    /// Seed of the random choices of the policy; used in slot 0 if the caller keeps the state. Default: 0. Not accepted with a
    /// session.
    #[serde(default, deserialize_with = "json::optional_integer")]
    seed: Option<u64>,
    /// Whether, where only one of two nodes of a graph reports the other, both detect each other; default: true. This, `frame`,
    /// `world` and `constraints` are not accepted with a session: set them when you open it. Without one, send the same in every slot.
    symmetric: Option<bool>,
    frame: Option<Frame>,
    world: Option<World>,
    constraints: Option<Constraints>,
    /// Whether to return the velocity of each UAV.
    #[serde(default)]
    return_velocity: bool,
    /// Whether to return where each UAV should be after the slot. UAVs without a position in the request get none.
    #[serde(default)]
    return_waypoint: bool,
    /// Whether to return what speaks for and against each heading. Takes a run of the policy per detection of a UAV.
    #[serde(default)]
    explain: bool,
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
    /// Estimated cost of converting the request.
    fn decoding_cost(&self) -> usize {
        let (nodes, detections) = self.graph.as_ref().map_or((0, 0), Graph::len);
        act::decoding_cost(nodes + self.scene.as_ref().map_or(0, Scene::len), detections)
    }
}

impl TryFrom<ActRequest> for act::Request {
    type Error = Invalid;

    fn try_from(request: ActRequest) -> Result<Self, Invalid> {
        let return_motion = request.return_velocity || request.return_waypoint;
        let ActRequest {
            policy,
            graph,
            scene,
            session_id,
            recurrent_state,
            step,
            run_id,
            seed,
            symmetric,
            frame,
            world,
            constraints,
            explain,
            ..
        } = request;
        let flight = flight::fields(frame, world, symmetric, constraints)?;
        let observation = match (graph, scene) {
            (Some(graph), None) => Some(FleetInput::try_from(graph)?),
            (None, Some(scene)) => Some(FleetInput::try_from(scene)?),
            (None, None) => None,
            _ => return Err(Invalid::schema("graph", "graph and scene", "one of graph and scene")),
        };
        if session_id.is_some() && recurrent_state.is_some() {
            return Err(Invalid::schema("session_id", "session_id and recurrent_state", "one of them"));
        }
        let recurrent_state = recurrent_state.map(|state| state.0).unwrap_or_default();
        ActFields { policy, session_id, recurrent_state, step, run_id, seed, flight, return_motion, explain }.request(observation)
    }
}

#[derive(Debug, Serialize, ToSchema)]
struct ActResponse {
    /// One per UAV, in the order of the request.
    actions: Vec<Action>,
    policy: PolicyRef,
    /// Index of the slot that the actions are for.
    step: u64,
    /// The recurrent state for the next request, if the caller keeps it.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    recurrent_state: Option<Base64>,
    timings: Timings,
}

#[derive(Debug, Serialize, ToSchema)]
pub(super) struct Action {
    uav_id: String,
    /// Heading index h: direction 45*h degrees counter-clockwise from the x axis of the area; 8 = hover, if the policy supports it.
    #[schema(maximum = 8)]
    heading_index: u8,
    /// Direction in degrees, counter-clockwise from the x axis of the caller; absent for hover.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    heading_deg: Option<f64>,
    /// Q-value of each heading, if requested and if the policy has Q-values.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    q_values: Vec<f32>,
    /// Velocity along the axes of the caller, per second, if requested.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    velocity: Option<Vector>,
    /// Where the UAV should be after the slot, if requested: in the area, unless the boundary is free.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    waypoint: Option<Vector>,
    /// Set if constraints changed the heading, or if the heading breaks one.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    overruled: Option<Overruled>,
    /// What speaks for and against the heading, the strongest first, if `explain` was set and if the policy has Q-values.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    influences: Vec<Influence>,
}

/// What one detection, or one message of another UAV, means for the heading that the policy prefers.
#[derive(Debug, Serialize, ToSchema)]
struct Influence {
    /// The node that the UAV detects, or the UAV that sends the message.
    node_id: String,
    /// Whether it is the message of the node: what it detects and remembers. Otherwise it is its detection.
    message: bool,
    /// The Q-value of the heading minus that without the detection or message. Positive: it speaks for the heading.
    change: f32,
}

impl From<response::Action> for Action {
    fn from(action: response::Action) -> Self {
        Self {
            heading_index: action.heading,
            heading_deg: action.degrees,
            uav_id: action.uav_id,
            q_values: action.q_values,
            velocity: action.velocity.map(Into::into),
            waypoint: action.waypoint.map(Into::into),
            overruled: action.overruled.map(Into::into),
            influences: action
                .influences
                .into_iter()
                .map(|of| Influence { node_id: of.node, message: of.message, change: of.change })
                .collect(),
        }
    }
}

/// A velocity or a position, along the axes of the caller.
#[derive(Debug, Serialize, ToSchema)]
struct Vector {
    x: f64,
    y: f64,
}

impl From<Point> for Vector {
    fn from([x, y]: Point) -> Self {
        Self { x, y }
    }
}

#[derive(Debug, Serialize, ToSchema)]
struct Timings {
    /// Time that the fleet waited in the queue of the engine.
    queue: Seconds,
    /// Duration of the forward pass.
    compute: Seconds,
    /// Number of fleets in the forward pass.
    batch_size: u32,
}

impl ActResponse {
    fn new(mut response: act::Response, wanted: Wanted) -> Self {
        let actions = actions(&mut response, wanted).map(Into::into).collect();
        let Decision { step, timings: serving::Timings { queue, compute, batch_size, .. }, .. } = response.decision;
        Self {
            actions,
            policy: (&response.policy.reference).into(),
            step,
            recurrent_state: response.recurrent_state.filter(|state| !state.is_empty()).map(Base64),
            timings: Timings { queue: Seconds(queue), compute: Seconds(compute), batch_size },
        }
    }
}

/// Choose a heading for every UAV of a fleet in one slot
#[utoipa::path(
    post, path = "/v1/act", operation_id = "act", tag = "act", request_body = ActRequest,
    responses((status = 200, description = "A heading per UAV.", body = ActResponse), BadBody, NotFound, Conflict, Draining)
)]
async fn decide(
    State(app): State<Arc<App>>,
    caller: Caller,
    extract::Json(request): extract::Json<ActRequest>,
) -> Result<Json<ActResponse>, Error> {
    let (q_values, velocity, waypoint) = (request.return_q_values, request.return_velocity, request.return_waypoint);
    let (wanted, cost) = (Wanted { q_values, velocity, waypoint }, request.decoding_cost());
    let decode = move || act::Request::try_from(request);
    let request = act::decode(&app, &caller, cost, None, decode).await??;
    Ok(Json(ActResponse::new(act::act(&app, &caller, request, None).await?, wanted)))
}
