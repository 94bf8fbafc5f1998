//! Environments that learners elsewhere fly. This file owns how they begin and end and how much memory they take together;
//! `environment` what one may do, and the table which there are.

mod blueprint;
mod environment;
mod state;

pub use blueprint::Blueprint;
pub use environment::{Environment, EnvironmentInfo, Flight, Progress, Reset};
pub use state::{CopyState, Finished, Sight, State};

use std::sync::Arc;

use tokio::sync::Semaphore;

use super::table::{Found, Table, fresh_name};
use super::{Error, Limits};
use crate::clock::Clock;
use environment::World;

/// Bytes that are accounted for together.
const PAGE: usize = 1024;

/// Limits of environments.
#[derive(Clone, Copy, Debug)]
pub struct EnvironmentsConfig {
    /// How many, and for how long.
    pub limits: Limits,
    /// Bytes that all may take together.
    pub memory: usize,
}

/// All environments of this server.
#[derive(Debug)]
pub struct Environments {
    table: Table<Environment>,
    /// Pages that are free.
    pages: Arc<Semaphore>,
    memory: usize,
}

impl Environments {
    /// No environments yet.
    pub fn new(config: EnvironmentsConfig, clock: Clock) -> Self {
        let pages = (config.memory / PAGE).min(Semaphore::MAX_PERMITS);
        Self { table: Table::new(config.limits, clock), pages: Arc::new(Semaphore::new(pages)), memory: config.memory }
    }

    /// Which there are.
    pub fn table(&self) -> &Table<Environment> {
        &self.table
    }

    /// Creates an environment called `id`, or by a name of its own. With the name of one that was created alike and has not
    /// been used it is a retry.
    ///
    /// # Errors
    /// The name is taken, or there are too many or too large environments.
    pub async fn create(&self, id: Option<String>, blueprint: Blueprint) -> Result<EnvironmentInfo, Error> {
        let id = id.unwrap_or_else(fresh_name);
        // A retry takes no memory, and is told from a name that is taken, even where there is none left.
        let environment = match self.table.get(&id) {
            Ok(existing) => {
                existing.recreate(&blueprint).await?;
                existing
            }
            Err(_) => self.build(id, blueprint).await?,
        };
        Ok(environment.info(self.table.ttl()))
    }

    async fn build(&self, id: String, blueprint: Blueprint) -> Result<Arc<Environment>, Error> {
        let pages = u32::try_from(blueprint.bytes().div_ceil(PAGE)).unwrap_or(u32::MAX);
        let share = || self.pages.clone().try_acquire_many_owned(pages);
        let share = share().or_else(|_| {
            // Those that nobody uses make room.
            self.table.sweep();
            share()
        });
        let share = share.map_err(|_| {
            let (size, memory) = (blueprint.bytes() >> 10, self.memory >> 10);
            Error::Busy(format!("no room for an environment of {size} KiB in the {memory} KiB that this server has for all"))
        })?;
        let wanted = blueprint.clone();
        let world = if blueprint.work() <= environment::LARGE {
            World::new(&wanted)?
        } else {
            let built = tokio::task::spawn_blocking(move || World::new(&wanted));
            built.await.map_err(|e| Error::Fault(e.to_string()))??
        };
        let clock = self.table.clock().clone();
        let make = || Environment::new(id.clone(), blueprint.clone(), world, share, clock);
        match self.table.find_or_add(&id, make)? {
            Found::New(environment) => Ok(environment),
            // Two asked for the same name at once.
            Found::Existing(environment) => environment.recreate(&blueprint).await.map(|()| environment),
        }
    }

    /// What a caller is told of environment `id`; asking keeps it alive.
    ///
    /// # Errors
    /// It expired, or there is none.
    pub fn describe(&self, id: &str) -> Result<EnvironmentInfo, Error> {
        Ok(self.table.get(id)?.info(self.table.ttl()))
    }

    /// Ends environment `id` after the step in flight, if there is one.
    ///
    /// # Errors
    /// It expired, or there is none.
    pub async fn delete(&self, id: &str) -> Result<EnvironmentInfo, Error> {
        let environment = self.table.get(id)?;
        self.table.remove(&environment);
        environment.end().await;
        Ok(environment.info(self.table.ttl()))
    }
}
