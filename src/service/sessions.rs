//! Opening, showing and ending sessions.

use std::sync::Arc;

use super::sequences::PREFIX;
use super::{App, Error};
use crate::invalid::{Invalid, in_range};
use crate::serving::{Entry, Opened, PolicySpec, SessionInfo, Table};

/// Opens a session pinned to what `policy` names now.
///
/// # Errors
/// An unknown policy, a name that is taken, a fenced run, too many sessions, draining.
pub async fn open(app: &App, policy: &PolicySpec, how: Opened) -> Result<SessionInfo, Error> {
    app.admit()?;
    if let Some(id) = how.id.as_deref().filter(|id| id.starts_with(PREFIX)) {
        let expected = format!("another name: those that begin with {PREFIX:?} belong to the Open Inference Protocol");
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

/// A page of open sessions in order of names, and the token of the next page.
///
/// # Errors
/// A page size out of range.
pub fn list(app: &App, size: u32, token: &str) -> Result<(Vec<SessionInfo>, Option<String>), Error> {
    let (page, next) = page(&app.sessions, size, token)?;
    Ok((page.iter().map(|session| session.info(app.sessions.ttl())).collect(), next))
}

/// A page of what `table` holds, and the token of the next one.
pub(super) fn page<T: Entry>(table: &Table<T>, size: u32, token: &str) -> Result<(Vec<Arc<T>>, Option<String>), Invalid> {
    let (page, more) = table.list(token, page_size(size)?);
    let next = page.last().filter(|_| more).map(|last| last.id().to_owned());
    Ok((page, next))
}

/// The size of a page: 100 unless said otherwise.
pub(super) fn page_size(size: u32) -> Result<usize, Invalid> {
    in_range("page_size", size, 0..=1000)?;
    Ok(if size == 0 { 100 } else { size as usize })
}
