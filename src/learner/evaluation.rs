//! Evaluates policies on layouts (docs/model.md, "Evaluation") and records what reports show.
//!
//! Checkpoints and baselines run through the same [`Policy`] trait. The episodes of a thread are stepped together. Layouts are
//! independent, so the number of threads changes no bit.

use std::ops::ControlFlow;
use std::sync::atomic::{AtomicBool, Ordering};

use super::disturbance::Disturbance;
use super::layouts::LayoutList;
use crate::env::{BatchEnv, EnvConfig, EpisodeMetrics, Point, points};
use crate::invalid::{Invalid, in_range};
use crate::policy::{EnvParams, FleetGraph, FleetStep, Policy, RequiredInput};

/// Runs `policy` on the episodes with these seeds, split among `threads`. Returns the metrics in the order of `seeds`. A policy
/// with fewer actions than the environment uses the first ones.
///
/// # Errors
/// The environment is invalid, or the policy does not fit it.
pub fn evaluate(policy: &dyn Policy, env: &EnvConfig, seeds: &[u64], threads: usize) -> Result<Vec<EpisodeMetrics>, Invalid> {
    let parts = run_parallel(policy, env, seeds, threads, &Disturbance::default(), |_| ())?;
    Ok(parts.into_iter().flat_map(|(metrics, ())| metrics).collect())
}

/// As [`evaluate`], on the first `episodes` layouts of a list; `env` is the environment of lists that are not mixed. A policy whose
/// fleet size is fixed does not fit a mixed list.
///
/// # Errors
/// As [`evaluate`].
pub fn evaluate_list(
    policy: &dyn Policy,
    (list, episodes): (&LayoutList, usize),
    env: &EnvConfig,
    threads: usize,
) -> Result<Vec<EpisodeMetrics>, Invalid> {
    let groups = list.environments(env, episodes);
    let parts: Result<Vec<_>, _> = groups.iter().map(|(env, seeds)| evaluate(policy, env, seeds, threads)).collect();
    Ok(parts?.concat())
}

/// As [`evaluate`], under a disturbance, unless `stop` is set before the last slot: then `None`, within a slot.
///
/// # Errors
/// As [`evaluate`].
pub fn evaluate_until(
    policy: &dyn Policy,
    env: &EnvConfig,
    seeds: &[u64],
    threads: usize,
    disturbance: &Disturbance,
    stop: &AtomicBool,
) -> Result<Option<Vec<EpisodeMetrics>>, Invalid> {
    let observer = |_| StopObserver { stop, stopped: false };
    let parts = run_parallel(policy, env, seeds, threads, disturbance, observer)?;
    let stopped = parts.iter().any(|(_, observer)| observer.stopped);
    Ok((!stopped).then(|| parts.into_iter().flat_map(|(metrics, _)| metrics).collect()))
}

/// Layouts to evaluate together, `least` to 64, so that a part of an evaluation takes seconds at most. Layouts are independent, so the
/// parts change no bit; in training their number determines the events, so it does not depend on the threads.
pub fn layouts_per_part(env: &EnvConfig, least: usize) -> usize {
    /// Pairs of a UAV and another node, over all slots and layouts of a part.
    const PAIRS: usize = 1 << 22;
    (PAIRS / (env.slots * env.uavs * (env.uavs + env.users))).clamp(least, 64)
}

/// Metrics of a policy on layouts, with the curve and the trajectory that a report shows.
#[derive(Clone, Debug, PartialEq)]
pub struct TracedEvaluation {
    /// Metrics of each episode, in the order of the seeds.
    pub episodes: Vec<EpisodeMetrics>,
    /// Mean AoI over users and layouts in slots 0..=K, in slots.
    pub aoi: Vec<f64>,
    /// One episode, slot by slot.
    pub trajectory: Trajectory,
}

/// True positions and AoI in slots 0..=K of one episode. Positions are in units of the square's side.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Trajectory {
    /// Seed of the episode.
    pub seed: u64,
    /// Per UAV its positions.
    pub uavs: Vec<Vec<Point>>,
    /// Per user its positions.
    pub users: Vec<Vec<Point>>,
    /// Per user its AoI, in slots.
    pub aoi: Vec<Vec<f32>>,
}

/// As [`evaluate`], under a disturbance, with a trace. `traced` is the index of the seed whose trajectory is kept.
///
/// # Errors
/// The environment or the disturbance is invalid, the policy does not fit it, or `traced` is not an index into `seeds`.
pub fn evaluate_traced(
    policy: &dyn Policy,
    env: &EnvConfig,
    seeds: &[u64],
    traced: usize,
    disturbance: &Disturbance,
    threads: usize,
) -> Result<TracedEvaluation, Invalid> {
    if seeds.is_empty() {
        return Err(Invalid::new("episodes", 0, "at least 1"));
    }
    in_range("traced", traced, 0..=seeds.len() - 1)?;
    let recorder = |seeds_before: usize| Recorder { traced: traced.checked_sub(seeds_before), ..Recorder::default() };
    let parts = run_parallel(policy, env, seeds, threads, disturbance, recorder)?;
    let mut evaluation =
        TracedEvaluation { episodes: Vec::new(), aoi: vec![0.0; env.slots + 1], trajectory: Trajectory::default() };
    for (metrics, recorder) in parts {
        // Layout by layout, so that the order of the sum does not depend on the number of threads.
        for b in 0..metrics.len() {
            evaluation.aoi.iter_mut().zip(&recorder.aoi).for_each(|(sum, slot)| *sum += slot[b]);
        }
        evaluation.episodes.extend(metrics);
        if !recorder.trajectory.uavs.is_empty() {
            evaluation.trajectory = Trajectory { seed: seeds[traced], ..recorder.trajectory };
        }
    }
    evaluation.aoi.iter_mut().for_each(|sum| *sum /= seeds.len() as f64);
    Ok(evaluation)
}

