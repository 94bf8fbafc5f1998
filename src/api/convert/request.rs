//! Requests of `PolicyService`.

use super::name;
use crate::invalid::Invalid;
use crate::service::act;
use crate::serving::{Observation, PolicySpec, SessionOptions};
use crate::wire::v1;

impl TryFrom<v1::ActRequest> for act::Request {
    type Error = Invalid;

    fn try_from(request: v1::ActRequest) -> Result<Self, Invalid> {
        use v1::act_request::{Memory, Observation as Sent};
        let policy = if request.policy.is_empty() { None } else { Some(request.policy.parse()?) };
        let memory = match request.memory {
            Some(Memory::SessionId(id)) => {
                name("session_id", &id)?;
                act::Memory::Session(id)
            }
            Some(Memory::RecurrentState(state)) => act::Memory::RecurrentState(state),
            None => act::Memory::RecurrentState(bytes::Bytes::new()),
        };
        if let Some(run_id) = &request.run_id {
            name("run_id", run_id)?;
        }
        let observation = match request.observation {
            Some(Sent::Graph(graph)) => Observation::try_from(graph)?,
            Some(Sent::Scene(scene)) => Observation::try_from(scene)?,
            None => return Err(Invalid::missing("observation", "a graph or a scene")),
        };
        Ok(Self { policy, observation, memory, step: request.step, run_id: request.run_id, seed: request.seed })
    }
}

/// What `OpenSession` asks for.
///
/// # Errors
/// A field that cannot be used.
pub fn open_session(request: v1::OpenSessionRequest) -> Result<(PolicySpec, SessionOptions), Invalid> {
    let policy = request.policy.parse()?;
    let id = Some(request.session_id).filter(|id| !id.is_empty());
    if let Some(id) = &id {
        name("session_id", id)?;
    }
    if let Some(run_id) = &request.run_id {
        name("run_id", run_id)?;
    }
    Ok((policy, SessionOptions { id, run_id: request.run_id, seed: request.seed }))
}
