//! Resolves a document into runs: every series at every point with every seed.
//!
//! The whole document is checked before the first run starts, so that a mistake in the last series is found at once.

use std::collections::HashSet;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::settings::{Overrides, RunSettings, TableReader};
use crate::checkpoint;
use crate::env::EnvConfig;
use crate::invalid::{Invalid, in_range};
use crate::learner::layout_list;
use crate::policy::baselines;
use crate::train_config::TrainConfig;

/// The kind of plot of an experiment.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PlotKind {
    /// Mean AoI on the validation layouts against environment steps, one curve per series.
    Convergence,
    /// Mean AoI against the points' `x`, one curve per series.
    Parameter,
    /// Trajectories of the fleet, one plot per series and point.
    Trajectories,
}

/// A point: settings that the experiment varies besides the series.
#[derive(Clone, Debug, PartialEq)]
pub struct ExperimentPoint {
    /// Its name; empty if the experiment has no points.
    pub name: String,
    /// Its position on the x axis.
    pub x: f64,
    /// The environment of the baselines: the settings of `run` and of this point.
    pub environment: EnvConfig,
}

/// One training run.
#[derive(Clone, Debug, PartialEq)]
pub struct Run {
    /// Index of its series.
    pub series: usize,
    /// Index of its point.
    pub point: usize,
    /// Name of its folder: series, point, seed, and the beginning of the digest of its configuration.
    pub folder: String,
    /// The configuration.
    pub config: TrainConfig,
}

/// A resolved experiment.
#[derive(Clone, Debug, PartialEq)]
pub struct Experiment {
    /// Title.
    pub title: String,
    /// Kind of plot.
    pub plot: PlotKind,
    /// Label of the x axis of `parameter`.
    pub x: String,
    /// Seeds of the runs.
    pub seeds: Vec<u64>,
    /// Name of the frozen list of layouts that the results are for.
    pub layouts: String,
    /// The episode seeds of its layouts; the first `episodes` of the list.
    pub layout_seeds: Vec<u64>,
    /// Names of the baselines to compare with.
    pub baselines: Vec<String>,
    /// Names of the series.
    pub series: Vec<String>,
    /// The points; one without a name if the document has none.
    pub points: Vec<ExperimentPoint>,
    /// All runs, ordered by seed, then point, then series, so that every series has a result early.
    pub runs: Vec<Run>,
}

const FIELDS: [&str; 10] = ["title", "figure", "x", "seeds", "layouts", "episodes", "baselines", "run", "series", "points"];

impl Experiment {
    /// Resolves a document.
    ///
    /// # Errors
    /// [`Invalid`] for the first field that is unknown, of the wrong type or out of range; the field includes its table, as in
    /// `series[1].training.batch`.
    pub fn resolve(document: Value, overrides: &Overrides) -> Result<Self, Invalid> {
        let mut top = TableReader::new("", document, &FIELDS)?;
        let title = top.name("title")?;
        let plot = top.required("figure", "convergence, parameter or trajectories")?;
        let seeds = match &overrides.seeds {
            Some(seeds) => seeds.clone(),
            None => first_seeds(top.optional("seeds")?.unwrap_or_else(|| vec![1]), overrides.num_seeds),
        };
        distinct("seeds", &seeds)?;
        let list = layout_list(&top.optional::<String>("layouts")?.unwrap_or_else(|| "eval-v1".into()))?;
        let episodes = top.optional("episodes")?.unwrap_or(256.min(list.episodes as usize));
        in_range("episodes", episodes, 1..=list.episodes as usize)?;
        let (layouts, layout_seeds) = (list.name.to_owned(), list.seeds(episodes));
        let baselines: Vec<String> = top.optional("baselines")?.unwrap_or_default();
        for (i, name) in baselines.iter().enumerate() {
            if !baselines::LIST.iter().any(|b| b.name == name) {
                let known: Vec<_> = baselines::LIST.iter().map(|b| b.name).collect();
                return Err(Invalid::new(format!("baselines[{i}]"), format!("{name:?}"), format!("one of {}", known.join(", "))));
            }
        }
        let run = top.optional("run")?.map_or(Ok(RunSettings::default()), |value| {
            RunSettings::read(&mut TableReader::new("run", value, &RunSettings::FIELDS)?)
        })?;
        let series = select("series", named_settings(&mut top, "series", &[])?, &overrides.series)?;
        if series.is_empty() {
            return Err(Invalid::missing("series", "at least one [[series]] table"));
        }
        let mut points = select("points", named_settings(&mut top, "points", &["x"])?, &overrides.points)?;
        if points.is_empty() {
            points.push(NamedSettings { name: String::new(), x: Some(0.0), settings: RunSettings::default() });
        }
        let x = top.optional("x")?.unwrap_or_default();
        let overriding = RunSettings::overrides(overrides);
        for (i, point) in points.iter().enumerate() {
            if let Some((field, value)) = point.settings.field_in_common(&overriding) {
                let expected = format!("a field that no point sets; points[{i}] sets it, so all points would be the same");
                return Err(Invalid::new(format!("{}{field}", overrides.origin), value, expected));
            }
        }

        let mut experiment_points = Vec::new();
        for (i, point) in points.iter().enumerate() {
            let x = match (point.x, plot) {
                (None, PlotKind::Parameter) => {
                    return Err(Invalid::missing_field(format!("points[{i}].x"), "the value on the x axis"));
                }
                (x, _) => x.unwrap_or(i as f64),
            };
            let shared = RunSettings::resolve(&[&run, &point.settings, &overriding], 1)?;
            experiment_points.push(ExperimentPoint { name: point.name.clone(), x, environment: shared.environment });
        }
        let mut runs = Vec::new();
        for &seed in &seeds {
            for (p, point) in points.iter().enumerate() {
                for (s, series) in series.iter().enumerate() {
                    let config = RunSettings::resolve(&[&run, &series.settings, &point.settings, &overriding], seed)?;
                    let folder = folder(&series.name, &point.name, &config);
                    runs.push(Run { series: s, point: p, folder, config });
                }
            }
        }
        let series: Vec<String> = series.into_iter().map(|row| row.name).collect();
        Ok(Self { title, plot, x, seeds, layouts, layout_seeds, baselines, series, points: experiment_points, runs })
    }

