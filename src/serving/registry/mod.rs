//! The registry of policies: names, versions and aliases, and the versions that are in memory.
//!
//! The registry knows every version, but keeps only some in memory, within a budget of bytes: `service::policies` loads a version
//! from the store when it is asked for, and the versions that were not used for the longest time leave memory. A version that a
//! session or a request uses stays. That a version is not in memory has no effect for callers; that it was unloaded has: requests
//! for it are refused until it is loaded again.

mod memory;
mod policy;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, HashMap};
use std::sync::atomic::Ordering;
use std::sync::{Arc, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};

use tokio::sync::{Mutex, MutexGuard};

use self::memory::Memory;
pub use self::memory::MemoryShare;
pub use self::policy::{LoadedPolicy, PolicyInfo, PolicyKind};
use super::bundled::is_bundled;
use super::{Error, PolicyRef, PolicySpec, VersionSelector};
use crate::error_code::ErrorCode;
use crate::invalid::nearest;

/// The version that a request names.
#[derive(Clone, Debug)]
pub enum Resolved {
    /// It is in memory.
    InMemory(Arc<LoadedPolicy>),
    /// It has to be loaded from the store.
    Stored(PolicyRef),
}

#[derive(Debug)]
struct VersionEntry {
    reference: PolicyRef,
    kind: PolicyKind,
    /// Requests for it are refused until it is loaded again.
    unloaded: bool,
    in_memory: Option<Arc<LoadedPolicy>>,
}

impl VersionEntry {
    fn resolve(&self, memory: &Memory) -> Result<Resolved, Error> {
        if self.unloaded {
            let message = format!("policy {} is unloaded; load it first", self.reference);
            return Err(Error::Precondition { code: ErrorCode::PolicyUnloaded, message });
        }
        let Some(policy) = &self.in_memory else { return Ok(Resolved::Stored(self.reference.clone())) };
        memory.touch(&policy.last_use);
        Ok(Resolved::InMemory(policy.clone()))
    }

    /// Whether a session or a request uses the version. With the lock for writing, nobody new can begin to.
    fn in_use(&self) -> bool {
        self.in_memory.as_ref().is_some_and(|policy| Arc::strong_count(policy) > 1)
    }

    fn state(&self) -> VersionState {
        VersionState { reference: self.reference.clone(), kind: self.kind, loaded: !self.unloaded }
    }
}

#[derive(Debug, Default)]
struct PolicyEntry {
    versions: BTreeMap<u64, VersionEntry>,
    by_digest: HashMap<[u8; 32], u64>,
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

    fn add(&mut self, entry: VersionEntry) {
        self.by_digest.insert(entry.reference.digest, entry.reference.version);
        self.versions.insert(entry.reference.version, entry);
    }

    fn aliases_of(&self, number: u64) -> Vec<String> {
        self.aliases.iter().filter(|(_, version)| **version == number).map(|(alias, _)| alias.clone()).collect()
    }

    fn describe(&self, version: &VersionEntry) -> VersionDetails {
        let mut versions: Vec<_> =
            self.versions.iter().rev().take(MAX_SIBLINGS).map(|(number, version)| (*number, !version.unloaded)).collect();
        versions.reverse();
        VersionDetails {
            state: version.state(),
            info: version.in_memory.as_ref().map(|policy| policy.info.clone()),
            aliases: self.aliases_of(version.reference.version),
            versions,
            version_count: self.versions.len(),
        }
    }
}

/// Maximum number of versions in [`VersionDetails::versions`].
pub const MAX_SIBLINGS: usize = 100;

/// A version as the registry knows it, without its checkpoint.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct VersionState {
    /// Name, version and digest.
    pub reference: PolicyRef,
    /// Origin.
    pub kind: PolicyKind,
    /// Whether requests for it are accepted. It may still have to be read from the store.
    pub loaded: bool,
}

/// A version with its aliases and sibling versions.
#[derive(Clone, Debug)]
pub struct VersionDetails {
    /// The version.
    pub state: VersionState,
    /// Its description, if the version is in memory.
    pub info: Option<Arc<PolicyInfo>>,
    /// Aliases that point to this version.
    pub aliases: Vec<String>,
    /// The newest versions of this name, oldest first and at most [`MAX_SIBLINGS`], and whether each is loaded.
    pub versions: Vec<(u64, bool)>,
    /// Number of all versions of this name.
    pub version_count: usize,
}

