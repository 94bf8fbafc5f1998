//! Sweeps: one job that makes many, over values of the fields of a training job and over seeds.

use rand::RngExt;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};

use super::spec::JobRequest;
use crate::invalid::{Invalid, in_range};
use crate::rng;
use crate::store::{JobKind, JobSpec};

/// Most jobs of a sweep.
pub const MAX_JOBS: usize = 500;
/// Most seeds of a sweep.
const MAX_SEEDS: u64 = 100;
/// Longest name of a sweep: the names of its jobs have a number at the end.
const MAX_NAME: usize = 58;

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

/// A sweep with its jobs.
#[derive(Clone, Debug, PartialEq)]
pub struct Sweep {
    /// The job of the sweep itself.
    pub spec: JobSpec,
    /// Its jobs: all seeds of the first combination, then of the next.
    pub jobs: Vec<JobSpec>,
}

impl SweepRequest {
    /// The combinations in their order.
    ///
    /// # Errors
    /// The first field that is not accepted.
    fn points(&self) -> Result<Vec<Point>, Invalid> {
        let points = match (&self.grid, &self.list, &self.random) {
            (Some(grid), None, None) => grid_points(grid)?,
            (None, Some(list), None) => list.clone(),
            (None, None, Some(random)) => random.points()?,
            _ => return Err(Invalid::missing("sweep.grid", "exactly one of grid, list and random")),
        };
        in_range("sweep.points", points.len(), 1..=MAX_JOBS)?;
        Ok(points)
    }
}

/// The values of a field of a grid.
fn choices<'a>(field: &str, values: &'a Value) -> Result<&'a Vec<Value>, Invalid> {
    let invalid = || Invalid::schema(field, values, "a list of at least one value");
    values.as_array().filter(|values| !values.is_empty()).ok_or_else(invalid)
}

fn grid_points(grid: &Map<String, Value>) -> Result<Vec<Point>, Invalid> {
    let mut points = vec![Point::new()];
    for (field, values) in grid {
        let values = choices(&format!("sweep.grid.{field}"), values)?;
        in_range("sweep.points", points.len().saturating_mul(values.len()), 1..=MAX_JOBS)?;
        let with = |point: &Point, value: &Value| {
            let mut point = point.clone();
            point.insert(field.clone(), value.clone());
            point
        };
        points = points.iter().flat_map(|point| values.iter().map(move |value| with(point, value))).collect();
    }
    Ok(points)
}

