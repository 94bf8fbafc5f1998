//! The plots of an experiment.

use super::{Experiment, ExperimentPoint, ExperimentSummary, PlotKind, Run, TrainingCurve, XScale};
use crate::learner::Interval;
use crate::plot::{self, Bar, Chart, Series, Trajectories, bars, lines};

fn aoi_on(layouts: &str) -> String {
    format!("mean AoI on {layouts} (slots)")
}

/// What the error bars of results are.
fn intervals_note(summary: &ExperimentSummary) -> &'static str {
    if summary.seeds.len() > 1 {
        "Whiskers: 95 % intervals over seeds and layouts."
    } else {
        "Whiskers: 95 % intervals over layouts; one seed."
    }
}

/// What curves, bands and levels of a convergence plot are.
fn convergence_note(summary: &ExperimentSummary) -> String {
    let seeds = summary.seeds.len();
    let curves =
        if seeds > 1 { format!("Means of {seeds} seeds, bands from the best to the worst.") } else { "One seed.".to_owned() };
    let levels = if summary.baselines.is_empty() { "" } else { " Horizontal lines: baselines." };
    curves + levels
}

/// File name and SVG text of every plot. `curves` are in the order of the runs; `trajectories` are of the first seed's runs.
pub fn plots(
    experiment: &Experiment,
    summary: &ExperimentSummary,
    curves: &[TrainingCurve],
    trajectories: &[Trajectories],
) -> Vec<(String, String)> {
    match experiment.plot {
        PlotKind::Convergence => convergence(experiment, summary, curves),
        PlotKind::Parameter => vec![("parameter.svg".to_owned(), parameter(experiment, summary))],
        PlotKind::Trajectories => trajectory_plots(experiment, trajectories),
    }
}

/// Per point, a plot of the mean AoI on the validation layouts (mean over seeds, with a band from the best to the worst seed) with the
/// baselines as lines, and a bar plot of the results of the best weights.
fn convergence(experiment: &Experiment, summary: &ExperimentSummary, curves: &[TrainingCurve]) -> Vec<(String, String)> {
    let mut files = Vec::new();
    for (p, point) in experiment.points.iter().enumerate() {
        let series = experiment.series.iter().enumerate().map(|(s, name)| {
            let of_seeds: Vec<_> = (experiment.runs.iter().zip(curves))
                .filter(|(run, _)| run.series == s && run.point == p)
                .map(|(_, curve)| curve.values("eval/mean_aoi"))
                .collect();
            let mut points = Vec::new();
            let mut band = Vec::new();
            // Only steps that every seed reached, so that each mean is over the same seeds.
            for &step in of_seeds.first().into_iter().flat_map(|first| first.keys()) {
                let Some(values) = of_seeds.iter().map(|values| values.get(&step).copied()).collect::<Option<Vec<f64>>>() else {
                    continue;
                };
                points.push([step as f64, values.iter().sum::<f64>() / values.len() as f64]);
                band.push(values.iter().fold([f64::INFINITY, f64::NEG_INFINITY], |b, &v| [b[0].min(v), b[1].max(v)]));
            }
            Series { name: name.clone(), points, band: (of_seeds.len() > 1).then_some(band) }
        });
        let title = title_with_point(&experiment.title, &point.name);
        let chart = Chart {
            title: title.clone(),
            x: "environment steps".into(),
            y: "validation mean AoI (slots)".into(),
            series: series.collect(),
            levels: (summary.baselines.iter().filter(|b| b.point == point.name))
                .map(|b| (format!("{} on {}", b.name, summary.layouts), b.mean_aoi.mean))
                .collect(),
            note: convergence_note(summary),
            ..Chart::default()
        };
        files.push((file_name("convergence", point), lines(&chart)));
        let bar = |name: &str, aoi: &Interval| Bar { name: name.to_owned(), mean: aoi.mean, low: aoi.low, high: aoi.high };
        let reached: Vec<Bar> = (summary.series_summaries.iter().filter(|row| row.point == point.name))
            .map(|row| bar(&row.series, &row.mean_aoi))
            .chain(summary.baselines.iter().filter(|b| b.point == point.name).map(|b| bar(&b.name, &b.mean_aoi)))
            .collect();
        let title = format!("{title}: best weights");
        files.push((file_name("reached", point), bars(&title, &aoi_on(&summary.layouts), intervals_note(summary), &reached)));
    }
    files
}

/// Mean AoI with its interval against the points' x, series first and then baselines.
fn parameter(experiment: &Experiment, summary: &ExperimentSummary) -> String {
    let along = |name: &str, aoi: Vec<Interval>| {
        let mut all: Vec<([f64; 2], [f64; 2])> =
            experiment.points.iter().zip(aoi).map(|(point, aoi)| ([point.x, aoi.mean], [aoi.low, aoi.high])).collect();
        all.sort_by(|a, b| a.0[0].total_cmp(&b.0[0]));
        let (points, band) = all.into_iter().unzip();
        Series { name: name.to_owned(), points, band: Some(band) }
    };
    let series = experiment.series.iter().map(|name| {
        along(name, summary.series_summaries.iter().filter(|row| &row.series == name).map(|row| row.mean_aoi).collect())
    });
    let baselines = experiment
        .baselines
        .iter()
        .map(|name| along(name, summary.baselines.iter().filter(|b| &b.name == name).map(|b| b.mean_aoi).collect()));
    lines(&Chart {
        title: experiment.title.clone(),
        x: experiment.x.clone(),
        y: aoi_on(&summary.layouts),
        series: series.chain(baselines).collect(),
        levels: Vec::new(),
        note: intervals_note(summary).to_owned(),
        markers: true,
        log_x: experiment.x_scale == XScale::Log,
    })
}

fn trajectory_plots(experiment: &Experiment, trajectories: &[Trajectories]) -> Vec<(String, String)> {
    let panel = |(run, trajectory): (&Run, &Trajectories)| {
        let (series, point) = (&experiment.series[run.series], &experiment.points[run.point]);
        (
            file_name(&format!("trajectories-{}", experiment.series_slugs[run.series]), point),
            plot::trajectories(&title_with_point(series, &point.name), trajectory),
        )
    };
    experiment.runs.iter().zip(trajectories).map(panel).collect()
}

fn title_with_point(title: &str, point: &str) -> String {
    if point.is_empty() { title.to_owned() } else { format!("{title}: {point}") }
}

fn file_name(plot: &str, point: &ExperimentPoint) -> String {
    if point.slug.is_empty() { format!("{plot}.svg") } else { format!("{plot}-{}.svg", point.slug) }
}
