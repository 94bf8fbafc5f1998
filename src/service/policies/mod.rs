//! Policies: which there are, publishing checkpoints as versions, aliases that move, versions loaded and unloaded.
//!
//! What these functions change is committed first and served afterwards. Changes take turns, so the registry goes through
//! the states of the database in their order, and each runs to its end even if whoever asked for it has left.

mod aliases;
mod loading;
mod publish;

use std::sync::Arc;

pub use aliases::{Target, aliases, delete_alias, history, set_alias};
pub use loading::{IndexEntry, index, load, load_policy, unload_policy};
pub use publish::{Source, Upload, check_publishable, publish, upload};

use super::paging::json_bytes;
use super::{App, Error, Page, PageRequest};
use crate::serving::{Described, Kind, PolicyRef, PolicySpec, Registry};
use crate::store::Store;

/// A page of policies in order of names, each in its newest version.
///
/// # Errors
/// [`Error::Invalid`]: the page size is out of range.
pub fn list(app: &App, page: &PageRequest) -> Result<Page<Described>, Error> {
    let (policies, more) = app.registry.list(&page.token, page.usual_limit()?);
    let bytes = |policy: &Described| json_bytes(&policy.about.config) + json_bytes(&policy.about.metrics);
    Ok(Page::bounded(policies, more, bytes, |policy| policy.about.reference.name.clone()))
}

/// The version that `spec` names, loaded or not.
///
/// # Errors
/// There is none.
pub fn get(app: &App, spec: &PolicySpec) -> Result<Described, Error> {
    Ok(app.registry.describe(spec)?)
}

/// The checkpoint of the version that `spec` names, loaded or not, as safetensors.
///
/// # Errors
/// There is no such version, or it is a baseline, which has no checkpoint.
pub async fn export(app: &App, spec: &PolicySpec) -> Result<(PolicyRef, Vec<u8>), Error> {
    let about = app.registry.describe(spec)?.about;
    let PolicyRef { name, version, .. } = &about.reference;
    if about.kind == Kind::Baseline {
        let message = format!("{name} is a baseline: it flies by rule and has no checkpoint to export");
        return Err(Error::Precondition { code: "no_checkpoint", message });
    }
    publish::Stored::new(&app.store, name, *version).await?.checkpoint()
}

/// What a change of policies works with.
struct Shelf {
    store: Store,
    registry: Arc<Registry>,
}

/// Runs `change` when it is its turn, to its end.
async fn in_turn<T, F>(app: &App, change: impl FnOnce(Shelf) -> F) -> Result<T, Error>
where
    T: Send + 'static,
    F: Future<Output = Result<T, Error>> + Send + 'static,
{
    let registry = app.registry.clone();
    let change = change(Shelf { store: app.store.clone(), registry: registry.clone() });
    let task = tokio::spawn(async move {
        let _turn = registry.turn().await;
        change.await
    });
    task.await.map_err(Error::internal)?
}
