//! Experiments: one job that makes a training job for every run of a document of `qedgix experiment`.

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::memory::default_limit;
use super::spec::JobRequest;
use super::sweep::MAX_JOBS;
use super::sweep_jobs::{MAX_NAME, Sweep};
use crate::env::{EnvConfig, EpisodeMetrics};
use crate::experiment::{Experiment, Overrides, RunResult};
use crate::invalid::{Invalid, in_range};
use crate::store::{JobKind, JobLimits, JobSpec};

/// Most evaluations of a job: layouts of the best weights, the last ones, and each baseline.
const MAX_EVALUATIONS: usize = 8192;

/// What a job of an experiment evaluates when it has trained.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunReport {
    /// Name of the list of layouts.
    pub layouts: String,
    /// Number of layouts, from the first.
    pub episodes: usize,
    /// The baselines of the point. Only the first job of each point evaluates them.
    pub baselines: Vec<String>,
    /// The environment of the baselines.
    pub environment: EnvConfig,
}

/// What a job of an experiment reports.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReportedRun {
    /// The evaluations of the weights.
    pub run: RunResult,
    /// Of each baseline the metrics on each layout.
    pub baselines: Vec<Vec<EpisodeMetrics>>,
}

/// What overrides the document, as the flags of `qedgix experiment` do.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct OverriddenFields {
    seeds: Option<Vec<u64>>,
    num_seeds: Option<u16>,
    series: Vec<String>,
    points: Vec<String>,
    environment: Map<String, Value>,
    training: Map<String, Value>,
}

/// The experiment of a document.
///
/// # Errors
/// The first field that is not accepted, with the prefix `experiment`.
pub fn experiment(mut document: Map<String, Value>) -> Result<Experiment, Invalid> {
    let overrides = document.remove("overrides").unwrap_or_else(|| Map::new().into());
    if !overrides.is_object() {
        return Err(Invalid::schema("experiment.overrides", &overrides, "an object"));
    }
    let read = serde_path_to_error::deserialize(&overrides).map_err(|e| {
        let field = format!("experiment.overrides.{}", e.path());
        Invalid::from_parser(field.trim_end_matches('.'), e.inner())
    });
    let OverriddenFields { seeds, num_seeds, series, points, environment, training } = read?;
    if let (Some(number), Some(_)) = (num_seeds, &seeds) {
        return Err(Invalid::new("experiment.overrides.num_seeds", number, "no value beside seeds"));
    }
    in_range("experiment.overrides.num_seeds", num_seeds.unwrap_or(1), 1..=1000)?;
    let num_seeds = num_seeds.map(usize::from);
    let overrides = Overrides { seeds, num_seeds, series, points, environment, training, origin: "overrides.".into() };
    Experiment::resolve(Value::Object(document), &overrides).map_err(|e| e.with_prefix("experiment"))
}

