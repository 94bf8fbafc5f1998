//! Which versions can be asked: at start, and as people load and unload them.

use std::error::Error as _;
use std::sync::Arc;

use sha2::{Digest, Sha256};

use super::publish::{Stored, publish};
use super::{Shelf, in_turn};
use crate::invalid::Invalid;
use crate::policy::baselines::{self, EnvParams};
use crate::service::{App, Error};
use crate::serving::bundled::BUNDLED;
use crate::serving::{About, Kind, LoadedPolicy, PolicyRef, PolicySpec, Registry, Which};

/// A version and whether it can be asked.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct IndexEntry {
    /// Name of the policy.
    pub name: String,
    /// The version.
    pub version: u64,
    /// Whether it is loaded.
    pub ready: bool,
    /// Why it is not; empty if it is.
    pub reason: String,
}

/// Every version in order of names and numbers.
pub fn index(app: &App) -> Vec<IndexEntry> {
    let entry = |reference: &PolicyRef, ready| IndexEntry {
        name: reference.name.clone(),
        version: reference.version,
        ready,
        reason: if ready { String::new() } else { "unloaded".to_owned() },
    };
    app.registry.versions().iter().map(|(about, ready)| entry(&about.reference, *ready)).collect()
}

/// Loads every version of a policy (`NAME`) or one (`NAME:VERSION`). Those that are loaded stay as they are.
///
/// # Errors
/// There is no such version, or its checkpoint cannot be read any more; then nothing changes.
pub async fn load_policy(app: &App, name: &str) -> Result<(), Error> {
    let spec = spec_of(name)?;
    let now = app.clock.now();
    in_turn(app, async move |Shelf { store, registry }| {
        let mut loaded = Vec::new();
        for (about, ready) in versions(&registry, &spec)? {
            loaded.push(match (ready, about.kind) {
                (true, _) => continue,
                (false, Kind::Baseline) => {
                    let missing = || Error::not_found("policy", about.reference.to_string());
                    let policy = baselines::by_name(&spec.name, EnvParams::default()).ok_or_else(missing)?;
                    LoadedPolicy { about, policy }
                }
                (false, Kind::Checkpoint) => Stored::new(&store, &spec.name, about.reference.version).await?.load().await?,
            });
        }
        let numbers: Vec<u64> = loaded.iter().map(|policy| policy.reference.version).collect();
        store.serve_policy_versions(&spec.name, &numbers, true, now).await?;
        for policy in loaded {
            tracing::info!(policy = %policy.reference, "loaded");
            registry.insert(policy);
        }
        Ok(())
    })
    .await
}

/// Unloads every version of a policy (`NAME`) or one (`NAME:VERSION`). Sessions that fly one go on; whoever asks for it
/// otherwise, by an alias too, is told that it is unloaded. That lasts until it is loaded, restarts included.
///
/// # Errors
/// There is no such version.
pub async fn unload_policy(app: &App, name: &str) -> Result<(), Error> {
    let spec = spec_of(name)?;
    let now = app.clock.now();
    in_turn(app, async move |Shelf { store, registry }| {
        let all = versions(&registry, &spec)?;
        let numbers: Vec<u64> = all.iter().filter(|(_, ready)| *ready).map(|(about, _)| about.reference.version).collect();
        store.serve_policy_versions(&spec.name, &numbers, false, now).await?;
        for version in numbers {
            registry.unload(&spec.name, version);
            tracing::info!(policy = spec.name, version, "unloaded");
        }
        Ok(())
    })
    .await
}

fn spec_of(name: &str) -> Result<PolicySpec, Invalid> {
    let spec: PolicySpec = name.parse()?;
    if matches!(spec.which, Which::Alias(_)) {
        return Err(Invalid::new("policy", format!("{name:?}"), "NAME, for all its versions, or NAME:VERSION"));
    }
    Ok(spec)
}

/// The versions that `spec` means, of all of its name.
fn versions(registry: &Registry, spec: &PolicySpec) -> Result<Vec<(Arc<About>, bool)>, Error> {
    let mut found = registry.versions_of(&spec.name);
    if let Which::Version(version) = spec.which {
        found.retain(|(about, _)| about.reference.version == version);
    }
    if found.is_empty() { Err(Error::not_found("policy", spec.to_string())) } else { Ok(found) }
}

/// Fills the registry: baselines, bundled policies, what was published before, aliases; what was unloaded stays unloaded.
///
/// # Errors
/// The store cannot be read, or a bundled policy is no checkpoint. A published version that cannot be read any more is left
/// out and logged: the others are served.
pub async fn load(app: &App) -> Result<(), Error> {
    let world = EnvParams::default();
    for baseline in &baselines::LIST {
        let Some(policy) = baselines::by_name(baseline.name, world) else { continue };
        // The digest says what a checkpoint's does: equal digests, equal answers.
        let digest = Sha256::digest(format!("baseline {} {world:?}", baseline.name)).into();
        let reference = PolicyRef { name: baseline.name.to_owned(), version: 1, digest };
        app.registry.insert(LoadedPolicy::baseline(reference, baseline.description, policy, app.clock.now()));
    }
    for (name, version) in app.store.policy_versions().await? {
        match Stored::new(&app.store, &name, version).await?.load().await {
            Ok(policy) => drop(app.registry.insert(policy)),
            Err(e) => {
                let reason = e.source().map_or_else(|| e.to_string(), ToString::to_string);
                tracing::error!(policy = name, version, reason, "its checkpoint cannot be read");
            }
        }
    }
    for (name, bytes) in BUNDLED {
        publish(app, name, bytes.to_vec()).await?;
    }
    for alias in app.store.policy_aliases().await? {
        app.registry.set_alias(&alias.name, &alias.alias, alias.version);
    }
    for (name, version) in app.store.unloaded_policies().await? {
        app.registry.unload(&name, version);
    }
    Ok(())
}