impl RandomSweep {
    fn points(&self) -> Result<Vec<Point>, Invalid> {
        in_range("sweep.random.samples", self.samples, 1..=MAX_JOBS as u64)?;
        let draw = |sample| {
            let mut draw = rng::stream(self.seed.unwrap_or(1), "sweep", sample);
            let values = self.fields.iter().map(|(field, from)| {
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
            values.collect()
        };
        (0..self.samples).map(draw).collect()
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
fn request_at(base: &Map<String, Value>, point: &Point) -> Result<Map<String, Value>, Invalid> {
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

/// The sweep of a request of this kind, with all of its jobs.
///
/// # Errors
/// The first field of the request, or of one of the jobs, that is not accepted.
pub fn resolve(mut request: JobRequest, cpu_budget: usize) -> Result<Sweep, Invalid> {
    let Some(sweep) = request.sweep.take() else {
        return Err(Invalid::missing("sweep", "what a job of the kind sweep varies"));
    };
    let points = sweep.points()?;
    let seeds = sweep.seeds.unwrap_or(1);
    in_range("sweep.seeds", seeds, 1..=MAX_SEEDS)?;
    in_range("sweep.points", points.len() as u64 * seeds, 1..=MAX_JOBS as u64)?;
    if let Some(name) = request.name.as_ref().filter(|name| name.len() > MAX_NAME) {
        return Err(Invalid::new("name", name, format!("at most {MAX_NAME} characters in a sweep")));
    }
    request.kind = None;
    let first_seed = request.seed.unwrap_or(1);
    let name = request.name.take();
    let Value::Object(base) = serde_json::to_value(&request).expect("a request is plain data") else {
        unreachable!("a request is an object")
    };
    let mut jobs = Vec::new();
    for (i, point) in points.iter().enumerate() {
        let at = |e: Invalid| e.with_prefix(&format!("sweep.points[{i}]"));
        let document = request_at(&base, point).map_err(at)?;
        for seed in 0..seeds {
            let mut request = JobRequest::from_json(Value::Object(document.clone())).map_err(at)?;
            let too_large = || Invalid::new("sweep.seeds", seeds, "seeds up to 18446744073709551615");
            request.seed = Some(first_seed.checked_add(seed).ok_or_else(too_large)?);
            request.name = name.as_ref().map(|name| format!("{name}-{:03}", jobs.len()));
            let spec = request.resolve(cpu_budget).map_err(at)?;
            jobs.push(JobSpec { point: Some(i as u64), ..spec });
        }
    }
    let first = jobs.first().expect("there is at least one combination and one seed");
    let work = jobs.iter().filter_map(|job| job.config.as_ref()).map(|config| config.training.steps).fold(0, u64::saturating_add);
    let document = json!({"points": points, "seeds": seeds});
    let spec = JobSpec { kind: JobKind::Sweep, name, config: None, sweep: Some(document), work, point: None, ..first.clone() };
    Ok(Sweep { spec, jobs })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn resolve_json(document: Value) -> Result<Sweep, Invalid> {
        resolve(JobRequest::from_json(document)?, 2)
    }

    #[test]
    fn a_grid_has_all_combinations_and_seeds() {
        let document = json!({
            "kind": "sweep", "name": "lr", "seed": 5, "training": {"steps": 1000},
            "sweep": {"grid": {"training.learning_rate": [0.001, 0.002], "algorithm": ["vdn", "qmix"]}, "seeds": 3},
        });
        let Sweep { spec, jobs } = resolve_json(document).unwrap();
        assert_eq!((spec.kind, spec.work, jobs.len()), (JobKind::Sweep, 12_000, 12));
        let configs: Vec<_> = jobs.iter().map(|job| job.config.clone().unwrap()).collect();
        assert_eq!(configs.iter().map(|config| config.seed).collect::<Vec<_>>(), [5, 6, 7].repeat(4));
        assert_eq!(configs[3].training.learning_rate, 0.002);
        assert_eq!((jobs[11].name.as_deref(), jobs[11].point), (Some("lr-011"), Some(3)));
        assert!(configs.iter().all(|config| config.training.steps == 1000));
    }

    #[test]
    fn random_combinations_are_in_their_ranges_and_always_the_same() {
        let document = json!({
            "sweep": {"random": {"samples": 50, "seed": 3, "fields": {
                "training.learning_rate": {"low": 1e-5, "high": 1e-2, "log": true},
                "environment.uavs": {"low": 1, "high": 4, "integer": true},
                "algorithm": ["vdn", "qmix"],
            }}},
        });
        let jobs = resolve_json(document.clone()).unwrap().jobs;
        assert_eq!(jobs, resolve_json(document).unwrap().jobs);
        let small = jobs.iter().filter(|job| job.config.as_ref().unwrap().training.learning_rate < 1e-3).count();
        assert!((20..50).contains(&small), "{small} of 50 learning rates are in the lower two decades of three");
        assert!(jobs.iter().all(|job| (1..=4).contains(&job.config.as_ref().unwrap().environment.uavs)));
    }

    #[test]
    fn invalid_sweeps_are_reported_by_name() {
        for (sweep, field) in [
            (json!({}), "sweep.grid"),
            (json!({"grid": {}, "list": []}), "sweep.grid"),
            (json!({"list": []}), "sweep.points"),
            (json!({"grid": {"algorithm": []}}), "sweep.grid.algorithm"),
            (json!({"grid": {"algorithm": ["dqn"]}}), "sweep.points[0].algorithm"),
            (json!({"grid": {"training.gamma": [0.9, 1.5]}}), "sweep.points[1].training.gamma"),
            (json!({"list": [{"training.gama": 0.9}]}), "sweep.points[0].training.gama"),
            (json!({"list": [{"seed": 1}]}), "sweep.points[0].seed"),
            (json!({"grid": {"threads": [1, 2, 1, 2]}, "seeds": 101}), "sweep.seeds"),
            (json!({"list": vec![json!({}); 501]}), "sweep.points"),
            (json!({"random": {"samples": 0, "fields": {}}}), "sweep.random.samples"),
            (json!({"random": {"samples": 1, "fields": {"threads": {"low": 2, "high": 1}}}}), "sweep.random.fields.threads"),
        ] {
            let refused = resolve_json(json!({"sweep": sweep})).expect_err("must be refused");
            assert_eq!(refused.field, field, "{sweep}");
        }
    }
}
