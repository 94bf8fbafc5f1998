//! The results of experiments on the server.

use std::collections::BTreeMap;

use serde_json::{Value, json};

use crate::experiment::ExperimentSummary;
use crate::jobs::experiment_jobs::{ReportedRun, experiment};
use crate::jobs::sweep::MAX_JOBS;
use crate::service::{App, Error};
use crate::store::{Job, JobFilter, JobList, JobOrder, JobSort, JobState};

/// The result of an experiment at the moment: the states of its jobs, and, when all have succeeded, the report of
/// `qedgix experiment`.
pub(super) async fn result(app: &App, job: &Job) -> Result<Value, Error> {
    if let Some(kept) = app.store.job_result(job.id).await?.filter(|_| job.state == JobState::Succeeded) {
        return serde_json::from_str(&kept).map_err(Error::internal);
    }
    let filter = JobFilter { parent: Some(job.id), ..JobFilter::default() };
    let order = JobOrder { by: JobSort::Created, descending: false };
    let list = JobList { filter, order, after: None, limit: MAX_JOBS, max_bytes: usize::MAX };
    let mut states = BTreeMap::<&str, usize>::new();
    let jobs = app.store.jobs(&list).await?.0;
    for listed in &jobs {
        *states.entry(listed.job.state.as_str()).or_default() += 1;
    }
    let unfinished = json!({"jobs": jobs.len(), "states": states, "report": null});
    if job.state != JobState::Succeeded {
        return Ok(unfinished);
    }
    let document = job.spec.decode().map_err(Error::internal)?.experiment;
    let results = app.store.results_of_jobs(job.id).await?;
    // Intervals over seeds and layouts take too long for a thread that serves connections.
    let report = tokio::task::spawn_blocking(move || report(document, &results)).await.map_err(Error::internal)??;
    // A job of the experiment was deleted.
    let Some(report) = report else { return Ok(unfinished) };
    let result = json!({"jobs": jobs.len(), "states": states, "report": report});
    // Only saves the next caller the time.
    if let Err(error) = app.store.keep_result(job.id, &result.to_string()).await {
        tracing::debug!(%error, "the report of an experiment could not be kept");
    }
    Ok(result)
}

/// The report; `None` if a job or its result is missing.
fn report(document: Option<Value>, results: &[Option<String>]) -> Result<Option<Value>, Error> {
    let Some(Value::Object(document)) = document else { return Err(Error::internal("an experiment has no document")) };
    let experiment = experiment(document)?;
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
    let summary = ExperimentSummary::new(&experiment, &runs, &baselines);
    serde_json::to_value(summary).map(Some).map_err(Error::internal)
}
