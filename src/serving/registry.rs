//! Which policies there are: names, versions, aliases, each version loaded once and shared, or unloaded.
//!
//! Whoever holds a [`LoadedPolicy`] goes on with it, whatever happens here: a session ends on the version it began with.

use std::collections::BTreeMap;
use std::ops::Deref;
use std::sync::{Arc, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};

use jiff::Timestamp;
use serde_json::Value;
use tokio::sync::{Mutex, MutexGuard};

use super::{Error, PolicyRef, PolicySpec, Which};
use crate::error_code::ErrorCode;
use crate::policy::{Policy, RequiredInput};

/// Where a policy comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Learned, stored as a checkpoint.
    Checkpoint,
    /// Part of the program (spec 6).
    Baseline,
}

/// What is known of one version of one policy, loaded or not.
#[derive(Clone, Debug)]
pub struct About {
    /// Which it is.
    pub reference: PolicyRef,
    /// Where it comes from.
    pub kind: Kind,
    /// A sentence for people.
    pub description: String,
    /// The only M it serves, where there is one.
    pub uavs: Option<u32>,
    /// The only N it serves, where there is one.
    pub users: Option<u32>,
    /// A, the number of headings.
    pub headings: usize,
    /// What it must be told.
    pub needs: RequiredInput,
    /// d, the detection range that it works with.
    pub detection_range: f64,
    /// Resolved training configuration of a checkpoint, an object; null for a baseline.
    pub config: Value,
    /// Figures a checkpoint was taken at, an object; null for a baseline.
    pub metrics: Value,
    /// When it was published; for baselines, when the server started.
    pub created_at: Timestamp,
}

/// One version of one policy, ready to fly.
pub struct LoadedPolicy {
    /// What is known of it.
    pub about: Arc<About>,
    /// What decides.
    pub policy: Arc<dyn Policy>,
}

impl LoadedPolicy {
    /// A policy that is part of the program.
    pub fn baseline(reference: PolicyRef, description: &str, policy: Arc<dyn Policy>, created_at: Timestamp) -> Self {
        let about = About {
            reference,
            kind: Kind::Baseline,
            description: description.to_owned(),
            uavs: None,
            users: None,
            headings: policy.actions(),
            needs: policy.needs(),
            detection_range: policy.detection_range(),
            config: Value::Null,
            metrics: Value::Null,
            created_at,
        };
        Self { about: Arc::new(about), policy }
    }
}

impl Deref for LoadedPolicy {
    type Target = About;

    fn deref(&self) -> &About {
        &self.about
    }
}

impl std::fmt::Debug for LoadedPolicy {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "LoadedPolicy({}, {:?})", self.reference, self.kind)
    }
}

#[derive(Debug)]
struct Version {
    about: Arc<About>,
    loaded: Option<Arc<LoadedPolicy>>,
}

impl Version {
    fn loaded(&self) -> Result<Arc<LoadedPolicy>, Error> {
        self.loaded.clone().ok_or_else(|| {
            let reference = &self.about.reference;
            let message = format!("policy {reference} is unloaded; load it to fly it");
            Error::Precondition { code: ErrorCode::PolicyUnloaded, message }
        })
    }
}

#[derive(Debug, Default)]
struct Entry {
    versions: BTreeMap<u64, Version>,
    aliases: BTreeMap<String, u64>,
}

impl Entry {
    fn meant_by(&self, which: &Which) -> Option<&Version> {
        match which {
            Which::Newest => self.versions.values().next_back(),
            Which::Alias(alias) => self.aliases.get(alias).and_then(|version| self.versions.get(version)),
            Which::Version(version) => self.versions.get(version),
        }
    }

    fn all(&self) -> impl Iterator<Item = (Arc<About>, bool)> {
        self.versions.values().map(|version| (version.about.clone(), version.loaded.is_some()))
    }

    fn describe(&self, version: &Version) -> Described {
        let number = version.about.reference.version;
        let pointing = self.aliases.iter().filter(|(_, version)| **version == number);
        Described {
            about: version.about.clone(),
            loaded: version.loaded.is_some(),
            aliases: pointing.map(|(alias, _)| alias.clone()).collect(),
            versions: self.versions.iter().map(|(number, version)| (*number, version.loaded.is_some())).collect(),
        }
    }
}

/// A policy version with what surrounds it, at one moment.
#[derive(Clone, Debug)]
pub struct Described {
    /// The version.
    pub about: Arc<About>,
    /// Whether it can be asked.
    pub loaded: bool,
    /// Aliases that mean this version.
    pub aliases: Vec<String>,
    /// All versions of this name, and which of them are loaded.
    pub versions: Vec<(u64, bool)>,
}

type Entries = BTreeMap<String, Entry>;

/// All policies of this server. The lock is held for look-ups and small changes only.
#[derive(Debug, Default)]
pub struct Registry {
    entries: RwLock<Entries>,
    turns: Mutex<()>,
}

