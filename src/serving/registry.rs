//! The registry of policies: names, versions and aliases. Each version is either unloaded, or loaded once and shared.
//!
//! A [`LoadedPolicy`] remains usable after the registry has unloaded or replaced it: a session stays on the version that it
//! began with.

use std::collections::BTreeMap;
use std::ops::Deref;
use std::sync::{Arc, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};

use jiff::Timestamp;
use serde_json::Value;
use tokio::sync::{Mutex, MutexGuard};

use super::{Error, PolicyRef, PolicySpec, VersionSelector};
use crate::error_code::ErrorCode;
use crate::policy::{Policy, RequiredInput};

/// Origin of a policy.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PolicyKind {
    /// Learned and stored as a checkpoint.
    Checkpoint,
    /// A policy by rule (docs/model.md, "Baselines").
    Baseline,
}

/// Description of one version of one policy, loaded or not.
#[derive(Clone, Debug)]
pub struct PolicyInfo {
    /// Name, version and digest.
    pub reference: PolicyRef,
    /// Origin.
    pub kind: PolicyKind,
    /// A sentence for people.
    pub description: String,
    /// M, if the policy accepts only this number of UAVs.
    pub uavs: Option<u32>,
    /// N, if the policy accepts only this number of users.
    pub users: Option<u32>,
    /// A, the number of actions.
    pub actions: usize,
    /// The input that the policy requires.
    pub needs: RequiredInput,
    /// d, the detection range.
    pub detection_range: f64,
    /// Complete training configuration of a checkpoint (an object); null for a baseline.
    pub config: Value,
    /// Metrics of a checkpoint (an object); null for a baseline.
    pub metrics: Value,
    /// Time of publication; for a baseline, when the server started.
    pub created_at: Timestamp,
}

/// One version of one policy, ready to run.
pub struct LoadedPolicy {
    /// Its description.
    pub info: Arc<PolicyInfo>,
    /// Computes headings.
    pub implementation: Arc<dyn Policy>,
}

impl LoadedPolicy {
    /// A baseline.
    pub fn baseline(reference: PolicyRef, description: &str, policy: Arc<dyn Policy>, created_at: Timestamp) -> Self {
        let info = PolicyInfo {
            reference,
            kind: PolicyKind::Baseline,
            description: description.to_owned(),
            uavs: None,
            users: None,
            actions: policy.actions(),
            needs: policy.needs(),
            detection_range: policy.env().detection_range,
            config: Value::Null,
            metrics: Value::Null,
            created_at,
        };
        Self { info: Arc::new(info), implementation: policy }
    }
}

impl Deref for LoadedPolicy {
    type Target = PolicyInfo;

    fn deref(&self) -> &PolicyInfo {
        &self.info
    }
}

impl std::fmt::Debug for LoadedPolicy {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "LoadedPolicy({}, {:?})", self.reference, self.kind)
    }
}

#[derive(Debug)]
struct VersionEntry {
    info: Arc<PolicyInfo>,
    loaded: Option<Arc<LoadedPolicy>>,
}

impl VersionEntry {
    fn loaded(&self) -> Result<Arc<LoadedPolicy>, Error> {
        self.loaded.clone().ok_or_else(|| {
            let reference = &self.info.reference;
            let message = format!("policy {reference} is unloaded; load it first");
            Error::Precondition { code: ErrorCode::PolicyUnloaded, message }
        })
    }
}

#[derive(Debug, Default)]
struct PolicyEntry {
    versions: BTreeMap<u64, VersionEntry>,
    aliases: BTreeMap<String, u64>,
}

impl PolicyEntry {
    fn resolve(&self, selector: &VersionSelector) -> Option<&VersionEntry> {
        match selector {
            VersionSelector::Newest => self.versions.values().next_back(),
            VersionSelector::Alias(alias) => self.aliases.get(alias).and_then(|version| self.versions.get(version)),
            VersionSelector::Version(version) => self.versions.get(version),
        }
    }

    fn all(&self) -> impl Iterator<Item = (Arc<PolicyInfo>, bool)> {
        self.versions.values().map(|version| (version.info.clone(), version.loaded.is_some()))
    }

    fn describe(&self, version: &VersionEntry) -> PolicyDetails {
        let number = version.info.reference.version;
        let pointing = self.aliases.iter().filter(|(_, version)| **version == number);
        PolicyDetails {
            info: version.info.clone(),
            loaded: version.loaded.is_some(),
            aliases: pointing.map(|(alias, _)| alias.clone()).collect(),
            versions: self.versions.iter().map(|(number, version)| (*number, version.loaded.is_some())).collect(),
        }
    }
}

/// A policy version with its aliases and sibling versions.
#[derive(Clone, Debug)]
pub struct PolicyDetails {
    /// Description of the version.
    pub info: Arc<PolicyInfo>,
    /// Whether it is loaded.
    pub loaded: bool,
    /// Aliases that point to this version.
    pub aliases: Vec<String>,
    /// All versions of this name, and whether each is loaded.
    pub versions: Vec<(u64, bool)>,
}

type Entries = BTreeMap<String, PolicyEntry>;

/// All policies of this server. Its lock is held only for look-ups and small changes.
#[derive(Debug, Default)]
pub struct Registry {
    entries: RwLock<Entries>,
    changes: Mutex<()>,
}

