//! `Act` with memory that the caller keeps, as the bytes of `recurrent_state`.

use std::sync::Arc;
use std::time::Instant;

use bytes::Bytes;

use super::compute;
use super::request::{Request, Response};
use crate::error_code::ErrorCode;
use crate::invalid::Invalid;
use crate::service::{App, Error, policies};
use crate::serving::{FleetIds, FleetInput, FleetMemory, LoadedPolicy, OutputBuffers, Owner, PolicySpec, RecurrentState, Task};

pub(super) async fn act(
    app: &App,
    owner: &Owner,
    state: &Bytes,
    request: Request,
    deadline: Option<Instant>,
) -> Result<Response, Error> {
    let Some(spec) = &request.policy else {
        return Err(Invalid::missing("policy", "NAME, NAME@ALIAS or NAME:VERSION, or a session_id").into());
    };
    let state = if state.is_empty() { None } else { Some(RecurrentState::decode(state)?) };
    let policy = match &state {
        None => policies::resolve(app, spec).await?,
        Some(state) => pinned_version(app, spec, state).await?,
    };
    let FleetInput { fleet, canonical_of_request, content } = request.input;
    let input = content.into_task_input(fleet.size(), &*policy.implementation)?;
    let step = state.as_ref().map_or(0, |state| state.step);
    if let Some(sent) = request.step.filter(|&sent| sent != step) {
        let message = format!("step {sent} does not match recurrent_state, which belongs to step {step}");
        return Err(Error::Precondition { code: ErrorCode::WrongStep, message });
    }
    let memory = if let Some(state) = state {
        memory_of(state, &fleet, &policy)?
    } else {
        let seed = request.seed.unwrap_or(0);
        FleetMemory::initial(&*policy.implementation, fleet.size(), seed, Vec::new())
    };
    let task = Task::new(policy.clone(), input, step, memory, OutputBuffers::default());
    let output = compute::run(app, owner, task, deadline).await?;
    let memory = output.memory.into_packed(&*policy.implementation, fleet.size());
    let next = RecurrentState::new(policy.reference.digest, step.saturating_add(1), &fleet, memory).encode();
    // The caller has to be able to send it back, also in JSON, where it grows by a third, and with the scene of the next slot.
    let limit = app.max_message_size / 8 * 5;
    if next.len() > limit {
        let message = format!(
            "the recurrent_state of this fleet has {} bytes, and a request can return at most {limit} (5/8 of \
             --max-message-size); let the server keep the memory, in a session",
            next.len()
        );
        return Err(Error::TooLarge { message, limit: Some(limit as u64) });
    }
    Ok(Response { policy, uavs: fleet.uavs, canonical_of_request, decision: output.decision, recurrent_state: Some(next) })
}

/// The version that wrote `state`: an episode stays on its version even if an alias has moved or a newer version has been
/// published.
async fn pinned_version(app: &App, spec: &PolicySpec, state: &RecurrentState) -> Result<Arc<LoadedPolicy>, Error> {
    let found = app.registry.find_by_digest(spec, &state.digest)?.ok_or_else(|| {
        let expected = format!("the recurrent_state of an earlier response of {spec}");
        Error::from(Invalid::new("recurrent_state", "the state of another policy or version", expected))
    })?;
    policies::in_memory(app, found).await
}

/// The memory in `state`, checked against the fleet and the policy.
fn memory_of(state: RecurrentState, fleet: &FleetIds, policy: &LoadedPolicy) -> Result<FleetMemory, Invalid> {
    let wrong = |value: &str| {
        let expected = "the recurrent_state of an earlier response to the same UAVs and users";
        Invalid::new("recurrent_state", value, expected)
    };
    let (uavs, users) = fleet.size();
    if (state.uavs as usize, state.users as usize) != (uavs, users) {
        return Err(wrong(&format!("the state of {} UAVs and {} users", state.uavs, state.users)));
    }
    if state.fleet != fleet.fingerprint() {
        return Err(wrong("the state of UAVs or users with other ids"));
    }
    state.memory.unpack_small(&*policy.implementation, (uavs, users))
}
