//! How policies are judged (spec 7): frozen layouts, every policy on the same ones, paired differences, bootstrap intervals.
//!
//! Knows nothing of what a policy is: baselines and checkpoints fly through the same [`Policy`] trait. Layouts are independent,
//! so splitting them among threads changes no bit.

use rand::RngExt;
use serde::{Deserialize, Serialize};

use crate::env::{BatchEnv, EnvConfig, EpisodeMetrics, Point};
use crate::invalid::Invalid;
use crate::policy::{Policy, Slot, Turn};
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
    LAYOUTS.into_iter().find(|l| l.name == name).ok_or_else(|| Invalid::new("layouts", name, known()))
}

/// Flies `policy` on the episodes with these seeds, all stepped together, shared among `threads`; figures in the order of
/// `seeds`. A policy with fewer actions than the environment has uses the first ones.
///
/// # Errors
/// The environment is invalid, or the policy does not fit it.
pub fn evaluate(policy: &dyn Policy, env: &EnvConfig, seeds: &[u64], threads: usize) -> Result<Vec<EpisodeMetrics>, Invalid> {
    env.validate()?;
    policy.check_fleet(env.uavs, env.users)?;
    if policy.actions() > env.headings() {
        let expected = format!("at most {}, the headings of the environment", env.headings());
        return Err(Invalid::new("policy.actions", policy.actions(), expected));
    }
    let share = seeds.len().div_ceil(threads.max(1)).max(1);
    let shares: Vec<&[u64]> = seeds.chunks(share).collect();
    if let [all] = shares[..] {
        return fly(policy, env, all);
    }
    let flown: Vec<_> = std::thread::scope(|scope| {
        let threads: Vec<_> = shares.iter().map(|seeds| scope.spawn(|| fly(policy, env, seeds))).collect();
        threads.into_iter().map(|t| t.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))).collect()
    });
    Ok(flown.into_iter().collect::<Result<Vec<_>, _>>()?.concat())
}

/// All `seeds` on one thread.
fn fly(policy: &dyn Policy, config: &EnvConfig, seeds: &[u64]) -> Result<Vec<EpisodeMetrics>, Invalid> {
    let (m, n) = (config.uavs, config.users);
    let mut env = BatchEnv::new(config, seeds.len())?;
    env.reset(seeds);
    let width = policy.memory_len(m, n);
    let mut memory = vec![0.0; width * seeds.len()];
    let mut memories = split(&mut memory, width, seeds.len());
    for (memory, &seed) in memories.iter_mut().zip(seeds) {
        policy.start(m, n, seed, memory);
    }
    let mut slots = vec![Slot::default(); seeds.len()];
    let mut headings = vec![0; seeds.len() * m];
    let (mut uavs, mut users): (Vec<Point>, Vec<Point>) = (vec![[0.0; 2]; m], vec![[0.0; 2]; n]);
    while !env.done() {
        for (b, slot) in slots.iter_mut().enumerate() {
            to_points(&env.uav_xy()[b * m * 2..(b + 1) * m * 2], &mut uavs);
            to_points(&env.user_xy()[b * n * 2..(b + 1) * n * 2], &mut users);
            slot.set_scene(&uavs, &users, &env.aoi()[b * n..(b + 1) * n], config.detection_range);
        }
        let step = env.slot() as u64;
        let mut turns: Vec<Turn<'_>> = slots
            .iter()
            .zip(&mut memories)
            .zip(headings.chunks_exact_mut(m))
            .map(|((slot, memory), headings)| Turn { slot, step, memory, headings, q_values: None })
            .collect();
        policy.act(&mut turns);
        env.step(&headings);
    }
    Ok((0..seeds.len()).map(|b| env.metrics(b)).collect())
}

/// `all` cut into `count` memories of `width`, which may be 0.
fn split(all: &mut [f32], width: usize, count: usize) -> Vec<&mut [f32]> {
    if width == 0 {
        return (0..count).map(|_| Default::default()).collect();
    }
    all.chunks_exact_mut(width).collect()
}

fn to_points(xy: &[f32], points: &mut [Point]) {
    for (p, xy) in points.iter_mut().zip(xy.chunks_exact(2)) {
        *p = [f64::from(xy[0]), f64::from(xy[1])];
    }
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
        return Err(Invalid::new("episodes", second.len(), format!("{}, as many as the other policy flew", first.len())));
    }
    let aoi: Vec<f64> = first.iter().zip(second).map(|(a, b)| a.mean_aoi - b.mean_aoi).collect();
    let wins = aoi.iter().filter(|&&d| d < 0.0).count() as f64 / aoi.len().max(1) as f64;
    Ok(Difference { mean_aoi: bootstrap(&aoi)?, wins })
}

/// Percentile bootstrap of the mean.
fn bootstrap(values: &[f64]) -> Result<Interval, Invalid> {
    const RESAMPLES: usize = 2000;
    if values.is_empty() {
        return Err(Invalid::new("episodes", 0, "at least 1"));
    }
    let n = values.len();
    let mut rng = rng::stream(0, "bootstrap", 0);
    let mut means: Vec<f64> =
        (0..RESAMPLES).map(|_| (0..n).map(|_| values[rng.random_range(0..n)]).sum::<f64>() / n as f64).collect();
    means.sort_by(f64::total_cmp);
    let mean = values.iter().sum::<f64>() / n as f64;
    Ok(Interval { mean, low: means[RESAMPLES / 40 - 1], high: means[RESAMPLES - RESAMPLES / 40] })
}