    /// The label of a run in logs: series, point, seed.
    pub fn label(&self, run: &Run) -> String {
        let names = [self.series[run.series].as_str(), self.points[run.point].name.as_str()];
        let names: Vec<&str> = names.into_iter().filter(|name| !name.is_empty()).collect();
        format!("{}, seed {}", names.join(", "), run.config.seed)
    }
}

/// A `[[series]]` or a `[[points]]` table.
struct NamedSettings {
    name: String,
    x: Option<f64>,
    settings: RunSettings,
}

fn named_settings(top: &mut TableReader, field: &str, more: &[&str]) -> Result<Vec<NamedSettings>, Invalid> {
    let tables: Vec<Value> = top.optional(field)?.unwrap_or_default();
    let known = [&["name"], more, &RunSettings::FIELDS].concat();
    let mut rows: Vec<NamedSettings> = Vec::new();
    for (i, value) in tables.into_iter().enumerate() {
        let mut table = TableReader::new(&format!("{field}[{i}]"), value, &known)?;
        let row = NamedSettings { name: table.name("name")?, x: table.optional("x")?, settings: RunSettings::read(&mut table)? };
        // Folders and plots are named after it.
        if rows.iter().any(|other| slug(&other.name) == slug(&row.name)) || slug(&row.name).is_empty() {
            return Err(Invalid::new(table.at("name"), format!("{:?}", row.name), "a distinct name with letters or digits"));
        }
        rows.push(row);
    }
    Ok(rows)
}

/// The rows with these names, in the order of the document; all rows if `names` is empty.
fn select(field: &str, rows: Vec<NamedSettings>, names: &[String]) -> Result<Vec<NamedSettings>, Invalid> {
    if let Some(unknown) = names.iter().find(|name| !rows.iter().any(|row| &row.name == *name)) {
        let known: Vec<_> = rows.iter().map(|row| row.name.as_str()).collect();
        return Err(Invalid::new(field, format!("{unknown:?}"), format!("one of {}", known.join("; "))));
    }
    Ok(rows.into_iter().filter(|row| names.is_empty() || names.contains(&row.name)).collect())
}

/// The first `count` seeds, and the numbers that follow the largest if there are fewer; all seeds without a count.
fn first_seeds(mut seeds: Vec<u64>, count: Option<usize>) -> Vec<u64> {
    if let Some(count) = count {
        seeds.truncate(count);
        let largest = seeds.iter().max().copied().unwrap_or(0);
        let missing = (count - seeds.len()) as u64;
        seeds.extend((1..=missing).map(|k| largest.saturating_add(k)));
    }
    seeds
}

fn distinct(field: &str, seeds: &[u64]) -> Result<(), Invalid> {
    let mut seen = HashSet::new();
    if seeds.is_empty() {
        return Err(Invalid::missing(field, "at least one seed"));
    }
    match seeds.iter().find(|seed| !seen.insert(**seed)) {
        Some(twice) => Err(Invalid::new(field, format!("{twice} twice"), "distinct seeds")),
        None => Ok(()),
    }
}

/// `name` as part of a file name: lower case, words joined by `-`.
pub(super) fn slug(name: &str) -> String {
    let words = name.split(|c: char| !c.is_ascii_alphanumeric()).filter(|word| !word.is_empty());
    words.map(str::to_ascii_lowercase).collect::<Vec<_>>().join("-")
}

fn folder(series: &str, point: &str, config: &TrainConfig) -> String {
    let text = serde_json::to_string(config).expect("a configuration is plain data");
    let digest = checkpoint::digest(text.as_bytes());
    let parts = [slug(series), slug(point), format!("seed{}", config.seed), digest[..12].to_owned()];
    parts.into_iter().filter(|part| !part.is_empty()).collect::<Vec<_>>().join("_")
}
