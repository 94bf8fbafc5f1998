//! Which policies there are; publishing a checkpoint as a new version of one.

use std::sync::Arc;

use sha2::{Digest, Sha256};

use super::sessions::page_size;
use super::{App, Error};
use crate::policy::baselines::{self, World};
use crate::serving::{Kind, LoadedPolicy, PolicyRef, PolicySpec};

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

/// Fills the registry: the baselines.
///
/// # Errors
/// The store cannot be read.
pub async fn load(app: &App) -> Result<(), Error> {
    let world = World::default();
    for baseline in &baselines::LIST {
        let Some(policy) = baselines::by_name(baseline.name, world) else { continue };
        // The digest says what a checkpoint's does: equal digests, equal answers.
        let digest = Sha256::digest(format!("baseline {} {world:?}", baseline.name)).into();
        app.registry.insert(LoadedPolicy {
            reference: PolicyRef { name: baseline.name.to_owned(), version: 1, digest },
            policy,
            kind: Kind::Baseline,
            description: baseline.text.to_owned(),
            uavs: None,
            users: None,
            config: serde_json::Value::Null,
            metrics: serde_json::Value::Null,
            created_at: app.clock.now(),
        });
    }
    Ok(())
}
