//! The results of an experiment as a Markdown page.

use std::fmt::Write;
use std::path::Path;

use super::{Experiment, ExperimentSummary, SeriesSummary};
use crate::env::EpisodeMetrics;
use crate::learner::Interval;

/// A figure in Markdown: the picture, or, as Markdown shows no PDF, a link to it.
pub fn figure_link(caption: &str, file: &str) -> String {
    let picture = if Path::new(file).extension().is_some_and(|extension| extension == "pdf") { "" } else { "!" };
    format!("{picture}[{caption}]({file})")
}

/// The page. `plots` are the names of the figures beside it.
pub fn readme(experiment: &Experiment, summary: &ExperimentSummary, command: &str, plots: &[String]) -> String {
    let mut page = Page(format!("# {}\n", summary.title));
    page.line(&format!(
        "Mean AoI in slots (lower is better) on {} layouts of `{}`, with the weights that are best on the validation layouts.",
        summary.episodes, summary.layouts
    ));
    page.0.push_str(if summary.seeds.len() == 1 {
        "Intervals are 95 % bootstrap intervals over layouts; there is one seed, so they exclude seed variance.\n"
    } else {
        "Intervals are 95 % bootstrap intervals over seeds and layouts.\n"
    });
    page.line("This command repeats the experiment, and resumes it after an interruption:");
    page.line(&format!("```sh\n{command}\n```"));
    for plot in plots {
        page.line(&figure_link(plot, plot));
    }
    // Without names, the column of points is left out.
    let points = experiment.points.iter().any(|point| !point.name.is_empty());
    page.line("## Learned policies");
    let seeds: Vec<String> = summary.seeds.iter().map(|seed| format!("seed {seed}")).collect();
    let header = ["point", "series", "mean AoI", "95 % interval", "last weights", "p95", "peak", "coverage", "fairness"];
    page.head(points, header.into_iter().chain(seeds.iter().map(String::as_str)));
    for row in &summary.series_summaries {
        let last = row.last_mean_aoi.map_or("diverged".to_owned(), |last| format!("{:.2}", last.mean));
        let [aoi, interval, others @ ..] = metric_cells(&row.mean_aoi, &row.mean);
        let cells = [row.point.clone(), row.series.clone(), aoi, interval, last];
        page.row(points, cells.into_iter().chain(others).chain(row.per_seed.iter().map(|aoi| format!("{aoi:.2}"))));
    }
    page.line("## Parameters");
    page.line("UAVs share one agent. The mixer is used in training only. How long the runs trained is in `timing.json`.");
    page.head(points, ["point", "series", "agent", "mixer"]);
    for SeriesSummary { point, series, parameters, .. } in &summary.series_summaries {
        page.row(points, [point.clone(), series.clone(), parameters.agent.to_string(), parameters.mixer.to_string()]);
    }
    if !summary.baselines.is_empty() {
        page.line("## Baselines on the same layouts");
        page.head(points, ["point", "policy", "mean AoI", "95 % interval", "p95", "peak", "coverage", "fairness"]);
        for b in &summary.baselines {
            page.row(points, [b.point.clone(), b.name.clone()].into_iter().chain(metric_cells(&b.mean_aoi, &b.mean)));
        }
    }
    if !summary.differences.is_empty() {
        page.line("## Differences on the same layouts and seeds");
        page.line("First minus second; a negative difference means that the first is better.");
        page.head(points, ["point", "first", "second", "difference", "95 % interval", "first is better"]);
        for d in &summary.differences {
            let names = [d.point.clone(), d.first.clone(), d.second.clone()];
            page.row(points, names.into_iter().chain(difference_cells(&d.mean_aoi, d.wins)));
        }
    }
    page.line("## Runs");
    page.head(points, ["point", "series", "seed", "steps", "best step", "best", "last", "folder"]);
    for run in &summary.runs {
        page.row(
            points,
            [
                run.point.clone(),
                run.series.clone(),
                run.seed.to_string(),
                run.steps.to_string(),
                run.best_step.to_string(),
                format!("{:.2}", run.best.mean_aoi),
                run.last.map_or("diverged".to_owned(), |last| format!("{:.2}", last.mean_aoi)),
                format!("`{}`", run.folder),
            ],
        );
    }
    page.0
}

/// Table cells: mean AoI, its interval, p95 AoI, peak AoI, coverage, fairness.
pub fn metric_cells(mean_aoi: &Interval, mean: &EpisodeMetrics) -> [String; 6] {
    [
        format!("{:.2}", mean_aoi.mean),
        format!("{:.2} to {:.2}", mean_aoi.low, mean_aoi.high),
        format!("{:.1}", mean.p95_aoi),
        format!("{:.1}", mean.peak_aoi),
        format!("{:.1} %", 100.0 * mean.coverage),
        format!("{:.2}", mean.fairness),
    ]
}

/// Table cells: difference of mean AoI, its interval, share of layouts on which the first is better.
pub fn difference_cells(mean_aoi: &Interval, wins: f64) -> [String; 3] {
    [format!("{:+.2}", mean_aoi.mean), format!("{:+.2} to {:+.2}", mean_aoi.low, mean_aoi.high), format!("{:.0} %", 100.0 * wins)]
}

/// The Markdown text so far.
struct Page(String);

impl Page {
    /// Adds a paragraph, a heading or a picture.
    fn line(&mut self, text: &str) {
        writeln!(self.0, "\n{text}").expect("a string takes what is written");
    }

    /// Adds the head of a table.
    fn head<T: AsRef<str>>(&mut self, points: bool, cells: impl IntoIterator<Item = T>) {
        let cells: Vec<T> = cells.into_iter().collect();
        let columns = cells.len();
        self.0.push('\n');
        self.row(points, cells);
        self.row(points, std::iter::repeat_n("---", columns));
    }

    /// Adds a row of a table. The first cell, the point, is left out if there are no points.
    fn row<T: AsRef<str>>(&mut self, points: bool, cells: impl IntoIterator<Item = T>) {
        let cells: Vec<String> =
            cells.into_iter().skip(usize::from(!points)).map(|cell| cell.as_ref().replace('|', "\\|")).collect();
        writeln!(self.0, "| {} |", cells.join(" | ")).expect("a string takes what is written");
    }
}
