//! What all runs of an experiment say together, as numbers: `results.json`.

use serde::Serialize;

use super::statistics::{interval, minus};
use super::{Experiment, Figure, Flown, Outcome};
use crate::env::EpisodeMetrics;
use crate::learner::Interval;

/// The results of an experiment. AoI is in slots.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// As in the document.
    pub title: String,
    /// As in the document.
    pub figure: Figure,
    /// The frozen list that was flown.
    pub layouts: String,
    /// How many of its layouts.
    pub episodes: usize,
    /// Seeds of the runs.
    pub seeds: Vec<u64>,
    /// Series at points, over all seeds.
    pub rows: Vec<Row>,
    /// Baselines at points.
    pub baselines: Vec<Reference>,
    /// Pairs at each point: series with series, then series with baselines.
    pub differences: Vec<Compared>,
    /// Every run.
    pub runs: Vec<RunRow>,
}

/// A series at a point.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    /// Name of the series.
    pub series: String,
    /// Name of the point.
    pub point: String,
    /// Mean AoI of the best weights, with an interval over seeds and layouts.
    pub mean_aoi: Interval,
    /// Mean AoI of the last weights; none where a run diverged.
    pub last_mean_aoi: Option<Interval>,
    /// Mean of every figure over seeds and layouts.
    pub mean: EpisodeMetrics,
    /// Mean AoI of each seed's best weights, in the order of the seeds.
    pub per_seed: Vec<f64>,
}

/// A policy that is not learned, at a point.
#[derive(Clone, Debug, Serialize)]
pub struct Reference {
    /// Its name.
    pub name: String,
    /// Name of the point.
    pub point: String,
    /// Mean AoI with an interval over layouts.
    pub mean_aoi: Interval,
    /// Mean of every figure over layouts.
    pub mean: EpisodeMetrics,
    /// Mean AoI on each layout.
    pub per_layout: Vec<f64>,
}

/// First minus second on the same layouts, with the same seeds; negative where the first keeps data fresher.
#[derive(Clone, Debug, Serialize)]
pub struct Compared {
    /// Name of the point.
    pub point: String,
    /// A series.
    pub first: String,
    /// A series or a baseline.
    pub second: String,
    /// Mean difference of mean AoI, with an interval over seeds and layouts.
    pub mean_aoi: Interval,
    /// Share of seeds and layouts on which the first is better.
    pub wins: f64,
}

/// A run.
#[derive(Clone, Debug, Serialize)]
pub struct RunRow {
    /// Name of the series.
    pub series: String,
    /// Name of the point.
    pub point: String,
    /// Seed.
    pub seed: u64,
    /// Its folder.
    pub folder: String,
    /// Environment steps trained for.
    pub steps: u64,
    /// Whether it ended early because training diverged.
    pub diverged: bool,
    /// Environment steps of the weights that were best by validation.
    pub best_step: u64,
    /// Mean of every figure of the best weights over layouts.
    pub best: EpisodeMetrics,
    /// The same of the last weights.
    pub last: Option<EpisodeMetrics>,
    /// Mean AoI of the best weights on each layout.
    pub per_layout: Vec<f64>,
}

/// The results of all runs. `outcomes` are in the order of the runs; `references` has for each point the episodes of each
/// baseline.
///
/// # Panics
/// When there is not one outcome per run, or not one reference per point and baseline.
pub fn report(experiment: &Experiment, outcomes: &[Outcome], references: &[Vec<Vec<EpisodeMetrics>>]) -> Report {
    assert_eq!(outcomes.len(), experiment.runs.len(), "one outcome per run");
    let mut rows = Vec::new();
    let mut baselines = Vec::new();
    let mut differences = Vec::new();
    for (p, (point, references)) in experiment.points.iter().zip(references).enumerate() {
        let point = &point.name;
        let mut values: Vec<(&str, Vec<Vec<f64>>)> = Vec::new();
        for (s, series) in experiment.series.iter().enumerate() {
            let of = |(run, _): &(&super::Run, &Outcome)| run.series == s && run.point == p;
            let all: Vec<&Outcome> = experiment.runs.iter().zip(outcomes).filter(of).map(|(_, outcome)| outcome).collect();
            let best: Vec<Vec<f64>> = all.iter().map(|outcome| aoi(&outcome.best.episodes)).collect();
            let last: Option<Vec<Vec<f64>>> = all.iter().map(|o| o.last.as_ref().map(|last| aoi(&last.episodes))).collect();
            let episodes: Vec<EpisodeMetrics> = all.iter().flat_map(|outcome| outcome.best.episodes.iter().copied()).collect();
            rows.push(Row {
                series: series.clone(),
                point: point.clone(),
                mean_aoi: interval(&best),
                last_mean_aoi: last.map(|last| interval(&last)),
                mean: EpisodeMetrics::mean(&episodes),
                per_seed: all.iter().map(|outcome| mean(&outcome.best).mean_aoi).collect(),
            });
            values.push((series, best));
        }
        for (name, episodes) in experiment.baselines.iter().zip(references) {
            let per_layout = aoi(episodes);
            baselines.push(Reference {
                name: name.clone(),
                point: point.clone(),
                mean_aoi: interval(std::slice::from_ref(&per_layout)),
                mean: EpisodeMetrics::mean(episodes),
                per_layout: per_layout.clone(),
            });
            // A baseline is the same for every seed.
            values.push((name, vec![per_layout; experiment.seeds.len()]));
        }
        for (i, (first, a)) in values.iter().enumerate().take(experiment.series.len()) {
            for (second, b) in &values[i + 1..] {
                let difference = minus(a, b);
                let all = difference.iter().flatten();
                differences.push(Compared {
                    point: point.clone(),
                    first: (*first).to_owned(),
                    second: (*second).to_owned(),
                    mean_aoi: interval(&difference),
                    wins: all.clone().filter(|&&d| d < 0.0).count() as f64 / all.count().max(1) as f64,
                });
            }
        }
    }
    let runs = experiment.runs.iter().zip(outcomes).map(|(run, outcome)| RunRow {
        series: experiment.series[run.series].clone(),
        point: experiment.points[run.point].name.clone(),
        seed: run.config.seed,
        folder: run.folder.clone(),
        steps: outcome.steps,
        diverged: outcome.diverged,
        best_step: outcome.best.step,
        best: mean(&outcome.best),
        last: outcome.last.as_ref().map(mean),
        per_layout: aoi(&outcome.best.episodes),
    });
    Report {
        title: experiment.title.clone(),
        figure: experiment.figure,
        layouts: experiment.layouts.clone(),
        episodes: experiment.layout_seeds.len(),
        seeds: experiment.seeds.clone(),
        rows,
        baselines,
        differences,
        runs: runs.collect(),
    }
}

fn aoi(episodes: &[EpisodeMetrics]) -> Vec<f64> {
    episodes.iter().map(|episode| episode.mean_aoi).collect()
}

fn mean(flown: &Flown) -> EpisodeMetrics {
    EpisodeMetrics::mean(&flown.episodes)
}
