//! Creating, resetting, stepping, showing and ending hosted environments.

use serde_json::Value;

use super::paging::json_bytes;
use super::{App, Error, Page, PageRequest};
use crate::serving::{Blueprint, EnvironmentInfo, Flight, Reset, State};
use crate::train_config;

/// How to create an environment.
#[derive(Clone, Debug)]
pub struct Create {
    /// Chosen by the server when absent.
    pub id: Option<String>,
    /// Fields of the configuration, over the defaults.
    pub environment: Value,
    /// Copy b's first episode has the seed `seed` + b.
    pub seed: u64,
    /// Number of copies.
    pub count: usize,
    /// Whether the last step of an episode begins the next.
    pub auto_reset: bool,
}

/// Creates an environment, at slot 0 of episode 0.
///
/// # Errors
/// A field that is unknown or out of range, a name that is taken, too many or too large environments, draining.
pub async fn create(app: &App, create: Create) -> Result<EnvironmentInfo, Error> {
    app.admit()?;
    let Create { id, environment, seed, count, auto_reset } = create;
    let blueprint = Blueprint::new(train_config::environment(environment)?, count, seed, auto_reset)?;
    Ok(app.environments.create(id, blueprint).await?)
}

/// Begins an episode in every copy.
///
/// # Errors
/// A seed out of range, graphs that are too large, an environment that expired or does not exist, draining.
pub async fn reset(app: &App, id: &str, reset: Reset) -> Result<State, Error> {
    app.admit()?;
    Ok(app.environments.table().get(id)?.reset(reset).await?)
}

/// Flies one slot in every copy.
///
/// # Errors
/// Actions that do not fit, a wrong step, an episode that is over, graphs that are too large, an environment that expired or
/// does not exist, draining.
pub async fn step(app: &App, id: &str, flight: Flight) -> Result<State, Error> {
    app.admit()?;
    Ok(app.environments.table().get(id)?.step(flight).await?)
}

/// Shows an environment.
///
/// # Errors
/// It expired, or there is none.
pub fn get(app: &App, id: &str) -> Result<EnvironmentInfo, Error> {
    Ok(app.environments.describe(id)?)
}

/// Ends an environment after its step in flight.
///
/// # Errors
/// It expired, or there is none.
pub async fn delete(app: &App, id: &str) -> Result<EnvironmentInfo, Error> {
    Ok(app.environments.delete(id).await?)
}

/// A page of environments in order of names.
///
/// # Errors
/// [`Error::Invalid`]: the page size is out of range.
pub fn list(app: &App, page: &PageRequest) -> Result<Page<EnvironmentInfo>, Error> {
    let table = app.environments.table();
    let (environments, more) = table.list(&page.token, page.usual_limit()?);
    let environments = environments.iter().map(|environment| environment.info(table.ttl())).collect();
    Ok(Page::bounded(environments, more, |info| json_bytes(&info.blueprint.config), |info| info.id.clone()))
}