/// Versions that were removed from the registry. If they cannot be deleted from the store, they return.
#[derive(Debug)]
pub struct RemovedVersions(Vec<VersionEntry>);

impl RemovedVersions {
    /// The numbers of the versions.
    pub fn numbers(&self) -> Vec<u64> {
        self.0.iter().map(|entry| entry.reference.version).collect()
    }
}

type Entries = BTreeMap<String, PolicyEntry>;

/// All policies of this server. Its lock is held only for look-ups and small changes.
#[derive(Debug)]
pub struct Registry {
    entries: RwLock<Entries>,
    changes: Mutex<()>,
    memory: Memory,
}

/// Memory of policies unless the server sets another, in bytes.
pub const DEFAULT_MEMORY: usize = 1 << 30;

impl Default for Registry {
    fn default() -> Self {
        Self::new(DEFAULT_MEMORY)
    }
}

/// The error about a policy that `spec` does not resolve to: which version or alias is missing, or an existing name that is similar.
fn not_found(entries: &Entries, spec: &PolicySpec) -> Error {
    let what = match (entries.contains_key(&spec.name), &spec.version) {
        (true, VersionSelector::Version(_)) => "policy version",
        (true, VersionSelector::Alias(_)) => "policy alias",
        _ => "policy",
    };
    let known = entries.keys().take(MAX_COMPARED).map(String::as_str);
    let near = if what == "policy" { nearest(&spec.name, known) } else { None };
    Error::NotFound { what, id: spec.to_string(), near: near.map(str::to_owned) }
}

/// Maximum number of names that an unknown one is compared with.
const MAX_COMPARED: usize = 256;

impl Registry {
    /// An empty registry that keeps versions of together `memory` bytes in memory.
    pub fn new(memory: usize) -> Self {
        Self { entries: RwLock::default(), changes: Mutex::default(), memory: Memory::new(memory) }
    }

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

    /// Adds a version that is in memory, such as a baseline.
    pub fn insert(&self, policy: LoadedPolicy) -> Arc<LoadedPolicy> {
        let policy = Arc::new(policy);
        let (reference, kind) = (policy.reference.clone(), policy.kind);
        let entry = VersionEntry { reference, kind, unloaded: false, in_memory: Some(policy.clone()) };
        self.write().entry(policy.reference.name.clone()).or_default().add(entry);
        policy
    }

    /// Adds a stored version without loading it.
    pub fn add(&self, reference: PolicyRef) {
        let name = reference.name.clone();
        let entry = VersionEntry { reference, kind: PolicyKind::Checkpoint, unloaded: false, in_memory: None };
        self.write().entry(name).or_default().add(entry);
    }

    /// Keeps a version that was loaded in memory, unless it was deleted meanwhile.
    pub fn keep(&self, policy: LoadedPolicy) -> Arc<LoadedPolicy> {
        let policy = Arc::new(policy);
        self.memory.touch(&policy.last_use);
        let PolicyRef { name, version, .. } = &policy.reference;
        if let Some(entry) = self.write().get_mut(name).and_then(|entry| entry.versions.get_mut(version)) {
            entry.in_memory = Some(policy.clone());
        }
        policy
    }

    /// Takes `bytes` of the memory of policies, if so many are free.
    pub fn take_free_memory(&self, bytes: usize) -> Option<MemoryShare> {
        self.memory.take(bytes)
    }

    /// Takes `bytes` of the memory of policies. Versions that nobody uses leave memory for it, first those that were not used for
    /// the longest time.
    ///
    /// # Errors
    /// [`Error::Busy`] if sessions and requests use too much.
    pub fn take_memory(&self, bytes: usize) -> Result<MemoryShare, Error> {
        loop {
            if let Some(share) = self.memory.take(bytes) {
                return Ok(share);
            }
            let evicted = self.evict(bytes);
            if evicted == 0 {
                let (used, budget) = (self.memory.used(), self.memory.budget());
                let message = format!("a policy needs {bytes} bytes; {used} of {budget} bytes for policies are in use");
                return Err(Error::Busy(message));
            }
        }
    }

