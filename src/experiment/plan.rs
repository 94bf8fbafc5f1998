//! From a document to runs: every series at every point with every seed.
//!
//! What is checked here is checked before the first run begins, so that a mistake in the last series costs no hours.

use std::collections::HashSet;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::document::{Overrides, Section, Table};
use crate::checkpoint;
use crate::env::EnvConfig;
use crate::invalid::{Invalid, in_range};
use crate::learner::layouts;
use crate::policy::baselines;
use crate::recipe::TrainConfig;

/// What an experiment draws.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Figure {
    /// Mean AoI on the validation layouts against environment steps, one curve per series.
    Convergence,
    /// Mean AoI against the points' `x`, one curve per series.
    Parameter,
    /// What the fleet flies, a panel per series and point.
    Trajectories,
}

/// A value of what the experiment varies besides the series.
#[derive(Clone, Debug, PartialEq)]
pub struct Point {
    /// Its name; empty where the experiment has no points.
    pub name: String,
    /// Its place on the x axis.
    pub x: f64,
    /// The environment of the baselines: what all runs share, and this point.
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
    /// What is trained.
    pub config: TrainConfig,
}

/// An experiment, resolved.
#[derive(Clone, Debug, PartialEq)]
pub struct Experiment {
    /// What it is called.
    pub title: String,
    /// What it draws.
    pub figure: Figure,
    /// What the x axis of `parameter` shows.
    pub x: String,
    /// Seeds of the runs.
    pub seeds: Vec<u64>,
    /// Name of the frozen list that results are reported on.
    pub layouts: String,
    /// The episode seeds of its layouts, the first ones where the document asks for fewer than all.
    pub layout_seeds: Vec<u64>,
    /// Policies that are not learned, flown for reference.
    pub baselines: Vec<String>,
    /// Names of the series.
    pub series: Vec<String>,
    /// The points; one without a name where the document has none.
    pub points: Vec<Point>,
    /// All runs, seed by seed, so that every series has results early.
    pub runs: Vec<Run>,
}

const FIELDS: [&str; 10] = ["title", "figure", "x", "seeds", "layouts", "episodes", "baselines", "run", "series", "points"];

impl Experiment {
    /// The experiment that a document describes.
    ///
    /// # Errors
    /// The first field that is unknown, of the wrong type or out of range, named with its table: `series[1].training.batch`.
    pub fn resolve(document: Value, overrides: &Overrides) -> Result<Self, Invalid> {
        let mut top = Table::new("", document, &FIELDS)?;
        let title = top.name("title")?;
        let figure = top.required("figure", "convergence, parameter or trajectories")?;
        let seeds = match &overrides.seeds {
            Some(seeds) => seeds.clone(),
            None => top.optional("seeds")?.unwrap_or_else(|| vec![1]),
        };
        distinct("seeds", &seeds)?;
        let list = layouts(&top.optional::<String>("layouts")?.unwrap_or_else(|| "eval-v1".into()))?;
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
        let run = top
            .optional("run")?
            .map_or(Ok(Section::default()), |value| Section::read(&mut Table::new("run", value, &Section::FIELDS)?))?;
        let series = only("series", rows(&mut top, "series", &[])?, &overrides.series)?;
        if series.is_empty() {
            return Err(Invalid::missing("series", "at least one [[series]] table"));
        }
        let mut points = only("points", rows(&mut top, "points", &["x"])?, &overrides.points)?;
        if points.is_empty() {
            points.push(Row { name: String::new(), x: Some(0.0), section: Section::default() });
        }
        let x = top.optional("x")?.unwrap_or_default();
        let over = Section::overrides(overrides);

        let mut places = Vec::new();
        for (i, point) in points.iter().enumerate() {
            let x = match (point.x, figure) {
                (None, Figure::Parameter) => {
                    return Err(Invalid::missing_field(format!("points[{i}].x"), "the value on the x axis"));
                }
                (x, _) => x.unwrap_or(i as f64),
            };
            let shared = Section::resolve(&[&run, &point.section, &over], 1)?;
            places.push(Point { name: point.name.clone(), x, environment: shared.environment });
        }
        let mut runs = Vec::new();
        for &seed in &seeds {
            for (p, point) in points.iter().enumerate() {
                for (s, series) in series.iter().enumerate() {
                    let config = Section::resolve(&[&run, &series.section, &point.section, &over], seed)?;
                    let folder = folder(&series.name, &point.name, &config);
                    runs.push(Run { series: s, point: p, folder, config });
                }
            }
        }
        let series: Vec<String> = series.into_iter().map(|row| row.name).collect();
        Ok(Self { title, figure, x, seeds, layouts, layout_seeds, baselines, series, points: places, runs })
    }

    /// What a run is called where people read: series, point, seed.
    pub fn label(&self, run: &Run) -> String {
        let names = [self.series[run.series].as_str(), self.points[run.point].name.as_str()];
        let names: Vec<&str> = names.into_iter().filter(|name| !name.is_empty()).collect();
        format!("{}, seed {}", names.join(", "), run.config.seed)
    }
}

/// A `[[series]]` or a `[[points]]`.
struct Row {
    name: String,
    x: Option<f64>,
    section: Section,
}

fn rows(top: &mut Table, field: &str, more: &[&str]) -> Result<Vec<Row>, Invalid> {
    let tables: Vec<Value> = top.optional(field)?.unwrap_or_default();
    let known = [&["name"], more, &Section::FIELDS].concat();
    let mut rows: Vec<Row> = Vec::new();
    for (i, value) in tables.into_iter().enumerate() {
        let mut table = Table::new(&format!("{field}[{i}]"), value, &known)?;
        let row = Row { name: table.name("name")?, x: table.optional("x")?, section: Section::read(&mut table)? };
        // Folders and figures are named after it.
        if rows.iter().any(|other| slug(&other.name) == slug(&row.name)) || slug(&row.name).is_empty() {
            return Err(Invalid::new(table.at("name"), format!("{:?}", row.name), "a distinct name with letters or digits"));
        }
        rows.push(row);
    }
    Ok(rows)
}

/// The rows with these names, in the document's order; all where no name is given.
fn only(field: &str, rows: Vec<Row>, names: &[String]) -> Result<Vec<Row>, Invalid> {
    if let Some(unknown) = names.iter().find(|name| !rows.iter().any(|row| &row.name == *name)) {
        let known: Vec<_> = rows.iter().map(|row| row.name.as_str()).collect();
        return Err(Invalid::new(field, format!("{unknown:?}"), format!("one of {}", known.join("; "))));
    }
    Ok(rows.into_iter().filter(|row| names.is_empty() || names.contains(&row.name)).collect())
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

/// A name as part of a file's name: lower case, words joined by `-`.
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