impl Registry {
    fn read(&self) -> RwLockReadGuard<'_, Entries> {
        // Nothing panics while holding the lock for writing.
        self.entries.read().unwrap_or_else(PoisonError::into_inner)
    }

    fn write(&self) -> RwLockWriteGuard<'_, Entries> {
        self.entries.write().unwrap_or_else(PoisonError::into_inner)
    }

    /// Serializes changes that also go to the store, so that they reach registry and store in the same order.
    pub async fn lock_changes(&self) -> MutexGuard<'_, ()> {
        self.changes.lock().await
    }

    /// Adds a version, or loads an unloaded one.
    pub fn insert(&self, policy: LoadedPolicy) -> Arc<LoadedPolicy> {
        let policy = Arc::new(policy);
        let PolicyRef { name, version, .. } = policy.reference.clone();
        let held = VersionEntry { info: policy.info.clone(), loaded: Some(policy.clone()) };
        let former = self.write().entry(name).or_default().versions.insert(version, held);
        // The former policy may be large, so it is dropped after the lock is released.
        drop(former);
        policy
    }

    /// Unloads a version. Sessions that use it continue.
    pub fn unload(&self, name: &str, version: u64) {
        let mut entries = self.write();
        let held = entries.get_mut(name).and_then(|entry| entry.versions.get_mut(&version));
        let former = held.and_then(|version| version.loaded.take());
        drop(entries);
        drop(former);
    }

    /// Points `name@alias` to `version`.
    pub fn set_alias(&self, name: &str, alias: &str, version: u64) {
        if let Some(entry) = self.write().get_mut(name) {
            entry.aliases.insert(alias.to_owned(), version);
        }
    }

    /// Removes `name@alias`.
    pub fn remove_alias(&self, name: &str, alias: &str) {
        if let Some(entry) = self.write().get_mut(name) {
            entry.aliases.remove(alias);
        }
    }

    /// The version that `spec` resolves to.
    ///
    /// # Errors
    /// [`Error::NotFound`], or `policy_unloaded`.
    pub fn resolve(&self, spec: &PolicySpec) -> Result<Arc<LoadedPolicy>, Error> {
        let entries = self.read();
        let found = entries.get(&spec.name).and_then(|entry| entry.resolve(&spec.version));
        found.ok_or_else(|| Error::not_found("policy", spec.to_string()))?.loaded()
    }

    /// Finds the version with this digest, so that an episode stays on the version that it began with. If `spec` has a version
    /// number, only that version is considered. Otherwise all versions of the name are, first the one that `spec` resolves to
    /// now. Returns `None` if none has this digest.
    ///
    /// # Errors
    /// [`Error::NotFound`] if `spec` does not resolve, or `policy_unloaded`.
    pub fn find_by_digest(&self, spec: &PolicySpec, digest: &[u8; 32]) -> Result<Option<Arc<LoadedPolicy>>, Error> {
        let matches = |version: &&VersionEntry| version.info.reference.digest == *digest;
        let entries = self.read();
        let found = entries.get(&spec.name).and_then(|entry| Some((entry, entry.resolve(&spec.version)?)));
        let (entry, current) = found.ok_or_else(|| Error::not_found("policy", spec.to_string()))?;
        let others = || entry.versions.values().filter(|_| !matches!(spec.version, VersionSelector::Version(_))).find(matches);
        Some(current).filter(matches).or_else(others).map(VersionEntry::loaded).transpose()
    }

    /// Describes the version that `spec` resolves to.
    ///
    /// # Errors
    /// [`Error::NotFound`].
    pub fn describe(&self, spec: &PolicySpec) -> Result<PolicyDetails, Error> {
        let entries = self.read();
        let found = entries.get(&spec.name).and_then(|entry| Some(entry.describe(entry.resolve(&spec.version)?)));
        found.ok_or_else(|| Error::not_found("policy", spec.to_string()))
    }

    /// Aliases of `name`, with the versions that they point to.
    ///
    /// # Errors
    /// [`Error::NotFound`].
    pub fn aliases(&self, name: &str) -> Result<BTreeMap<String, u64>, Error> {
        let entries = self.read();
        entries.get(name).map(|entry| entry.aliases.clone()).ok_or_else(|| Error::not_found("policy", name))
    }

    /// The newest versions of at most `limit` names after `after`, in order of names, and whether there are more.
    pub fn list(&self, after: &str, limit: usize) -> (Vec<PolicyDetails>, bool) {
        use std::ops::Bound::{Excluded, Unbounded};
        let entries = self.read();
        let newest =
            |(_, entry): (_, &PolicyEntry)| entry.resolve(&VersionSelector::Newest).map(|version| entry.describe(version));
        let mut rest = entries.range::<str, _>((Excluded(after), Unbounded)).filter_map(newest);
        let page = rest.by_ref().take(limit).collect();
        (page, rest.next().is_some())
    }

    /// All versions in order of names and numbers, and whether each is loaded.
    pub fn versions(&self) -> Vec<(Arc<PolicyInfo>, bool)> {
        self.read().values().flat_map(PolicyEntry::all).collect()
    }

    /// All versions of `name` in order of numbers, and whether each is loaded.
    pub fn versions_of(&self, name: &str) -> Vec<(Arc<PolicyInfo>, bool)> {
        self.read().get(name).into_iter().flat_map(PolicyEntry::all).collect()
    }

    /// Number of policy versions, loaded or not.
    pub fn len(&self) -> usize {
        self.read().values().map(|entry| entry.versions.len()).sum()
    }

    /// Whether there is no policy.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}
