//! Sessions: fleets whose memory the server keeps. This file owns how they begin and end; `session` what one may do, and
//! the table which there are.

mod session;

pub use session::{Answered, Session, Turn};

use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;

use super::table::{Found, Table, fresh_name};
use super::{Error, LoadedPolicy, PolicyRef};

/// What a caller is told of a session.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SessionInfo {
    /// Its name.
    pub id: String,
    /// The policy version it is pinned to.
    pub policy: PolicyRef,
    /// Slots answered in the current run.
    pub steps: u64,
    /// When it was opened.
    pub opened_at: Timestamp,
    /// Idle time after which it expires.
    pub ttl: Duration,
}

/// How to open a session.
#[derive(Clone, Debug, Default)]
pub struct Opened {
    /// Chosen by the server when absent.
    pub id: Option<String>,
    /// The run it begins with.
    pub run_id: Option<String>,
    /// Fixes what is random about the policy; when absent, session and run do.
    pub seed: Option<u64>,
}

/// All sessions of this server.
pub type Sessions = Table<Session>;

impl Sessions {
    /// Opens a session pinned to `policy`.
    ///
    /// With the name of an open session it is a retry if that session has not flown and was opened alike; with a new
    /// `run_id` it starts that session over, on the version it is pinned to.
    ///
    /// # Errors
    /// The name is taken, the run is fenced, or there are too many sessions.
    pub async fn open(&self, policy: Arc<LoadedPolicy>, how: Opened) -> Result<SessionInfo, Error> {
        let id = how.id.clone().unwrap_or_else(fresh_name);
        let make = || Session::new(id.clone(), policy.clone(), &how, self.clock().clone());
        let session = match self.find_or_add(&id, make)? {
            Found::New(session) => session,
            Found::Existing(session) => {
                session.reopen(&policy, &how).await?;
                session
            }
        };
        Ok(session.info(self.ttl()))
    }

    /// Begins session `id` pinned to `policy`, whether or not there is one of that name. Slots of the former one that are in
    /// flight are answered.
    ///
    /// # Errors
    /// There are too many sessions.
    pub fn begin(&self, id: &str, policy: Arc<LoadedPolicy>, seed: Option<u64>) -> Result<Arc<Session>, Error> {
        let how = Opened { seed, ..Opened::default() };
        self.replace(id, || Session::new(id.to_owned(), policy, &how, self.clock().clone()))
    }

    /// Forgets a session that [`Sessions::begin`] began, unless another one was begun since.
    pub fn discard(&self, session: &Arc<Session>) {
        self.remove(session);
    }

    /// What a caller is told of session `id`; asking keeps it alive.
    ///
    /// # Errors
    /// It expired, or there is none.
    pub fn describe(&self, id: &str) -> Result<SessionInfo, Error> {
        Ok(self.get(id)?.info(self.ttl()))
    }

    /// Ends session `id` after the slot in flight, if there is one.
    ///
    /// # Errors
    /// It expired, or there is none.
    pub async fn close(&self, id: &str) -> Result<SessionInfo, Error> {
        let session = self.get(id)?;
        self.remove(&session);
        session.end().await;
        Ok(session.info(self.ttl()))
    }
}

#[cfg(test)]
mod tests;
