//! Resolves a document into runs: every series at every point with every seed.
//!
//! The whole document is checked before the first run starts, so that a mistake in the last series is found at once.

use std::collections::{HashMap, HashSet};

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::settings::{Overrides, RunSettings, TableReader};
use super::slugs::slugs;
use crate::checkpoint;
use crate::env::EnvConfig;
use crate::invalid::{Invalid, in_range};
use crate::learner::layout_list;
use crate::policy::baselines;
use crate::train_config::{TrainConfig, floats_to_integers};

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

/// The x axis of `parameter`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum XScale {
    /// Equal differences are equally far from each other.
    #[default]
    Linear,
    /// Equal factors are equally far from each other, as of learning rates.
    Log,
}

/// A point: settings that the experiment varies besides the series.
#[derive(Clone, Debug, PartialEq)]
pub struct ExperimentPoint {
    /// Its name; empty if the experiment has no points.
    pub name: String,
    /// Its name as a part of file names, different from that of other points.
    pub slug: String,
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
    /// Scale of the x axis of `parameter`.
    pub x_scale: XScale,
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
    /// Their names as parts of file names, all different.
    pub series_slugs: Vec<String>,
    /// The points; one without a name if the document has none.
    pub points: Vec<ExperimentPoint>,
    /// All runs, ordered by seed, then point, then series, so that every series has a result early.
    pub runs: Vec<Run>,
}

const FIELDS: [&str; 11] =
    ["title", "figure", "x", "x_scale", "seeds", "layouts", "episodes", "baselines", "run", "series", "points"];

impl Experiment {
    /// Resolves a document.
    ///
    /// # Errors
    /// [`Invalid`] for the first field that is unknown, of the wrong type or out of range; the field includes its table, as in
    /// `series[1].training.batch`.
    pub fn resolve(mut document: Value, overrides: &Overrides) -> Result<Self, Invalid> {
        // Whole numbers may be written as 4e5. Fields that are no integers are the same either way.
        floats_to_integers(&mut document);
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
            points.push(NamedSettings {
                name: String::new(),
                slug: String::new(),
                x: Some(0.0),
                settings: RunSettings::default(),
            });
        }
        let x = top.optional("x")?.unwrap_or_default();
        let x_scale: XScale = top.optional("x_scale")?.unwrap_or_default();
        if x_scale == XScale::Log && plot != PlotKind::Parameter {
            return Err(Invalid::new("x_scale", "\"log\"", "no value, because figure is not parameter"));
        }
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
                (Some(x), PlotKind::Parameter) if x_scale == XScale::Log && x <= 0.0 => {
                    return Err(Invalid::new(format!("points[{i}].x"), x, "a number above 0, because x_scale is log"));
                }
                (x, _) => x.unwrap_or(i as f64),
            };
            let shared = RunSettings::resolve(&[&run, &point.settings, &overriding], 1)?;
            experiment_points.push(ExperimentPoint {
                name: point.name.clone(),
                slug: point.slug.clone(),
                x,
                environment: shared.environment,
            });
        }
        let mut runs = Vec::new();
        for &seed in &seeds {
            for (p, point) in points.iter().enumerate() {
                for (s, series) in series.iter().enumerate() {
                    let config = RunSettings::resolve(&[&run, &series.settings, &point.settings, &overriding], seed)?;
                    let folder = folder(&series.slug, &point.slug, &config);
                    runs.push(Run { series: s, point: p, folder, config });
                }
            }
        }
        Rows { run: &run, series: &series, points: &points, overriding: &overriding }.check_different(&runs)?;
        let (series, series_slugs) = series.into_iter().map(|row| (row.name, row.slug)).unzip();
        Ok(Self {
            title,
            plot,
            x,
            x_scale,
            seeds,
            layouts,
            layout_seeds,
            baselines,
            series,
            series_slugs,
            points: experiment_points,
            runs,
        })
    }

    /// The label of a run in logs: series, point, seed.
    pub fn label(&self, run: &Run) -> String {
        let names = [self.series[run.series].as_str(), self.points[run.point].name.as_str()];
        let names: Vec<&str> = names.into_iter().filter(|name| !name.is_empty()).collect();
        format!("{}, seed {}", names.join(", "), run.config.seed)
    }
}

