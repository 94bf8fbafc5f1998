//! Deletes versions of policies: on request of a caller, and old ones by the rules of retention.

use std::time::Duration;

use super::{PolicyStores, one_at_a_time};
use crate::error_code::ErrorCode;
use crate::service::{App, Error};
use crate::serving::bundled::is_bundled;
use crate::serving::{PolicyKind, check_name};

/// What the server keeps. 0 keeps everything.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Retention {
    /// Checkpoints of every job that has ended, in the order best, last.
    pub checkpoints: u32,
    /// Versions of every policy, without those that an alias points to.
    pub versions: usize,
    /// Jobs that have ended, the newest; jobs of a sweep or an experiment count with it.
    pub jobs: usize,
    /// Time after its end for which a job is kept.
    pub jobs_for: Duration,
}

/// Maximum number of versions that one transaction deletes, so that other writers do not wait for long.
const BATCH: usize = 16;

/// Deletes a version of a policy, or all of them. Their numbers are never given to other versions.
///
/// # Errors
/// [`Error::NotFound`] when there is no such version. [`Error::Precondition`] when an alias points to one of the versions, a
/// session or a request uses it, or it is bundled with the program (`wrong_state`), or the policy is a baseline.
pub async fn delete(app: &App, name: &str, version: Option<u64>) -> Result<(), Error> {
    check_name("policy", name)?;
    let name = name.to_owned();
    one_at_a_time(app, async move |stores| {
        let mut versions = stores.registry.versions_of(&name);
        versions.retain(|state| version.is_none_or(|version| state.reference.version == version));
        if versions.is_empty() {
            return Err(Error::not_found("policy", version.map_or(name.clone(), |version| format!("{name}:{version}"))));
        }
        if versions[0].kind == PolicyKind::Baseline {
            let message = format!("{name} is a baseline, which cannot be deleted; unload it instead");
            return Err(Error::Precondition { code: ErrorCode::NoCheckpoint, message });
        }
        if let Some(bundled) = versions.iter().find(|state| is_bundled(&state.reference)) {
            let message = format!("{} is bundled with this program and cannot be deleted; unload it instead", bundled.reference);
            return Err(Error::Precondition { code: ErrorCode::WrongState, message });
        }
        let numbers: Vec<u64> = versions.iter().map(|state| state.reference.version).collect();
        remove(&stores, &name, &numbers).await
    })
    .await
}

/// Removes versions from the registry, so that no request finds them any more, then deletes them from the database. They return
/// to the registry if that fails.
pub(super) async fn remove(PolicyStores { store, registry }: &PolicyStores, name: &str, versions: &[u64]) -> Result<(), Error> {
    let removed = registry.remove(name, versions)?;
    let numbers = removed.numbers();
    if let Err(e) = store.delete_policy_versions(name, &numbers).await {
        registry.restore(removed);
        return Err(e.into());
    }
    tracing::info!(policy = name, versions = ?numbers, "versions deleted");
    Ok(())
}

/// Deletes the versions that the rules of retention do not keep. Versions that somebody uses stay until nobody does.
///
/// # Errors
/// [`Error::Internal`] when the database fails.
pub async fn delete_excess_versions(app: &App) -> Result<(), Error> {
    for name in app.registry.names() {
        delete_excess_versions_of(app, &name).await?;
    }
    Ok(())
}

async fn delete_excess_versions_of(app: &App, name: &str) -> Result<(), Error> {
    let keep = app.retention.versions;
    // Usually there are none, which needs no lock.
    while keep > 0 && !app.registry.excess_versions(name, keep).is_empty() {
        let name = name.to_owned();
        let deleted = one_at_a_time(app, async move |stores| {
            // An alias may have moved meanwhile, so the versions are determined again.
            let mut excess = stores.registry.excess_versions(&name, keep);
            excess.truncate(BATCH);
            match remove(&stores, &name, &excess).await {
                // A session began to use one of them in this moment; the next pass tries again.
                Err(Error::Precondition { .. }) => Ok(false),
                result => result.map(|()| true),
            }
        });
        if !deleted.await? {
            break;
        }
    }
    Ok(())
}

/// Applies the rules of retention to a policy that has a new version. The version is published, whatever happens here.
pub(in crate::service) async fn retain_after_publishing(app: &App, name: &str) {
    if let Err(error) = delete_excess_versions_of(app, name).await {
        tracing::warn!(policy = name, reason = error.reason(), "old versions cannot be deleted; trying again later");
    }
}

/// Deletes the checkpoints of ended jobs that the rules of retention do not keep: of some jobs after row id `after`. Returns the
/// row id to continue after; `None` after the last job.
///
/// # Errors
/// [`Error::Internal`] when the database fails.
pub async fn delete_excess_checkpoints(app: &App, after: i64) -> Result<Option<i64>, Error> {
    /// Row ids per transaction.
    const JOBS: i64 = 200;
    let keep = app.retention.checkpoints;
    let last = app.store.last_job().await?;
    if keep == 0 || after >= last {
        return Ok(None);
    }
    let end = after.saturating_add(JOBS).min(last);
    let deleted = app.store.trim_checkpoints(after + 1..=end, keep).await?;
    if deleted > 0 {
        tracing::info!(deleted, "checkpoints of ended jobs deleted (--keep-checkpoints)");
    }
    Ok(Some(end))
}
