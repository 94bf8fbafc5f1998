//! Use cases of sessions: open, describe, close, list.

use super::act::SEQUENCE_PREFIX;
use super::{App, Error, Page, PageRequest};
use crate::invalid::Invalid;
use crate::serving::{PolicySpec, SessionInfo, SessionOptions, TableEntry};

/// Opens a session pinned to the version that `policy` resolves to.
///
/// # Errors
/// [`Error::Draining`]; [`Error::NotFound`] if the policy is unknown; [`Error::Invalid`] if the name belongs to sequences;
/// [`Error::Conflict`] if the name is taken; `policy_unloaded`; `run_fenced`; [`Error::Busy`] if the number of sessions is
/// exhausted.
pub async fn open(app: &App, policy: &PolicySpec, options: SessionOptions) -> Result<SessionInfo, Error> {
    app.admit()?;
    if let Some(id) = options.id.as_deref().filter(|id| id.starts_with(SEQUENCE_PREFIX)) {
        let expected = format!("an id that does not start with {SEQUENCE_PREFIX:?}, which the Open Inference Protocol reserves");
        return Err(Invalid::new("session_id", format!("{id:?}"), expected).into());
    }
    let policy = app.registry.resolve(policy)?;
    Ok(app.sessions.open(policy, options).await?)
}

/// Describes a session.
///
/// # Errors
/// [`Error::NotFound`], or `session_expired`.
pub fn get(app: &App, id: &str) -> Result<SessionInfo, Error> {
    Ok(app.sessions.describe(id)?)
}

/// Closes a session after its step in flight.
///
/// # Errors
/// [`Error::NotFound`], or `session_expired`.
pub async fn close(app: &App, id: &str) -> Result<SessionInfo, Error> {
    Ok(app.sessions.close(id).await?)
}

/// A page of open sessions in order of names.
///
/// # Errors
/// [`Error::Invalid`]: the page size is out of range.
pub fn list(app: &App, page: &PageRequest) -> Result<Page<SessionInfo>, Error> {
    let (sessions, more) = app.sessions.list(&page.token, page.usual_limit()?);
    Ok(Page::new(sessions, more, |session| session.id().to_owned()).map(|session| session.info(app.sessions.ttl())))
}