impl Registry {
    fn read(&self) -> RwLockReadGuard<'_, Entries> {
        // Nothing panics while holding the lock for writing, and a map is whole after every insertion.
        self.entries.read().unwrap_or_else(PoisonError::into_inner)
    }

    fn write(&self) -> RwLockWriteGuard<'_, Entries> {
        self.entries.write().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits for the turn to change what is also kept elsewhere. Changes that take turns happen here in the order in which
    /// they happen there.
    pub async fn turn(&self) -> MutexGuard<'_, ()> {
        self.turns.lock().await
    }

    /// Adds a version, or loads one that is known.
    pub fn insert(&self, policy: LoadedPolicy) -> Arc<LoadedPolicy> {
        let policy = Arc::new(policy);
        let PolicyRef { name, version, .. } = policy.reference.clone();
        let held = Version { about: policy.about.clone(), loaded: Some(policy.clone()) };
        let former = self.write().entry(name).or_default().versions.insert(version, held);
        // What it holds may be large: not dropped under the lock.
        drop(former);
        policy
    }

    /// Keeps a version in mind, but not what decides. Sessions that fly it go on.
    pub fn unload(&self, name: &str, version: u64) {
        let mut entries = self.write();
        let held = entries.get_mut(name).and_then(|entry| entry.versions.get_mut(&version));
        let former = held.and_then(|version| version.loaded.take());
        drop(entries);
        drop(former);
    }

    /// Lets `name@alias` mean `version`.
    pub fn set_alias(&self, name: &str, alias: &str, version: u64) {
        if let Some(entry) = self.write().get_mut(name) {
            entry.aliases.insert(alias.to_owned(), version);
        }
    }

    /// Lets `name@alias` mean nothing.
    pub fn remove_alias(&self, name: &str, alias: &str) {
        if let Some(entry) = self.write().get_mut(name) {
            entry.aliases.remove(alias);
        }
    }

    /// The version that `spec` names now.
    ///
    /// # Errors
    /// [`Error::Unknown`], or `policy_unloaded`.
    pub fn resolve(&self, spec: &PolicySpec) -> Result<Arc<LoadedPolicy>, Error> {
        let entries = self.read();
        let found = entries.get(&spec.name).and_then(|entry| entry.meant_by(&spec.which));
        found.ok_or_else(|| Error::unknown("policy", spec.to_string()))?.loaded()
    }

    /// The version with this digest, which an episode asked for as `spec` began with: the one that `spec` names now, or,
    /// unless `spec` names a version, another of its name. None if it is neither.
    ///
    /// # Errors
    /// [`Error::Unknown`] where `spec` names nothing, or `policy_unloaded`.
    pub fn pinned(&self, spec: &PolicySpec, digest: &[u8; 32]) -> Result<Option<Arc<LoadedPolicy>>, Error> {
        let is_it = |version: &&Version| version.about.reference.digest == *digest;
        let entries = self.read();
        let found = entries.get(&spec.name).and_then(|entry| Some((entry, entry.meant_by(&spec.which)?)));
        let (entry, now) = found.ok_or_else(|| Error::unknown("policy", spec.to_string()))?;
        let others = || entry.versions.values().filter(|_| !matches!(spec.which, Which::Version(_))).find(is_it);
        Some(now).filter(is_it).or_else(others).map(Version::loaded).transpose()
    }

    /// What is known of the version that `spec` names.
    ///
    /// # Errors
    /// [`Error::Unknown`].
    pub fn describe(&self, spec: &PolicySpec) -> Result<Described, Error> {
        let entries = self.read();
        let found = entries.get(&spec.name).and_then(|entry| Some(entry.describe(entry.meant_by(&spec.which)?)));
        found.ok_or_else(|| Error::unknown("policy", spec.to_string()))
    }

    /// Aliases of `name` with the versions that they mean.
    ///
    /// # Errors
    /// [`Error::Unknown`].
    pub fn aliases(&self, name: &str) -> Result<BTreeMap<String, u64>, Error> {
        let entries = self.read();
        entries.get(name).map(|entry| entry.aliases.clone()).ok_or_else(|| Error::unknown("policy", name))
    }

    /// The newest version of each name after `after`, at most `limit`, in order of names, and whether there are more.
    pub fn list(&self, after: &str, limit: usize) -> (Vec<Described>, bool) {
        use std::ops::Bound::{Excluded, Unbounded};
        let entries = self.read();
        let newest = |(_, entry): (_, &Entry)| entry.meant_by(&Which::Newest).map(|version| entry.describe(version));
        let mut rest = entries.range::<str, _>((Excluded(after), Unbounded)).filter_map(newest);
        let page = rest.by_ref().take(limit).collect();
        (page, rest.next().is_some())
    }

    /// Every version in order of names and numbers, and whether it is loaded.
    pub fn versions(&self) -> Vec<(Arc<About>, bool)> {
        self.read().values().flat_map(Entry::all).collect()
    }

    /// Every version of `name` in order of numbers, and whether it is loaded.
    pub fn versions_of(&self, name: &str) -> Vec<(Arc<About>, bool)> {
        self.read().get(name).into_iter().flat_map(Entry::all).collect()
    }

    /// Number of policy versions, loaded or not.
    pub fn len(&self) -> usize {
        self.read().values().map(|entry| entry.versions.len()).sum()
    }

    /// Whether there is no policy at all.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}
