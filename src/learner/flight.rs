//! Flies policies on layouts, all episodes of a thread stepped together, and writes down what reports need.
//!
//! Knows nothing of what a policy is: baselines and checkpoints fly through the same [`Policy`] trait. Layouts are independent,
//! so splitting them among threads changes no bit.

use super::disturbance::Disturbance;
use crate::env::{BatchEnv, EnvConfig, EpisodeMetrics, Point, points};
use crate::invalid::{Invalid, in_range};
use crate::policy::{FleetStep, Policy, Slot};

/// Flies `policy` on the episodes with these seeds, shared among `threads`; figures in the order of `seeds`. A policy with
/// fewer actions than the environment has uses the first ones.
///
/// # Errors
/// The environment is invalid, or the policy does not fit it.
pub fn evaluate(policy: &dyn Policy, env: &EnvConfig, seeds: &[u64], threads: usize) -> Result<Vec<EpisodeMetrics>, Invalid> {
    let flown = shared(policy, env, seeds, threads, &Disturbance::default(), |_| ())?;
    Ok(flown.into_iter().flat_map(|(metrics, ())| metrics).collect())
}

/// What a report tells of a policy on layouts.
#[derive(Clone, Debug, PartialEq)]
pub struct Survey {
    /// Figures of each episode, in the order of the seeds.
    pub episodes: Vec<EpisodeMetrics>,
    /// Mean AoI over users and layouts in slots 0..=K, in slots.
    pub aoi: Vec<f64>,
    /// One episode in full.
    pub track: Track,
}

/// Where everybody truly was in every slot 0..=K of one episode, in units of the square's side.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Track {
    /// Seed of the episode.
    pub seed: u64,
    /// Per UAV its positions.
    pub uavs: Vec<Vec<Point>>,
    /// Per user its positions.
    pub users: Vec<Vec<Point>>,
    /// Per user its AoI, in slots.
    pub aoi: Vec<Vec<f32>>,
}

/// [`evaluate`] under a disturbance, with all that a report shows; `drawn` is the index of the seed whose episode is kept.
///
/// # Errors
/// The environment or the disturbance is invalid, the policy does not fit, or there is no seed `drawn`.
pub fn survey(
    policy: &dyn Policy,
    env: &EnvConfig,
    seeds: &[u64],
    drawn: usize,
    disturbance: &Disturbance,
    threads: usize,
) -> Result<Survey, Invalid> {
    if seeds.is_empty() {
        return Err(Invalid::new("episodes", 0, "at least 1"));
    }
    in_range("drawn", drawn, 0..=seeds.len() - 1)?;
    let record = |seeds_before: usize| Record { drawn: drawn.checked_sub(seeds_before), ..Record::default() };
    let flown = shared(policy, env, seeds, threads, disturbance, record)?;
    let mut survey = Survey { episodes: Vec::new(), aoi: vec![0.0; env.slots + 1], track: Track::default() };
    for (metrics, record) in flown {
        // Layout by layout, so that the sum is the same however the layouts were shared.
        for b in 0..metrics.len() {
            survey.aoi.iter_mut().zip(&record.aoi).for_each(|(sum, slot)| *sum += slot[b]);
        }
        survey.episodes.extend(metrics);
        if !record.track.uavs.is_empty() {
            survey.track = Track { seed: seeds[drawn], ..record.track };
        }
    }
    survey.aoi.iter_mut().for_each(|sum| *sum /= seeds.len() as f64);
    Ok(survey)
}

/// Watches a batch of episodes in slots 0..=K.
trait Observer {
    fn see(&mut self, env: &BatchEnv);
}

/// Nobody watches.
impl Observer for () {
    fn see(&mut self, _env: &BatchEnv) {}
}

/// What a survey keeps of one thread's episodes.
#[derive(Default)]
struct Record {
    /// Which episode to keep in full; absent when it lies before them.
    drawn: Option<usize>,
    /// Per slot the mean AoI of each episode.
    aoi: Vec<Vec<f64>>,
    track: Track,
}

