//! One hosted environment. Only one reset or step runs at a time. Others wait and are checked afterwards, so a retry that
//! arrives before its first attempt has finished returns the result of the first attempt.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex as SyncMutex, MutexGuard, PoisonError};
use std::time::Duration;

use jiff::Timestamp;
use tokio::sync::{Mutex, OwnedMutexGuard};

use super::simulation::{EpisodeCursor, Simulation};
use super::spec::{EnvironmentSpec, check_seed};
use super::state::EnvironmentState;
use crate::clock::Clock;
use crate::error_code::ErrorCode;
use crate::invalid::Invalid;
use crate::serving::memory_budget::MemoryCharge;
use crate::serving::table::{LastUse, TableEntry};
use crate::serving::{Error, Owner};

/// Environments with more work per step are stepped on blocking threads, not on those that serve connections.
pub(super) const MAX_INLINE_WORK: usize = 16_384;

/// Description of an environment.
#[derive(Clone, Debug, PartialEq)]
pub struct EnvironmentInfo {
    /// Who created it.
    pub owner: Owner,
    /// Its name.
    pub id: String,
    /// Its specification, with the seed of the last reset that gave one.
    pub spec: EnvironmentSpec,
    /// Its current episode, slot and step.
    pub cursor: EpisodeCursor,
    /// When it was created.
    pub created_at: Timestamp,
    /// Idle time after which it expires.
    pub ttl: Duration,
}

/// A reset request.
#[derive(Clone, Copy, Debug, Default)]
pub struct EnvironmentReset {
    /// A new seed.
    pub seed: Option<u64>,
    /// The number of the episode to begin.
    pub episode: Option<u64>,
    /// Whether to return graphs.
    pub graph: bool,
}

/// A step request.
#[derive(Clone, Debug, Default)]
pub struct EnvironmentStep {
    /// Heading indices (B, M).
    pub actions: Vec<Vec<u32>>,
    /// The step's index, if the caller counts steps.
    pub step: Option<u64>,
    /// Whether to return graphs.
    pub graph: bool,
}

/// A hosted environment.
#[derive(Debug)]
pub struct Environment {
    owner: Owner,
    id: String,
    spec: EnvironmentSpec,
    created_at: Timestamp,
    clock: Clock,
    last_use: LastUse,
    /// Copy of the simulation's cursor, readable during a step.
    cursor: SyncMutex<EpisodeCursor>,
    simulation: Arc<Mutex<Simulation>>,
    /// Set while `simulation` is locked, so that the next holder of the lock sees the flag.
    deleted: AtomicBool,
    /// The environment's share of the memory for environments.
    _memory: MemoryCharge,
}

impl Environment {
    pub(super) fn new(
        (owner, id): (Owner, String),
        spec: EnvironmentSpec,
        simulation: Simulation,
        memory: MemoryCharge,
        clock: Clock,
    ) -> Self {
        let created_at = clock.now();
        Self {
            owner,
            id,
            spec,
            created_at,
            last_use: LastUse::at(clock.monotonic()),
            clock,
            cursor: SyncMutex::new(simulation.cursor()),
            simulation: Arc::new(Mutex::new(simulation)),
            deleted: AtomicBool::new(false),
            _memory: memory,
        }
    }

    fn cursor(&self) -> MutexGuard<'_, EpisodeCursor> {
        // Nothing panics while holding the lock.
        self.cursor.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Describes the environment.
    pub fn info(&self, ttl: Duration) -> EnvironmentInfo {
        let cursor = *self.cursor();
        let spec = EnvironmentSpec { seed: cursor.seed, ..self.spec.clone() };
        let (owner, id) = (self.owner.clone(), self.id.clone());
        EnvironmentInfo { owner, id, spec, cursor, created_at: self.created_at, ttl }
    }

    /// Handles a second creation under the same name: a retry if the environment was created from `spec` and is unused.
    ///
    /// # Errors
    /// [`Error::Conflict`] otherwise.
    pub(super) async fn recreate(&self, spec: &EnvironmentSpec) -> Result<(), Error> {
        let simulation = self.simulation.lock().await;
        let reason = if self.deleted.load(Ordering::Relaxed) {
            "and is being deleted"
        } else if self.spec != *spec {
            "with another configuration"
        } else if !simulation.is_untouched() {
            "and has been stepped or reset"
        } else {
            self.last_use.touch(self.clock.monotonic());
            return Ok(());
        };
        Err(Error::Conflict(format!("environment {:?} exists {reason}; delete it, or choose another name", self.id)))
    }