/// Is called with a batch of episodes in each of the slots 0..=K, and may end them early.
trait Observer {
    fn observe(&mut self, env: &BatchEnv) -> ControlFlow<()>;
}

impl Observer for () {
    fn observe(&mut self, _env: &BatchEnv) -> ControlFlow<()> {
        ControlFlow::Continue(())
    }
}

/// Ends one thread's episodes when `stop` is set.
struct StopObserver<'a> {
    stop: &'a AtomicBool,
    /// Whether it has ended them.
    stopped: bool,
}

impl Observer for StopObserver<'_> {
    fn observe(&mut self, env: &BatchEnv) -> ControlFlow<()> {
        self.stopped = !env.done() && self.stop.load(Ordering::Acquire);
        if self.stopped { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    }
}

/// Records one thread's episodes.
#[derive(Default)]
struct Recorder {
    /// Index of the episode whose trajectory is kept, from this thread's first; absent when the index is before it.
    traced: Option<usize>,
    /// Per slot the mean AoI of each episode.
    aoi: Vec<Vec<f64>>,
    trajectory: Trajectory,
}

impl Observer for Recorder {
    fn observe(&mut self, env: &BatchEnv) -> ControlFlow<()> {
        self.aoi.push((0..env.copies()).map(|b| env.mean_aoi(b)).collect());
        let (m, n) = (env.config().uavs, env.config().users);
        let Some(b) = self.traced.filter(|&b| b < env.copies()) else { return ControlFlow::Continue(()) };
        let trajectory = &mut self.trajectory;
        trajectory.uavs.resize(m, Vec::new());
        trajectory.users.resize(n, Vec::new());
        trajectory.aoi.resize(n, Vec::new());
        for (path, at) in trajectory.uavs.iter_mut().zip(points(&env.uav_xy()[b * m * 2..][..m * 2])) {
            path.push(at);
        }
        for (path, at) in trajectory.users.iter_mut().zip(points(&env.user_xy()[b * n * 2..][..n * 2])) {
            path.push(at);
        }
        for (ages, &age) in trajectory.aoi.iter_mut().zip(&env.aoi()[b * n..(b + 1) * n]) {
            ages.push(age);
        }
        ControlFlow::Continue(())
    }
}

/// Runs all `seeds`, one part per thread, and returns the parts in order, each with its observer. `observer` makes an observer
/// from the number of seeds before the part.
fn run_parallel<O: Observer + Send>(
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
    if policy.actions() > env.actions() {
        let expected = format!("at most {}, the headings of the environment", env.actions());
        return Err(Invalid::new("policy.actions", policy.actions(), expected));
    }
    let part_len = seeds.len().div_ceil(threads.max(1)).max(1);
    let run_part = |(i, seeds): (usize, &[u64])| {
        let mut observer = observer(i * part_len);
        run(policy, env, seeds, disturbance, &mut observer).map(|metrics| (metrics, observer))
    };
    if seeds.len() <= part_len {
        return seeds.chunks(part_len).enumerate().map(run_part).collect();
    }
    let run_part = &run_part;
    std::thread::scope(|scope| {
        let threads: Vec<_> = seeds.chunks(part_len).enumerate().map(|part| scope.spawn(move || run_part(part))).collect();
        threads.into_iter().map(|t| t.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))).collect()
    })
}

/// Runs all `seeds` on this thread.
fn run(
    policy: &dyn Policy,
    config: &EnvConfig,
    seeds: &[u64],
    disturbance: &Disturbance,
    observer: &mut impl Observer,
) -> Result<Vec<EpisodeMetrics>, Invalid> {
    let (m, n, params) = (config.uavs, config.users, EnvParams::from(config));
    let mut env = BatchEnv::new(config, seeds.len())?;
    env.reset(seeds);
    let hide = policy.needs() != RequiredInput::FullScene;
    let width = policy.memory_len(m, n);
    let mut memory = vec![0.0; width * seeds.len()];
    let mut memories = split(&mut memory, width, seeds.len());
    for (memory, &seed) in memories.iter_mut().zip(seeds) {
        policy.start(m, n, seed, memory);
    }
    let mut graphs = vec![FleetGraph::default(); seeds.len()];
    let mut headings = vec![0; seeds.len() * m];
    let (mut uavs, mut users): (Vec<Point>, Vec<Point>) = (Vec::with_capacity(m), Vec::with_capacity(n));
    let mut flow = observer.observe(&env);
    while flow.is_continue() && !env.done() {
        let step = env.slot();
        if let Some(uav) = disturbance.lost(config, step) {
            env.lose_uav(uav);
        }
        for ((b, graph), &seed) in graphs.iter_mut().enumerate().zip(seeds) {
            uavs.clear();
            uavs.extend(points(&env.uav_xy()[b * m * 2..][..m * 2]));
            users.clear();
            users.extend(points(&env.user_xy()[b * n * 2..][..n * 2]));
            disturbance.distort(config, (seed, step), &mut uavs, &mut users, hide);
            graph.set_scene(&uavs, &users, &env.aoi()[b * n..(b + 1) * n], params.ranges());
        }
        let mut steps: Vec<FleetStep<'_>> = graphs
            .iter()
            .zip(&mut memories)
            .zip(headings.chunks_exact_mut(m))
            .map(|((graph, memory), headings)| FleetStep {
                env: params,
                graph,
                profile: None,
                step: step as u64,
                memory,
                headings,
                q_values: None,
            })
            .collect();
        policy.act(&mut steps);
        env.step(&headings);
        flow = observer.observe(&env);
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
