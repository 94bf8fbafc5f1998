//! The manifest of a server's policies, and how a replica takes over what the manifest of its primary lists.
//!
//! A replica has the same versions under the same numbers. It deletes only versions that the primary has had, too.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::deletion::remove;
use super::publish::check_publishable;
use super::stored::{CheckpointBytes, ParsedCheckpoint, StoredVersion};
use super::{PolicyStores, info, one_at_a_time};
use crate::error_code::ErrorCode;
use crate::invalid::Invalid;
use crate::service::{App, Error};
use crate::serving::{PolicyKind, PolicyRef, VersionState, check_name};
use crate::store::{AliasMove, FollowedVersion};

/// All policies with checkpoints, by name.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Manifest {
    /// The policies.
    pub policies: BTreeMap<String, ManifestPolicy>,
}

/// A policy in a [`Manifest`].
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ManifestPolicy {
    /// Its versions in order of numbers.
    pub versions: Vec<ManifestVersion>,
    /// Aliases and the versions that they point to.
    pub aliases: BTreeMap<String, u64>,
}

/// A version in a [`Manifest`].
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ManifestVersion {
    /// Its number.
    pub version: u64,
    /// SHA-256 of the checkpoint, in hexadecimal.
    pub sha256: String,
    /// Whether requests for it are accepted.
    pub loaded: bool,
}

impl Manifest {
    /// SHA-256 of the manifest, in hexadecimal.
    pub fn digest(&self) -> String {
        let text = serde_json::to_vec(self).expect("texts and numbers are plain data");
        hex::encode(Sha256::digest(text))
    }
}

impl ManifestVersion {
    fn digest(&self) -> Result<[u8; 32], Invalid> {
        let mut digest = [0; 32];
        let decoded = hex::decode_to_slice(&self.sha256, &mut digest);
        decoded.map_err(|_| Invalid::new("sha256", &self.sha256, "64 hexadecimal digits"))?;
        Ok(digest)
    }
}

/// The manifest of this server.
///
/// # Errors
/// [`Error::Unavailable`] on a replica that has taken nothing yet: its manifest would have its own replicas delete everything.
pub fn manifest(app: &App) -> Result<Manifest, Error> {
    app.check_copy()?;
    let mut policies: BTreeMap<String, ManifestPolicy> = BTreeMap::new();
    let checkpoints = app.registry.versions().into_iter().filter(|state| state.kind == PolicyKind::Checkpoint);
    for VersionState { reference, loaded, .. } in checkpoints {
        let (version, sha256) = (reference.version, reference.digest_hex());
        let policy = policies.entry(reference.name).or_default();
        policy.versions.push(ManifestVersion { version, sha256, loaded });
    }
    for (name, policy) in &mut policies {
        // Deleted meanwhile: no aliases.
        policy.aliases = app.registry.aliases(name).unwrap_or_default();
    }
    Ok(Manifest { policies })
}

/// A version of the primary that this server does not have.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MissingVersion {
    /// Name, number and announced digest.
    pub reference: PolicyRef,
    /// A version of this server with the same checkpoint.
    pub known: Option<PolicyRef>,
}

/// The versions of a manifest that this server does not have.
///
/// # Errors
/// [`Invalid`] for a digest that cannot be read.
pub fn missing(app: &App, manifest: &Manifest) -> Result<Vec<MissingVersion>, Invalid> {
    let states = app.registry.versions().into_iter().filter(|state| state.kind == PolicyKind::Checkpoint);
    let all: Vec<PolicyRef> = states.map(|state| state.reference).collect();
    let by_number: HashMap<(&str, u64), &PolicyRef> = all.iter().map(|r| ((r.name.as_str(), r.version), r)).collect();
    let by_digest: HashMap<[u8; 32], &PolicyRef> = all.iter().map(|r| (r.digest, r)).collect();
    let mut missing = Vec::new();
    for (name, policy) in &manifest.policies {
        for listed in &policy.versions {
            let (version, digest) = (listed.version, listed.digest()?);
            if by_number.get(&(name.as_str(), version)).is_none_or(|known| known.digest != digest) {
                let reference = PolicyRef { name: name.clone(), version, digest };
                missing.push(MissingVersion { reference, known: by_digest.get(&digest).map(|known| (*known).clone()) });
            }
        }
    }
    Ok(missing)
}

/// The checkpoint of a version of this server.
///
/// # Errors
/// [`Error::Internal`] when it is damaged, [`Error::NotFound`] when it was deleted meanwhile.
pub async fn checkpoint_of(app: &App, reference: &PolicyRef) -> Result<Vec<u8>, Error> {
    let stored = StoredVersion::read(&app.store, &reference.name, reference.version).await?;
    Ok(stored.checkpoint()?.1)
}

