//! The report of an evaluation as files: an HTML page, the same as Markdown, plots, and the numbers as JSON.
//!
//! This file owns the content; `render` writes HTML and Markdown. Of this machine, the report contains the command line only.

mod render;

use std::fs;
use std::path::Path;

use super::figures::FigureArgs;
use crate::experiment::{difference_cells, metric_cells};
use crate::learner::{Comparison, Pair, PolicyEvaluation};
use crate::learner::{Difference, Interval};
use crate::plot::{self, Bar, Chart, Series, Trajectories};
use render::{ReportPage, ReportPlot, ReportSection, ReportTable};

/// Writes `index.html`, `report.md`, `report.json` and the plots to `directory`. Creates the directory and replaces existing files.
///
/// # Errors
/// The directory or a file cannot be written.
pub fn write((directory, figures): (&Path, &FigureArgs), comparison: &Comparison, command: &str) -> anyhow::Result<()> {
    let mut page = page(comparison, command)?;
    fs::create_dir_all(directory)?;
    for plot in page.sections.iter_mut().flat_map(|s| &mut s.plots) {
        figures.write(&directory.join(&plot.file), &plot.svg)?;
        plot.file = figures.shown(&plot.file);
    }
    fs::write(directory.join("index.html"), render::html(&page))?;
    fs::write(directory.join("report.md"), render::markdown(&page))?;
    fs::write(directory.join("report.json"), serde_json::to_string_pretty(&comparison.json()?)? + "\n")?;
    Ok(())
}

/// What the error bars of a report are.
const INTERVALS: &str = "Whiskers: 95 % intervals over layouts.";

fn page(comparison: &Comparison, command: &str) -> anyhow::Result<ReportPage> {
    let evaluations = comparison.best_first();
    let mut sections = vec![conditions(comparison), policies(&evaluations)];
    for name in Comparison::REFERENCES {
        sections.extend(gaps(name, &comparison.gaps(name)?));
    }
    sections.extend(pairs(&comparison.pairs()?));
    sections.push(over_slots(&evaluations));
    sections.push(over_layouts(&evaluations));
    sections.push(trajectories(comparison, &evaluations));
    Ok(ReportPage { title: "Evaluation of UAV policies".to_owned(), command: command.to_owned(), sections })
}

fn conditions(comparison: &Comparison) -> ReportSection {
    let Comparison { env, disturbance, layouts, episodes, .. } = comparison;
    let row = |what: &str, value: String| vec![what.to_owned(), value];
    let last = layouts.first + *episodes as u64 - 1;
    let rows = vec![
        row("layouts", format!("{episodes} of {} (seeds {} to {last})", layouts.name, layouts.first)),
        row("UAVs, users, slots", format!("{}, {}, {}", env.uavs, env.users, env.slots)),
        row("speed of UAVs", format!("{} per slot", env.speed)),
        row("transmission range, detection range", format!("{}, {}", env.transmission_range, env.detection_range)),
        row("users", if env.user_speed > 0.0 { format!("move {} per slot", env.user_speed) } else { "stay".to_owned() }),
        row("lost UAV", disturbance.lose.map_or_else(|| "none".to_owned(), |l| format!("UAV {} from slot {} on", l.uav, l.slot))),
        row(
            "error of observed positions",
            if disturbance.position_noise > 0.0 {
                format!("Gaussian, standard deviation {}", disturbance.position_noise)
            } else {
                "none".to_owned()
            },
        ),
    ];
    ReportSection {
        title: "Conditions".to_owned(),
        text:
            "All policies are evaluated on the same layouts. Lengths are in units of the square's side; the age of information \
               (AoI) is in slots, and lower is better."
                .to_owned(),
        table: Some(ReportTable { header: vec!["condition".to_owned(), "value".to_owned()], rows, numbers_from: 2 }),
        plots: Vec::new(),
    }
}

fn policies(evaluations: &[&PolicyEvaluation]) -> ReportSection {
    let header = ["policy", "mean AoI", "95 % interval", "p95 AoI", "peak AoI", "coverage", "fairness"];
    let rows = evaluations.iter().map(|policy| {
        let name = if policy.reference { format!("{} (reference)", policy.name) } else { policy.name.clone() };
        std::iter::once(name).chain(metric_cells(&policy.summary.mean_aoi, &policy.summary.mean)).collect()
    });
    let bars: Vec<Bar> = evaluations.iter().map(|policy| bar(policy, policy.summary.mean_aoi)).collect();
    ReportSection {
        title: "Policies, the best first".to_owned(),
        text: "Means over layouts; the interval of the mean AoI is a 95 % bootstrap interval. p95 and peak are over the users \
               and slots of an episode, coverage is the share of users ever visited, fairness is Jain's index of the users' \
               mean AoI. References are added for comparison; `tour` is a planner with full information, not a bound."
            .to_owned(),
        table: Some(ReportTable { header: header.map(str::to_owned).to_vec(), rows: rows.collect(), numbers_from: 1 }),
        plots: vec![ReportPlot {
            file: "means.svg".to_owned(),
            caption: "Mean AoI with its 95 % interval.".to_owned(),
            svg: plot::bars("Mean AoI", "mean AoI (slots)", INTERVALS, &bars),
        }],
    }
}

