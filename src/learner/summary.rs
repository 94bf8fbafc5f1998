//! Statistics of evaluations: means with bootstrap intervals, paired differences (docs/model.md, "Evaluation").

use rand::RngExt;
use serde::{Deserialize, Serialize};

use crate::env::EpisodeMetrics;
use crate::invalid::Invalid;
use crate::rng;

/// A mean with its 95 % bootstrap interval.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Interval {
    /// Mean.
    pub mean: f64,
    /// 2.5th percentile of the resampled means.
    pub low: f64,
    /// 97.5th percentile of the resampled means.
    pub high: f64,
}

impl Interval {
    /// The percentile bootstrap: `mean`, and percentiles of the values that `resample` returns.
    pub fn of_resamples(mean: f64, mut resample: impl FnMut() -> f64) -> Self {
        const RESAMPLES: usize = 2000;
        let mut means: Vec<f64> = (0..RESAMPLES).map(|_| resample()).collect();
        means.sort_by(f64::total_cmp);
        Self { mean, low: means[RESAMPLES / 40 - 1], high: means[RESAMPLES - RESAMPLES / 40] }
    }
}

/// Statistics of a policy on a list of layouts.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// Number of layouts.
    pub episodes: usize,
    /// Mean AoI with its interval, in slots.
    pub mean_aoi: Interval,
    /// Every metric, averaged over the layouts.
    pub mean: EpisodeMetrics,
}

/// The paired difference of two policies on the same layouts: first minus second. Negative: the first is better.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Difference {
    /// Mean difference of mean AoI with its interval, in slots.
    pub mean_aoi: Interval,
    /// Share of layouts on which the first policy is better.
    pub wins: f64,
}

/// Statistics over layouts. The bootstrap is seeded, so the result is reproducible.
///
/// # Errors
/// [`Invalid`] if there are no episodes.
pub fn summarize(episodes: &[EpisodeMetrics]) -> Result<Summary, Invalid> {
    let aoi: Vec<f64> = episodes.iter().map(|e| e.mean_aoi).collect();
    Ok(Summary { episodes: episodes.len(), mean_aoi: interval(&aoi)?, mean: EpisodeMetrics::mean(episodes) })
}

/// The paired difference of two policies evaluated on the same layouts, in the same order.
///
/// # Errors
/// [`Invalid`] if there are no episodes, or not the same number of each.
pub fn difference(first: &[EpisodeMetrics], second: &[EpisodeMetrics]) -> Result<Difference, Invalid> {
    if first.len() != second.len() {
        return Err(Invalid::new(
            "episodes",
            second.len(),
            format!("{}, the number of episodes of the other policy", first.len()),
        ));
    }
    let aoi: Vec<f64> = first.iter().zip(second).map(|(a, b)| a.mean_aoi - b.mean_aoi).collect();
    let wins = aoi.iter().filter(|&&d| d < 0.0).count() as f64 / aoi.len().max(1) as f64;
    Ok(Difference { mean_aoi: interval(&aoi)?, wins })
}

/// The mean of `values` with the interval of the percentile bootstrap.
///
/// # Errors
/// [`Invalid`] if there are no values.
pub fn interval(values: &[f64]) -> Result<Interval, Invalid> {
    if values.is_empty() {
        return Err(Invalid::new("episodes", 0, "at least 1"));
    }
    let n = values.len();
    let mut rng = rng::stream(0, "bootstrap", 0);
    let mean = values.iter().sum::<f64>() / n as f64;
    Ok(Interval::of_resamples(mean, || (0..n).map(|_| values[rng.random_range(0..n)]).sum::<f64>() / n as f64))
}
