//! Counters and histograms of the engine. Handles are cached, because creating one takes as long as running a policy for a
//! small fleet.

use std::collections::HashMap;
use std::sync::{Arc, PoisonError, RwLock};
use std::time::Duration;

use metrics::{Counter, Histogram};

use crate::serving::{LoadedPolicy, StatisticsTable, VersionStatistics};

/// Maximum number of policies with counters of their own. Later ones share counters with the label `other`.
const MAX_POLICIES: usize = 256;

/// Metrics of all policies.
pub(super) struct EngineMetrics {
    queue: Histogram,
    compute: Histogram,
    batch_size: Histogram,
    by_policy: RwLock<HashMap<String, Arc<PolicyMetrics>>>,
    pub(super) statistics: StatisticsTable,
}

/// Metrics of one policy, over all its versions.
pub(super) struct PolicyMetrics {
    /// Fleets computed.
    fleets: Counter,
    /// Forward passes.
    batches: Counter,
    /// Fleets whose caller received a decision.
    pub(super) success: Counter,
    /// Fleets whose caller did not.
    pub(super) failure: Counter,
}

impl PolicyMetrics {
    fn new(policy: &str) -> Arc<Self> {
        let counter = |name: &'static str| metrics::counter!(name, "policy" => policy.to_owned());
        Arc::new(Self {
            fleets: counter("qedgix_inference_count_total"),
            batches: counter("qedgix_inference_exec_count_total"),
            success: counter("qedgix_inference_success_total"),
            failure: counter("qedgix_inference_failure_total"),
        })
    }
}

impl EngineMetrics {
    pub(super) fn new() -> Self {
        Self {
            queue: metrics::histogram!("qedgix_act_queue_seconds"),
            compute: metrics::histogram!("qedgix_act_compute_seconds"),
            batch_size: metrics::histogram!("qedgix_act_batch_size"),
            by_policy: RwLock::default(),
            statistics: StatisticsTable::default(),
        }
    }

    /// The statistics of a version.
    pub(super) fn of_version<'a>(&self, policy: &'a LoadedPolicy) -> &'a VersionStatistics {
        policy.statistics.get_or_init(|| self.statistics.begin(&policy.reference))
    }

    /// Counts a fleet whose caller got no decision, `time` after its request.
    pub(super) fn record_failure(&self, policy: &LoadedPolicy, time: Duration) {
        self.policy(&policy.reference.name).failure.increment(1);
        self.of_version(policy).record_failure(time);
    }

    /// Records a forward pass over `fleets` fleets.
    pub(super) fn record_batch(&self, policy: &PolicyMetrics, fleets: usize) {
        self.batch_size.record(fleets as f64);
        policy.batches.increment(1);
        policy.fleets.increment(fleets as u64);
    }

    /// Records the times of one fleet.
    pub(super) fn record_times(&self, queue: Duration, compute: Duration) {
        self.queue.record(queue.as_secs_f64());
        self.compute.record(compute.as_secs_f64());
    }

    /// The metrics of the policy called `name`.
    pub(super) fn policy(&self, name: &str) -> Arc<PolicyMetrics> {
        if let Some(existing) = self.by_policy.read().unwrap_or_else(PoisonError::into_inner).get(name) {
            return existing.clone();
        }
        let mut by_policy = self.by_policy.write().unwrap_or_else(PoisonError::into_inner);
        let name = if by_policy.len() < MAX_POLICIES { name } else { "other" };
        by_policy.entry(name.to_owned()).or_insert_with(|| PolicyMetrics::new(name)).clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn number_of_policies_with_own_counters_is_bounded() {
        let metrics = EngineMetrics::new();
        for i in 0..2 * MAX_POLICIES {
            metrics.policy(&format!("policy-{i}"));
        }
        assert_eq!(metrics.by_policy.read().unwrap().len(), MAX_POLICIES + 1);
        assert!(Arc::ptr_eq(&metrics.policy("policy-0"), &metrics.policy("policy-0")));
        assert!(Arc::ptr_eq(&metrics.policy("policy-400"), &metrics.policy("new")));
    }
}
