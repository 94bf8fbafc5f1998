//! Which policies there are; publishing a checkpoint as a new version of one.

use std::sync::Arc;

use jiff::Timestamp;
use serde_json::{Value, json};
use sha2::{Digest, Sha256};

use super::sessions::page_size;
use super::{App, Error};
use crate::checkpoint::Checkpoint;
use crate::invalid::Invalid;
use crate::policy::baselines::{self, World};
use crate::policy::{Identity, Observation};
use crate::serving::bundled::BUNDLED;
use crate::serving::{Kind, LoadedPolicy, PolicyRef, PolicySpec, check_name};
use crate::store::NewPolicyVersion;

/// A policy version with what surrounds it.
#[derive(Clone, Debug)]
pub struct Described {
    /// The version.
    pub policy: Arc<LoadedPolicy>,
    /// Aliases that mean this version.
    pub aliases: Vec<String>,
    /// All versions of this name.
    pub versions: Vec<u64>,
}

/// A page of policies in order of names, each in its newest version, and the token of the next page.
///
/// # Errors
/// A page size out of range.
pub fn list(app: &App, size: u32, token: &str) -> Result<(Vec<Described>, Option<String>), Error> {
    let (page, more) = app.registry.list(token, page_size(size)?);
    let next = page.last().filter(|_| more).map(|last| last.reference.name.clone());
    Ok((page.into_iter().map(|policy| describe(app, policy)).collect(), next))
}

/// The version that `spec` names.
///
/// # Errors
/// There is none.
pub fn get(app: &App, spec: &PolicySpec) -> Result<Described, Error> {
    Ok(describe(app, app.registry.resolve(spec)?))
}

fn describe(app: &App, policy: Arc<LoadedPolicy>) -> Described {
    let (aliases, versions) = app.registry.neighbours(&policy.reference);
    Described { policy, aliases, versions }
}

/// Checks that policies may be published as `name`.
///
/// # Errors
/// A name that no policy can have, or a baseline's.
pub fn check_publishable(name: &str) -> Result<(), Invalid> {
    check_name("name", name)?;
    if baselines::LIST.iter().any(|baseline| baseline.name == name) {
        return Err(Invalid::new("name", format!("{name:?}"), "a name that is not a baseline's"));
    }
    Ok(())
}

/// Stores a checkpoint (safetensors) as the next version of policy `name` and serves it. Equal bytes under the same name are
/// the version that they already are.
///
/// # Errors
/// A name that cannot be used, bytes that are no checkpoint, a database that fails.
pub async fn publish(app: &App, name: &str, bytes: Vec<u8>) -> Result<PolicyRef, Error> {
    check_publishable(name)?;
    let (checkpoint, bytes) = read(bytes).await?;
    let digest: [u8; 32] = Sha256::digest(&bytes).into();
    let mut reference = PolicyRef { name: name.to_owned(), version: 0, digest };
    let new =
        NewPolicyVersion { name, digest: &reference.digest_hex(), checkpoint: &bytes, now: app.clock.now().as_millisecond() };
    let (version, created_at) = app.store.publish_policy(new).await?;
    reference.version = version;
    app.registry.insert(learned(reference.clone(), &checkpoint, created_at));
    tracing::info!(policy = %reference, digest = reference.digest_hex(), "published");
    Ok(reference)
}