    /// Rejects all later requests. Waits for the step in flight.
    pub(super) async fn delete(&self) {
        let _simulation = self.simulation.lock().await;
        self.deleted.store(true, Ordering::Relaxed);
    }

    /// Begins an episode.
    ///
    /// # Errors
    /// [`Error::Invalid`] if the seed is out of range or graphs would be too large, [`Error::NotFound`] if the environment
    /// has been deleted.
    pub async fn reset(self: &Arc<Self>, reset: EnvironmentReset) -> Result<EnvironmentState, Error> {
        reset.seed.map_or(Ok(()), check_seed)?;
        self.check_graph(reset.graph)?;
        let mut simulation = self.lock_simulation().await?;
        self.compute(move |environment| {
            simulation.reset(reset.seed, reset.episode);
            environment.finish(&simulation, reset.graph)
        })
        .await
    }

    /// Advances every copy by one slot. Repeating the last step returns the same result without stepping, whatever the
    /// actions.
    ///
    /// # Errors
    /// [`Error::Invalid`] if the actions do not fit or graphs would be too large, `wrong_step` for a step that is neither
    /// the last nor the next, `episode_over` after the episode's last slot, [`Error::NotFound`] if the environment has been
    /// deleted.
    pub async fn step(self: &Arc<Self>, request: EnvironmentStep) -> Result<EnvironmentState, Error> {
        let headings = self.spec.headings(&request.actions)?;
        self.check_graph(request.graph)?;
        let mut simulation = self.lock_simulation().await?;
        let next = simulation.cursor().step;
        let step = request.step.unwrap_or(next);
        let repeated = simulation.is_last_step(step);
        if !repeated && step != next {
            return Err(wrong_step(&self.id, next, step));
        }
        if !repeated && simulation.is_done() {
            let slots = self.spec.config.slots;
            let message = format!("the episode of environment {:?} ended after {slots} slots; reset the environment", self.id);
            return Err(Error::precondition(ErrorCode::EpisodeOver, message));
        }
        self.compute(move |environment| {
            if !repeated {
                simulation.step(&headings, environment.spec.auto_reset);
            }
            environment.finish(&simulation, request.graph)
        })
        .await
    }

    fn check_graph(&self, requested: bool) -> Result<(), Invalid> {
        if requested { self.spec.check_graph() } else { Ok(()) }
    }

    /// Waits for the reset or step in flight.
    async fn lock_simulation(&self) -> Result<OwnedMutexGuard<Simulation>, Error> {
        let simulation = self.simulation.clone().lock_owned().await;
        if self.deleted.load(Ordering::Relaxed) { Err(Error::not_found(Self::KIND, &self.id)) } else { Ok(simulation) }
    }

    /// Publishes the cursor after a reset or step, and returns the state.
    fn finish(&self, simulation: &Simulation, graph: bool) -> EnvironmentState {
        *self.cursor() = simulation.cursor();
        self.last_use.touch(self.clock.monotonic());
        simulation.state(graph)
    }

    /// Runs `work` on this thread if it is short, on a blocking thread otherwise. Once begun, it completes even if the
    /// caller stops waiting.
    async fn compute(
        self: &Arc<Self>,
        work: impl FnOnce(&Self) -> EnvironmentState + Send + 'static,
    ) -> Result<EnvironmentState, Error> {
        if self.spec.work() <= MAX_INLINE_WORK {
            return Ok(work(self));
        }
        let environment = self.clone();
        let done = tokio::task::spawn_blocking(move || work(&environment));
        done.await.map_err(|e| Error::Internal(e.to_string()))
    }
}

impl TableEntry for Environment {
    const KIND: &'static str = "environment";
    const EXPIRED: ErrorCode = ErrorCode::EnvironmentExpired;
    const MEMORY_FLAG: &'static str = "--environment-memory";

    fn owner(&self) -> &Owner {
        &self.owner
    }

    fn id(&self) -> &str {
        &self.id
    }

    fn last_use(&self) -> &LastUse {
        &self.last_use
    }
}

fn wrong_step(id: &str, next: u64, step: u64) -> Error {
    let message = match next {
        0 => format!("step {step} is out of order: environment {id:?} has not been stepped since its reset; send step 0"),
        _ => format!("step {step} is out of order in environment {id:?}; send {next}, or {} to repeat the last step", next - 1),
    };
    Error::precondition(ErrorCode::WrongStep, message)
}
