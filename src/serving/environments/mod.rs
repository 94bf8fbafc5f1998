//! Environments that the server hosts for callers that train elsewhere. This file owns their creation and their deletion;
//! `environment` owns the requests to one of them.

mod environment;
mod simulation;
mod spec;
mod state;

pub use environment::{Environment, EnvironmentInfo, EnvironmentReset, EnvironmentStep};
pub use simulation::EpisodeCursor;
pub use spec::EnvironmentSpec;
pub use state::{CopyObservation, CopyState, EnvironmentState, FinishedEpisode};

use std::sync::Arc;

use super::table::{Lookup, Table, generate_id};
use super::{Error, Limits, Owner};
use crate::clock::Clock;
use simulation::Simulation;

/// All environments of this server.
#[derive(Debug)]
pub struct Environments {
    table: Table<Environment>,
}

impl Environments {
    /// An empty set of environments.
    pub fn new(limits: Limits, clock: Clock) -> Self {
        Self { table: Table::new(limits, clock) }
    }

    /// The environments by name.
    pub fn table(&self) -> &Table<Environment> {
        &self.table
    }

    /// Creates an environment of `owner` named `id`, or with a generated name. If an unused environment of that name was created from
    /// the same `spec`, the call is a retry and returns that environment.
    ///
    /// # Errors
    /// [`Error::Conflict`] if the name is taken, [`Error::Busy`] if the number or the memory of environments is exhausted.
    pub async fn create(&self, owner: &Owner, id: Option<String>, spec: EnvironmentSpec) -> Result<EnvironmentInfo, Error> {
        let name = (owner.clone(), id.unwrap_or_else(generate_id));
        // Checked first, so that a retry succeeds and a conflict is reported even if no memory is left.
        let environment = match self.table.get(owner, &name.1) {
            Ok(existing) => {
                existing.recreate(&spec).await?;
                existing
            }
            Err(_) => self.build(name, spec).await?,
        };
        Ok(environment.info(self.table.ttl()))
    }

    async fn build(&self, name: (Owner, String), spec: EnvironmentSpec) -> Result<Arc<Environment>, Error> {
        let memory = self.table.charge_memory(&name.0, spec.bytes())?;
        let requested = spec.clone();
        let simulation = if spec.work() <= environment::MAX_INLINE_WORK {
            Simulation::new(&requested)?
        } else {
            let built = tokio::task::spawn_blocking(move || Simulation::new(&requested));
            built.await.map_err(|e| Error::Internal(e.to_string()))??
        };
        let clock = self.table.clock().clone();
        let make = || Environment::new(name.clone(), spec.clone(), simulation, memory, clock);
        match self.table.find_or_add(&name.0, &name.1, make)? {
            Lookup::Added(environment) => Ok(environment),
            // A concurrent call created it.
            Lookup::Found(environment) => environment.recreate(&spec).await.map(|()| environment),
        }
    }

    /// Describes environment `id` of `owner`, and counts as a use of it.
    ///
    /// # Errors
    /// `environment_expired`, or [`Error::NotFound`].
    pub fn describe(&self, owner: &Owner, id: &str) -> Result<EnvironmentInfo, Error> {
        Ok(self.table.get(owner, id)?.info(self.table.ttl()))
    }

    /// Deletes environment `id` of `owner`. Waits for the step in flight.
    ///
    /// # Errors
    /// `environment_expired`, or [`Error::NotFound`].
    pub async fn delete(&self, owner: &Owner, id: &str) -> Result<EnvironmentInfo, Error> {
        let environment = self.table.get(owner, id)?;
        self.table.remove(&environment);
        environment.delete().await;
        Ok(environment.info(self.table.ttl()))
    }
}
