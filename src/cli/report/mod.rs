//! The report of an evaluation (spec 7) as files: a page, the same as Markdown, the figures, the numbers as JSON.
//!
//! What it says is here; how a page or Markdown spells it is in `render`. Nothing of this machine gets into it but what was
//! typed on the command line.

mod render;

use std::fs;
use std::path::Path;

use super::comparison::{Comparison, Pair, PolicyEvaluation};
use crate::experiment::{difference_cells, metric_cells};
use crate::learner::{Difference, Interval};
use crate::plot::{self, Bar, Chart, Series, Trajectories};
use render::{ReportPage, ReportPlot, ReportSection, ReportTable};

/// Writes `index.html`, `report.md`, `report.json` and the figures into `directory`, which is made where it is missing;
/// files of these names are replaced.
///
/// # Errors
/// The directory or a file cannot be written.
pub fn write(directory: &Path, comparison: &Comparison, command: &str) -> anyhow::Result<()> {
    let page = page(comparison, command)?;
    fs::create_dir_all(directory)?;
    for figure in page.sections.iter().flat_map(|s| &s.plots) {
        fs::write(directory.join(&figure.file), &figure.svg)?;
    }
    fs::write(directory.join("index.html"), render::html(&page))?;
    fs::write(directory.join("report.md"), render::markdown(&page))?;
    fs::write(directory.join("report.json"), serde_json::to_string_pretty(&comparison.json()?)? + "\n")?;
    Ok(())
}

fn page(comparison: &Comparison, command: &str) -> anyhow::Result<ReportPage> {
    let flown = comparison.best_first();
    let mut sections = vec![conditions(comparison), policies(&flown)];
    for name in Comparison::REFERENCES {
        sections.extend(gaps(name, &comparison.gaps(name)?));
    }
    sections.extend(pairs(&comparison.pairs()?));
    sections.push(over_slots(&flown));
    sections.push(over_layouts(&flown));
    sections.push(flights(comparison, &flown));
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
        row("users", if env.user_speed > 0.0 { format!("walk {} per slot", env.user_speed) } else { "stay".to_owned() }),
        row("lost UAV", disturbance.lose.map_or_else(|| "none".to_owned(), |l| format!("UAV {} from slot {} on", l.uav, l.slot))),
        row(
            "error of the positions seen",
            if disturbance.position_noise > 0.0 {
                format!("Gaussian, standard deviation {}", disturbance.position_noise)
            } else {
                "none".to_owned()
            },
        ),
    ];
    ReportSection {
        title: "What was flown".to_owned(),
        text: "Every policy flew the same layouts. Lengths are in units of the square's side; the age of information (AoI) is \
               in slots, and less is fresher."
            .to_owned(),
        table: Some(ReportTable { header: vec!["condition".to_owned(), "value".to_owned()], rows, numbers_from: 2 }),
        plots: Vec::new(),
    }
}

fn policies(flown: &[&PolicyEvaluation]) -> ReportSection {
    let header = ["policy", "mean AoI", "95 % interval", "p95 AoI", "peak AoI", "coverage", "fairness"];
    let rows = flown.iter().map(|f| {
        let name = if f.reference { format!("{} (reference)", f.name) } else { f.name.clone() };
        std::iter::once(name).chain(metric_cells(&f.summary.mean_aoi, &f.summary.mean)).collect()
    });
    let bars: Vec<Bar> = flown.iter().map(|f| bar(f, f.summary.mean_aoi)).collect();
    ReportSection {
        title: "Policies, the freshest first".to_owned(),
        text: "Means over layouts; the interval of the mean AoI is a 95 % bootstrap interval. p95 and peak are over the users \
               and slots of an episode, coverage is the share of users ever visited, fairness is Jain's index of the users' \
               mean AoI. References flew only to be compared with; `tour` is a planner that knows everything, not a bound."
            .to_owned(),
        table: Some(ReportTable { header: header.map(str::to_owned).to_vec(), rows: rows.collect(), numbers_from: 1 }),
        plots: vec![ReportPlot {
            file: "means.svg".to_owned(),
            caption: "Mean AoI with its 95 % interval.".to_owned(),
            svg: plot::bars("Mean AoI", "mean AoI (slots)", &bars),
        }],
    }
}

/// Nothing when the reference did not fly, or nobody else did.
fn gaps(name: &str, gaps: &[Pair]) -> Option<ReportSection> {
    let others = gaps.iter().filter(|(f, reference, _)| f.name != reference.name);
    let rows: Vec<Vec<String>> = others.map(|(f, _, d)| difference_row([&f.name], d)).collect();
    if rows.is_empty() {
        return None;
    }
    // The reference keeps its bar, of length 0, so that every policy keeps its colour.
    let bars: Vec<Bar> = gaps.iter().map(|(f, _, d)| bar(f, d.mean_aoi)).collect();
    let header = ["policy", "gap", "95 % interval", "better on"];
    Some(ReportSection {
        title: format!("Gap to {name}"),
        text: format!(
            "Mean AoI of the policy minus that of {name} on the same layout, averaged over layouts: negative where the policy \
             is better."
        ),
        table: Some(ReportTable { header: header.map(str::to_owned).to_vec(), rows, numbers_from: 1 }),
        plots: vec![ReportPlot {
            file: format!("gap-{name}.svg"),
            caption: format!("Gap to {name} with its 95 % interval."),
            svg: plot::bars(&format!("Gap to {name}"), &format!("mean AoI minus that of {name} (slots)"), &bars),
        }],
    })
}

