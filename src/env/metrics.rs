//! Metrics of an episode (docs/model.md, "Metrics"). AoI are small integers, so percentiles are computed from counts.

use serde::{Deserialize, Serialize};

/// Metrics of one episode over slots 1..K, or their means over episodes. AoI is in slots.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct EpisodeMetrics {
    /// Mean AoI over users and slots, weighted if users have weights.
    pub mean_aoi: f64,
    /// Largest AoI of any user in any slot.
    pub peak_aoi: f64,
    /// 95th percentile of AoI over users and slots (nearest rank).
    pub p95_aoi: f64,
    /// Share of the users whose data was collected at least once.
    pub coverage: f64,
    /// Jain's fairness index of the users' mean AoI x, (sum x)^2 / (N sum x^2); 1 if all are 0.
    pub fairness: f64,
}

impl EpisodeMetrics {
    /// Mean of each metric over `episodes`; all 0 without episodes.
    pub fn mean(episodes: &[Self]) -> Self {
        let n = episodes.len().max(1) as f64;
        let mean = |metric: fn(&Self) -> f64| episodes.iter().map(metric).sum::<f64>() / n;
        Self {
            mean_aoi: mean(|e| e.mean_aoi),
            peak_aoi: mean(|e| e.peak_aoi),
            p95_aoi: mean(|e| e.p95_aoi),
            coverage: mean(|e| e.coverage),
            fairness: mean(|e| e.fairness),
        }
    }
}

/// Counts from which the metrics of B running episodes are computed.
#[derive(Clone, Debug)]
pub(super) struct MetricsCounter {
    users: usize,
    /// K + 1, the number of values an AoI can take.
    values: usize,
    /// (B, K+1) how often each AoI occurred.
    counts: Vec<u32>,
    /// (B, N) sum of AoI over slots.
    sums: Vec<u64>,
    /// (B, N) whether the user's data was collected.
    visited: Vec<bool>,
    /// (B, N) slots in which the user was there; empty if users do not come and go.
    present: Vec<u32>,
}

impl MetricsCounter {
    pub(super) fn new(copies: usize, users: usize, slots: usize) -> Self {
        let values = slots + 1;
        Self {
            users,
            values,
            counts: vec![0; copies * values],
            sums: vec![0; copies * users],
            visited: vec![false; copies * users],
            present: Vec::new(),
        }
    }

    pub(super) fn clear(&mut self) {
        self.counts.fill(0);
        self.sums.fill(0);
        self.visited.fill(false);
        self.present.fill(0);
    }

    /// Counts one slot of copy `b`.
    pub(super) fn add(&mut self, b: usize, aoi: &[f32]) {
        let counts = &mut self.counts[b * self.values..(b + 1) * self.values];
        let first = b * self.users;
        for (i, &age) in aoi.iter().enumerate() {
            counts[age as usize] += 1;
            self.sums[first + i] += age as u64;
            self.visited[first + i] |= age == 0.0;
        }
    }

    /// As [`MetricsCounter::add`], where only the users `there` count.
    pub(super) fn add_present(&mut self, b: usize, aoi: &[f32], there: &[bool]) {
        self.present.resize(self.visited.len(), 0);
        let counts = &mut self.counts[b * self.values..(b + 1) * self.values];
        let first = b * self.users;
        for (i, (&age, _)) in aoi.iter().zip(there).enumerate().filter(|(_, (_, there))| **there) {
            counts[age as usize] += 1;
            self.sums[first + i] += age as u64;
            // An AoI of 0 in its first slot is no collection.
            self.visited[first + i] |= age == 0.0 && self.present[first + i] > 0;
            self.present[first + i] += 1;
        }
    }

    /// Metrics of copy `b` after `slots` slots. Before the first slot all are 0, except fairness, which is 1.
    pub(super) fn metrics(&self, b: usize, slots: usize, weights: &[f64]) -> EpisodeMetrics {
        let n = self.users as f64;
        let slots = slots.max(1) as f64;
        let counts = &self.counts[b * self.values..(b + 1) * self.values];
        let sums = &self.sums[b * self.users..(b + 1) * self.users];
        let visited = &self.visited[b * self.users..(b + 1) * self.users];
        let total: u64 = counts.iter().map(|&c| u64::from(c)).sum();
        let rank = (total * 95).div_ceil(100);
        let mut seen = 0;
        let p95 = counts.iter().position(|&c| {
            seen += u64::from(c);
            seen >= rank
        });
        let sum: f64 = sums.iter().map(|&s| s as f64).sum();
        let squares: f64 = sums.iter().map(|&s| s as f64 * s as f64).sum();
        let weighted = sums.iter().zip(weights).map(|(&s, w)| w * s as f64).sum::<f64>();
        if let Some(present) = self.present.get(b * self.users..(b + 1) * self.users) {
            return present_metrics((sums, present, visited), weights, (weighted, counts, p95.unwrap_or(0)));
        }
        EpisodeMetrics {
            mean_aoi: weighted / (n * slots),
            peak_aoi: counts.iter().rposition(|&c| c > 0).unwrap_or(0) as f64,
            p95_aoi: p95.unwrap_or(0) as f64,
            coverage: visited.iter().filter(|&&v| v).count() as f64 / n,
            fairness: if squares > 0.0 { sum * sum / (n * squares) } else { 1.0 },
        }
    }
}

/// Metrics where users come and go: means over the slots in which each user was there, and over the users that were there at all.
fn present_metrics(
    (sums, present, visited): (&[u64], &[u32], &[bool]),
    weights: &[f64],
    (weighted, counts, p95): (f64, &[u32], usize),
) -> EpisodeMetrics {
    let slots: f64 = present.iter().zip(weights).map(|(&slots, w)| w * f64::from(slots)).sum();
    let means: Vec<f64> =
        sums.iter().zip(present).filter(|(_, slots)| **slots > 0).map(|(&s, &p)| s as f64 / f64::from(p)).collect();
    let (n, sum) = (means.len().max(1) as f64, means.iter().sum::<f64>());
    let squares: f64 = means.iter().map(|mean| mean * mean).sum();
    EpisodeMetrics {
        mean_aoi: weighted / slots.max(1e-9),
        peak_aoi: counts.iter().rposition(|&c| c > 0).unwrap_or(0) as f64,
        p95_aoi: p95 as f64,
        coverage: visited.iter().filter(|&&v| v).count() as f64 / n,
        fairness: if squares > 0.0 { sum * sum / (n * squares) } else { 1.0 },
    }
}
