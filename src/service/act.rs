//! The use case `Act`: an observation of one fleet in one slot in, a heading per UAV out.
//!
//! The memory of the fleet is kept in a session, in a sequence or by the caller: one file for each.

mod recurrent_state;
mod request;
mod sequence;
mod session;
mod slot;

pub use request::{Memory, Request, Response, Sequence, SequenceId};
pub use sequence::SEQUENCE_PREFIX;
pub use slot::INLINE_NODES;

use std::time::Instant;

use super::{App, Error};

/// Runs the policy for one slot.
///
/// # Errors
/// [`Error::Draining`]; [`Error::NotFound`] for an unknown policy or session; [`Error::Invalid`]; [`Error::Precondition`] for
/// wrong steps, fenced runs, expired sessions, unloaded policies and sequences that have not started; [`Error::Busy`] if the
/// engine's queue is full; [`Error::Deadline`].
pub async fn act(app: &App, request: Request, deadline: Option<Instant>) -> Result<Response, Error> {
    app.admit()?;
    match &request.memory {
        Memory::Session(id) => {
            slot::record_in_span("session", id);
            let session = app.sessions.get(id)?;
            within(deadline, session::act(app, &session, request, deadline)).await
        }
        Memory::Sequence(sequence) => {
            let sequence = sequence.clone();
            // Boxed, so that its size does not add to the future of other requests.
            within(deadline, Box::pin(sequence::act(app, &sequence, request, deadline))).await
        }
        Memory::RecurrentState(state) => {
            let state = state.clone();
            recurrent_state::act(app, &state, request, deadline).await
        }
    }
}

/// Applies the deadline to the wait for another step of the session. The engine applies it to its own queue.
async fn within(deadline: Option<Instant>, response: impl Future<Output = Result<Response, Error>>) -> Result<Response, Error> {
    let Some(deadline) = deadline else { return response.await };
    let late = |_| Err(Error::Deadline("behind another slot of the session"));
    tokio::time::timeout_at(deadline.into(), response).await.unwrap_or_else(late)
}