/// Nothing when only one policy was asked for.
fn pairs(pairs: &[Pair]) -> Option<ReportSection> {
    let rows: Vec<_> = pairs.iter().map(|(a, b, d)| difference_row([&a.name, &b.name], d)).collect();
    let header = ["first", "second", "first minus second", "95 % interval", "first better on"];
    (!rows.is_empty()).then(|| ReportSection {
        title: "Every pair".to_owned(),
        text: "Paired differences of mean AoI on the same layouts. Where the interval holds 0, these layouts do not tell which \
               is better."
            .to_owned(),
        table: Some(ReportTable { header: header.map(str::to_owned).to_vec(), rows, numbers_from: 2 }),
        plots: Vec::new(),
    })
}

fn over_slots(flown: &[&PolicyEvaluation]) -> ReportSection {
    let series = flown.iter().map(|f| {
        let points = f.evaluation.aoi.iter().enumerate().map(|(slot, &aoi)| [slot as f64, aoi]).collect();
        Series { name: f.name.clone(), points, band: None }
    });
    let chart = Chart {
        title: "AoI in the course of an episode".to_owned(),
        x: "slot".to_owned(),
        y: "mean AoI (slots)".to_owned(),
        series: series.collect(),
        markers: false,
    };
    ReportSection {
        title: "Over slots".to_owned(),
        text: "All data is fresh at slot 0. A curve that levels off keeps up with its users; one that keeps rising leaves some \
               of them alone."
            .to_owned(),
        table: None,
        plots: vec![ReportPlot {
            file: "aoi.svg".to_owned(),
            caption: "Mean AoI over users and layouts in every slot.".to_owned(),
            svg: plot::lines(&chart),
        }],
    }
}

fn over_layouts(flown: &[&PolicyEvaluation]) -> ReportSection {
    let values = |f: &&PolicyEvaluation| (f.name.clone(), f.evaluation.episodes.iter().map(|e| e.mean_aoi).collect());
    let series: Vec<(String, Vec<f64>)> = flown.iter().map(values).collect();
    ReportSection {
        title: "Over layouts".to_owned(),
        text: "A curve further left is better; a long tail to the right says that some layouts went badly.".to_owned(),
        table: None,
        plots: vec![ReportPlot {
            file: "distribution.svg".to_owned(),
            caption: "Share of layouts whose mean AoI is at most that of the x axis.".to_owned(),
            svg: plot::distribution("Distribution over layouts", "mean AoI of a layout (slots)", &series),
        }],
    }
}

fn flights(comparison: &Comparison, flown: &[&PolicyEvaluation]) -> ReportSection {
    let seed = flown.first().map_or(0, |f| f.evaluation.trajectory.seed);
    let index = seed.saturating_sub(comparison.layouts.first) as usize;
    let figures = flown.iter().enumerate().map(|(i, f)| {
        let trajectory = &f.evaluation.trajectory;
        let flight = Trajectories {
            uavs: trajectory.uavs.clone(),
            users: trajectory.users.iter().filter_map(|path| path.first().copied()).collect(),
            transmission_range: comparison.env.transmission_range,
        };
        let aoi = f.evaluation.episodes.get(index).map_or(f64::NAN, |e| e.mean_aoi);
        ReportPlot {
            file: format!("flight-{}-{}.svg", i + 1, file_name(&f.name)),
            caption: format!("{}: mean AoI {aoi:.2} on this layout.", f.name),
            svg: plot::trajectories(&f.name, &flight),
        }
    });
    let walking = if comparison.env.user_speed > 0.0 { " Users are drawn where they start." } else { "" };
    ReportSection {
        title: format!("Flights on layout {index}"),
        text: format!("What each fleet flew on layout {index} of {} (seed {seed}), all slots.{walking}", comparison.layouts.name),
        table: None,
        plots: figures.collect(),
    }
}

fn bar(flown: &PolicyEvaluation, interval: Interval) -> Bar {
    Bar { name: flown.name.clone(), mean: interval.mean, low: interval.low, high: interval.high }
}

/// A row of names and their difference.
fn difference_row<const N: usize>(names: [&String; N], difference: &Difference) -> Vec<String> {
    names.into_iter().cloned().chain(difference_cells(&difference.mean_aoi, difference.wins)).collect()
}

/// `name` as a part of a file's name that every system takes.
fn file_name(name: &str) -> String {
    let last = name.rsplit(['/', '\\']).next().unwrap_or(name);
    last.chars().take(40).map(|c| if c.is_ascii_alphanumeric() { c } else { '-' }).collect()
}
