//! Use cases of sessions: open, describe, close, list.

use std::sync::Arc;

use super::act::SEQUENCE_PREFIX;
use super::keys::Caller;
use super::{App, Error, Page, PageRequest, policies};
use crate::invalid::Invalid;
use crate::serving::{PolicySpec, Session, SessionInfo, SessionOptions, TableEntry};

/// Opens a session pinned to the version that `policy` resolves to.
///
/// # Errors
/// [`Error::Draining`]; [`Error::NotFound`] if the policy is unknown; [`Error::Invalid`] if the name belongs to sequences;
/// [`Error::Conflict`] if the name is taken; `policy_unloaded`; `run_fenced`; [`Error::Busy`] if the number of sessions is
/// exhausted.
pub async fn open(app: &App, caller: &Caller, policy: &PolicySpec, options: SessionOptions) -> Result<SessionInfo, Error> {
    app.admit()?;
    if let Some(id) = options.id.as_deref().filter(|id| id.starts_with(SEQUENCE_PREFIX)) {
        let expected = format!("an id that does not start with {SEQUENCE_PREFIX:?}, which the Open Inference Protocol reserves");
        return Err(Invalid::new("session_id", format!("{id:?}"), expected).into());
    }
    let policy = policies::resolve(app, policy).await?;
    Ok(app.sessions.open(caller.owner(), policy, options).await?)
}

/// Describes a session.
///
/// # Errors
/// [`Error::NotFound`], or `session_expired`.
pub fn get(app: &App, caller: &Caller, id: &str) -> Result<SessionInfo, Error> {
    Ok(app.sessions.describe(&caller.owner_among(&app.sessions, id), id)?)
}

/// Closes a session after its step in flight.
///
/// # Errors
/// [`Error::NotFound`], or `session_expired`.
pub async fn close(app: &App, caller: &Caller, id: &str) -> Result<SessionInfo, Error> {
    Ok(app.sessions.close(&caller.owner_among(&app.sessions, id), id).await?)
}

/// A page of the open sessions that the caller sees, in order of names.
///
/// # Errors
/// [`Error::Invalid`]: the page size is out of range.
pub fn list(app: &App, caller: &Caller, page: &PageRequest) -> Result<Page<SessionInfo>, Error> {
    let (owner, id) = caller.list_position(&page.token);
    let (sessions, more) = app.sessions.list(caller.sees(), (id, &owner), page.usual_limit()?);
    let token = |session: &Arc<Session>| caller.list_token(session.owner(), session.id());
    Ok(Page::new(sessions, more, token).map(|session| session.info(app.sessions.ttl())))
}
