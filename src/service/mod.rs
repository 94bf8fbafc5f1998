//! Use cases: one function each, one error type. Both transports call only this.

pub mod act;
pub mod environments;
mod error;
pub mod events;
pub mod jobs;
pub mod keys;
pub mod operations;
mod paging;
pub mod policies;
pub mod sequences;
pub mod sessions;
pub mod worker;

use std::sync::Arc;

pub use error::Error;
pub use events::Watchers;
pub use paging::{Page, PageRequest};
use tokio_util::sync::CancellationToken;

use crate::jobs::Jobs;
use crate::serving::{Clock, Engine, Environments, Registry, Sessions};
use crate::store::Store;

/// What use cases work with; shared by all connections behind an `Arc`.
pub struct App {
    /// Durable state.
    pub store: Store,
    /// The scheduler.
    pub jobs: Jobs,
    /// Policies that can be asked.
    pub registry: Arc<Registry>,
    /// Fleets whose memory the server keeps.
    pub sessions: Sessions,
    /// Environments that learners elsewhere fly.
    pub environments: Environments,
    /// Where headings are computed.
    pub engine: Engine,
    /// Who may ask.
    pub keys: keys::Keyring,
    /// Who follows a job.
    pub watchers: Watchers,
    /// The time of day.
    pub clock: Clock,
    /// Whether the server is shutting down.
    pub draining: Draining,
}

/// Whether the server is shutting down: new work is refused, work in flight goes on.
#[derive(Debug, Default)]
pub struct Draining(CancellationToken);

impl Draining {
    /// From now on new work is refused.
    pub fn begin(&self) {
        self.0.cancel();
    }

    /// Whether [`Draining::begin`] was called.
    pub fn begun(&self) -> bool {
        self.0.is_cancelled()
    }

    /// Returns when it is called.
    pub async fn wait(&self) {
        self.0.cancelled().await;
    }
}

impl App {
    /// Lets new work in.
    ///
    /// # Errors
    /// [`Error::Draining`].
    pub fn admit(&self) -> Result<(), Error> {
        if self.draining.begun() { Err(Error::Draining) } else { Ok(()) }
    }
}

impl From<crate::serving::Error> for Error {
    fn from(error: crate::serving::Error) -> Self {
        use crate::serving::Error as E;
        match error {
            E::Invalid(e) => Self::Invalid(e),
            E::Unknown { what, id } => Self::NotFound { what, id },
            E::Precondition { code, message } => Self::Precondition { code, message },
            E::Exists(message) => Self::Conflict { code: "already_exists", message },
            E::Busy(message) => Self::busy(message),
            E::Deadline(place) => Self::Deadline(place),
            E::Fault(cause) => Self::internal(cause),
        }
    }
}
