//! What a sweep varies: the values of the fields of a training job.

use rand::RngExt;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};

use crate::invalid::{Invalid, InvalidKind, count_in_range, in_range};
use crate::rng;
use crate::train_config::field_name;

/// Most jobs of a sweep.
pub const MAX_JOBS: usize = 500;
/// Most seeds of a sweep.
pub(super) const MAX_SEEDS: u64 = 100;

/// Values of fields, by the path of the field: `algorithm`, `training.learning_rate`.
pub type Point = Map<String, Value>;

/// What a sweep varies; exactly one of `grid`, `list` and `random` is given.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SweepRequest {
    /// Values of each field; all combinations are tried.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub grid: Option<Map<String, Value>>,
    /// The combinations themselves.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub list: Option<Vec<Point>>,
    /// Combinations that are drawn.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub random: Option<RandomSweep>,
    /// Number of seeds of each combination, from the seed of the job on; default: 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub seeds: Option<u64>,
}

/// Combinations that are drawn.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RandomSweep {
    /// Number of combinations.
    pub samples: u64,
    /// Seed of the draw; default: 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub seed: Option<u64>,
    /// What each field is drawn from: a list of values, or a range `{low, high, log, integer}`.
    pub fields: Map<String, Value>,
}

/// A range that numbers are drawn from.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Range {
    low: f64,
    high: f64,
    /// Draws the logarithm uniformly.
    #[serde(default)]
    log: bool,
    /// Draws whole numbers.
    #[serde(default)]
    integer: bool,
}

impl SweepRequest {
    /// The combinations in their order.
    ///
    /// # Errors
    /// The first field that is not accepted.
    pub(super) fn points(&self) -> Result<Vec<Point>, Invalid> {
        let given = [("grid", self.grid.is_some()), ("list", self.list.is_some()), ("random", self.random.is_some())];
        let mut given = given.into_iter().filter_map(|(name, given)| given.then_some(name));
        if let (Some(first), Some(second)) = (given.next(), given.next()) {
            let value = format!("a value beside sweep.{first}");
            return Err(Invalid::new(format!("sweep.{second}"), value, "exactly one of grid, list and random"));
        }
        match (&self.grid, &self.list, &self.random) {
            (Some(grid), ..) => grid_points(grid),
            (_, Some(list), _) => list_points(list),
            (.., Some(random)) => random.points(),
            _ => Err(Invalid::missing("sweep.grid", "exactly one of grid, list and random")),
        }
    }

    /// An error of the job at `point`, the combination `i`, with the field as this request names it.
    pub fn named_as_requested(&self, i: usize, point: &Point, error: Invalid) -> Invalid {
        let found = point.iter().find_map(|(path, value)| Some((path, value, rest_within(&error.field, path)?)));
        // A field that the sweep does not vary has the name that it has in the request.
        let Some((path, value, rest)) = found else { return error };
        let values = self.grid.as_ref().and_then(|grid| grid.get(path)?.as_array());
        let at = values.and_then(|values| values.iter().position(|v| v == value));
        let field = match at {
            Some(_) if error.kind == InvalidKind::UnknownField && rest.is_empty() => format!("sweep.grid.{path}"),
            Some(at) => format!("sweep.grid.{path}[{at}]{rest}"),
            None if self.list.is_some() => format!("sweep.list[{i}].{path}{rest}"),
            None => format!("sweep.random.fields.{path}{rest}"),
        };
        Invalid { field, ..error }
    }
}

/// What of `field` follows `path`, which may have a symbol of the paper; `None`: another field.
fn rest_within<'a>(field: &'a str, path: &str) -> Option<&'a str> {
    let name = path.split_once('.').map(|(section, name)| format!("{section}.{}", field_name(name)));
    let rest = field.strip_prefix(path).or_else(|| field.strip_prefix(name?.as_str()))?;
    (rest.is_empty() || rest.starts_with(['.', '['])).then_some(rest)
}

/// The values of a field of a grid.
fn choices<'a>(field: &str, values: &'a Value) -> Result<&'a Vec<Value>, Invalid> {
    let invalid = || Invalid::schema(field, values, "a list of at least one value");
    values.as_array().filter(|values| !values.is_empty()).ok_or_else(invalid)
}

/// The place of the first item that is equal to one before it. Its jobs would be equal, too.
fn repeated<T: PartialEq>(items: &[T]) -> Option<usize> {
    (1..items.len()).find(|&i| items[..i].contains(&items[i]))
}

