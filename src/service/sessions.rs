//! Opening, showing and ending sessions.

use super::sequences::PREFIX;
use super::{App, Error, Page, PageRequest};
use crate::invalid::Invalid;
use crate::serving::{Entry, Opened, PolicySpec, SessionInfo};

/// Opens a session pinned to what `policy` names now.
///
/// # Errors
/// An unknown policy, a name that is taken, a fenced run, too many sessions, draining.
pub async fn open(app: &App, policy: &PolicySpec, how: Opened) -> Result<SessionInfo, Error> {
    app.admit()?;
    if let Some(id) = how.id.as_deref().filter(|id| id.starts_with(PREFIX)) {
        let expected = format!("an id that does not start with {PREFIX:?}, which the Open Inference Protocol reserves");
        return Err(Invalid::new("session_id", format!("{id:?}"), expected).into());
    }
    let policy = app.registry.resolve(policy)?;
    Ok(app.sessions.open(policy, how).await?)
}

/// Shows a session.
///
/// # Errors
/// It expired, or there is none.
pub fn get(app: &App, id: &str) -> Result<SessionInfo, Error> {
    Ok(app.sessions.describe(id)?)
}

/// Ends a session after its slot in flight.
///
/// # Errors
/// It expired, or there is none.
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
