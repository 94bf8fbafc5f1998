//! The use case `Act`: computes a heading per UAV from the scene or graph of one fleet in one slot.
//!
//! The memory of the fleet is kept in a session (`session`), in a sequence (`sequence`) or by the caller (`recurrent_state`).

mod compute;
mod recurrent_state;
mod request;
mod sequence;
mod session;

pub use compute::{decode, decoding_cost};
pub use request::{MemoryLocation, Motion, Request, Response, Sequence, SequenceId};
pub use sequence::SEQUENCE_PREFIX;

use std::time::Instant;

use super::{App, Error};
use crate::service::keys::Caller;

/// Runs the policy for one slot. Sessions and sequences are those of the caller's owner, also for `admin`: nobody steps the fleet of
/// another owner by using the same name.
///
/// # Errors
/// [`Error::Draining`]; [`Error::NotFound`] for an unknown policy or session; [`Error::Invalid`]; [`Error::Precondition`] for
/// wrong steps, earlier runs, expired sessions, unloaded policies and sequences that have not started; [`Error::Busy`] if the
/// engine's queue is full; [`Error::Deadline`].
pub async fn act(app: &App, caller: &Caller, request: Request, deadline: Option<Instant>) -> Result<Response, Error> {
    app.admit()?;
    match &request.memory {
        MemoryLocation::Session(id) => {
            compute::record_in_span("session", id);
            let session = app.sessions.get(caller.owner(), id)?;
            with_deadline(deadline, session::act(app, &session, request, deadline)).await
        }
        MemoryLocation::Sequence(sequence) => {
            let sequence = sequence.clone();
            // Boxed, so that its size does not add to the future of other requests.
            with_deadline(deadline, Box::pin(sequence::act(app, caller.owner(), &sequence, request, deadline))).await
        }
        MemoryLocation::RecurrentState(state) => {
            let state = state.clone();
            recurrent_state::act(app, caller.owner(), &state, request, deadline).await
        }
    }
}

/// Applies the deadline while a request waits for another step of its session. The engine applies it in its own queue.
async fn with_deadline(
    deadline: Option<Instant>,
    response: impl Future<Output = Result<Response, Error>>,
) -> Result<Response, Error> {
    let Some(deadline) = deadline else { return response.await };
    let late = |_| Err(Error::Deadline("while another step of the session was running"));
    tokio::time::timeout_at(deadline.into(), response).await.unwrap_or_else(late)
}