fn grid_points(grid: &Map<String, Value>) -> Result<Vec<Point>, Invalid> {
    if grid.is_empty() {
        return Err(Invalid::new("sweep.grid", "no field", "the values of at least one field"));
    }
    let mut points = vec![Point::new()];
    for (field, values) in grid {
        let path = format!("sweep.grid.{field}");
        let values = choices(&path, values)?;
        count_in_range("sweep.grid", points.len().saturating_mul(values.len()), 1..=MAX_JOBS, "combinations")?;
        if let Some(i) = repeated(values) {
            return Err(Invalid::new(format!("{path}[{i}]"), &values[i], "each value once"));
        }
        let with = |point: &Point, value: &Value| {
            let mut point = point.clone();
            point.insert(field.clone(), value.clone());
            point
        };
        points = points.iter().flat_map(|point| values.iter().map(move |value| with(point, value))).collect();
    }
    Ok(points)
}

fn list_points(list: &[Point]) -> Result<Vec<Point>, Invalid> {
    count_in_range("sweep.list", list.len(), 1..=MAX_JOBS, "combinations")?;
    if let Some(i) = list.iter().position(Map::is_empty) {
        return Err(Invalid::new(format!("sweep.list[{i}]"), "no field", "the value of at least one field"));
    }
    if let Some(i) = repeated(list) {
        return Err(Invalid::new(format!("sweep.list[{i}]"), Value::Object(list[i].clone()), "each combination once"));
    }
    Ok(list.to_vec())
}

impl RandomSweep {
    /// The combinations that are drawn, each once.
    fn points(&self) -> Result<Vec<Point>, Invalid> {
        in_range("sweep.random.samples", self.samples, 1..=MAX_JOBS as u64)?;
        if self.fields.is_empty() {
            return Err(Invalid::new("sweep.random.fields", "no field", "what at least one field is drawn from"));
        }
        let draw = |sample| {
            let mut draw = rng::stream(self.seed.unwrap_or(1), "sweep", sample);
            let values = self.fields.iter().map(|(field, from)| -> Result<_, Invalid> {
                let path = format!("sweep.random.fields.{field}");
                let value = match from {
                    Value::Array(_) => {
                        let values = choices(&path, from)?;
                        values[draw.random_range(0..values.len())].clone()
                    }
                    range => Range::parse(&path, range)?.value(draw.random()),
                };
                Ok((field.clone(), value))
            });
            values.collect::<Result<Point, Invalid>>()
        };
        let mut points = Vec::new();
        for sample in 0..self.samples {
            let point = draw(sample)?;
            // Few values are drawn more than once; the jobs would be equal.
            if !points.contains(&point) {
                points.push(point);
            }
        }
        Ok(points)
    }
}

impl Range {
    fn parse(field: &str, range: &Value) -> Result<Self, Invalid> {
        let expected = "a list of values, or {low, high} with low < high, and low > 0 with log";
        let read = Self::deserialize(range).map_err(|_| Invalid::schema(field, range, expected))?;
        let ordered = read.low < read.high && (!read.log || read.low > 0.0);
        if ordered { Ok(read) } else { Err(Invalid::new(field, range, expected)) }
    }

    /// The value at the place `x` of the range, which is from 0 to 1.
    fn value(self, x: f64) -> Value {
        let Self { low, high, log, integer } = self;
        let value = if log { (low.ln() + x * (high.ln() - low.ln())).exp() } else { low + x * (high - low) };
        let value = value.clamp(low, high);
        if integer { json!(value.round() as i64) } else { json!(value) }
    }
}

/// The fields of a job that a sweep may vary, besides those of `environment` and `training`.
const FIELDS: [&str; 3] = ["algorithm", "preset", "threads"];

/// The request of a job at `point`.
pub(super) fn request_at(base: &Map<String, Value>, point: &Point) -> Result<Map<String, Value>, Invalid> {
    let mut request = base.clone();
    for (path, value) in point {
        match path.split_once('.') {
            None if FIELDS.contains(&path.as_str()) => drop(request.insert(path.clone(), value.clone())),
            Some((section @ ("environment" | "training"), field)) => {
                let section = request.entry(section).or_insert_with(|| json!({}));
                section[field] = value.clone();
            }
            _ => {
                let expected = format!("{}, environment.FIELD or training.FIELD", FIELDS.join(", "));
                return Err(Invalid::unknown_field(path.as_str(), expected));
            }
        }
    }
    Ok(request)
}
