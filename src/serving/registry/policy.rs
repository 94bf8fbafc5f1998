//! A version of a policy: its description, and the version in memory, ready to run.

use std::ops::Deref;
use std::sync::atomic::AtomicU64;
use std::sync::{Arc, OnceLock};

use jiff::Timestamp;
use serde_json::Value;

use super::memory::MemoryShare;
use crate::invalid::Invalid;
use crate::policy::{Policy, RequiredInput};
use crate::serving::{FleetIds, PolicyRef, VersionStatistics};

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

/// One version of one policy in memory, ready to run.
pub struct LoadedPolicy {
    /// Its description.
    pub info: Arc<PolicyInfo>,
    /// Computes headings.
    pub implementation: Arc<dyn Policy>,
    /// Given back when nobody uses the policy any more.
    pub(super) memory: MemoryShare,
    /// Number of the last use by a request without a session.
    pub(super) last_use: AtomicU64,
    /// What the version has computed, from its first computation on.
    pub statistics: OnceLock<Arc<VersionStatistics>>,
}

impl LoadedPolicy {
    /// A policy that takes `memory` from the budget of the registry while anybody uses it.
    pub fn new(info: Arc<PolicyInfo>, implementation: Arc<dyn Policy>, memory: MemoryShare) -> Self {
        Self { info, implementation, memory, last_use: AtomicU64::new(0), statistics: OnceLock::new() }
    }

    /// Bytes that it takes from the budget.
    pub fn memory_bytes(&self) -> usize {
        self.memory.bytes()
    }

    /// Checks that a fleet of which the last step listed `before` may list `now`: a policy that has a place for each UAV or user cannot
    /// follow changes.
    ///
    /// # Errors
    /// [`Invalid`] with a new and a missing id.
    pub fn check_same_fleet(&self, before: &FleetIds, now: &FleetIds) -> Result<(), Invalid> {
        before.check_bound(now, (self.info.uavs.is_some(), self.info.users.is_some()))
    }

    /// A baseline. It takes nothing from the budget and never leaves memory.
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
        Self::new(Arc::new(info), policy, MemoryShare::default())
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