impl Observer for Record {
    fn see(&mut self, env: &BatchEnv) {
        self.aoi.push((0..env.copies()).map(|b| env.mean_aoi(b)).collect());
        let (m, n) = (env.config().uavs, env.config().users);
        let Some(b) = self.drawn.filter(|&b| b < env.copies()) else { return };
        let track = &mut self.track;
        track.uavs.resize(m, Vec::new());
        track.users.resize(n, Vec::new());
        track.aoi.resize(n, Vec::new());
        for (path, at) in track.uavs.iter_mut().zip(points(&env.uav_xy()[b * m * 2..][..m * 2])) {
            path.push(at);
        }
        for (path, at) in track.users.iter_mut().zip(points(&env.user_xy()[b * n * 2..][..n * 2])) {
            path.push(at);
        }
        for (ages, &age) in track.aoi.iter_mut().zip(&env.aoi()[b * n..(b + 1) * n]) {
            ages.push(age);
        }
    }
}

/// All `seeds` in one share per thread, each with the observer that `observer` makes given the number of seeds before its
/// share; in the order of the seeds.
fn shared<O: Observer + Send>(
    policy: &dyn Policy,
    env: &EnvConfig,
    seeds: &[u64],
    threads: usize,
    disturbance: &Disturbance,
    observer: impl Fn(usize) -> O + Sync,
) -> Result<Vec<(Vec<EpisodeMetrics>, O)>, Invalid> {
    env.validate()?;
    disturbance.validate(env)?;
    policy.check_fleet(env.uavs, env.users)?;
    if policy.actions() > env.headings() {
        let expected = format!("at most {}, the headings of the environment", env.headings());
        return Err(Invalid::new("policy.actions", policy.actions(), expected));
    }
    let share = seeds.len().div_ceil(threads.max(1)).max(1);
    let one = |(i, seeds): (usize, &[u64])| {
        let mut observer = observer(i * share);
        fly(policy, env, seeds, disturbance, &mut observer).map(|metrics| (metrics, observer))
    };
    if seeds.len() <= share {
        return seeds.chunks(share).enumerate().map(one).collect();
    }
    let one = &one;
    std::thread::scope(|scope| {
        let threads: Vec<_> = seeds.chunks(share).enumerate().map(|part| scope.spawn(move || one(part))).collect();
        threads.into_iter().map(|t| t.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))).collect()
    })
}

/// All `seeds` on one thread.
fn fly(
    policy: &dyn Policy,
    config: &EnvConfig,
    seeds: &[u64],
    disturbance: &Disturbance,
    observer: &mut impl Observer,
) -> Result<Vec<EpisodeMetrics>, Invalid> {
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
    let (mut uavs, mut users): (Vec<Point>, Vec<Point>) = (Vec::with_capacity(m), Vec::with_capacity(n));
    observer.see(&env);
    while !env.done() {
        let step = env.slot();
        if let Some(uav) = disturbance.lost(step) {
            env.ground(uav);
        }
        for ((b, slot), &seed) in slots.iter_mut().enumerate().zip(seeds) {
            uavs.clear();
            uavs.extend(points(&env.uav_xy()[b * m * 2..][..m * 2]));
            users.clear();
            users.extend(points(&env.user_xy()[b * n * 2..][..n * 2]));
            disturbance.distort(config, seed, step, &mut uavs, &mut users);
            slot.set_scene(&uavs, &users, &env.aoi()[b * n..(b + 1) * n], config.detection_range);
        }
        let mut turns: Vec<FleetStep<'_>> = slots
            .iter()
            .zip(&mut memories)
            .zip(headings.chunks_exact_mut(m))
            .map(|((slot, memory), headings)| FleetStep { slot, step: step as u64, memory, headings, q_values: None })
            .collect();
        policy.act(&mut turns);
        env.step(&headings);
        observer.see(&env);
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
