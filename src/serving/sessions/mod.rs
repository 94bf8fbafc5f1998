//! Sessions: fleets whose memory the server keeps. This file owns their beginning and end; `session` owns the steps of one of
//! them.

mod seed;
mod session;

use session::EMPTY_SESSION;
pub use session::{Listed, PendingStep, Session, SessionInfo, SessionOptions, StepStart};

use std::sync::Arc;

use super::table::{Lookup, Table, generate_id};
use super::{Error, Flight, FlightOptions, LoadedPolicy, Owner};

/// All sessions of this server.
pub type Sessions = Table<Session>;

impl Sessions {
    /// Opens a session of `owner`, pinned to `policy`.
    ///
    /// If a session of that name is open, the call is a retry, provided that the session was opened with the same options and
    /// has no step. With a new `run_id` the call restarts that session, on the version that it is pinned to.
    ///
    /// # Errors
    /// [`Error::Conflict`] if the name is taken, `run_fenced` if `run_id` names a former run, [`Error::Busy`] if the number or
    /// the memory of sessions is exhausted.
    pub async fn open(&self, owner: &Owner, policy: Arc<LoadedPolicy>, options: SessionOptions) -> Result<SessionInfo, Error> {
        let flight = flight(&policy, &options)?;
        let id = options.id.clone().unwrap_or_else(generate_id);
        // Checked first, so that a retry succeeds even if no memory is left.
        let session = if let Some(session) = self.peek(owner, &id) {
            Lookup::Found(session)
        } else {
            let charge = self.charge_memory(owner, EMPTY_SESSION)?;
            let make =
                || Session::new((owner.clone(), id.clone()), policy.clone(), (&options, flight), charge, self.clock().clone());
            self.find_or_add(owner, &id, make)?
        };
        let session = match session {
            Lookup::Added(session) => session,
            Lookup::Found(session) => {
                session.retry_or_restart(&policy, &options).await?;
                session
            }
        };
        Ok(session.info(self.ttl()))
    }

    /// Starts session `id` of `owner`, pinned to `policy`, in place of the session of that name, if any. Steps of that session that are in
    /// flight complete.
    ///
    /// # Errors
    /// [`Error::Busy`] if the number or the memory of sessions is exhausted, [`Error::Invalid`] for a frame or a world that is not valid.
    pub fn start_replacing(
        &self,
        owner: &Owner,
        id: &str,
        policy: Arc<LoadedPolicy>,
        options: SessionOptions,
    ) -> Result<Arc<Session>, Error> {
        let flight = flight(&policy, &options)?;
        let name = (owner.clone(), id.to_owned());
        let charge = self.charge_memory(owner, EMPTY_SESSION)?;
        self.replace(owner, id, || Session::new(name, policy, (&options, flight), charge, self.clock().clone()))
    }

    /// Removes a session that [`Sessions::start_replacing`] started, unless another session has taken its name.
    pub fn discard(&self, session: &Arc<Session>) {
        self.remove(session);
    }

    /// Puts the session that [`Sessions::start_replacing`] replaced with `session` back in its place.
    pub fn restore(&self, session: &Arc<Session>, former: &Arc<Session>) {
        self.replace_with(session, former);
    }

    /// Describes session `id` of `owner`, and counts as a use of it.
    ///
    /// # Errors
    /// `session_expired`, or [`Error::NotFound`].
    pub fn describe(&self, owner: &Owner, id: &str) -> Result<SessionInfo, Error> {
        Ok(self.get(owner, id)?.info(self.ttl()))
    }

    /// Closes session `id` of `owner`. Waits for the step in flight.
    ///
    /// # Errors
    /// `session_expired`, or [`Error::NotFound`].
    pub async fn close(&self, owner: &Owner, id: &str) -> Result<SessionInfo, Error> {
        let session = self.get(owner, id)?;
        self.remove(&session);
        session.close().await;
        Ok(session.info(self.ttl()))
    }
}

/// The frame and the world of a session with these options, if it has its own.
fn flight(policy: &LoadedPolicy, options: &SessionOptions) -> Result<Option<Arc<Flight>>, Error> {
    let flight = |options: &FlightOptions| Flight::new(options, &*policy.implementation).map(Arc::new);
    Ok(options.flight.as_deref().map(flight).transpose()?)
}

#[cfg(test)]
mod tests;
