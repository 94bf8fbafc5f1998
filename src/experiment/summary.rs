//! The summary of an experiment as numbers: `results.json`.

use serde::Serialize;

use super::statistics::{interval, minus};
use super::{EvaluatedWeights, Experiment, PlotKind, Run, RunResult};
use crate::checkpoint::parameter_layout;
use crate::env::EpisodeMetrics;
use crate::learner::Interval;
use crate::policy::Agent;
use crate::train_config::TrainConfig;

/// The summary of an experiment. AoI is in slots.
#[derive(Clone, Debug, Serialize)]
pub struct ExperimentSummary {
    /// Title of the document.
    pub title: String,
    /// Kind of plot.
    #[serde(rename = "figure")]
    pub plot: PlotKind,
    /// Name of the frozen list of layouts.
    pub layouts: String,
    /// Number of layouts evaluated, from the first.
    pub episodes: usize,
    /// Seeds of the runs.
    pub seeds: Vec<u64>,
    /// Every series at every point, over all seeds.
    #[serde(rename = "rows")]
    pub series_summaries: Vec<SeriesSummary>,
    /// Baselines at points.
    pub baselines: Vec<BaselineSummary>,
    /// Pairs at each point: series with series, then series with baselines.
    pub differences: Vec<PairedDifference>,
    /// Every run.
    pub runs: Vec<RunSummary>,
}

/// A series at a point.
#[derive(Clone, Debug, Serialize)]
pub struct SeriesSummary {
    /// Name of the series.
    pub series: String,
    /// Name of the point.
    pub point: String,
    /// Mean AoI of the best weights, with an interval over seeds and layouts.
    pub mean_aoi: Interval,
    /// Mean AoI of the last weights; absent if a run diverged.
    pub last_mean_aoi: Option<Interval>,
    /// Mean of every metric over seeds and layouts.
    pub mean: EpisodeMetrics,
    /// Mean AoI of each seed's best weights, in the order of the seeds.
    pub per_seed: Vec<f64>,
    /// Numbers that training learns.
    pub parameters: ParameterCounts,
}

/// Numbers of parameters. The agent flies; the mixer is used in training only.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct ParameterCounts {
    /// Of the agent, which all UAVs share.
    pub agent: usize,
    /// Of the mixer.
    pub mixer: usize,
}

impl ParameterCounts {
    fn of(config: &TrainConfig) -> Self {
        let agent = Agent::new(config.agent(), config.dims()).layout().len();
        Self { agent, mixer: parameter_layout(config).len() - agent }
    }
}

/// A baseline at a point.
#[derive(Clone, Debug, Serialize)]
pub struct BaselineSummary {
    /// Its name.
    pub name: String,
    /// Name of the point.
    pub point: String,
    /// Mean AoI with an interval over layouts.
    pub mean_aoi: Interval,
    /// Mean of every metric over layouts.
    pub mean: EpisodeMetrics,
    /// Mean AoI on each layout.
    pub per_layout: Vec<f64>,
}

/// First minus second on the same layouts with the same seeds. Negative: the first is better.
#[derive(Clone, Debug, Serialize)]
pub struct PairedDifference {
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
pub struct RunSummary {
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
    /// Environment steps of the best weights by validation.
    pub best_step: u64,
    /// Every metric of the best weights over layouts.
    pub best: EpisodeMetrics,
    /// The same of the last weights.
    pub last: Option<EpisodeMetrics>,
    /// Mean AoI of the best weights on each layout.
    pub per_layout: Vec<f64>,
}

impl ExperimentSummary {
    /// Summarizes the `results` of all runs, in the order of the runs. `baseline_episodes` holds, per point, the episodes of each
    /// baseline.
    ///
    /// # Panics
    /// If there is not one result per run.
    pub fn new(experiment: &Experiment, results: &[RunResult], baseline_episodes: &[Vec<Vec<EpisodeMetrics>>]) -> Self {
        assert_eq!(results.len(), experiment.runs.len(), "one result per run");
        let mut series_summaries = Vec::new();
        let mut baselines = Vec::new();
        let mut differences = Vec::new();
        for (p, (point, baseline_episodes)) in experiment.points.iter().zip(baseline_episodes).enumerate() {
            let point = &point.name;
            let mut values: Vec<(&str, Vec<Vec<f64>>)> = Vec::new();
            for (s, series) in experiment.series.iter().enumerate() {
                let belongs = |(run, _): &(&Run, &RunResult)| run.series == s && run.point == p;
                let (runs, all): (Vec<&Run>, Vec<&RunResult>) = experiment.runs.iter().zip(results).filter(belongs).unzip();
                let best: Vec<Vec<f64>> = all.iter().map(|result| aoi(&result.best.episodes)).collect();
                let last: Option<Vec<Vec<f64>>> =
                    all.iter().map(|result| result.last.as_ref().map(|last| aoi(&last.episodes))).collect();
                let episodes: Vec<EpisodeMetrics> = all.iter().flat_map(|result| result.best.episodes.iter().copied()).collect();
                series_summaries.push(SeriesSummary {
                    series: series.clone(),
                    point: point.clone(),
                    mean_aoi: interval(&best),
                    last_mean_aoi: last.map(|last| interval(&last)),
                    mean: EpisodeMetrics::mean(&episodes),
                    per_seed: all.iter().map(|result| mean(&result.best).mean_aoi).collect(),
                    parameters: ParameterCounts::of(&runs[0].config),
                });
                values.push((series, best));
            }
            for (name, episodes) in experiment.baselines.iter().zip(baseline_episodes) {
                let per_layout = aoi(episodes);
                baselines.push(BaselineSummary {
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
                    differences.push(PairedDifference {
                        point: point.clone(),
                        first: (*first).to_owned(),
                        second: (*second).to_owned(),
                        mean_aoi: interval(&difference),
                        wins: all.clone().filter(|&&d| d < 0.0).count() as f64 / all.count().max(1) as f64,
                    });
                }
            }
        }
        let runs = experiment.runs.iter().zip(results).map(|(run, result)| RunSummary {
            series: experiment.series[run.series].clone(),
            point: experiment.points[run.point].name.clone(),
            seed: run.config.seed,
            folder: run.folder.clone(),
            steps: result.steps,
            diverged: result.diverged,
            best_step: result.best.step,
            best: mean(&result.best),
            last: result.last.as_ref().map(mean),
            per_layout: aoi(&result.best.episodes),
        });
        Self {
            title: experiment.title.clone(),
            plot: experiment.plot,
            layouts: experiment.layouts.clone(),
            episodes: experiment.layout_seeds.len(),
            seeds: experiment.seeds.clone(),
            series_summaries,
            baselines,
            differences,
            runs: runs.collect(),
        }
    }
}

fn aoi(episodes: &[EpisodeMetrics]) -> Vec<f64> {
    episodes.iter().map(|episode| episode.mean_aoi).collect()
}

fn mean(weights: &EvaluatedWeights) -> EpisodeMetrics {
    EpisodeMetrics::mean(&weights.episodes)
}