    /// Lets versions that nobody uses leave memory until `bytes` are free, and returns how many have left.
    fn evict(&self, bytes: usize) -> usize {
        let mut unused: Vec<(u64, String, u64)> = Vec::new();
        // Other requests find their versions while this looks for some to evict.
        for entry in self.read().values().flat_map(|entry| entry.versions.values()).filter(|entry| !entry.in_use()) {
            if let Some(policy) = entry.in_memory.as_ref().filter(|policy| policy.memory.bytes() > 0) {
                let PolicyRef { name, version, .. } = &entry.reference;
                unused.push((policy.last_use.load(Ordering::Relaxed), name.clone(), *version));
            }
        }
        unused.sort_unstable();
        let (mut evicted, mut freed) = (Vec::new(), 0);
        let needed = (self.memory.used() + bytes).saturating_sub(self.memory.budget());
        let mut entries = self.write();
        for (_, name, version) in unused {
            if freed >= needed {
                break;
            }
            let entry = entries.get_mut(&name).and_then(|entry| entry.versions.get_mut(&version));
            if let Some(policy) = entry.filter(|entry| !entry.in_use()).and_then(|entry| entry.in_memory.take()) {
                freed += policy.memory.bytes();
                evicted.push(policy);
            }
        }
        drop(entries);
        // The policies may be large, so they are dropped after the lock is released.
        evicted.len()
    }

    /// Bytes of the policies in memory.
    pub fn memory_used(&self) -> usize {
        self.memory.used()
    }

    /// The version, if it is in memory.
    pub fn in_memory(&self, reference: &PolicyRef) -> Option<Arc<LoadedPolicy>> {
        let entries = self.read();
        let entry = entries.get(&reference.name)?.versions.get(&reference.version)?;
        entry.in_memory.clone().filter(|policy| policy.reference.digest == reference.digest)
    }

    /// Unloads a version, or loads it again. Sessions that use it continue.
    pub fn set_loaded(&self, name: &str, version: u64, loaded: bool) {
        if let Some(entry) = self.write().get_mut(name).and_then(|entry| entry.versions.get_mut(&version)) {
            entry.unloaded = !loaded;
        }
    }

    /// Removes versions, all or none.
    ///
    /// # Errors
    /// `wrong_state` if an alias points to one of them, or a session or a request uses it.
    pub fn remove(&self, name: &str, versions: &[u64]) -> Result<RemovedVersions, Error> {
        let wrong = |message| Error::Precondition { code: ErrorCode::WrongState, message };
        let mut entries = self.write();
        let Some(entry) = entries.get_mut(name) else { return Ok(RemovedVersions(Vec::new())) };
        for number in versions {
            if let Some(alias) = entry.aliases_of(*number).first() {
                return Err(wrong(format!("{name}@{alias} points to {name}:{number}; move or delete the alias first")));
            }
            if entry.versions.get(number).is_some_and(VersionEntry::in_use) {
                return Err(wrong(format!(
                    "sessions or requests use {name}:{number}; close its sessions first, or unload it, so that no new ones begin, and \
                     wait until they have ended"
                )));
            }
        }
        let removed: Vec<_> = versions.iter().filter_map(|number| entry.versions.remove(number)).collect();
        for version in &removed {
            entry.by_digest.remove(&version.reference.digest);
        }
        if entry.versions.is_empty() {
            entries.remove(name);
        }
        Ok(RemovedVersions(removed))
    }

