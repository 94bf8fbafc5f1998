//! The use cases of policies: list, get and export; publish checkpoints as versions and delete them; move aliases; load and unload
//! versions.
//!
//! A change is committed to the database first and applied to the registry afterwards. Changes run one at a time, so the registry
//! passes through the states of the database in order. A change completes even if the caller disconnects.

mod aliases;
mod deletion;
mod info;
mod loading;
mod manifest;
mod promotion;
mod publish;
mod statistics;
mod stored;
mod upload_limit;

use std::sync::Arc;

pub use aliases::{AliasChange, aliases, delete_alias, history, set_alias};
pub use deletion::{Retention, delete, delete_excess_checkpoints, delete_excess_versions};
pub use info::PolicyDetails;
pub use loading::{IndexEntry, Loads, fill_registry, index, load_policy, unload_policy};
pub(super) use loading::{pinned, resolve};
pub use manifest::{
    Manifest, ManifestPolicy, ManifestVersion, MissingVersion, align, checkpoint_of, manifest, missing, take_over,
};
pub(super) use promotion::{JobResult, Promotion};
pub use publish::{CheckpointSource, PublishRequest, Publisher, check_owner, check_publishable, publish, publish_bytes};
pub(super) use publish::{NewVersion, publish_and_end};
pub use statistics::{VersionStatistics, statistics};
pub use upload_limit::{UploadLimit, UploadPermit};

use super::paging::{json_bytes, parse_number};
use super::{App, Error, Page, PageRequest};
use crate::error_code::ErrorCode;
use crate::serving::{PolicyKind, PolicyRef, PolicySpec, Registry, VersionState, check_name};
use crate::store::Store;

/// A page of policies in order of names, each in its newest version.
///
/// # Errors
/// [`Error::Invalid`]: the page size is out of range.
pub async fn list(app: &App, page: &PageRequest) -> Result<Page<PolicyDetails>, Error> {
    let (found, more) = app.registry.list(&page.token, page.usual_limit()?);
    let mut policies = Vec::with_capacity(found.len());
    for details in found {
        let reference = details.state.reference.clone();
        match info::complete(app, details).await {
            Ok(policy) => policies.push(policy),
            // One damaged checkpoint does not hide all others.
            Err(error) => tracing::error!(policy = %reference, reason = error.reason(), "a policy cannot be described"),
        }
    }
    let bytes = |policy: &PolicyDetails| json_bytes(&policy.info.config) + json_bytes(&policy.info.metrics);
    Ok(Page::bounded(policies, more, bytes, |policy| policy.info.reference.name.clone()))
}

/// The version that `spec` names, loaded or not.
///
/// # Errors
/// [`Error::NotFound`], [`Error::Internal`] when its checkpoint is damaged.
pub async fn get(app: &App, spec: &PolicySpec) -> Result<PolicyDetails, Error> {
    info::complete(app, found(app, |registry| registry.describe(spec)).await?).await
}

/// Whether the version that `spec` names is loaded.
///
/// # Errors
/// [`Error::NotFound`].
pub fn is_loaded(app: &App, spec: &PolicySpec) -> Result<bool, Error> {
    Ok(app.registry.describe(spec)?.state.loaded)
}

/// A version of a policy in the list of its versions.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct VersionSummary {
    /// Name, version and digest.
    pub reference: PolicyRef,
    /// Whether requests for it are accepted.
    pub loaded: bool,
    /// Aliases that point to it.
    pub aliases: Vec<String>,
}

/// A page of the versions of the policy `name`, newest first.
///
/// # Errors
/// [`Error::NotFound`]; [`Error::Invalid`] when the page size is out of range, or the name or the token is malformed.
pub fn versions(app: &App, name: &str, page: &PageRequest) -> Result<Page<VersionSummary>, Error> {
    check_name("policy", name)?;
    let (limit, before) = (page.usual_limit()?, page.parse_token(parse_number)?);
    let before = before.map_or(u64::MAX, |before| before as u64);
    let (versions, more) = app.registry.list_versions(name, before, limit)?;
    let page = Page::new(versions, more, |(state, _)| state.reference.version.to_string());
    Ok(page.map(|(VersionState { reference, loaded, .. }, aliases)| VersionSummary { reference, loaded, aliases }))
}

/// The checkpoint of the version that `spec` names, loaded or not, as safetensors.
///
/// # Errors
/// [`Error::NotFound`], or [`Error::Precondition`] for a baseline, which has no checkpoint.
pub async fn export(app: &App, spec: &PolicySpec) -> Result<(PolicyRef, Vec<u8>), Error> {
    let found = found(app, |registry| registry.describe(spec)).await?.state;
    let PolicyRef { name, version, .. } = &found.reference;
    if found.kind == PolicyKind::Baseline {
        let message = format!("{name} is a baseline, which has no checkpoint to export");
        return Err(Error::Precondition { code: ErrorCode::NoCheckpoint, message });
    }
    stored::StoredVersion::read(&app.store, name, *version).await?.checkpoint()
}

/// What a change of policies changes: the database, then the registry.
struct PolicyStores {
    store: Store,
    registry: Arc<Registry>,
}

/// What `look` finds in the registry. If it finds nothing, it looks again after the change that is in progress: the end of a job is visible
/// in the database a moment before the registry has the version that it names.
pub(in crate::service) async fn found<T>(
    app: &App,
    look: impl Fn(&Registry) -> Result<T, crate::serving::Error>,
) -> Result<T, crate::serving::Error> {
    match look(&app.registry) {
        Err(crate::serving::Error::NotFound { .. }) => {}
        found => return found,
    }
    // In a box, because it is rare and would make the futures of all requests larger.
    drop(Box::pin(app.registry.lock_changes()).await);
    look(&app.registry)
}

/// Runs `change` after all changes that were begun before. It completes even if the caller disconnects.
async fn one_at_a_time<T, F>(app: &App, change: impl FnOnce(PolicyStores) -> F) -> Result<T, Error>
where
    T: Send + 'static,
    F: Future<Output = Result<T, Error>> + Send + 'static,
{
    let registry = app.registry.clone();
    let change = change(PolicyStores { store: app.store.clone(), registry: registry.clone() });
    let task = tokio::spawn(async move {
        let _lock = registry.lock_changes().await;
        change.await
    });
    task.await.map_err(Error::internal)?
}