/// The settings of all runs.
struct Rows<'a> {
    run: &'a RunSettings,
    series: &'a [NamedSettings],
    points: &'a [NamedSettings],
    overriding: &'a RunSettings,
}

impl Rows<'_> {
    /// Checks that no two runs of a seed have the same configuration: a comparison of a run with itself says nothing.
    fn check_different(&self, runs: &[Run]) -> Result<(), Invalid> {
        let mut seen: HashMap<String, &Run> = HashMap::new();
        for run in runs.iter().take(self.series.len() * self.points.len()) {
            let text = serde_json::to_string(&run.config).expect("a configuration is plain data");
            if let Some(other) = seen.insert(text, run) {
                return Err(self.same(other, run)?);
            }
        }
        Ok(())
    }

    /// The error of two runs with the same configuration.
    fn same(&self, one: &Run, other: &Run) -> Result<Invalid, Invalid> {
        let plain = |run: &Run| {
            let settings = [self.run, &self.series[run.series].settings, &self.points[run.point].settings];
            RunSettings::resolve(&settings, run.config.seed)
        };
        let (field, rows, i, j) = if one.series == other.series {
            ("points", self.points, one.point, other.point)
        } else {
            ("series", self.series, one.series, other.series)
        };
        let [first, second] = [&rows[i], &rows[j]];
        let in_common = || [second, first].into_iter().find_map(|row| row.settings.field_in_common(self.overriding));
        if plain(one)? != plain(other)?
            && let Some((set, value)) = in_common()
        {
            let expected = format!(
                "a field that no {field} set; it would make {:?} and {:?} the same, so run only one of them",
                first.name, second.name
            );
            return Ok(Invalid::new(format!("{}{set}", self.overriding.prefix()), value, expected));
        }
        let same = format!("{:?}, with the settings of {:?}", second.name, first.name);
        Ok(Invalid::new(field, same, "different settings of each"))
    }
}

/// A `[[series]]` or a `[[points]]` table.
struct NamedSettings {
    name: String,
    /// Its part of file names.
    slug: String,
    x: Option<f64>,
    settings: RunSettings,
}

fn named_settings(top: &mut TableReader, field: &str, more: &[&str]) -> Result<Vec<NamedSettings>, Invalid> {
    let tables: Vec<Value> = top.optional(field)?.unwrap_or_default();
    let known = [&["name"], more, &RunSettings::FIELDS].concat();
    let mut rows: Vec<NamedSettings> = Vec::new();
    for (i, value) in tables.into_iter().enumerate() {
        let mut table = TableReader::new(&format!("{field}[{i}]"), value, &known)?;
        let row = NamedSettings {
            name: table.name("name")?,
            slug: String::new(),
            x: table.optional("x")?,
            settings: RunSettings::read(&mut table)?,
        };
        if let Some(other) = rows.iter().position(|other| other.name == row.name) {
            let expected = format!("another name than {field}[{other}] has");
            return Err(Invalid::new(table.at("name"), format!("{:?}", row.name), expected));
        }
        rows.push(row);
    }
    let names: Vec<&str> = rows.iter().map(|row| row.name.as_str()).collect();
    // Of all rows, so that a row has the same files when only some rows are run.
    for (i, slug) in slugs(field, &names).into_iter().enumerate() {
        rows[i].slug = slug;
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

fn folder(series: &str, point: &str, config: &TrainConfig) -> String {
    let text = serde_json::to_string(config).expect("a configuration is plain data");
    let digest = checkpoint::digest(text.as_bytes());
    let parts = [series.to_owned(), point.to_owned(), format!("seed{}", config.seed), digest[..12].to_owned()];
    parts.into_iter().filter(|part| !part.is_empty()).collect::<Vec<_>>().join("_")
}
