//! Use cases of hosted environments: create, reset, step, describe, delete, list.

use serde_json::Value;

use super::keys::Caller;
use super::paging::json_bytes;
use super::{App, Error, Page, PageRequest};
use crate::serving::{EnvironmentInfo, EnvironmentReset, EnvironmentSpec, EnvironmentState, EnvironmentStep};
use crate::train_config;

/// A request to create an environment.
#[derive(Clone, Debug)]
pub struct NewEnvironment {
    /// The environment's name; generated if absent.
    pub id: Option<String>,
    /// Fields of the configuration that differ from the defaults.
    pub environment: Value,
    /// Copy b's first episode has the seed `seed` + b.
    pub seed: u64,
    /// B, the number of copies.
    pub count: usize,
    /// Whether the last step of an episode begins the next.
    pub auto_reset: bool,
}

/// Creates an environment, at slot 0 of episode 0.
///
/// # Errors
/// [`Error::Draining`]; [`Error::Invalid`] for unknown fields and values out of range; [`Error::Conflict`] if the name is
/// taken; [`Error::Busy`] if the number or the memory of environments is exhausted.
pub async fn create(app: &App, caller: &Caller, new: NewEnvironment) -> Result<EnvironmentInfo, Error> {
    app.admit()?;
    let NewEnvironment { id, environment, seed, count, auto_reset } = new;
    let spec = EnvironmentSpec::new(train_config::parse_environment(environment)?, count, seed, auto_reset)?;
    Ok(app.environments.create(caller.owner(), id, spec).await?)
}

/// Begins an episode in every copy of an environment of the caller's owner.
///
/// # Errors
/// [`Error::Draining`]; [`Error::Invalid`] if the seed is out of range or graphs would be too large; [`Error::NotFound`];
/// `environment_expired`.
pub async fn reset(app: &App, caller: &Caller, id: &str, reset: EnvironmentReset) -> Result<EnvironmentState, Error> {
    app.admit()?;
    Ok(app.environments.table().get(caller.owner(), id)?.reset(reset).await?)
}

/// Advances every copy of an environment of the caller's owner by one slot.
///
/// # Errors
/// [`Error::Draining`]; [`Error::Invalid`] if the actions do not fit or graphs would be too large; [`Error::NotFound`];
/// `wrong_step`, `episode_over`, `environment_expired`.
pub async fn step(app: &App, caller: &Caller, id: &str, step: EnvironmentStep) -> Result<EnvironmentState, Error> {
    app.admit()?;
    Ok(app.environments.table().get(caller.owner(), id)?.step(step).await?)
}

/// Describes an environment.
///
/// # Errors
/// [`Error::NotFound`], or `environment_expired`.
pub fn get(app: &App, caller: &Caller, id: &str) -> Result<EnvironmentInfo, Error> {
    Ok(app.environments.describe(&caller.owner_among(app.environments.table(), id), id)?)
}

/// Deletes an environment after its step in flight.
///
/// # Errors
/// [`Error::NotFound`], or `environment_expired`.
pub async fn delete(app: &App, caller: &Caller, id: &str) -> Result<EnvironmentInfo, Error> {
    Ok(app.environments.delete(&caller.owner_among(app.environments.table(), id), id).await?)
}

/// A page of the environments that the caller sees, in order of names.
///
/// # Errors
/// [`Error::Invalid`]: the page size is out of range.
pub fn list(app: &App, caller: &Caller, page: &PageRequest) -> Result<Page<EnvironmentInfo>, Error> {
    let table = app.environments.table();
    let (owner, id) = caller.list_position(&page.token);
    let (environments, more) = table.list(caller.sees(), (id, &owner), page.usual_limit()?);
    let environments = environments.iter().map(|environment| environment.info(table.ttl())).collect();
    Ok(Page::bounded(environments, more, |info| json_bytes(&info.spec.config), |info| caller.list_token(&info.owner, &info.id)))
}
