//! Whether a job may publish as it asks to. Checked at the submission, instead of after training.

use crate::invalid::Invalid;
use crate::policy::baselines;
use crate::service::keys::{Caller, Scope};
use crate::service::policies::{self, Publisher};
use crate::service::{App, Error};
use crate::serving::{PolicySpec, check_name};
use crate::store::JobSpec;

/// Checks the name of the policy of a job, and the alias that is to move.
///
/// # Errors
/// [`Error::Invalid`] with the field. [`Error::PermissionDenied`]: another owner made the policy, or the caller may not move aliases.
pub(super) async fn check(app: &App, caller: &Caller, spec: &JobSpec) -> Result<(), Error> {
    let rule = spec.publish.clone().unwrap_or_default();
    let name = rule.policy.as_ref().or(spec.name.as_ref());
    if let Some(name) = name {
        let field = if rule.policy.is_some() { "publish.policy" } else { "name" };
        policies::check_publishable(name).map_err(|e| Invalid { field: field.into(), ..e })?;
        policies::check_owner(app, &Publisher::from(caller), name).await?;
    }
    let Some(alias) = &rule.alias else { return Ok(()) };
    check_name("publish.alias", alias)?;
    if !caller.is_admin() {
        let scope = Scope::Admin.name();
        let message = format!("publish.alias moves an alias, which requires a key with the scope {scope}");
        return Err(Error::PermissionDenied { message, scope });
    }
    if let Some(rival) = rule.better_than.as_ref().filter(|rival| !baselines::is_name(rival)) {
        let unknown = || {
            Invalid::new(
                "publish.if.better_than",
                format!("{rival:?}"),
                "a policy of this server, or the one that the job publishes",
            )
        };
        let found: PolicySpec = rival.parse().map_err(|_| unknown())?;
        if app.registry.describe(&found).is_err() && name != Some(&found.name) {
            return Err(unknown().into());
        }
    }
    Ok(())
}