/// Fills the registry: baselines, bundled policies, and what was published before.
///
/// # Errors
/// The store cannot be read, or a bundled policy is no checkpoint. A published version that cannot be read any more is left
/// out and logged: the others are served.
pub async fn load(app: &App) -> Result<(), Error> {
    let world = World::default();
    for baseline in &baselines::LIST {
        let Some(policy) = baselines::by_name(baseline.name, world) else { continue };
        // The digest says what a checkpoint's does: equal digests, equal answers.
        let digest = Sha256::digest(format!("baseline {} {world:?}", baseline.name)).into();
        app.registry.insert(LoadedPolicy {
            reference: PolicyRef { name: baseline.name.to_owned(), version: 1, digest },
            policy,
            kind: Kind::Baseline,
            description: baseline.text.to_owned(),
            uavs: None,
            users: None,
            config: Value::Null,
            metrics: Value::Null,
            created_at: app.clock.now(),
        });
    }
    for (name, version) in app.store.policy_versions().await? {
        let Some(stored) = app.store.policy_version(&name, version).await? else { continue };
        let digest: [u8; 32] = Sha256::digest(&stored.checkpoint).into();
        let reference = PolicyRef { name, version, digest };
        if reference.digest_hex() != stored.digest {
            tracing::error!(policy = %reference, "its checkpoint is damaged: another digest than when it was published");
            continue;
        }
        match Checkpoint::from_bytes(&stored.checkpoint) {
            Ok(checkpoint) => drop(app.registry.insert(learned(reference, &checkpoint, stored.created_at))),
            Err(error) => tracing::error!(policy = %reference, %error, "its checkpoint cannot be read"),
        }
    }
    for (name, bytes) in BUNDLED {
        publish(app, name, bytes.to_vec()).await?;
    }
    for alias in app.store.policy_aliases().await? {
        app.registry.set_alias(&alias.name, &alias.alias, alias.version);
    }
    Ok(())
}

/// Reads a checkpoint away from the threads that serve connections; hands the bytes back.
async fn read(bytes: Vec<u8>) -> Result<(Checkpoint, Vec<u8>), Error> {
    let read = tokio::task::spawn_blocking(move || (Checkpoint::from_bytes(&bytes), bytes));
    let (checkpoint, bytes) = read.await.map_err(Error::internal)?;
    let size = bytes.len();
    let refused = |e| Invalid::new("checkpoint", format!("{size} bytes"), format!("a checkpoint of this program ({e})"));
    Ok((checkpoint.map_err(refused)?, bytes))
}

fn learned(reference: PolicyRef, checkpoint: &Checkpoint, created_at: i64) -> LoadedPolicy {
    let config = checkpoint.config();
    let (environment, training) = (&config.environment, &config.training);
    let flat = training.observation == Observation::Flat;
    let object = |value: serde_json::Result<Value>| value.unwrap_or_default();
    let mut metrics = json!({"step": checkpoint.step()});
    if let (Some(all), Value::Object(figures)) = (metrics.as_object_mut(), object(serde_json::to_value(checkpoint.metrics()))) {
        all.extend(figures);
    }
    LoadedPolicy {
        description: format!(
            "{:?}, trained for {} slots with {} UAVs and {} users.",
            config.algorithm,
            checkpoint.step(),
            environment.uavs,
            environment.users
        ),
        uavs: (flat || training.identity == Identity::Onehot).then_some(environment.uavs as u32),
        users: flat.then_some(environment.users as u32),
        config: object(serde_json::to_value(config)),
        metrics,
        policy: Arc::new(checkpoint.policy()),
        kind: Kind::Checkpoint,
        created_at: Timestamp::from_millisecond(created_at).unwrap_or_default(),
        reference,
    }
}

/// A policy version as an index of all shows it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct IndexEntry {
    /// Name.
    pub name: String,
    /// Version.
    pub version: u64,
    /// Whether it can be asked for.
    pub ready: bool,
    /// Why not.
    pub reason: String,
}

/// Lets all versions of `name` be asked for again.
///
/// # Errors
/// There is no such policy.
#[allow(clippy::unused_async)]
pub async fn load_policy(app: &App, name: &str) -> Result<(), Error> {
    Ok(app.registry.set_loaded(name, true)?)
}

/// Lets no version of `name` be asked for any more. Sessions that have begun go on.
///
/// # Errors
/// There is no such policy.
#[allow(clippy::unused_async)]
pub async fn unload_policy(app: &App, name: &str) -> Result<(), Error> {
    Ok(app.registry.set_loaded(name, false)?)
}

/// All policy versions in order of names, those included that cannot be asked for.
pub fn index(app: &App) -> Vec<IndexEntry> {
    let entry = |(policy, ready): (PolicyRef, bool)| IndexEntry {
        name: policy.name,
        version: policy.version,
        ready,
        reason: if ready { String::new() } else { "unloaded".into() },
    };
    app.registry.index().into_iter().map(entry).collect()
}
