//! Checkpoints of versions: parsed, described, and as stored.

use std::sync::Arc;

use jiff::Timestamp;
use serde_json::{Value, json};
use sha2::{Digest, Sha256};

use super::upload_limit::UploadPermit;
use crate::checkpoint::Checkpoint;
use crate::invalid::Invalid;
use crate::policy::{Identity, ObservationKind, Policy};
use crate::service::Error;
use crate::serving::{LoadedPolicy, MemoryShare, PolicyInfo, PolicyKind, PolicyRef};
use crate::store::{PolicyVersion, Store};

/// A checkpoint in memory, with the permit of its upload if it was uploaded.
pub(super) struct CheckpointBytes {
    pub(super) bytes: Vec<u8>,
    pub(super) _permit: Option<UploadPermit>,
}

/// A parsed checkpoint and its policy.
pub(super) struct ParsedCheckpoint {
    checkpoint: Checkpoint,
    policy: Arc<dyn Policy>,
    pub(super) source: CheckpointBytes,
    pub(super) digest: [u8; 32],
}

impl ParsedCheckpoint {
    /// Parses a checkpoint on a thread that does not serve connections.
    pub(super) async fn parse(source: CheckpointBytes) -> Result<Self, Error> {
        let parsed = tokio::task::spawn_blocking(move || {
            let bytes = &source.bytes;
            let size = bytes.len();
            let invalid = |e| Invalid::new("checkpoint", format!("{size} bytes"), format!("a checkpoint of Qedgix ({e})"));
            let checkpoint = Checkpoint::from_bytes(bytes).map_err(invalid)?;
            let (policy, digest) = (Arc::new(checkpoint.policy()), Sha256::digest(bytes).into());
            Ok(Self { checkpoint, policy, source, digest })
        });
        parsed.await.map_err(Error::internal)?
    }

    /// What lists show of it, published as `reference`.
    pub(super) fn describe(&self, reference: PolicyRef, created_at: Timestamp) -> PolicyInfo {
        let (config, step) = (self.checkpoint.config(), self.checkpoint.env_steps());
        let (environment, training) = (&config.environment, &config.training);
        let flat = training.observation == ObservationKind::Flat;
        let object = |value: serde_json::Result<Value>| value.unwrap_or_default();
        let mut metrics = json!({"step": step});
        let evaluated = object(serde_json::to_value(self.checkpoint.metrics()));
        if let (Some(all), Value::Object(evaluated)) = (metrics.as_object_mut(), evaluated) {
            all.extend(evaluated);
        }
        let (uavs, users) = (environment.uavs, environment.users);
        PolicyInfo {
            reference,
            kind: PolicyKind::Checkpoint,
            description: format!("{:?}, trained for {step} slots with {uavs} UAVs and {users} users.", config.algorithm),
            uavs: (flat || training.identity == Identity::Onehot).then_some(uavs as u32),
            users: flat.then_some(users as u32),
            actions: self.policy.actions(),
            needs: self.policy.needs(),
            detection_range: self.policy.env().detection_range,
            config: object(serde_json::to_value(config)),
            metrics,
            created_at,
        }
    }

    /// The policy, published as `reference`.
    pub(super) fn into_policy(self, reference: PolicyRef, created_at: i64, memory: MemoryShare) -> LoadedPolicy {
        let created_at = Timestamp::from_millisecond(created_at).unwrap_or_default();
        LoadedPolicy::new(Arc::new(self.describe(reference, created_at)), self.policy, memory)
    }
}

/// A published version as stored.
pub(super) struct StoredVersion {
    reference: PolicyRef,
    version: PolicyVersion,
}

impl StoredVersion {
    pub(super) async fn read(store: &Store, name: &str, version: u64) -> Result<Self, Error> {
        let found = store.policy_version(name, version).await?;
        let found = found.ok_or_else(|| Error::not_found("checkpoint", format!("{name}:{version}")))?;
        let hash = move || (Sha256::digest(&found.checkpoint).into(), found);
        let (digest, version) = tokio::task::spawn_blocking(hash).await.map_err(Error::internal)?;
        Ok(Self { reference: PolicyRef { name: name.to_owned(), version: version.version, digest }, version })
    }

    /// The checkpoint, after a check that it has not changed since it was published.
    pub(super) fn checkpoint(self) -> Result<(PolicyRef, Vec<u8>), Error> {
        let Self { reference, version } = self;
        if reference.digest_hex() != version.digest {
            let reason = format!("the checkpoint of {reference} is damaged: its digest has changed");
            return Err(Error::internal(reason));
        }
        Ok((reference, version.checkpoint))
    }

    /// Bytes of the checkpoint, which are about those of the policy in memory.
    pub(super) fn size(&self) -> usize {
        self.version.checkpoint.len()
    }

    /// The policy, which takes `memory`.
    pub(super) async fn load(self, memory: MemoryShare) -> Result<LoadedPolicy, Error> {
        let created_at = self.version.created_at;
        let (reference, parsed) = self.parse().await?;
        Ok(parsed.into_policy(reference, created_at, memory))
    }

    /// What lists show of it.
    pub(super) async fn describe(self) -> Result<PolicyInfo, Error> {
        let created_at = Timestamp::from_millisecond(self.version.created_at).unwrap_or_default();
        let (reference, parsed) = self.parse().await?;
        Ok(parsed.describe(reference, created_at))
    }

    async fn parse(self) -> Result<(PolicyRef, ParsedCheckpoint), Error> {
        let (reference, bytes) = self.checkpoint()?;
        // The checkpoint was readable when it was published, so the caller has made no mistake.
        let parsed = ParsedCheckpoint::parse(CheckpointBytes { bytes, _permit: None }).await;
        let parsed = parsed.map_err(|error| Error::internal(format!("the checkpoint of {reference}: {}", error.reason())))?;
        Ok((reference, parsed))
    }
}
