//! Evaluations on the server: the versions that they compare.

use serde_json::Value;

use crate::invalid::Invalid;
use crate::jobs::evaluation::EvaluationSpec;
use crate::policy::baselines;
use crate::service::{App, Error, policies};
use crate::serving::PolicySpec;

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
