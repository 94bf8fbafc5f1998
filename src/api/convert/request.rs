//! Requests of `PolicyService`; the checks are the same for REST.

use bytes::Bytes;

use super::flight::{self, FlightFields};
use crate::invalid::Invalid;
use crate::service::act;
use crate::serving::{FleetIds, FleetInput, PolicySpec, SessionOptions};
use crate::wire::v1;

/// An `Act` request without its scene or graph, not checked yet.
#[derive(Debug)]
pub struct ActFields {
    /// Empty: the policy of the session.
    pub policy: String,
    /// The session that keeps the memory.
    pub session_id: Option<String>,
    /// The recurrent state that the caller keeps; empty with a session.
    pub recurrent_state: Bytes,
    /// The step, if the caller sends it.
    pub step: Option<u64>,
    /// The run, if the caller names it.
    pub run_id: Option<String>,
    /// The seed, if the caller sets it.
    pub seed: Option<u64>,
    /// The frame and the world, if the request describes them.
    pub flight: FlightFields,
    /// Whether velocities or waypoints are requested.
    pub return_motion: bool,
    /// Whether the response says why.
    pub explain: bool,
}

impl ActFields {
    /// The checked request.
    ///
    /// # Errors
    /// [`Invalid`] for an invalid name, an area without size, or if there is neither a scene nor a graph.
    pub fn request(self, input: Option<FleetInput>) -> Result<act::Request, Invalid> {
        let Self { policy, session_id, recurrent_state, step, run_id, seed, flight, return_motion, explain } = self;
        let flight = flight.options()?;
        let policy = if policy.is_empty() { None } else { Some(policy.parse()?) };
        check_ids(session_id.as_deref(), run_id.as_deref())?;
        let memory = session_id.map_or(act::MemoryLocation::RecurrentState(recurrent_state), act::MemoryLocation::Session);
        let input = input.ok_or_else(|| Invalid::missing("observation", "a graph or a scene"))?;
        Ok(act::Request { policy, input, memory, step, run_id, seed, flight, return_motion, explain })
    }
}

fn check_ids(session_id: Option<&str>, run_id: Option<&str>) -> Result<(), Invalid> {
    session_id.map_or(Ok(()), |id| FleetIds::check_id("session_id", id))?;
    run_id.map_or(Ok(()), |id| FleetIds::check_id("run_id", id))
}

impl TryFrom<v1::ActRequest> for act::Request {
    type Error = Invalid;

    fn try_from(request: v1::ActRequest) -> Result<Self, Invalid> {
        use v1::act_request::{Memory, Observation as Sent};
        let return_motion = request.return_velocity || request.return_waypoint;
        let v1::ActRequest {
            policy, observation, memory, step, run_id, seed, symmetric, frame, world, constraints, explain, ..
        } = request;
        let flight = flight::fields(frame, world, symmetric, constraints)?;
        let (session_id, recurrent_state) = match memory {
            Some(Memory::SessionId(id)) => (Some(id), Bytes::new()),
            Some(Memory::RecurrentState(state)) => (None, state),
            None => (None, Bytes::new()),
        };
        let input = match observation {
            Some(Sent::Graph(graph)) => Some(graph.try_into()?),
            Some(Sent::Scene(scene)) => Some(scene.try_into()?),
            None => None,
        };
        ActFields { policy, session_id, recurrent_state, step, run_id, seed, flight, return_motion, explain }.request(input)
    }
}

/// The policy and the options of a session to open. With an empty `session_id` the server generates an id.
///
/// # Errors
/// [`Invalid`] for an invalid name.
pub fn open_session(
    policy: &str,
    session_id: String,
    run_id: Option<String>,
    seed: Option<u64>,
    flight: FlightFields,
) -> Result<(PolicySpec, SessionOptions), Invalid> {
    let policy = policy.parse()?;
    let id = Some(session_id).filter(|id| !id.is_empty());
    check_ids(id.as_deref(), run_id.as_deref())?;
    Ok((policy, SessionOptions { id, run_id, seed, flight: flight.options()? }))
}
