//! Loads policy versions into the registry: all at start, and single ones when callers load and unload them.

use std::error::Error as _;
use std::sync::Arc;

use sha2::{Digest, Sha256};

use super::publish::{Publisher, StoredVersion, publish_bytes};
use super::{PolicyStores, one_at_a_time};
use crate::invalid::Invalid;
use crate::policy::{EnvParams, baselines};
use crate::service::{App, Error};
use crate::serving::bundled::BUNDLED;
use crate::serving::{LoadedPolicy, PolicyInfo, PolicyKind, PolicyRef, PolicySpec, Registry, VersionSelector};

/// A version and whether it is loaded.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct IndexEntry {
    /// Name of the policy.
    pub name: String,
    /// The version.
    pub version: u64,
    /// Whether it is loaded.
    pub loaded: bool,
    /// Why the version is not loaded; empty if it is.
    pub reason: String,
}

/// All versions by name and number.
pub fn index(app: &App) -> Vec<IndexEntry> {
    let entry = |reference: &PolicyRef, loaded| IndexEntry {
        name: reference.name.clone(),
        version: reference.version,
        loaded,
        reason: if loaded { String::new() } else { "unloaded".to_owned() },
    };
    app.registry.versions().iter().map(|(info, loaded)| entry(&info.reference, *loaded)).collect()
}

/// Loads every version of a policy (`NAME`) or one (`NAME:VERSION`). Loaded versions stay as they are.
///
/// # Errors
/// [`Error::NotFound`] when there is no such version, [`Error::Internal`] when a checkpoint is damaged. Nothing changes then.
pub async fn load_policy(app: &App, name: &str) -> Result<(), Error> {
    let spec = spec_of(name)?;
    let now = app.clock.now();
    one_at_a_time(app, async move |PolicyStores { store, registry }| {
        let mut to_insert = Vec::new();
        for (info, loaded) in versions(&registry, &spec)? {
            to_insert.push(match (loaded, info.kind) {
                (true, _) => continue,
                (false, PolicyKind::Baseline) => {
                    let missing = || Error::not_found("policy", info.reference.to_string());
                    let implementation = baselines::by_name(&spec.name, EnvParams::default()).ok_or_else(missing)?;
                    LoadedPolicy { info, implementation }
                }
                (false, PolicyKind::Checkpoint) => {
                    StoredVersion::read(&store, &spec.name, info.reference.version).await?.load().await?
                }
            });
        }
        let numbers: Vec<u64> = to_insert.iter().map(|policy| policy.reference.version).collect();
        store.set_policy_versions_loaded(&spec.name, &numbers, true, now).await?;
        for policy in to_insert {
            tracing::info!(policy = %policy.reference, "policy loaded");
            registry.insert(policy);
        }
        Ok(())
    })
    .await
}

/// Unloads every version of a policy (`NAME`) or one (`NAME:VERSION`) until it is loaded again, also across restarts. Open
/// sessions continue; all other requests for the version, also by an alias, are refused.
///
/// # Errors
/// [`Error::NotFound`] when there is no such version.
pub async fn unload_policy(app: &App, name: &str) -> Result<(), Error> {
    let spec = spec_of(name)?;
    let now = app.clock.now();
    one_at_a_time(app, async move |PolicyStores { store, registry }| {
        let all = versions(&registry, &spec)?;
        let numbers: Vec<u64> = all.iter().filter(|(_, loaded)| *loaded).map(|(info, _)| info.reference.version).collect();
        store.set_policy_versions_loaded(&spec.name, &numbers, false, now).await?;
        for version in numbers {
            registry.unload(&spec.name, version);
            tracing::info!(policy = spec.name, version, "policy unloaded");
        }
        Ok(())
    })
    .await
}

fn spec_of(name: &str) -> Result<PolicySpec, Invalid> {
    let spec: PolicySpec = name.parse()?;
    if matches!(spec.version, VersionSelector::Alias(_)) {
        return Err(Invalid::new("policy", format!("{name:?}"), "NAME for all versions, or NAME:VERSION"));
    }
    Ok(spec)
}

/// The versions that `spec` names, and whether each is loaded.
fn versions(registry: &Registry, spec: &PolicySpec) -> Result<Vec<(Arc<PolicyInfo>, bool)>, Error> {
    let mut found = registry.versions_of(&spec.name);
    if let VersionSelector::Version(version) = spec.version {
        found.retain(|(info, _)| info.reference.version == version);
    }
    if found.is_empty() { Err(Error::not_found("policy", spec.to_string())) } else { Ok(found) }
}

/// Fills the registry with baselines, published versions, bundled policies and aliases. Unloaded versions stay unloaded. A
/// damaged version is logged and skipped.
///
/// # Errors
/// [`Error::Internal`] when the database fails, [`Error::Invalid`] when a bundled policy is not a checkpoint.
pub async fn fill_registry(app: &App) -> Result<(), Error> {
    let params = EnvParams::default();
    for baseline in &baselines::LIST {
        let Some(policy) = baselines::by_name(baseline.name, params) else { continue };
        // Equal digests mean equal headings, as for checkpoints.
        let digest = Sha256::digest(format!("baseline {} {params:?}", baseline.name)).into();
        let reference = PolicyRef { name: baseline.name.to_owned(), version: 1, digest };
        app.registry.insert(LoadedPolicy::baseline(reference, baseline.description, policy, app.clock.now()));
    }
    for (name, version) in app.store.policy_versions().await? {
        match StoredVersion::read(&app.store, &name, version).await?.load().await {
            Ok(policy) => drop(app.registry.insert(policy)),
            Err(e) => {
                let reason = e.source().map_or_else(|| e.to_string(), ToString::to_string);
                tracing::error!(policy = name, version, reason, "a checkpoint cannot be read");
            }
        }
    }
    for (name, bytes) in BUNDLED {
        publish_bytes(app, Publisher::PROGRAM, name, bytes.to_vec()).await?;
    }
    for alias in app.store.policy_aliases().await? {
        app.registry.set_alias(&alias.name, &alias.alias, alias.version);
    }
    for (name, version) in app.store.unloaded_policies().await? {
        app.registry.unload(&name, version);
    }
    Ok(())
}