    /// Takes versions back that could not be deleted.
    pub fn restore(&self, removed: RemovedVersions) {
        let mut entries = self.write();
        for version in removed.0 {
            entries.entry(version.reference.name.clone()).or_default().add(version);
        }
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
    pub fn resolve(&self, spec: &PolicySpec) -> Result<Resolved, Error> {
        let entries = self.read();
        let found = entries.get(&spec.name).and_then(|entry| entry.resolve(&spec.version));
        found.ok_or_else(|| not_found(&entries, spec))?.resolve(&self.memory)
    }

    /// Finds the version with this digest, so that an episode stays on the version that it began with. If `spec` has a version
    /// number, only that version is considered. Otherwise all versions of the name are. Returns `None` if none has this digest.
    ///
    /// # Errors
    /// [`Error::NotFound`] if `spec` does not resolve, or `policy_unloaded`.
    pub fn find_by_digest(&self, spec: &PolicySpec, digest: &[u8; 32]) -> Result<Option<Resolved>, Error> {
        let entries = self.read();
        let found = entries.get(&spec.name).and_then(|entry| Some((entry, entry.resolve(&spec.version)?)));
        let (entry, current) = found.ok_or_else(|| not_found(&entries, spec))?;
        let found = if current.reference.digest == *digest {
            Some(current)
        } else if matches!(spec.version, VersionSelector::Version(_)) {
            None
        } else {
            entry.by_digest.get(digest).and_then(|version| entry.versions.get(version))
        };
        found.map(|version| version.resolve(&self.memory)).transpose()
    }

    /// The version of `name` with this digest, loaded or not.
    pub fn version_of_digest(&self, name: &str, digest: &[u8; 32]) -> Option<VersionState> {
        let entries = self.read();
        let entry = entries.get(name)?;
        Some(entry.versions.get(entry.by_digest.get(digest)?)?.state())
    }

    /// Describes the version that `spec` resolves to.
    ///
    /// # Errors
    /// [`Error::NotFound`].
    pub fn describe(&self, spec: &PolicySpec) -> Result<VersionDetails, Error> {
        let entries = self.read();
        let found = entries.get(&spec.name).and_then(|entry| Some(entry.describe(entry.resolve(&spec.version)?)));
        found.ok_or_else(|| not_found(&entries, spec))
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
    pub fn list(&self, after: &str, limit: usize) -> (Vec<VersionDetails>, bool) {
        use std::ops::Bound::{Excluded, Unbounded};
        let entries = self.read();
        let newest =
            |(_, entry): (_, &PolicyEntry)| entry.resolve(&VersionSelector::Newest).map(|version| entry.describe(version));
        let mut rest = entries.range::<str, _>((Excluded(after), Unbounded)).filter_map(newest);
        let page = rest.by_ref().take(limit).collect();
        (page, rest.next().is_some())
    }

    /// At most `limit` versions of `name` before version `before` with their aliases, newest first, and whether there are more.
    ///
    /// # Errors
    /// [`Error::NotFound`].
    pub fn list_versions(
        &self,
        name: &str,
        before: u64,
        limit: usize,
    ) -> Result<(Vec<(VersionState, Vec<String>)>, bool), Error> {
        let entries = self.read();
        let entry = entries.get(name).ok_or_else(|| Error::not_found("policy", name))?;
        let mut rest = entry.versions.range(..before).rev();
        let page = rest.by_ref().take(limit).map(|(number, version)| (version.state(), entry.aliases_of(*number))).collect();
        Ok((page, rest.next().is_some()))
    }

    /// All versions in order of names and numbers.
    pub fn versions(&self) -> Vec<VersionState> {
        self.read().values().flat_map(|entry| entry.versions.values()).map(VersionEntry::state).collect()
    }

    /// All versions of `name` in order of numbers.
    pub fn versions_of(&self, name: &str) -> Vec<VersionState> {
        self.read().get(name).into_iter().flat_map(|entry| entry.versions.values()).map(VersionEntry::state).collect()
    }

    /// The names of all policies.
    pub fn names(&self) -> Vec<String> {
        self.read().keys().cloned().collect()
    }

    /// The versions of `name` that are older than the newest `keep` of those without an alias, oldest first. Versions with an
    /// alias, versions that somebody uses, and what the program brings with it are not among them.
    pub fn excess_versions(&self, name: &str, keep: usize) -> Vec<u64> {
        let entries = self.read();
        let Some(entry) = entries.get(name) else { return Vec::new() };
        let aliased = |number: &u64| entry.aliases.values().any(|version| version == number);
        let candidates = entry.versions.iter().rev().filter(|(number, _)| !aliased(number)).skip(keep);
        let deletable = |version: &VersionEntry| version.kind == PolicyKind::Checkpoint && !is_bundled(&version.reference);
        let excess = candidates.filter(|(_, version)| deletable(version) && !version.in_use());
        let mut numbers: Vec<u64> = excess.map(|(number, _)| *number).collect();
        numbers.reverse();
        numbers
    }

    /// Number of policy versions, loaded or not.
    pub fn len(&self) -> usize {
        self.read().values().map(|entry| entry.versions.len()).sum()
    }

    /// Whether there is no policy.
    pub fn is_empty(&self) -> bool {
        self.read().is_empty()
    }
}
