//! The use cases of policies: list, get and export; publish checkpoints as versions; move aliases; load and unload versions.
//!
//! A change is committed to the database first and applied to the registry afterwards. Changes run one at a time, so the registry
//! passes through the states of the database in order. A change completes even if the caller disconnects.

mod aliases;
mod loading;
mod publish;
mod upload_limit;

use std::sync::Arc;

pub use aliases::{AliasChange, aliases, delete_alias, history, set_alias};
pub use loading::{IndexEntry, fill_registry, index, load_policy, unload_policy};
pub use publish::{CheckpointSource, PublishRequest, Publisher, check_owner, check_publishable, publish, publish_bytes};
pub(super) use publish::{NewVersion, publish_and_end};
pub use upload_limit::{UploadLimit, UploadPermit};

use super::paging::json_bytes;
use super::{App, Error, Page, PageRequest};
use crate::error_code::ErrorCode;
use crate::serving::{PolicyDetails, PolicyKind, PolicyRef, PolicySpec, Registry};
use crate::store::Store;

/// A page of policies in order of names, each in its newest version.
///
/// # Errors
/// [`Error::Invalid`]: the page size is out of range.
pub fn list(app: &App, page: &PageRequest) -> Result<Page<PolicyDetails>, Error> {
    let (policies, more) = app.registry.list(&page.token, page.usual_limit()?);
    let bytes = |policy: &PolicyDetails| json_bytes(&policy.info.config) + json_bytes(&policy.info.metrics);
    Ok(Page::bounded(policies, more, bytes, |policy| policy.info.reference.name.clone()))
}

/// The version that `spec` names, loaded or not.
///
/// # Errors
/// [`Error::NotFound`].
pub fn get(app: &App, spec: &PolicySpec) -> Result<PolicyDetails, Error> {
    Ok(app.registry.describe(spec)?)
}

/// The checkpoint of the version that `spec` names, loaded or not, as safetensors.
///
/// # Errors
/// [`Error::NotFound`], or [`Error::Precondition`] for a baseline, which has no checkpoint.
pub async fn export(app: &App, spec: &PolicySpec) -> Result<(PolicyRef, Vec<u8>), Error> {
    let info = app.registry.describe(spec)?.info;
    let PolicyRef { name, version, .. } = &info.reference;
    if info.kind == PolicyKind::Baseline {
        let message = format!("{name} is a baseline, which has no checkpoint to export");
        return Err(Error::Precondition { code: ErrorCode::NoCheckpoint, message });
    }
    publish::StoredVersion::read(&app.store, name, *version).await?.checkpoint()
}

/// What a change of policies changes: the database, then the registry.
struct PolicyStores {
    store: Store,
    registry: Arc<Registry>,
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
