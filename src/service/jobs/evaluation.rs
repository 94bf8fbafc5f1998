//! Evaluations on the server: the versions that they compare, and their results.

use serde_json::Value;

use super::get;
use crate::error_code::ErrorCode;
use crate::invalid::Invalid;
use crate::jobs::evaluation::EvaluationSpec;
use crate::policy::baselines;
use crate::service::keys::Caller;
use crate::service::{App, Error, policies};
use crate::serving::PolicySpec;
use crate::store::JobKind;

/// The evaluation with the versions that its policies have now, so that a moving alias does not change it.
///
/// # Errors
/// [`Error::Invalid`] with the policy that does not exist.
pub(super) async fn pin_versions(app: &App, evaluation: Value) -> Result<Value, Error> {
    let mut evaluation: EvaluationSpec = serde_json::from_value(evaluation).map_err(Error::internal)?;
    for (i, name) in evaluation.policies.iter_mut().enumerate() {
        if baselines::LIST.iter().any(|baseline| baseline.name == name) {
            continue;
        }
        let unknown = || Invalid::new(format!("evaluation.policies[{i}]"), format!("{name:?}"), "a policy of this server");
        let spec: PolicySpec = name.parse().map_err(|_| unknown())?;
        let found = policies::found(app, |registry| registry.describe(&spec)).await.map_err(|_| unknown())?.state.reference;
        *name = format!("{}:{}", found.name, found.version);
    }
    let twice = evaluation.policies.iter().enumerate().find(|(i, name)| evaluation.policies[..*i].contains(name));
    if let Some((i, name)) = twice {
        return Err(Invalid::new(format!("evaluation.policies[{i}]"), name, "each version once").into());
    }
    serde_json::to_value(evaluation).map_err(Error::internal)
}

/// The result of the job `id`: of an evaluation, the report of `qedgix evaluate --json`; of a sweep, at any time, the states of its
/// jobs and means over seeds; of an experiment, the states of its jobs and, when all have succeeded, the report; of a training job with
/// `publish`, what became of it.
///
/// # Errors
/// [`Error::NotFound`], or [`Error::Precondition`] while the job has none.
pub async fn result(app: &App, caller: &Caller, id: &str) -> Result<Value, Error> {
    let job = get(app, caller, id).await?;
    if job.spec.kind.as_deref() == Some(JobKind::Sweep.as_str()) {
        return super::sweep::result(app, &job).await;
    }
    if job.spec.kind.as_deref() == Some(JobKind::Experiment.as_str()) {
        return super::experiment::result(app, &job).await;
    }
    if let Some(result) = app.store.job_result(job.id).await? {
        serde_json::from_str(&result).map_err(Error::internal)
    } else {
        let message =
            format!("job {id} is {} and has no result; only a sweep, or an evaluation that has succeeded, has one", job.state);
        Err(Error::Precondition { code: ErrorCode::WrongState, message })
    }
}
