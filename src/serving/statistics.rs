//! What a policy version has computed since the server started: counts and times, as model statistics show them.
//!
//! They outlive the policy in memory: a version that is read again goes on counting.

use std::collections::{BTreeMap, HashMap};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use super::reference::PolicyRef;

/// Maximum number of versions with statistics. Beyond it, those of versions that are not in memory are forgotten.
const MAX_VERSIONS: usize = 4096;

/// How often something happened, and how long it took in total.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct TimedCount {
    /// How often.
    pub count: u64,
    /// In nanoseconds.
    pub nanos: u64,
}

impl TimedCount {
    fn add(&mut self, each: Duration) {
        self.add_many(1, each);
    }

    fn add_many(&mut self, count: u64, total: Duration) {
        self.count += count;
        self.nanos = self.nanos.saturating_add(u64::try_from(total.as_nanos()).unwrap_or(u64::MAX));
    }
}

/// The parts of a computation.
#[derive(Clone, Copy, Debug, Default)]
pub struct ComputeTimes {
    /// Preparing the inputs.
    pub input: Duration,
    /// The forward pass.
    pub infer: Duration,
    /// Handing over the decisions.
    pub output: Duration,
}

/// Computations, by their parts.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ComputeCounts {
    /// See [`ComputeTimes::input`].
    pub input: TimedCount,
    /// See [`ComputeTimes::infer`].
    pub infer: TimedCount,
    /// See [`ComputeTimes::output`].
    pub output: TimedCount,
}

impl ComputeCounts {
    fn add(&mut self, count: u64, times: &ComputeTimes) {
        let total = |each: Duration| each.saturating_mul(count as u32);
        self.input.add_many(count, total(times.input));
        self.infer.add_many(count, total(times.infer));
        self.output.add_many(count, total(times.output));
    }
}

/// The statistics of a version.
#[derive(Clone, Debug, Default)]
pub struct Statistics {
    /// Fleets computed.
    pub inferences: u64,
    /// Forward passes.
    pub executions: u64,
    /// End of the last forward pass.
    pub last: Option<Instant>,
    /// Fleets whose caller received a decision, with the time from the request to the decision.
    pub success: TimedCount,
    /// Fleets whose caller did not.
    pub failure: TimedCount,
    /// Time in the queue.
    pub queue: TimedCount,
    /// Times of each fleet; all fleets of a batch have those of the batch.
    pub compute: ComputeCounts,
    /// Forward passes by the number of fleets in them.
    pub batches: BTreeMap<u32, ComputeCounts>,
}

/// Counts for one version. All threads share it; it is locked once per forward pass, for less than a microsecond.
#[derive(Debug, Default)]
pub struct VersionStatistics(Mutex<Statistics>);

impl VersionStatistics {
    fn lock(&self) -> MutexGuard<'_, Statistics> {
        // Counting does not panic.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The statistics now.
    pub fn snapshot(&self) -> Statistics {
        self.lock().clone()
    }

    /// Counts a forward pass over one fleet for each of `queued`, the time that it waited and whether its caller received the decision.
    pub fn record_batch(&self, queued: impl ExactSizeIterator<Item = (Duration, bool)>, times: &ComputeTimes, end: Instant) {
        let mut all = self.lock();
        let fleets = queued.len();
        all.inferences += fleets as u64;
        all.executions += 1;
        all.last = Some(end);
        all.batches.entry(fleets as u32).or_default().add(1, times);
        let compute = times.input + times.infer + times.output;
        let mut received = 0;
        for (queue, is_received) in queued {
            if is_received {
                received += 1;
                all.success.add(queue + compute);
                all.queue.add(queue);
            } else {
                all.failure.add(queue + compute);
            }
        }
        all.compute.add(received, times);
    }

    /// Counts a fleet that got no decision, `time` after its request.
    pub fn record_failure(&self, time: Duration) {
        self.lock().failure.add(time);
    }
}

/// The statistics of all versions.
#[derive(Debug, Default)]
pub struct StatisticsTable(Mutex<HashMap<(String, u64), Arc<VersionStatistics>>>);

impl StatisticsTable {
    /// The statistics of a version, which begin now unless there are some.
    pub fn begin(&self, reference: &PolicyRef) -> Arc<VersionStatistics> {
        let mut all = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if all.len() >= MAX_VERSIONS {
            all.retain(|_, statistics| Arc::strong_count(statistics) > 1);
        }
        all.entry((reference.name.clone(), reference.version)).or_default().clone()
    }

    /// The statistics of a version; empty if it has computed nothing.
    pub fn get(&self, name: &str, version: u64) -> Statistics {
        let all = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        all.get(&(name.to_owned(), version)).map_or_else(Statistics::default, |statistics| statistics.snapshot())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_fleet_of_a_batch_has_the_times_of_the_batch() {
        let (table, end) = (StatisticsTable::default(), Instant::now());
        let reference = PolicyRef { name: "p".into(), version: 3, digest: [0; 32] };
        let ms = Duration::from_millis;
        let times = ComputeTimes { input: ms(1), infer: ms(10), output: ms(2) };
        let counts = table.begin(&reference);
        counts.record_batch([(ms(5), true), (ms(7), true), (ms(0), false)].into_iter(), &times, end);
        counts.record_batch([(ms(0), true)].into_iter(), &times, end);
        counts.record_failure(ms(4));
        let all = table.get("p", 3);
        assert_eq!((all.inferences, all.executions, all.last), (4, 2, Some(end)));
        let timed = |count, millis: u64| TimedCount { count, nanos: millis * 1_000_000 };
        assert_eq!(all.success, timed(3, 5 + 7 + 3 * 13));
        assert_eq!(all.failure, timed(2, 13 + 4));
        assert_eq!(all.queue, timed(3, 12));
        assert_eq!(all.compute, ComputeCounts { input: timed(3, 3), infer: timed(3, 30), output: timed(3, 6) });
        assert_eq!(all.batches.keys().copied().collect::<Vec<_>>(), [1, 3]);
        assert_eq!(all.batches[&3].infer, timed(1, 10));
        assert_eq!(table.get("p", 4).inferences, 0);
    }

    #[test]
    fn the_number_of_versions_is_bounded_by_those_in_use() {
        let table = StatisticsTable::default();
        let reference = |version| PolicyRef { name: "p".into(), version, digest: [0; 32] };
        let kept = table.begin(&reference(0));
        kept.record_failure(Duration::ZERO);
        for version in 1..=2 * MAX_VERSIONS as u64 {
            table.begin(&reference(version));
        }
        assert!(table.0.lock().unwrap().len() <= MAX_VERSIONS);
        assert_eq!(table.get("p", 0).failure.count, 1);
    }
}
