//! Counts and times of the engine. Handles are kept, because making one takes as long as some fleets.

use std::collections::HashMap;
use std::sync::{Arc, PoisonError, RwLock};
use std::time::Duration;

use metrics::{Counter, Histogram};

/// Policies that are counted by name; those that come later are counted together, as `other`.
const MOST_POLICIES: usize = 256;

/// Of all policies.
pub(super) struct Meters {
    queue: Histogram,
    compute: Histogram,
    batch_size: Histogram,
    by_policy: RwLock<HashMap<String, Arc<PolicyMeter>>>,
}

/// Of one policy, whatever its version.
pub(super) struct PolicyMeter {
    /// Fleets computed.
    fleets: Counter,
    /// Forward passes.
    passes: Counter,
    /// Fleets that were answered.
    pub(super) success: Counter,
    /// Fleets that were not.
    pub(super) failure: Counter,
}

impl PolicyMeter {
    fn new(policy: &str) -> Arc<Self> {
        let counter = |name: &'static str| metrics::counter!(name, "policy" => policy.to_owned());
        Arc::new(Self {
            fleets: counter("qedgix_inference_count_total"),
            passes: counter("qedgix_inference_exec_count_total"),
            success: counter("qedgix_inference_success_total"),
            failure: counter("qedgix_inference_failure_total"),
        })
    }
}

impl Meters {
    pub(super) fn new() -> Self {
        Self {
            queue: metrics::histogram!("qedgix_act_queue_seconds"),
            compute: metrics::histogram!("qedgix_act_compute_seconds"),
            batch_size: metrics::histogram!("qedgix_act_batch_size"),
            by_policy: RwLock::default(),
        }
    }

    /// Counts a forward pass over `fleets` fleets.
    pub(super) fn pass(&self, policy: &PolicyMeter, fleets: usize) {
        self.batch_size.record(fleets as f64);
        policy.passes.increment(1);
        policy.fleets.increment(fleets as u64);
    }

    /// Notes how long a fleet waited and was computed.
    pub(super) fn times(&self, queue: Duration, compute: Duration) {
        self.queue.record(queue.as_secs_f64());
        self.compute.record(compute.as_secs_f64());
    }

    /// Those of the policy called `name`.
    pub(super) fn policy(&self, name: &str) -> Arc<PolicyMeter> {
        if let Some(known) = self.by_policy.read().unwrap_or_else(PoisonError::into_inner).get(name) {
            return known.clone();
        }
        let mut all = self.by_policy.write().unwrap_or_else(PoisonError::into_inner);
        let name = if all.len() < MOST_POLICIES { name } else { "other" };
        all.entry(name.to_owned()).or_insert_with(|| PolicyMeter::new(name)).clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_variety_of_policies_is_bounded() {
        let meters = Meters::new();
        for i in 0..2 * MOST_POLICIES {
            meters.policy(&format!("policy-{i}"));
        }
        assert_eq!(meters.by_policy.read().unwrap().len(), MOST_POLICIES + 1);
        assert!(Arc::ptr_eq(&meters.policy("policy-0"), &meters.policy("policy-0")));
        assert!(Arc::ptr_eq(&meters.policy("policy-400"), &meters.policy("new")));
    }
}
