//! Sweeps: one job that makes many, over values of the fields of a training job and over seeds.

use serde_json::{Value, json};

use super::spec::JobRequest;
use super::sweep::{MAX_JOBS, MAX_SEEDS, request_at};
use super::webhooks;
use crate::invalid::{Invalid, count_in_range, in_range};
use crate::store::{JobKind, JobLimits, JobSpec};
use crate::train_config::TrainConfig;

/// Longest name of a sweep: the names of its jobs have a number at the end.
pub(super) const MAX_NAME: usize = 58;

/// A sweep or an experiment with its jobs.
#[derive(Clone, Debug, PartialEq)]
pub struct Sweep {
    /// The job itself.
    pub spec: JobSpec,
    /// Its jobs; of a sweep all seeds of the first combination, then of the next.
    pub jobs: Vec<JobSpec>,
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
    count_in_range("sweep.seeds", points.len() * seeds as usize, 1..=MAX_JOBS, "jobs (combinations times seeds)")?;
    if let Some(name) = request.name.as_ref().filter(|name| name.len() > MAX_NAME) {
        return Err(Invalid::new("name", name, format!("at most {MAX_NAME} characters in a sweep")));
    }
    request.kind = None;
    let webhooks = webhooks::resolve(request.webhooks.take().unwrap_or_default())?;
    let first_seed = request.seed.unwrap_or(1);
    let name = request.name.take();
    let Value::Object(base) = serde_json::to_value(&request).expect("a request is plain data") else {
        unreachable!("a request is an object")
    };
    let mut jobs = Vec::new();
    for (i, point) in points.iter().enumerate() {
        let at = |e: Invalid| sweep.named_as_requested(i, point, e);
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
    let work = jobs.iter().filter_map(|job| job.config.as_ref()).map(TrainConfig::total_steps).fold(0, u64::saturating_add);
    // With these, the same sweep can be submitted again.
    let base = json!({
        "algorithm": request.algorithm, "preset": request.preset, "environment": request.environment, "training": request.training,
        "seed": first_seed,
    });
    let document = json!({"points": points, "seeds": seeds, "base": base});
    let (kind, sweep) = (JobKind::Sweep, Some(document));
    // Without a limit of the request, each job has its own.
    let limits = JobLimits { memory: request.memory, ..first.limits };
    let spec = JobSpec { kind, name, webhooks, limits, config: None, sweep, work, point: None, ..first.clone() };
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
        assert_eq!((spec.kind, spec.work, jobs.len()), (JobKind::Sweep, 12 * 1280, 12));
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
        let few = json!({"sweep": {"random": {"samples": 50, "fields": {"algorithm": ["vdn", "qmix"]}}}});
        assert_eq!(resolve_json(few).unwrap().jobs.len(), 2, "what is drawn again makes no further job");
    }

    #[test]
    fn fields_inside_of_objects_are_varied() {
        let document = json!({
            "training": {"vary": {"users": [4, 8]}}, "sweep": {"grid": {"training.vary.uavs": [[1, 2], [2, 3]]}},
        });
        let jobs = resolve_json(document).unwrap().jobs;
        let vary: Vec<_> = jobs.iter().map(|job| job.config.as_ref().unwrap().training.vary).collect();
        assert_eq!(vary.iter().map(|vary| vary.uavs).collect::<Vec<_>>(), [Some([1, 2]), Some([2, 3])]);
        assert!(vary.iter().all(|vary| vary.users == Some([4, 8])));
    }

    #[test]
    fn invalid_sweeps_are_reported_by_name() {
        for (sweep, field) in [
            (json!({}), "sweep.grid"),
            (json!({"grid": {}, "list": []}), "sweep.list"),
            (json!({"list": []}), "sweep.list"),
            (json!({"list": [{}]}), "sweep.list[0]"),
            (json!({"list": [{"threads": 1}, {"threads": 2}, {"threads": 1.0}]}), "sweep.list[2]"),
            (json!({"grid": {}}), "sweep.grid"),
            (json!({"grid": {"algorithm": []}}), "sweep.grid.algorithm"),
            (json!({"grid": {"training.batch": [8, 16, 8]}}), "sweep.grid.training.batch[2]"),
            (json!({"grid": {"algorithm": ["dqn"]}}), "sweep.grid.algorithm[0]"),
            (json!({"grid": {"training.gamma": [0.9, 1.5]}}), "sweep.grid.training.gamma[1]"),
            (json!({"grid": {"training.learning_rat": [1]}}), "sweep.grid.training.learning_rat"),
            (json!({"grid": {"environment.M": [0]}}), "sweep.grid.environment.M[0]"),
            (json!({"grid": {"training.vary": [{"uav": [1, 2]}]}}), "sweep.grid.training.vary[0].uav"),
            (json!({"grid": {"training.vary.uavs": [[2, 1]]}}), "sweep.grid.training.vary.uavs[0]"),
            (json!({"list": [{"training.gama": 0.9}]}), "sweep.list[0].training.gama"),
            (json!({"list": [{"seed": 1}]}), "sweep.list[0].seed"),
            (json!({"grid": {"threads": [1, 2]}, "seeds": 101}), "sweep.seeds"),
            (json!({"list": vec![json!({}); 501]}), "sweep.list"),
            (json!({"random": {"samples": 0, "fields": {}}}), "sweep.random.samples"),
            (json!({"random": {"samples": 1, "fields": {}}}), "sweep.random.fields"),
            (json!({"random": {"samples": 1, "fields": {"training.gamma": [2]}}}), "sweep.random.fields.training.gamma"),
            (json!({"random": {"samples": 1, "fields": {"threads": {"low": 2, "high": 1}}}}), "sweep.random.fields.threads"),
        ] {
            let refused = resolve_json(json!({"sweep": sweep})).expect_err("must be refused");
            assert_eq!(refused.field, field, "{sweep}");
        }
    }
}
