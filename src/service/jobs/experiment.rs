//! The results of experiments on the server.

use std::collections::BTreeMap;
use std::sync::Arc;

use serde_json::{Value, json};

use crate::experiment::{Experiment, ExperimentSummary};
use crate::jobs::experiment_jobs::{ReportedRun, experiment};
use crate::jobs::sweep::MAX_JOBS;
use crate::service::{App, Error};
use crate::store::{Job, JobFilter, JobList, JobOrder, JobSort, JobState, ListedJob};

/// The result of an experiment at the moment: the states of its jobs, its runs, and, when all have succeeded, the report of
/// `qedgix experiment`.
pub(super) async fn result(app: &App, job: &Job) -> Result<Value, Error> {
    let document = job.spec.decode().map_err(Error::internal)?.experiment;
    let Some(Value::Object(document)) = document else { return Err(Error::internal("an experiment has no document")) };
    let experiment = Arc::new(experiment(document).map_err(Error::internal)?);
    let filter = JobFilter { parent: Some(job.id), ..JobFilter::default() };
    let order = JobOrder { by: JobSort::Created, descending: false };
    let list = JobList { filter, order, after: None, limit: MAX_JOBS, max_bytes: usize::MAX };
    let jobs = app.store.jobs(&list).await?.0;
    let mut states = BTreeMap::<&str, usize>::new();
    let mut runs = Vec::with_capacity(jobs.len());
    for ListedJob { job, spec, .. } in &jobs {
        *states.entry(job.state.as_str()).or_default() += 1;
        let point = spec.as_ref().ok().and_then(|spec| spec.point);
        let run = point.and_then(|point| experiment.runs.get(point as usize));
        let (series, point) = run.map(|run| (&experiment.series[run.series], &experiment.points[run.point].name)).unzip();
        let (id, seed, state, reason) = (job.id, job.spec.seed, job.state, &job.reason);
        runs.push(json!({"id": id, "series": series, "point": point, "seed": seed, "state": state, "reason": reason}));
    }
    let report = if job.state == JobState::Succeeded { report_of(app, job, experiment).await? } else { None };
    Ok(json!({"jobs": jobs.len(), "states": states, "runs": runs, "report": report}))
}

/// The report of an experiment that has succeeded; `None` if one of its jobs was deleted before somebody asked for the report.
async fn report_of(app: &App, job: &Job, experiment: Arc<Experiment>) -> Result<Option<Value>, Error> {
    if let Some(kept) = app.store.job_result(job.id).await? {
        return serde_json::from_str(&kept).map_err(Error::internal);
    }
    let results = app.store.results_of_jobs(job.id).await?;
    // Intervals over seeds and layouts take too long for a thread that serves connections.
    let report = tokio::task::spawn_blocking(move || report(&experiment, &results)).await.map_err(Error::internal)??;
    // Only saves the next caller the time.
    if let Some(report) = &report
        && let Err(error) = app.store.keep_result(job.id, &report.to_string()).await
    {
        tracing::debug!(%error, "the report of an experiment could not be kept");
    }
    Ok(report)
}

/// The report; `None` if a job or its result is missing.
fn report(experiment: &Experiment, results: &[Option<String>]) -> Result<Option<Value>, Error> {
    let mut runs = Vec::new();
    for result in results.iter().flatten() {
        runs.push(serde_json::from_str::<ReportedRun>(result).map_err(Error::internal)?);
    }
    if runs.len() != experiment.runs.len() {
        return Ok(None);
    }
    let of_point = |point: usize| {
        let first = experiment.runs.iter().position(|run| run.point == point);
        first.map(|first| runs[first].baselines.clone()).unwrap_or_default()
    };
    let baselines: Vec<_> = (0..experiment.points.len()).map(of_point).collect();
    let runs: Vec<_> = runs.iter().map(|reported| reported.run.clone()).collect();
    let summary = ExperimentSummary::new(experiment, &runs, &baselines);
    serde_json::to_value(summary).map(Some).map_err(Error::internal)
}
