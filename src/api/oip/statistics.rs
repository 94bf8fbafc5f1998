//! Model statistics: what policies have computed since the server started, over all protocols.

use super::model::{model_error, policy_spec};
use crate::invalid::Invalid;
use crate::service::policies::{self, VersionStatistics};
use crate::service::{App, Error};

/// The statistics of a version, or of all versions if `version` is empty, or of all models if `name` is empty, too.
///
/// # Errors
/// [`Error::NotFound`] if the model does not exist, [`Error::Invalid`] if the name or the version does not parse.
pub fn statistics(app: &App, name: &str, version: &str) -> Result<Vec<VersionStatistics>, Error> {
    if name.is_empty() && !version.is_empty() {
        return Err(Invalid::missing("model_name", "the name of a model, because model_version is set").into());
    }
    let spec = if name.is_empty() { None } else { Some(policy_spec(name, version)?) };
    policies::statistics(app, spec.as_ref()).map_err(model_error)
}
