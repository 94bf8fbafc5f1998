//! Checkpoints become versions.

use std::sync::Arc;

use jiff::Timestamp;
use serde_json::{Value, json};
use sha2::{Digest, Sha256};

use super::aliases::{check_alias, unloaded};
use super::{Shelf, in_turn};
use crate::checkpoint::Checkpoint;
use crate::invalid::Invalid;
use crate::policy::baselines;
use crate::policy::{Identity, ObservationKind, Policy};
use crate::service::{App, Error, jobs};
use crate::serving::{About, Described, Kind, LoadedPolicy, PolicyRef, PolicySpec, Which, check_name};
use crate::store::{NewPolicyVersion, PolicyVersion, Store};

/// Where a checkpoint comes from.
#[derive(Clone, Debug)]
pub enum Source {
    /// Here it is, as safetensors.
    Bytes(Vec<u8>),
    /// A job made it; its id.
    Checkpoint(String),
}

/// A checkpoint to publish.
#[derive(Clone, Debug)]
pub struct Upload {
    /// Name of the policy, new or known.
    pub name: String,
    /// The checkpoint.
    pub source: Source,
    /// An alias that shall mean it.
    pub alias: Option<String>,
    /// Who publishes it, where that is known.
    pub by: Option<String>,
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
/// the version that they already are, loaded or not.
///
/// # Errors
/// A name that cannot be used, bytes that are no checkpoint, a database that fails.
pub async fn publish(app: &App, name: &str, bytes: Vec<u8>) -> Result<PolicyRef, Error> {
    let (reference, _) = keep(app, name, bytes, None, None).await?;
    Ok(reference)
}

/// Publishes what somebody sends, and tells whether it is a new version.
///
/// # Errors
/// As [`publish`]; an unknown checkpoint, an alias that cannot be used, an alias for a version that is unloaded, draining.
pub async fn upload(app: &App, upload: Upload) -> Result<(Described, bool), Error> {
    app.admit()?;
    let Upload { name, source, alias, by } = upload;
    check_publishable(&name)?;
    if let Some(alias) = &alias {
        check_name("alias", alias)?;
    }
    let bytes = match source {
        Source::Bytes(bytes) => bytes,
        Source::Checkpoint(id) => jobs::checkpoint(app, &id).await?.1,
    };
    let (reference, new) = keep(app, &name, bytes, alias, by).await?;
    let spec = PolicySpec { name, which: Which::Version(reference.version) };
    Ok((app.registry.describe(&spec)?, new))
}

async fn keep(
    app: &App,
    name: &str,
    bytes: Vec<u8>,
    alias: Option<String>,
    by: Option<String>,
) -> Result<(PolicyRef, bool), Error> {
    check_publishable(name)?;
    let read = Read::new(bytes).await?;
    let mut reference = PolicyRef { name: name.to_owned(), version: 0, digest: read.digest };
    let now = app.clock.now();
    in_turn(app, async move |Shelf { store, registry }| {
        let of_name = registry.versions_of(&reference.name);
        let known = of_name.into_iter().find(|(about, _)| about.reference.digest == reference.digest);
        if let Some(alias) = &alias {
            check_alias(&registry, &reference.name, alias)?;
            if let Some((about, false)) = &known {
                return Err(unloaded(&about.reference));
            }
        }
        let new = NewPolicyVersion {
            name: &reference.name,
            digest: &reference.digest_hex(),
            checkpoint: &read.bytes,
            now,
            alias: alias.as_deref(),
            by: by.as_deref(),
        };
        let published = store.publish_policy(new).await?;
        reference.version = published.version;
        // One that is known stays as it is: what was unloaded comes back when somebody loads it.
        if known.is_none() {
            registry.insert(read.learned(reference.clone(), published.created_at));
        }
        if let Some(alias) = &alias {
            registry.set_alias(&reference.name, alias, reference.version);
        }
        if published.new {
            tracing::info!(policy = %reference, digest = reference.digest_hex(), alias, "published");
        }
        Ok((reference, published.new))
    })
    .await
}

/// A checkpoint that was read, and what flies it.
struct Read {
    checkpoint: Checkpoint,
    policy: Arc<dyn Policy>,
    bytes: Vec<u8>,
    digest: [u8; 32],
}

impl Read {
    /// Reads a checkpoint away from the threads that serve connections.
    async fn new(bytes: Vec<u8>) -> Result<Self, Error> {
        let read = tokio::task::spawn_blocking(move || {
            let size = bytes.len();
            let refused = |e| Invalid::new("checkpoint", format!("{size} bytes"), format!("a checkpoint of this program ({e})"));
            let checkpoint = Checkpoint::from_bytes(&bytes).map_err(refused)?;
            let (policy, digest) = (Arc::new(checkpoint.policy()), Sha256::digest(&bytes).into());
            Ok(Self { checkpoint, policy, bytes, digest })
        });
        read.await.map_err(Error::internal)?
    }

    /// The policy, published as `reference`.
    fn learned(self, reference: PolicyRef, created_at: i64) -> LoadedPolicy {
        let (config, step) = (self.checkpoint.config(), self.checkpoint.step());
        let (environment, training) = (&config.environment, &config.training);
        let flat = training.observation == ObservationKind::Flat;
        let object = |value: serde_json::Result<Value>| value.unwrap_or_default();
        let mut metrics = json!({"step": step});
        let figures = object(serde_json::to_value(self.checkpoint.metrics()));
        if let (Some(all), Value::Object(figures)) = (metrics.as_object_mut(), figures) {
            all.extend(figures);
        }
        let (uavs, users) = (environment.uavs, environment.users);
        let about = About {
            reference,
            kind: Kind::Checkpoint,
            description: format!("{:?}, trained for {step} slots with {uavs} UAVs and {users} users.", config.algorithm),
            uavs: (flat || training.identity == Identity::Onehot).then_some(uavs as u32),
            users: flat.then_some(users as u32),
            headings: self.policy.actions(),
            needs: self.policy.needs(),
            detection_range: self.policy.detection_range(),
            config: object(serde_json::to_value(config)),
            metrics,
            created_at: Timestamp::from_millisecond(created_at).unwrap_or_default(),
        };
        LoadedPolicy { about: Arc::new(about), policy: self.policy }
    }
}

/// A published version out of the store.
pub(super) struct Stored {
    reference: PolicyRef,
    version: PolicyVersion,
}

impl Stored {
    pub(super) async fn new(store: &Store, name: &str, version: u64) -> Result<Self, Error> {
        let found = store.policy_version(name, version).await?;
        let found = found.ok_or_else(|| Error::not_found("checkpoint", format!("{name}:{version}")))?;
        let hash = move || (Sha256::digest(&found.checkpoint).into(), found);
        let (digest, version) = tokio::task::spawn_blocking(hash).await.map_err(Error::internal)?;
        Ok(Self { reference: PolicyRef { name: name.to_owned(), version: version.version, digest }, version })
    }

    /// The checkpoint, if its bytes are those that were published.
    pub(super) fn checkpoint(self) -> Result<(PolicyRef, Vec<u8>), Error> {
        let Self { reference, version } = self;
        if reference.digest_hex() != version.digest {
            let reason = format!("the checkpoint of {reference} is damaged: another digest than when it was published");
            return Err(Error::internal(reason));
        }
        Ok((reference, version.checkpoint))
    }

    /// What flies it.
    pub(super) async fn load(self) -> Result<LoadedPolicy, Error> {
        let created_at = self.version.created_at;
        let (reference, bytes) = self.checkpoint()?;
        Ok(Read::new(bytes).await?.learned(reference, created_at))
    }
}
