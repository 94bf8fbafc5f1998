//! Loads policy versions into memory when they are asked for, and lets callers load and unload them.

use std::collections::HashMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use futures::FutureExt;
use futures::future::{BoxFuture, Shared};
use sha2::{Digest, Sha256};
use tokio::sync::Semaphore;

use super::publish::{Publisher, publish_bytes};
use super::stored::StoredVersion;
use super::{PolicyStores, one_at_a_time};
use crate::invalid::Invalid;
use crate::policy::{EnvParams, baselines};
use crate::service::{App, Error};
use crate::serving::bundled::BUNDLED;
use crate::serving::{LoadedPolicy, PolicyKind, PolicyRef, PolicySpec, Registry, Resolved, VersionSelector, VersionState};
use crate::store::Store;

/// Maximum number of checkpoints that are read at once.
const MAX_LOADS: usize = 2;

/// A load that several requests wait for.
type Load = Shared<BoxFuture<'static, Result<Arc<LoadedPolicy>, Arc<Error>>>>;

/// Loads in progress. Requests for the same version wait for one load.
#[derive(Clone, Debug)]
pub struct Loads(Arc<LoadsInner>);

#[derive(Debug)]
struct LoadsInner {
    running: Mutex<HashMap<(String, u64), Load>>,
    permits: Semaphore,
    count: AtomicU64,
}

impl Default for Loads {
    fn default() -> Self {
        let (running, permits) = (Mutex::default(), Semaphore::new(MAX_LOADS));
        Self(Arc::new(LoadsInner { running, permits, count: AtomicU64::new(0) }))
    }
}

impl Loads {
    /// Number of versions that were read since the start.
    pub fn count(&self) -> u64 {
        self.0.count.load(Ordering::Relaxed)
    }

    /// The load of a version, which begins now unless it is in progress. It completes even if all callers disconnect.
    fn begin(&self, app: &App, reference: PolicyRef) -> Load {
        let mut running = self.0.running.lock().unwrap_or_else(PoisonError::into_inner);
        // A load adds the version to the registry before it leaves `running`, so none is missed.
        if let Some(policy) = app.registry.in_memory(&reference) {
            return async { Ok(policy) }.boxed().shared();
        }
        let key = (reference.name.clone(), reference.version);
        if let Some(load) = running.get(&key) {
            return load.clone();
        }
        let (store, registry) = (app.store.clone(), app.registry.clone());
        let guard = LoadGuard { loads: self.clone(), key: key.clone() };
        let task = tokio::spawn(async move {
            let guard = guard;
            // Never closed.
            let _permit = guard.loads.0.permits.acquire().await;
            guard.loads.0.count.fetch_add(1, Ordering::Relaxed);
            read(&store, &registry, &reference).await
        });
        let load = async { task.await.map_err(Error::internal).flatten().map_err(Arc::new) }.boxed().shared();
        running.insert(key, load.clone());
        load
    }
}

/// Ends a load, also after a panic.
struct LoadGuard {
    loads: Loads,
    key: (String, u64),
}

impl Drop for LoadGuard {
    fn drop(&mut self) {
        self.loads.0.running.lock().unwrap_or_else(PoisonError::into_inner).remove(&self.key);
    }
}

/// Reads a version from the store into memory.
async fn read(store: &Store, registry: &Registry, reference: &PolicyRef) -> Result<Arc<LoadedPolicy>, Error> {
    let stored = StoredVersion::read(store, &reference.name, reference.version).await?;
    let share = registry.take_memory(stored.size())?;
    let policy = registry.keep(stored.load(share).await?);
    tracing::debug!(policy = %reference, bytes = policy.memory_bytes(), "policy read into memory");
    Ok(policy)
}

/// Loads a version that is not in memory.
async fn load(app: &App, reference: PolicyRef) -> Result<Arc<LoadedPolicy>, Error> {
    let load = app.loads.begin(app, reference).await;
    load.map_err(|error| match &*error {
        Error::Busy { message, retry_after } => Error::Busy { message: message.clone(), retry_after: *retry_after },
        // It was deleted meanwhile.
        Error::NotFound { what, id, near } => Error::NotFound { what, id: id.clone(), near: near.clone() },
        _ => Error::internal(error.reason()),
    })
}

/// The version that a look-up in the registry found, in memory.
async fn in_memory(app: &App, found: Resolved) -> Result<Arc<LoadedPolicy>, Error> {
    match found {
        Resolved::InMemory(policy) => Ok(policy),
        // In a box, because it is rare and would make the futures of all requests larger.
        Resolved::Stored(reference) => Box::pin(load(app, reference)).await,
    }
}

