//! Which policies there are; publishing a checkpoint as a new version of one.

use std::sync::Arc;

use super::sessions::page_size;
use super::{App, Error};
use crate::serving::{LoadedPolicy, PolicySpec};

/// A policy version with what surrounds it.
#[derive(Clone, Debug)]
pub struct Described {
    /// The version.
    pub policy: Arc<LoadedPolicy>,
    /// Aliases that mean this version.
    pub aliases: Vec<String>,
    /// All versions of this name.
    pub versions: Vec<u64>,
}

/// A page of policies in order of names, each in its newest version, and the token of the next page.
///
/// # Errors
/// A page size out of range.
pub fn list(app: &App, size: u32, token: &str) -> Result<(Vec<Described>, Option<String>), Error> {
    let (page, more) = app.registry.list(token, page_size(size)?);
    let next = page.last().filter(|_| more).map(|last| last.reference.name.clone());
    Ok((page.into_iter().map(|policy| describe(app, policy)).collect(), next))
}

/// The version that `spec` names.
///
/// # Errors
/// There is none.
pub fn get(app: &App, spec: &PolicySpec) -> Result<Described, Error> {
    Ok(describe(app, app.registry.resolve(spec)?))
}

fn describe(app: &App, policy: Arc<LoadedPolicy>) -> Described {
    let (aliases, versions) = app.registry.neighbours(&policy.reference);
    Described { policy, aliases, versions }
}