/// Takes over a version of the primary, after a check of its digest. What the primary had before under this number, or with this
/// checkpoint under another number, is deleted.
///
/// # Errors
/// [`Error::Invalid`] for a name that cannot be published, another digest, or bytes that are no checkpoint; [`Error::Precondition`] if
/// this server has a version of its own in that place, or one that is in use; [`Error::Internal`] when the database fails.
pub async fn take_over(app: &App, reference: PolicyRef, bytes: Vec<u8>, created_at: Timestamp) -> Result<(), Error> {
    check_publishable(&reference.name)?;
    if i64::try_from(reference.version).is_err() || reference.version == 0 {
        return Err(Invalid::new("version", reference.version, "a number of a version").into());
    }
    let parsed = ParsedCheckpoint::parse(CheckpointBytes { bytes, _permit: None }).await?;
    if parsed.digest != reference.digest {
        let expected = format!("{}, as the primary announced", reference.digest_hex());
        return Err(Invalid::new("sha256", hex::encode(parsed.digest), expected).into());
    }
    let info = info::to_json(&parsed.describe(reference.clone(), created_at))?;
    let now = app.clock.now();
    one_at_a_time(app, async move |stores| {
        stores.make_room(&reference, now).await?;
        let PolicyRef { name, version, .. } = &reference;
        let (version, digest, checkpoint) = (*version, &reference.digest_hex(), &parsed.source.bytes);
        stores.store.follow_version(FollowedVersion { name, version, digest, checkpoint, info: &info, created_at }).await?;
        tracing::info!(policy = %reference, digest, "policy taken from the primary");
        stores.registry.add(reference.clone());
        if let Some(share) = stores.registry.take_free_memory(checkpoint.len()) {
            stores.registry.keep(parsed.into_policy(reference, created_at.as_millisecond(), share));
        }
        Ok(())
    })
    .await
}

/// Brings aliases, and which versions are loaded, to the state of the manifest, and deletes what the primary has deleted. Versions that
/// are in use stay until they are not. Returns whether all is done.
///
/// # Errors
/// [`Error::Internal`] when the database fails.
pub async fn align(app: &App, manifest: &Manifest) -> Result<bool, Error> {
    let followed = app.store.followed_versions().await?;
    let names: BTreeSet<String> = followed.keys().chain(manifest.policies.keys()).cloned().collect();
    let mut done = true;
    for name in names.into_iter().filter(|name| check_publishable(name).is_ok()) {
        let wanted = manifest.policies.get(&name).cloned().unwrap_or_default();
        let followed = followed.get(&name).cloned().unwrap_or_default();
        let now = app.clock.now();
        done &= one_at_a_time(app, async move |stores| stores.align(&name, &wanted, followed, now).await).await?;
    }
    Ok(done)
}

impl PolicyStores {
    async fn align(&self, name: &str, wanted: &ManifestPolicy, followed: BTreeSet<u64>, now: Timestamp) -> Result<bool, Error> {
        let listed: HashMap<u64, &ManifestVersion> = wanted.versions.iter().map(|listed| (listed.version, listed)).collect();
        let (mut common, mut others) = (BTreeSet::new(), Vec::new());
        for VersionState { reference: PolicyRef { version, digest, .. }, loaded, .. } in self.registry.versions_of(name) {
            let Some(listed) = listed.get(&version).filter(|listed| listed.digest() == Ok(digest)) else {
                others.push(version);
                continue;
            };
            common.insert(version);
            if listed.loaded != loaded {
                self.store.set_policy_versions_loaded(name, &[version], listed.loaded, now).await?;
                self.registry.set_loaded(name, version, listed.loaded);
            }
        }
        let new: Vec<u64> = common.difference(&followed).copied().collect();
        if !new.is_empty() {
            self.store.mark_followed(name, &new).await?;
        }
        let current = self.registry.aliases(name).unwrap_or_default();
        for (alias, &version) in wanted.aliases.iter().filter(|(alias, _)| check_name("alias", alias).is_ok()) {
            // A version that could not be taken over leaves its aliases where they are.
            if current.get(alias) != Some(&version) && common.contains(&version) {
                self.move_alias(name, alias, Some(version), now).await?;
            }
        }
        for alias in current.keys().filter(|alias| !wanted.aliases.contains_key(*alias)) {
            self.move_alias(name, alias, None, now).await?;
        }
        let mut done = true;
        for version in others.into_iter().filter(|version| followed.contains(version)) {
            match remove(self, name, &[version]).await {
                Err(Error::Precondition { .. }) => done = false,
                result => result?,
            }
        }
        Ok(done)
    }

    /// Removes versions that stand in the place of a version of the primary: the primary had them, and has deleted them. Their aliases
    /// follow when the version has been taken over.
    async fn make_room(&self, reference: &PolicyRef, now: Timestamp) -> Result<(), Error> {
        let PolicyRef { name, version, digest } = reference;
        let in_place = |state: &VersionState| state.reference.version == *version || state.reference.digest == *digest;
        let in_place: Vec<_> = self.registry.versions_of(name).into_iter().filter(in_place).collect();
        if in_place.is_empty() {
            return Ok(());
        }
        let followed = self.store.followed_versions().await?.remove(name).unwrap_or_default();
        for PolicyRef { version: other, .. } in in_place.into_iter().map(|state| state.reference) {
            if !followed.contains(&other) {
                let message = format!("{name}:{other} of this server stands in the place of {reference} of the primary");
                return Err(Error::Precondition { code: ErrorCode::WrongState, message });
            }
            let aliases = self.registry.aliases(name).unwrap_or_default().into_iter().filter(|(_, to)| *to == other);
            let aliases: Vec<String> = aliases.map(|(alias, _)| alias).collect();
            for alias in &aliases {
                self.move_alias(name, alias, None, now).await?;
            }
            if let Err(error) = remove(self, name, &[other]).await {
                for alias in &aliases {
                    self.move_alias(name, alias, Some(other), now).await?;
                }
                return Err(error);
            }
        }
        Ok(())
    }

    async fn move_alias(&self, name: &str, alias: &str, to: Option<u64>, at: Timestamp) -> Result<(), Error> {
        self.store.move_policy_alias(AliasMove { name, alias, to, at, by: None }).await?;
        match to {
            Some(version) => self.registry.set_alias(name, alias, version),
            None => self.registry.remove_alias(name, alias),
        }
        tracing::info!(policy = name, alias, version = to, "alias as on the primary");
        Ok(())
    }
}