/// The version that `spec` resolves to, in memory.
///
/// # Errors
/// [`Error::NotFound`], `policy_unloaded`; [`Error::Busy`] if sessions and requests use all memory of policies;
/// [`Error::Internal`] if its checkpoint is damaged.
pub(in crate::service) async fn resolve(app: &App, spec: &PolicySpec) -> Result<Arc<LoadedPolicy>, Error> {
    in_memory(app, super::found(app, |registry| registry.resolve(spec)).await?).await
}

/// The version with this digest that wrote a state of the caller, in memory: an episode stays on its version even if an alias has moved
/// or a newer version has been published. `field` holds the state.
///
/// # Errors
/// [`Error::Invalid`] if `spec` has no such version; otherwise as [`resolve`].
pub(in crate::service) async fn pinned(
    app: &App,
    spec: &PolicySpec,
    digest: &[u8; 32],
    field: &'static str,
) -> Result<Arc<LoadedPolicy>, Error> {
    let found = app.registry.find_by_digest(spec, digest)?.ok_or_else(|| {
        let expected = format!("the {field} of an earlier response of {spec}");
        Error::from(Invalid::new(field, "the state of another policy or version", expected))
    })?;
    in_memory(app, found).await
}

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
    let entry = |VersionState { reference, loaded, .. }| IndexEntry {
        name: reference.name,
        version: reference.version,
        loaded,
        reason: if loaded { String::new() } else { "unloaded".to_owned() },
    };
    app.registry.versions().into_iter().map(entry).collect()
}

/// Loads every version of a policy (`NAME`) or one (`NAME:VERSION`). Loaded versions stay as they are.
///
/// # Errors
/// [`Error::NotFound`] when there is no such version, [`Error::Internal`] when a checkpoint is damaged, [`Error::Busy`] when
/// sessions and requests use all memory of policies. Nothing changes then.
pub async fn load_policy(app: &App, name: &str) -> Result<(), Error> {
    let spec = spec_of(name)?;
    // Every version is read, so that none is loaded that cannot be served. Those that do not fit into memory together leave it.
    for VersionState { reference, kind, loaded } in versions(&app.registry, &spec)? {
        if !loaded && kind == PolicyKind::Checkpoint {
            load(app, reference).await?;
        }
    }
    set_loaded(app, spec, true).await
}

/// Unloads every version of a policy (`NAME`) or one (`NAME:VERSION`) until it is loaded again, also across restarts. Open
/// sessions continue; all other requests for the version, also by an alias, are refused.
///
/// # Errors
/// [`Error::NotFound`] when there is no such version.
pub async fn unload_policy(app: &App, name: &str) -> Result<(), Error> {
    set_loaded(app, spec_of(name)?, false).await
}

async fn set_loaded(app: &App, spec: PolicySpec, loaded: bool) -> Result<(), Error> {
    let now = app.clock.now();
    one_at_a_time(app, async move |PolicyStores { store, registry }| {
        let all = versions(&registry, &spec)?;
        let numbers: Vec<u64> = all.iter().filter(|v| v.loaded != loaded).map(|v| v.reference.version).collect();
        store.set_policy_versions_loaded(&spec.name, &numbers, loaded, now).await?;
        for version in numbers {
            registry.set_loaded(&spec.name, version, loaded);
            tracing::info!(policy = spec.name, version, "{}", if loaded { "policy loaded" } else { "policy unloaded" });
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

/// The versions that `spec` names.
fn versions(registry: &Registry, spec: &PolicySpec) -> Result<Vec<VersionState>, Error> {
    let mut found = registry.versions_of(&spec.name);
    if let VersionSelector::Version(version) = spec.version {
        found.retain(|state| state.reference.version == version);
    }
    if found.is_empty() { Err(Error::not_found("policy", spec.to_string())) } else { Ok(found) }
}

/// Fills the registry with baselines, published versions, bundled policies (not on a replica) and aliases. Unloaded versions stay unloaded. No
/// checkpoint is read.
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
    for version in app.store.policy_versions().await? {
        let (name, version, digest) = (version.name, version.version, version.digest);
        let mut bytes = [0; 32];
        if hex::decode_to_slice(&digest, &mut bytes).is_ok() {
            app.registry.add(PolicyRef { name, version, digest: bytes });
        } else {
            tracing::error!(policy = name, version, digest, "the digest of a version cannot be read");
        }
    }
    // A replica has what its primary has.
    for (name, bytes) in BUNDLED.iter().filter(|_| app.replica.is_none()) {
        if app.registry.version_of_digest(name, &Sha256::digest(bytes).into()).is_none() {
            publish_bytes(app, Publisher::PROGRAM, name, bytes.to_vec()).await?;
        }
    }
    for alias in app.store.policy_aliases().await? {
        app.registry.set_alias(&alias.name, &alias.alias, alias.version);
    }
    for (name, version) in app.store.unloaded_policies().await? {
        app.registry.set_loaded(&name, version, false);
    }
    Ok(())
}