/// `None` if the reference or all other policies are missing.
fn gaps(name: &str, gaps: &[Pair]) -> Option<ReportSection> {
    let others = gaps.iter().filter(|(policy, reference, _)| policy.name != reference.name);
    let rows: Vec<Vec<String>> = others.map(|(policy, _, d)| difference_row([&policy.name], d)).collect();
    if rows.is_empty() {
        return None;
    }
    // The reference has a bar of length 0, so that every policy has the same colour in all plots.
    let bars: Vec<Bar> = gaps.iter().map(|(policy, _, d)| bar(policy, d.mean_aoi)).collect();
    let header = ["policy", "gap", "95 % interval", "better on"];
    Some(ReportSection {
        title: format!("Gap to {name}"),
        text: format!(
            "Mean AoI of the policy minus that of {name} on the same layout, averaged over layouts. Negative: the policy is better."
        ),
        table: Some(ReportTable { header: header.map(str::to_owned).to_vec(), rows, numbers_from: 1 }),
        plots: vec![ReportPlot {
            file: format!("gap-{name}.svg"),
            caption: format!("Gap to {name} with its 95 % interval."),
            svg: plot::bars(&format!("Gap to {name}"), &format!("mean AoI minus that of {name} (slots)"), INTERVALS, &bars),
        }],
    })
}

/// `None` if only one policy was requested.
fn pairs(pairs: &[Pair]) -> Option<ReportSection> {
    let rows: Vec<_> = pairs.iter().map(|(a, b, d)| difference_row([&a.name, &b.name], d)).collect();
    let header = ["first", "second", "first minus second", "95 % interval", "first better on"];
    (!rows.is_empty()).then(|| ReportSection {
        title: "Differences".to_owned(),
        text:
            "Paired differences of mean AoI on the same layouts. If the interval contains 0, these layouts do not decide which \
               policy is better. The intervals cover the variation over layouts; they exclude seed variance."
                .to_owned(),
        table: Some(ReportTable { header: header.map(str::to_owned).to_vec(), rows, numbers_from: 2 }),
        plots: Vec::new(),
    })
}

fn over_slots(evaluations: &[&PolicyEvaluation]) -> ReportSection {
    let series = evaluations.iter().map(|policy| {
        let points = policy.evaluation.aoi.iter().enumerate().map(|(slot, &aoi)| [slot as f64, aoi]).collect();
        Series { name: policy.name.clone(), points, band: None }
    });
    let chart = Chart {
        title: "AoI during an episode".to_owned(),
        x: "slot".to_owned(),
        y: "mean AoI (slots)".to_owned(),
        series: series.collect(),
        ..Chart::default()
    };
    ReportSection {
        title: "Over slots".to_owned(),
        text:
            "At slot 0 all AoI are 0. A curve that becomes flat means that all users are visited regularly; a curve that keeps \
               rising means that some users are not visited."
                .to_owned(),
        table: None,
        plots: vec![ReportPlot {
            file: "aoi.svg".to_owned(),
            caption: "Mean AoI over users and layouts in every slot.".to_owned(),
            svg: plot::lines(&chart),
        }],
    }
}

fn over_layouts(evaluations: &[&PolicyEvaluation]) -> ReportSection {
    let values =
        |policy: &&PolicyEvaluation| (policy.name.clone(), policy.evaluation.episodes.iter().map(|e| e.mean_aoi).collect());
    let series: Vec<(String, Vec<f64>)> = evaluations.iter().map(values).collect();
    ReportSection {
        title: "Over layouts".to_owned(),
        text: "A curve further left is better. A long tail to the right means that the policy is bad on some layouts.".to_owned(),
        table: None,
        plots: vec![ReportPlot {
            file: "distribution.svg".to_owned(),
            caption: "Share of layouts whose mean AoI is at most that of the x axis.".to_owned(),
            svg: plot::distribution("Distribution over layouts", "mean AoI of a layout (slots)", &series),
        }],
    }
}

fn trajectories(comparison: &Comparison, evaluations: &[&PolicyEvaluation]) -> ReportSection {
    let seed = evaluations.first().map_or(0, |policy| policy.evaluation.trajectory.seed);
    let index = seed.saturating_sub(comparison.layouts.first) as usize;
    let plots = evaluations.iter().enumerate().map(|(i, policy)| {
        let trajectory = &policy.evaluation.trajectory;
        let paths = Trajectories {
            uavs: trajectory.uavs.clone(),
            users: trajectory.users.iter().filter_map(|path| path.first().copied()).collect(),
            transmission_range: comparison.env.transmission_range,
            note: format!("Layout {index} of {} (seed {seed}).", comparison.layouts.name),
        };
        let aoi = policy.evaluation.episodes.get(index).map_or(f64::NAN, |e| e.mean_aoi);
        ReportPlot {
            file: format!("flight-{}-{}.svg", i + 1, file_name(&policy.name)),
            caption: format!("{}: mean AoI {aoi:.2} on this layout.", policy.name),
            svg: plot::trajectories(&policy.name, &paths),
        }
    });
    let note = if comparison.env.user_speed > 0.0 { " Users are shown at their start positions." } else { "" };
    ReportSection {
        title: format!("Trajectories on layout {index}"),
        text: format!(
            "The paths of the UAVs on layout {index} of {} (seed {seed}), in all slots.{note}",
            comparison.layouts.name
        ),
        table: None,
        plots: plots.collect(),
    }
}

fn bar(evaluation: &PolicyEvaluation, interval: Interval) -> Bar {
    Bar { name: evaluation.name.clone(), mean: interval.mean, low: interval.low, high: interval.high }
}

/// A row of names and their difference.
fn difference_row<const N: usize>(names: [&String; N], difference: &Difference) -> Vec<String> {
    names.into_iter().cloned().chain(difference_cells(&difference.mean_aoi, difference.wins)).collect()
}

/// `name` as part of a file name on every system.
fn file_name(name: &str) -> String {
    let last = name.rsplit(['/', '\\']).next().unwrap_or(name);
    last.chars().take(40).map(|c| if c.is_ascii_alphanumeric() { c } else { '-' }).collect()
}
