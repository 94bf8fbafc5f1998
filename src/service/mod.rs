//! Use cases: one function each, with one error type. Both transports call only this layer.

pub mod act;
pub mod backup;
pub mod checkpoints;
pub mod decentral;
pub mod environments;
mod error;
pub mod events;
pub mod jobs;
pub mod keys;
pub mod operations;
mod paging;
pub mod policies;
pub mod progress;
mod replica;
pub mod sessions;
mod watch_limit;
pub mod webhooks;
pub mod worker;

use std::sync::Arc;

pub use error::Error;
pub use paging::{Page, PageRequest};
pub use replica::Replica;
pub use watch_limit::WatchLimit;

use crate::clock::Clock;
use crate::draining::Draining;
use crate::error_code::ErrorCode;
use crate::jobs::Scheduler;
use crate::serving::{Engine, Environments, Registry, Sessions};
use crate::store::Store;

/// Everything that use cases work with. All connections share it behind an `Arc`.
pub struct App {
    /// The database.
    pub store: Store,
    /// The scheduler of jobs.
    pub scheduler: Scheduler,
    /// The published policies and baselines.
    pub registry: Arc<Registry>,
    /// Open sessions.
    pub sessions: Sessions,
    /// Hosted environments.
    pub environments: Environments,
    /// Runs policies in batches.
    pub engine: Engine,
    /// API keys.
    pub keys: keys::Keyring,
    /// Versions of policies that are being loaded.
    pub loads: policies::Loads,
    /// What this server is a replica of; `None`: it is none.
    pub replica: Option<Replica>,
    /// What the server keeps of old versions and checkpoints.
    pub retention: policies::Retention,
    /// The limit of uploads of checkpoints.
    pub uploads: policies::UploadLimit,
    /// Slots after which UAVs and users that are missing are forgotten.
    pub absent_after: u64,
    /// Maximum size of a gRPC message or HTTP body, in bytes.
    pub max_message_size: usize,
    /// Limits of watches of jobs.
    pub watchers: WatchLimit,
    /// Tells receivers that jobs have ended.
    pub webhooks: webhooks::Webhooks,
    /// Wall time and monotonic time.
    pub clock: Clock,
    /// Whether the server is shutting down.
    pub draining: Draining,
}

impl App {
    /// Admits new work.
    ///
    /// # Errors
    /// [`Error::Draining`] once draining has begun.
    pub fn admit(&self) -> Result<(), Error> {
        if self.draining.begun() { Err(Error::Draining) } else { Ok(()) }
    }

    /// Checks that this server has policies of its primary, if it is a replica.
    ///
    /// # Errors
    /// [`Error::Unavailable`].
    pub fn check_copy(&self) -> Result<(), Error> {
        if self.replica.as_ref().is_some_and(|replica| replica.age(&self.clock).is_none()) {
            return Err(Error::Unavailable("this replica has not taken policies from its primary yet"));
        }
        Ok(())
    }
}

impl From<crate::serving::Error> for Error {
    fn from(error: crate::serving::Error) -> Self {
        use crate::serving::Error as E;
        match error {
            E::Invalid(e) => Self::Invalid(e),
            E::NotFound { what, id, near } => Self::NotFound { what, id, near },
            E::Precondition { code, message } => Self::Precondition { code, message },
            E::Conflict(message) => Self::Conflict { code: ErrorCode::AlreadyExists, message },
            E::Busy(message) => Self::busy(message),
            E::Deadline(place) => Self::Deadline(place),
            E::Internal(cause) => Self::internal(cause),
        }
    }
}