/// The experiment of a request of this kind, with all of its jobs, in the order of its runs.
///
/// # Errors
/// The first field of the request that is not accepted.
pub fn resolve(mut request: JobRequest, cpu_budget: usize) -> Result<Sweep, Invalid> {
    let Some(document) = request.experiment.take() else {
        return Err(Invalid::missing("experiment", "what a job of the kind experiment compares"));
    };
    let of_others = [
        ("algorithm", request.algorithm.is_some()),
        ("preset", request.preset.is_some()),
        ("environment", request.environment.is_some()),
        ("training", request.training.is_some()),
        ("seed", request.seed.is_some()),
        ("stop", request.stop.is_some()),
        ("init", request.init.is_some()),
        ("publish", request.publish.is_some()),
        ("evaluation", request.evaluation.is_some()),
        ("sweep", request.sweep.is_some()),
    ];
    if let Some((field, _)) = of_others.iter().find(|(_, given)| *given) {
        return Err(Invalid::new(*field, "a value", "no value in a job of the kind experiment, whose document has it"));
    }
    if let Some(name) = request.name.as_ref().filter(|name| name.len() > MAX_NAME) {
        return Err(Invalid::new("name", name, format!("at most {MAX_NAME} characters in an experiment")));
    }
    let experiment = experiment(document.clone())?;
    in_range("experiment.runs", experiment.runs.len(), 1..=MAX_JOBS)?;
    let episodes = experiment.layout_seeds.len();
    in_range("experiment.episodes", episodes * (2 + experiment.baselines.len()), 1..=MAX_EVALUATIONS)?;
    request.kind = None;
    let (name, memory) = (request.name.take(), request.memory);
    let template = request.resolve(cpu_budget)?;
    let mut work = 0_u64;
    let first_of_point = |i: usize| experiment.runs[..i].iter().all(|run| run.point != experiment.runs[i].point);
    let jobs = experiment.runs.iter().enumerate().map(|(i, run)| {
        work = work.saturating_add(run.config.total_steps());
        let baselines = if first_of_point(i) { experiment.baselines.clone() } else { Vec::new() };
        let environment = experiment.points[run.point].environment.clone();
        let report = RunReport { layouts: experiment.layouts.clone(), episodes, baselines, environment };
        JobSpec {
            name: name.as_ref().map(|name| format!("{name}-{i:03}")),
            limits: JobLimits {
                memory: memory.or_else(|| Some(default_limit(&run.config, template.threads))),
                ..template.limits
            },
            config: Some(run.config.clone()),
            report: Some(serde_json::to_value(report).expect("a report is plain data")),
            point: Some(i as u64),
            // They get the message of the experiment.
            webhooks: Vec::new(),
            ..template.clone()
        }
    });
    let jobs: Vec<JobSpec> = jobs.collect();
    let experiment = Some(Value::Object(document));
    // Without a limit of the request, each job has its own.
    let limits = JobLimits { memory, ..template.limits };
    let spec = JobSpec { kind: JobKind::Experiment, name, limits, config: None, experiment, work, ..template };
    Ok(Sweep { spec, jobs })
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn resolve_json(experiment: &Value) -> Result<Sweep, Invalid> {
        resolve(JobRequest::from_json(json!({"kind": "experiment", "name": "e", "experiment": experiment}))?, 2)
    }

    #[test]
    fn every_run_is_a_job_and_the_first_of_a_point_has_the_baselines() {
        let document = json!({
            "title": "t", "figure": "parameter", "seeds": [1, 2], "episodes": 3, "baselines": ["sweep"],
            "series": [{"name": "a", "algorithm": "vdn"}, {"name": "b", "algorithm": "qmix"}],
            "points": [{"name": "p", "x": 1, "environment": {"uavs": 2}}, {"name": "q", "x": 2}],
            "overrides": {"training": {"steps": 100}},
        });
        let Sweep { spec, jobs } = resolve_json(&document).unwrap();
        assert_eq!((spec.kind, spec.work, jobs.len()), (JobKind::Experiment, 8 * 640, 8));
        let reports: Vec<RunReport> =
            jobs.iter().map(|job| serde_json::from_value(job.report.clone().unwrap()).unwrap()).collect();
        let with_baselines: Vec<usize> = (0..8).filter(|i| !reports[*i].baselines.is_empty()).collect();
        assert_eq!(with_baselines, [0, 2]);
        assert_eq!((reports[0].environment.uavs, reports[2].environment.uavs, reports[0].episodes), (2, 3, 3));
        assert_eq!(jobs[7].name.as_deref(), Some("e-007"));
    }

    #[test]
    fn invalid_experiments_are_reported_by_name() {
        let good = json!({"title": "t", "figure": "convergence", "series": [{"name": "a"}]});
        resolve_json(&good).unwrap();
        for (field, value, reported) in [
            ("figure", json!("pie"), "experiment.figure"),
            ("series", json!([]), "experiment.series"),
            ("series", json!([{"name": "a", "training": {"batch": 0}}]), "experiment.series[0].training.batch"),
            ("seeds", json!((0..600).collect::<Vec<_>>()), "experiment.runs"),
            ("baselines", json!(vec!["sweep"; 40]), "experiment.episodes"),
            ("overrides", json!({"training": {"gama": 1}}), "experiment.overrides.training.gama"),
            ("overrides", json!([]), "experiment.overrides"),
            ("colour", json!("red"), "experiment.colour"),
        ] {
            let mut document = good.clone();
            document[field] = value;
            assert_eq!(resolve_json(&document).unwrap_err().field, reported);
        }
        let mut points = good.clone();
        points["points"] = json!([{"name": "p", "training": {"gamma": 0.5}}]);
        points["overrides"] = json!({"training": {"gamma": 0.9}});
        assert_eq!(resolve_json(&points).unwrap_err().field, "experiment.overrides.training.gamma");
        let both = json!({"kind": "experiment", "experiment": good, "seed": 3});
        assert_eq!(resolve(JobRequest::from_json(both).unwrap(), 1).unwrap_err().field, "seed");
    }
}
