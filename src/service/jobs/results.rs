//! The results of jobs of all kinds.

use serde_json::Value;

use super::{experiment, get, sweep};
use crate::error_code::ErrorCode;
use crate::service::keys::Caller;
use crate::service::{App, Error};
use crate::store::{Job, JobKind};

/// The result of the job `id`: of an evaluation, the report of `qedgix evaluate --json`; of a sweep, at any time, the states of its
/// jobs and means over seeds; of an experiment, the states of its jobs and, when all have succeeded, the report; of a training job with
/// `publish`, what became of it.
///
/// # Errors
/// [`Error::NotFound`], or [`Error::Precondition`] while the job has none.
pub async fn result(app: &App, caller: &Caller, id: &str) -> Result<Value, Error> {
    let job = get(app, caller, id).await?;
    let kind = job.spec.kind.as_deref();
    if kind == Some(JobKind::Sweep.as_str()) {
        return sweep::result(app, &job).await;
    }
    if kind == Some(JobKind::Experiment.as_str()) {
        return experiment::result(app, &job).await;
    }
    match app.store.job_result(job.id).await? {
        Some(result) => serde_json::from_str(&result).map_err(Error::internal),
        None => Err(Error::Precondition { code: ErrorCode::WrongState, message: missing(&job) }),
    }
}

/// Why a job has no result.
fn missing(job: &Job) -> String {
    let (id, state) = (job.id, job.state);
    let has_one = job.spec.kind.as_deref() == Some(JobKind::Evaluate.as_str())
        || job.spec.decode().is_ok_and(|spec| spec.report.is_some() || spec.publish.is_some_and(|rule| rule.alias.is_some()));
    if !has_one {
        return format!("job {id} has no result; a training job has one only with publish.alias");
    }
    if state.ended() {
        format!("job {id} is {state} and has no result")
    } else {
        format!("job {id} is {state} and has no result yet")
    }
}
