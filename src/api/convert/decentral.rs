//! Requests and responses of `Encode` and `Decide`; the checks are the same for all transports.

use bytes::Bytes;

use super::flight::{self, FlightFields};
use super::response::{Action, Wanted};
use crate::invalid::Invalid;
use crate::service::decentral::{DecideRequest, Decided, EncodeRequest, Encoded};
use crate::serving::{Node, NodeDetection};
use crate::wire::v1;

impl TryFrom<v1::EncodeRequest> for EncodeRequest {
    type Error = Invalid;

    fn try_from(request: v1::EncodeRequest) -> Result<Self, Invalid> {
        let v1::EncodeRequest { policy, uav_ids, user_ids, observation, state, seed, step, frame, world } = request;
        let observation = observation.ok_or_else(missing_observation)?;
        let is_uav = match v1::NodeKind::try_from(observation.kind) {
            Ok(v1::NodeKind::Uav) => true,
            Ok(v1::NodeKind::User) => false,
            _ => return Err(Invalid::new("observation.kind", observation.kind, "NODE_KIND_UAV (1)")),
        };
        let detection = |d: v1::Detection| NodeDetection { target_id: d.target_id, rel: [d.rel_x, d.rel_y], aoi: d.aoi };
        let observation = Node {
            id: observation.id,
            is_uav,
            detections: observation.detections.into_iter().map(detection).collect(),
            position: observation.position.map(|p| [p.x, p.y]),
            aoi: observation.aoi,
            speed: observation.speed,
            endurance: observation.endurance_seconds,
        };
        let flight = flight::fields(frame, world, None, None)?.options()?;
        Ok(Self { policy: policy.parse()?, uav_ids, user_ids, observation, state, seed, step, flight })
    }
}

/// The error of a request without what the UAV observes.
pub fn missing_observation() -> Invalid {
    Invalid::missing("observation", "what the UAV observes itself")
}

impl TryFrom<v1::DecideRequest> for DecideRequest {
    type Error = Invalid;

    fn try_from(request: v1::DecideRequest) -> Result<Self, Invalid> {
        let v1::DecideRequest { policy, state, messages, frame, world, .. } = request;
        decide(&policy, state, messages, flight::fields(frame, world, None, None)?)
    }
}

/// The checked request.
///
/// # Errors
/// [`Invalid`] for an invalid name or area.
pub fn decide(policy: &str, state: Bytes, messages: Vec<Bytes>, flight: FlightFields) -> Result<DecideRequest, Invalid> {
    Ok(DecideRequest { policy: policy.parse()?, state, messages, flight: flight.options()? })
}

impl From<Encoded> for v1::EncodeResponse {
    fn from(encoded: Encoded) -> Self {
        let Encoded { policy, step, state, message, message_links, message_range } = encoded;
        Self { state, message, policy: Some((&policy.reference).into()), step, message_links, message_range }
    }
}

/// The action of a UAV that decided alone.
pub fn action(decided: &Decided, wanted: Wanted) -> Action {
    let Decided { decision, flight, speed, position, uav, .. } = decided;
    let heading = decision.heading;
    let known = wanted.q_values && decision.q_values.iter().all(|q| q.is_finite());
    Action {
        uav_id: uav.clone(),
        heading,
        degrees: flight.degrees(heading),
        q_values: if known { decision.q_values.clone() } else { Vec::new() },
        velocity: wanted.velocity.then(|| flight.velocity(heading, *speed)),
        waypoint: position.filter(|_| wanted.waypoint).map(|at| flight.waypoint(at, heading, *speed)),
        overruled: None,
        influences: Vec::new(),
    }
}

/// The response, with what is wanted.
pub fn decide_response(decided: Decided, wanted: Wanted) -> v1::DecideResponse {
    v1::DecideResponse {
        action: Some(action(&decided, wanted).into()),
        policy: Some((&decided.policy.reference).into()),
        state: decided.state,
        step: decided.step,
        missing_uav_ids: decided.missing,
    }
}
