//! The results of an experiment for people: a Markdown page.

use std::fmt::Write;

use super::{Experiment, Report};
use crate::learner::Interval;

/// The page. `figures` are the names of the SVG files beside it.
pub fn readme(experiment: &Experiment, report: &Report, command: &str, figures: &[String]) -> String {
    let mut page = Page(format!("# {}\n", report.title));
    page.line(&format!(
        "Mean AoI in slots, lower is fresher, on {} layouts of `{}`; the best weights by validation. Intervals are 95 %, by bootstrap",
        report.episodes, report.layouts
    ));
    page.0.push_str("over seeds and layouts. Repeated, or continued after an interruption, by\n");
    page.line(&format!("```sh\n{command}\n```"));
    for figure in figures {
        page.line(&format!("![{figure}]({figure})"));
    }
    // A column of empty names says nothing.
    let points = experiment.points.iter().any(|point| !point.name.is_empty());
    page.line("## Learned policies");
    let seeds: Vec<String> = report.seeds.iter().map(|seed| format!("seed {seed}")).collect();
    let header = ["point", "series", "mean AoI", "95 % interval", "last weights", "p95", "peak", "coverage", "fairness"];
    page.head(points, header.into_iter().chain(seeds.iter().map(String::as_str)));
    for row in &report.rows {
        let last = row.last_mean_aoi.map_or("diverged".to_owned(), |last| format!("{:.2}", last.mean));
        let m = &row.mean;
        let cells = [
            row.point.clone(),
            row.series.clone(),
            format!("{:.2}", row.mean_aoi.mean),
            range(&row.mean_aoi),
            last,
            format!("{:.1}", m.p95_aoi),
            format!("{:.1}", m.peak_aoi),
            format!("{:.1} %", 100.0 * m.coverage),
            format!("{:.2}", m.fairness),
        ];
        page.row(points, cells.into_iter().chain(row.per_seed.iter().map(|aoi| format!("{aoi:.2}"))));
    }
    if !report.baselines.is_empty() {
        page.line("## Baselines on the same layouts");
        page.head(points, ["point", "policy", "mean AoI", "95 % interval", "p95", "peak", "coverage", "fairness"]);
        for b in &report.baselines {
            let m = &b.mean;
            page.row(
                points,
                [
                    b.point.clone(),
                    b.name.clone(),
                    format!("{:.2}", b.mean_aoi.mean),
                    range(&b.mean_aoi),
                    format!("{:.1}", m.p95_aoi),
                    format!("{:.1}", m.peak_aoi),
                    format!("{:.1} %", 100.0 * m.coverage),
                    format!("{:.2}", m.fairness),
                ],
            );
        }
    }
    if !report.differences.is_empty() {
        page.line("## Differences on the same layouts and seeds");
        page.line("First minus second: negative where the first keeps data fresher.");
        page.head(points, ["point", "first", "second", "difference", "95 % interval", "first is better"]);
        for d in &report.differences {
            page.row(
                points,
                [
                    d.point.clone(),
                    d.first.clone(),
                    d.second.clone(),
                    format!("{:+.2}", d.mean_aoi.mean),
                    format!("{:+.2} to {:+.2}", d.mean_aoi.low, d.mean_aoi.high),
                    format!("{:.0} %", 100.0 * d.wins),
                ],
            );
        }
    }
    page.line("## Runs");
    page.head(points, ["point", "series", "seed", "steps", "best step", "best", "last", "folder"]);
    for run in &report.runs {
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

fn range(interval: &Interval) -> String {
    format!("{:.2} to {:.2}", interval.low, interval.high)
}

/// Markdown as it grows.
struct Page(String);

impl Page {
    /// A paragraph, a heading, a picture.
    fn line(&mut self, text: &str) {
        writeln!(self.0, "\n{text}").expect("a string takes what is written");
    }

    /// The head of a table.
    fn head<T: AsRef<str>>(&mut self, points: bool, cells: impl IntoIterator<Item = T>) {
        let cells: Vec<T> = cells.into_iter().collect();
        let columns = cells.len();
        self.0.push('\n');
        self.row(points, cells);
        self.row(points, std::iter::repeat_n("---", columns));
    }

    /// A row of a table; the first cell, the point, only where there are points.
    fn row<T: AsRef<str>>(&mut self, points: bool, cells: impl IntoIterator<Item = T>) {
        let cells: Vec<String> =
            cells.into_iter().skip(usize::from(!points)).map(|cell| cell.as_ref().replace('|', "\\|")).collect();
        writeln!(self.0, "| {} |", cells.join(" | ")).expect("a string takes what is written");
    }
}
