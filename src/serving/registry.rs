//! Which policies can be asked: names, versions, aliases, each version loaded once and shared.

use std::collections::BTreeMap;
use std::sync::{Arc, PoisonError, RwLock, RwLockReadGuard};

use jiff::Timestamp;
use serde_json::Value;

use super::{Error, PolicyRef, PolicySpec, Which};
use crate::policy::Policy;

/// Where a policy comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Learned, stored as a checkpoint.
    Checkpoint,
    /// Part of the program (spec 6).
    Baseline,
}

/// One version of one policy, ready to fly.
pub struct LoadedPolicy {
    /// Which it is.
    pub reference: PolicyRef,
    /// What decides.
    pub policy: Arc<dyn Policy>,
    /// Where it comes from.
    pub kind: Kind,
    /// A sentence for people.
    pub description: String,
    /// The only M it serves, where there is one.
    pub uavs: Option<u32>,
    /// The only N it serves, where there is one.
    pub users: Option<u32>,
    /// Resolved training configuration of a checkpoint, an object; null for a baseline.
    pub config: Value,
    /// Figures a checkpoint was taken at, an object; null for a baseline.
    pub metrics: Value,
    /// When it was published; for baselines, when the server started.
    pub created_at: Timestamp,
}

impl std::fmt::Debug for LoadedPolicy {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "LoadedPolicy({}, {:?})", self.reference, self.kind)
    }
}

#[derive(Debug, Default)]
struct Entry {
    versions: BTreeMap<u64, Arc<LoadedPolicy>>,
    aliases: BTreeMap<String, u64>,
    /// Nobody new may ask for it.
    unloaded: bool,
}

/// All policies of this server. The lock is held for look-ups only.
#[derive(Debug, Default)]
pub struct Registry(RwLock<BTreeMap<String, Entry>>);

impl Registry {
    fn read(&self) -> RwLockReadGuard<'_, BTreeMap<String, Entry>> {
        // Nothing panics while holding the lock for writing, and a map is whole after every insertion.
        self.0.read().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds a version, or replaces it by an equal one.
    pub fn insert(&self, policy: LoadedPolicy) -> Arc<LoadedPolicy> {
        let policy = Arc::new(policy);
        let mut entries = self.0.write().unwrap_or_else(PoisonError::into_inner);
        let entry = entries.entry(policy.reference.name.clone()).or_default();
        entry.versions.insert(policy.reference.version, policy.clone());
        policy
    }

    /// Lets `name@alias` mean `version`.
    pub fn set_alias(&self, name: &str, alias: &str, version: u64) {
        let mut entries = self.0.write().unwrap_or_else(PoisonError::into_inner);
        if let Some(entry) = entries.get_mut(name) {
            entry.aliases.insert(alias.to_owned(), version);
        }
    }

    /// The version that `spec` names now.
    ///
    /// # Errors
    /// [`Error::Unknown`].
    pub fn resolve(&self, spec: &PolicySpec) -> Result<Arc<LoadedPolicy>, Error> {
        let entries = self.read();
        let found = entries.get(&spec.name).filter(|entry| !entry.unloaded).and_then(|entry| match &spec.which {
            Which::Newest => entry.versions.values().next_back(),
            Which::Alias(alias) => entry.aliases.get(alias).and_then(|version| entry.versions.get(version)),
            Which::Version(version) => entry.versions.get(version),
        });
        found.cloned().ok_or_else(|| Error::unknown("policy", spec.to_string()))
    }

    /// The version of `name` with this digest.
    pub fn with_digest(&self, name: &str, digest: &[u8; 32]) -> Option<Arc<LoadedPolicy>> {
        let entries = self.read();
        entries.get(name)?.versions.values().find(|policy| policy.reference.digest == *digest).cloned()
    }

    /// Aliases that point at this version, and all versions of its name.
    pub fn neighbours(&self, reference: &PolicyRef) -> (Vec<String>, Vec<u64>) {
        let entries = self.read();
        let Some(entry) = entries.get(&reference.name) else { return Default::default() };
        let pointing = entry.aliases.iter().filter(|(_, version)| **version == reference.version);
        (pointing.map(|(alias, _)| alias.clone()).collect(), entry.versions.keys().copied().collect())
    }

    /// The newest version of each name after `after`, at most `limit`, in order of names, and whether there are more.
    pub fn list(&self, after: &str, limit: usize) -> (Vec<Arc<LoadedPolicy>>, bool) {
        use std::ops::Bound::{Excluded, Unbounded};
        let entries = self.read();
        let mut rest = entries.range::<str, _>((Excluded(after), Unbounded)).filter_map(|(_, e)| e.versions.values().next_back());
        let page = rest.by_ref().take(limit).cloned().collect();
        (page, rest.next().is_some())
    }

    /// Lets all versions of `name` be asked for, or not. Whoever holds one keeps it.
    ///
    /// # Errors
    /// [`Error::Unknown`].
    pub fn set_loaded(&self, name: &str, loaded: bool) -> Result<(), Error> {
        let mut entries = self.0.write().unwrap_or_else(PoisonError::into_inner);
        let entry = entries.get_mut(name).ok_or_else(|| Error::unknown("policy", name))?;
        entry.unloaded = !loaded;
        Ok(())
    }

    /// All versions in order of names, and whether they can be asked for.
    pub fn index(&self) -> Vec<(PolicyRef, bool)> {
        let entries = self.read();
        let of = |entry: &Entry| {
            let loaded = !entry.unloaded;
            entry.versions.values().map(|policy| (policy.reference.clone(), loaded)).collect::<Vec<_>>()
        };
        entries.values().flat_map(of).collect()
    }

    /// Number of policy versions.
    pub fn len(&self) -> usize {
        self.read().values().map(|entry| entry.versions.len()).sum()
    }

    /// Whether nothing can be served.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}
