//! What versions of policies have computed since the server started.

use std::time::Instant;

use crate::service::{App, Error};
use crate::serving::{PolicyRef, PolicySpec, Statistics, VersionSelector};

/// The statistics of one version.
#[derive(Clone, Debug)]
pub struct VersionStatistics {
    /// Name of the policy.
    pub name: String,
    /// The version.
    pub version: u64,
    /// Milliseconds since 1970 of the last forward pass; 0 if there was none.
    pub last_inference: u64,
    /// Counts and times.
    pub statistics: Statistics,
}

/// The statistics of all versions of all policies, or of the version that `spec` selects, or of all versions if it selects none.
///
/// # Errors
/// [`Error::NotFound`].
pub fn statistics(app: &App, spec: Option<&PolicySpec>) -> Result<Vec<VersionStatistics>, Error> {
    let states = match spec {
        None => app.registry.versions(),
        Some(spec) => {
            let selected = app.registry.describe(spec)?.state;
            let all = spec.version == VersionSelector::Newest;
            if all { app.registry.versions_of(&spec.name) } else { vec![selected] }
        }
    };
    let (wall, now) = (app.clock.now().as_millisecond(), Instant::now());
    let of_version = |PolicyRef { name, version, .. }| {
        let statistics = app.engine.statistics(&name, version);
        let age = |last| i64::try_from(now.saturating_duration_since(last).as_millis()).unwrap_or(i64::MAX);
        let last_inference = statistics.last.map_or(0, |last| wall.saturating_sub(age(last)).max(0) as u64);
        VersionStatistics { name, version, last_inference, statistics }
    };
    Ok(states.into_iter().map(|state| of_version(state.reference)).collect())
}
