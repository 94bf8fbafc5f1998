//! Sweeps on the server: their jobs, and their results with means over seeds.

use std::collections::BTreeMap;

use serde_json::{Value, json};
use uuid::Uuid;

use super::init::InitialWeights;
use super::{check_dependency, publication};
use crate::invalid::Invalid;
use crate::jobs::memory::check as check_memory;
use crate::jobs::spec::JobRequest;
use crate::jobs::{experiment_jobs, sweep, sweep_jobs};
use crate::learner::MeanOverSeeds;
use crate::service::keys::Caller;
use crate::service::policies::Publisher;
use crate::service::{App, Error};
use crate::store::{
    Job, JobFilter, JobId, JobKind, JobList, JobOrder, JobSort, JobState, ListedJob, MetricSummary, NewJob, SubmitResult,
};

/// The metrics of the result of a sweep.
const METRICS: [&str; 6] =
    ["eval/mean_aoi", "eval/p95_aoi", "eval/peak_aoi", "eval/coverage", "eval/fairness", "eval-v1/mean_aoi"];

/// Submits a sweep or an experiment with its jobs.
pub(super) async fn submit(
    app: &App,
    caller: &Caller,
    request: JobRequest,
    idempotency: Option<(String, [u8; 32])>,
) -> Result<SubmitResult, Error> {
    let notes = request.notes.clone().unwrap_or_default();
    let weights = match &request.init {
        Some(init) => Some(InitialWeights::find(app, caller, init).await?),
        None => None,
    };
    let (budget, varied) = (app.scheduler.cpu_budget(), request.sweep.clone());
    let mut sweep = match request.kind {
        Some(JobKind::Experiment) => experiment_jobs::resolve(request, budget)?,
        _ => sweep_jobs::resolve(request, budget)?,
    };
    let points = sweep.spec.sweep.as_ref().and_then(|sweep| sweep["points"].as_array()).cloned().unwrap_or_default();
    app.webhooks.check(&sweep.spec.webhooks)?;
    let memory = app.scheduler.config().memory;
    let mut beginning = None;
    for (i, job) in sweep.jobs.iter_mut().enumerate() {
        let point = job.point.map_or(i, |point| point as usize);
        let at = |e: Invalid| match (&varied, points.get(point).and_then(Value::as_object)) {
            (Some(varied), Some(fields)) => varied.named_as_requested(point, fields, e),
            _ => e.with_prefix(&format!("experiment.runs[{i}]")),
        };
        if let Some(weights) = &weights {
            beginning = Some(weights.put_into(job).map_err(at)?);
        }
        if let Some(config) = &job.config {
            check_memory(config, job.threads, memory).map_err(at)?;
        }
        publication::check(app, caller, job).await?;
    }
    // All jobs begin with the same weights.
    sweep.spec.init = sweep.jobs.first().and_then(|job| job.init.clone());
    for (i, needed) in sweep.spec.after.iter().enumerate() {
        check_dependency(app, caller, i, *needed).await?;
    }
    app.admit()?;
    let Publisher { owner, any_name, .. } = caller.into();
    let parent = JobId(Uuid::now_v7());
    let job = |id, spec, notes, parent: Option<JobId>, idempotency| {
        let (owner, beginning) = (owner.clone(), beginning.clone().filter(|_| parent.is_some()));
        NewJob { id, owner, any_name, spec, notes, parent, beginning, now: app.clock.now(), idempotency }
    };
    let jobs: Vec<NewJob> =
        sweep.jobs.into_iter().map(|spec| job(JobId(Uuid::now_v7()), spec, String::new(), Some(parent), None)).collect();
    Ok(app.store.submit_sweep(job(parent, sweep.spec, notes, None, idempotency), &jobs).await?)
}

/// The result of a sweep at the moment: the states of its jobs, and of each combination the means of metrics over seeds.
pub(super) async fn result(app: &App, sweep: &Job) -> Result<Value, Error> {
    let spec = sweep.spec.decode().map_err(Error::internal)?;
    let points = spec.sweep.as_ref().and_then(|sweep| sweep["points"].as_array()).cloned().unwrap_or_default();
    let filter = JobFilter { parent: Some(sweep.id), ..JobFilter::default() };
    let order = JobOrder { by: JobSort::Created, descending: false };
    let list = JobList { filter, order, after: None, limit: sweep::MAX_JOBS, max_bytes: usize::MAX };
    let jobs = app.store.jobs(&list).await?.0;
    let rows: Vec<i64> = jobs.iter().map(|listed| listed.job.row_id).collect();
    let metrics = app.store.metric_summaries(&rows, &METRICS.map(str::to_owned)).await?;
    let mut states = BTreeMap::<&str, usize>::new();
    let mut of_points: Vec<Vec<&Job>> = vec![Vec::new(); points.len()];
    for ListedJob { job, spec, .. } in &jobs {
        *states.entry(job.state.as_str()).or_default() += 1;
        let point = spec.as_ref().ok().and_then(|spec| spec.point);
        if let Some(of_point) = point.and_then(|point| of_points.get_mut(point as usize)) {
            of_point.push(job);
        }
    }
    let points = points.into_iter().zip(of_points).map(|(fields, jobs)| {
        let means: BTreeMap<&str, Value> =
            METRICS.iter().filter_map(|name| Some((*name, means(name, &jobs, &metrics)?))).collect();
        let jobs = jobs.iter().map(|job| json!({"id": job.id, "seed": job.spec.seed, "state": job.state, "reason": job.reason}));
        json!({"fields": fields, "jobs": jobs.collect::<Vec<_>>(), "metrics": means})
    });
    Ok(json!({"jobs": jobs.len(), "states": states, "points": points.collect::<Vec<_>>()}))
}

/// The best and the last value of a metric, as means with 95 % intervals over the jobs that have succeeded, as `qedgix jobs compare`
/// has them.
fn means(name: &str, jobs: &[&Job], metrics: &BTreeMap<i64, Vec<(String, MetricSummary)>>) -> Option<Value> {
    let done = jobs.iter().filter(|job| job.state == JobState::Succeeded);
    let summaries: Vec<MetricSummary> = done
        .filter_map(|job| metrics.get(&job.row_id)?.iter().find(|(metric, _)| metric == name).map(|(_, summary)| *summary))
        .collect();
    let mean = |values: Vec<f64>| {
        MeanOverSeeds::of(&values).map(|MeanOverSeeds { mean, interval }| {
            let [low, high] = [0, 1].map(|end| interval.map(|interval| interval[end]));
            json!({"mean": mean, "low": low, "high": high})
        })
    };
    let best = mean(summaries.iter().filter_map(|summary| summary.best).collect());
    let last = mean(summaries.iter().filter_map(|summary| summary.last).collect());
    (best.is_some() || last.is_some()).then(|| json!({"seeds": summaries.len(), "best": best, "last": last}))
}
