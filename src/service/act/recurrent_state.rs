//! `Act` with memory that the caller keeps, as the bytes of `recurrent_state`.

use std::sync::Arc;
use std::time::Instant;

use bytes::Bytes;

use super::compute;
use super::request::{Placed, Request, Response};
use crate::error_code::ErrorCode;
use crate::invalid::Invalid;
use crate::service::{App, Error, policies};
use crate::serving::{
    FleetMemory, Flight, ListedUsers, Members, OutputBuffers, Owner, RecurrentState, Roster, RosterRules, Task, UserMemory,
};

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
        Some(state) => policies::pinned(app, spec, &state.digest, "recurrent_state").await?,
    };
    let implementation = &*policy.implementation;
    let flight = request.flight.map(|options| Flight::new(&options, implementation).map(Arc::new)).transpose()?;
    let placed = Placed::new(request.input, &policy, flight.as_ref(), request.return_motion)?;
    let sensing = placed.sensing(&policy);
    let Placed { fleet, canonical_of_request, content, speeds, endurance, flight, motion } = placed;
    let listed = content.listed_users();
    let open = listed == ListedUsers::Detected && implementation.remembers_users();
    let input = content.into_task_input(fleet.size(), implementation, sensing)?;
    let step = state.as_ref().map_or(0, |state| state.step);
    if let Some(sent) = request.step.filter(|&sent| sent != step) {
        let message = match &state {
            Some(_) => format!("step {sent} does not match recurrent_state, which belongs to step {step}"),
            None => format!(
                "step {sent} needs the recurrent_state of the response before; without one, a first request begins at step 0"
            ),
        };
        return Err(Error::Precondition { code: ErrorCode::WrongStep, message });
    }
    let seed = state.as_ref().map_or_else(|| request.seed.unwrap_or(0), |state| state.seed);
    let before = match &state {
        None => Roster::new(&fleet, step, open, UserMemory::of(&policy)),
        Some(state) => state.roster(&fleet, &policy)?,
    };
    let rules = RosterRules { policy: &policy, absent_after: app.absent_after, seed, listed };
    let (roster, change) = before.advance(&fleet, step, &rules);
    let memory = match state {
        None => FleetMemory::initial(implementation, before.size(), seed, Vec::new()),
        Some(state) => state.memory.unpack_small(implementation, before.size())?,
    };
    let task = Task::new(policy.clone(), input, step, memory, OutputBuffers::default()).with_change(Some(Box::new(change)));
    let task = Placed::in_world(task, flight.as_ref(), speeds, endurance);
    let task = if request.explain { task.explained(fleet.clone()) } else { task };
    let output = compute::run(app, owner, task, deadline).await?;
    let memory = output.memory.into_packed(implementation, roster.size());
    let (digest, step, members) = (policy.reference.digest, step.saturating_add(1), Members::Roster(roster));
    let next = RecurrentState { digest, step, seed, members, memory }.encode();
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
    let (uavs, decision, recurrent_state) = (fleet.uavs, output.decision, Some(next));
    Ok(Response { policy, uavs, canonical_of_request, decision, recurrent_state, flight, motion })
}
