//! How policies are judged (spec 7): frozen layouts, every policy on the same ones, paired differences, bootstrap intervals.
//! How they are flown is in `flight`.

use rand::RngExt;
use serde::{Deserialize, Serialize};

use crate::env::EpisodeMetrics;
use crate::invalid::Invalid;
use crate::rng;

/// A named, frozen list of layouts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Layouts {
    /// Its name.
    pub name: &'static str,
    /// Seed of its first episode; the others follow.
    pub first: u64,
    /// Number of episodes.
    pub episodes: u64,
}

impl Layouts {
    /// The first `episodes` seeds of the list (all, when it has fewer).
    pub fn seeds(&self, episodes: usize) -> Vec<u64> {
        (self.first..self.first + self.episodes.min(episodes as u64)).collect()
    }
}

/// All lists: what policies are reported on, and what training chooses its best weights by. They share no seed with each
/// other, nor with training, whose seeds have the top bit set.
pub const LAYOUTS: [Layouts; 2] =
    [Layouts { name: "eval-v1", first: 10_000, episodes: 256 }, Layouts { name: "valid-v1", first: 20_000, episodes: 4096 }];

/// The list called `name`.
///
/// # Errors
/// An unknown name.
pub fn layouts(name: &str) -> Result<Layouts, Invalid> {
    let known = || LAYOUTS.map(|l| l.name).join(" or ");
    LAYOUTS.into_iter().find(|l| l.name == name).ok_or_else(|| Invalid::new("layouts", format!("{name:?}"), known()))
}

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
    /// The percentile bootstrap: `mean` between the percentiles of what `resample` returns, call after call.
    pub fn of_resamples(mean: f64, mut resample: impl FnMut() -> f64) -> Self {
        const RESAMPLES: usize = 2000;
        let mut means: Vec<f64> = (0..RESAMPLES).map(|_| resample()).collect();
        means.sort_by(f64::total_cmp);
        Self { mean, low: means[RESAMPLES / 40 - 1], high: means[RESAMPLES - RESAMPLES / 40] }
    }
}

/// What a report says about a policy on a list of layouts.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// Number of layouts.
    pub episodes: usize,
    /// Mean AoI with its interval, in slots.
    pub mean_aoi: Interval,
    /// Mean of every figure over the layouts.
    pub mean: EpisodeMetrics,
}

/// How two policies differ on the same layouts: first minus second, negative where the first keeps data fresher.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Difference {
    /// Mean difference of mean AoI with its interval, in slots.
    pub mean_aoi: Interval,
    /// Share of layouts on which the first is better.
    pub wins: f64,
}

/// Means over layouts; the interval's resampling is seeded, so a report can be repeated.
///
/// # Errors
/// There are no episodes.
pub fn summarize(episodes: &[EpisodeMetrics]) -> Result<Summary, Invalid> {
    let aoi: Vec<f64> = episodes.iter().map(|e| e.mean_aoi).collect();
    Ok(Summary { episodes: episodes.len(), mean_aoi: bootstrap(&aoi)?, mean: EpisodeMetrics::mean(episodes) })
}

/// The paired difference of two policies flown on the same layouts in the same order.
///
/// # Errors
/// There are no episodes, or not equally many.
pub fn difference(first: &[EpisodeMetrics], second: &[EpisodeMetrics]) -> Result<Difference, Invalid> {
    if first.len() != second.len() {
        return Err(Invalid::new("episodes", second.len(), format!("{}, the number of the other policy", first.len())));
    }
    let aoi: Vec<f64> = first.iter().zip(second).map(|(a, b)| a.mean_aoi - b.mean_aoi).collect();
    let wins = aoi.iter().filter(|&&d| d < 0.0).count() as f64 / aoi.len().max(1) as f64;
    Ok(Difference { mean_aoi: bootstrap(&aoi)?, wins })
}

/// Percentile bootstrap of the mean.
fn bootstrap(values: &[f64]) -> Result<Interval, Invalid> {
    if values.is_empty() {
        return Err(Invalid::new("episodes", 0, "at least 1"));
    }
    let n = values.len();
    let mut rng = rng::stream(0, "bootstrap", 0);
    let mean = values.iter().sum::<f64>() / n as f64;
    Ok(Interval::of_resamples(mean, || (0..n).map(|_| values[rng.random_range(0..n)]).sum::<f64>() / n as f64))
}
