//! The figures of an experiment.

use super::plan::slug;
use super::{Curve, Experiment, Figure, Report};
use crate::figure::{Bar, Chart, Flight, Series, bars, lines, trajectories};
use crate::learner::Interval;

const AOI: &str = "mean AoI (slots)";

/// Name and text of every SVG. `curves` are in the order of the runs; `flights` are those of the first seed's runs.
pub fn figures(experiment: &Experiment, report: &Report, curves: &[Curve], flights: &[Flight]) -> Vec<(String, String)> {
    match experiment.figure {
        Figure::Convergence => convergence(experiment, report, curves),
        Figure::Parameter => vec![("parameter.svg".to_owned(), parameter(experiment, report))],
        Figure::Trajectories => panels(experiment, flights),
    }
}

/// Mean over seeds of the mean AoI on the validation layouts, with the band from the best to the worst seed; a file per
/// point. Then the bars of what the best weights reach.
fn convergence(experiment: &Experiment, report: &Report, curves: &[Curve]) -> Vec<(String, String)> {
    let mut files = Vec::new();
    for (p, point) in experiment.points.iter().enumerate() {
        let series = experiment.series.iter().enumerate().map(|(s, name)| {
            let of_seeds: Vec<_> = (experiment.runs.iter().zip(curves))
                .filter(|(run, _)| run.series == s && run.point == p)
                .map(|(_, curve)| curve.values("eval/mean_aoi"))
                .collect();
            let mut points = Vec::new();
            let mut band = Vec::new();
            // Steps that every seed reached: a mean over other seeds at other steps would jump.
            for &step in of_seeds.first().into_iter().flat_map(|first| first.keys()) {
                let Some(values) = of_seeds.iter().map(|values| values.get(&step).copied()).collect::<Option<Vec<f64>>>() else {
                    continue;
                };
                points.push([step as f64, values.iter().sum::<f64>() / values.len() as f64]);
                band.push(values.iter().fold([f64::INFINITY, f64::NEG_INFINITY], |b, &v| [b[0].min(v), b[1].max(v)]));
            }
            Series { name: name.clone(), points, band: (of_seeds.len() > 1).then_some(band) }
        });
        let title = titled(&experiment.title, &point.name);
        let chart = Chart {
            title: title.clone(),
            x: "environment steps".into(),
            y: format!("{AOI} on validation layouts"),
            series: series.collect(),
            markers: false,
        };
        files.push((named("convergence", &point.name), lines(&chart)));
        let bar = |name: &str, aoi: &Interval| Bar { name: name.to_owned(), mean: aoi.mean, low: aoi.low, high: aoi.high };
        let reached: Vec<Bar> = (report.rows.iter().filter(|row| row.point == point.name))
            .map(|row| bar(&row.series, &row.mean_aoi))
            .chain(report.baselines.iter().filter(|b| b.point == point.name).map(|b| bar(&b.name, &b.mean_aoi)))
            .collect();
        let title = format!("{title}: best weights");
        files.push((named("reached", &point.name), bars(&title, &format!("{AOI} on {}", report.layouts), &reached)));
    }
    files
}

/// Mean AoI with its interval against the points' x, series first and then baselines.
fn parameter(experiment: &Experiment, report: &Report) -> String {
    let along = |name: &str, aoi: Vec<Interval>| {
        let mut all: Vec<([f64; 2], [f64; 2])> =
            experiment.points.iter().zip(aoi).map(|(point, aoi)| ([point.x, aoi.mean], [aoi.low, aoi.high])).collect();
        all.sort_by(|a, b| a.0[0].total_cmp(&b.0[0]));
        let (points, band) = all.into_iter().unzip();
        Series { name: name.to_owned(), points, band: Some(band) }
    };
    let series = experiment
        .series
        .iter()
        .map(|name| along(name, report.rows.iter().filter(|row| &row.series == name).map(|row| row.mean_aoi).collect()));
    let baselines = experiment
        .baselines
        .iter()
        .map(|name| along(name, report.baselines.iter().filter(|b| &b.name == name).map(|b| b.mean_aoi).collect()));
    lines(&Chart {
        title: experiment.title.clone(),
        x: experiment.x.clone(),
        y: format!("{AOI} on {}", report.layouts),
        series: series.chain(baselines).collect(),
        markers: true,
    })
}

fn panels(experiment: &Experiment, flights: &[Flight]) -> Vec<(String, String)> {
    let panel = |(run, flight): (&super::Run, &Flight)| {
        let (series, point) = (&experiment.series[run.series], &experiment.points[run.point].name);
        (named(&format!("trajectories-{}", slug(series)), point), trajectories(&titled(series, point), flight))
    };
    experiment.runs.iter().zip(flights).map(panel).collect()
}

fn titled(title: &str, point: &str) -> String {
    if point.is_empty() { title.to_owned() } else { format!("{title}: {point}") }
}

fn named(figure: &str, point: &str) -> String {
    if point.is_empty() { format!("{figure}.svg") } else { format!("{figure}-{}.svg", slug(point)) }
}
