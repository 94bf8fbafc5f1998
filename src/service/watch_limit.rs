//! The limit of open watches of jobs.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::{App, Error};

/// The limit of open watches, and their heartbeat.
#[derive(Debug)]
pub struct WatchLimit {
    permits: Arc<Semaphore>,
    max: usize,
    heartbeat: Duration,
}

impl WatchLimit {
    /// At most `max` watches at a time. A watch without events sends a heartbeat every `heartbeat` on transports that have
    /// none of their own.
    pub fn new(max: usize, heartbeat: Duration) -> Self {
        Self { permits: Arc::new(Semaphore::new(max)), max, heartbeat }
    }

    /// Number of open watches.
    pub fn open(&self) -> usize {
        self.max - self.permits.available_permits()
    }

    /// Time without events after which a watch sends a heartbeat.
    pub fn heartbeat(&self) -> Duration {
        self.heartbeat
    }

    /// The permit of one more watch.
    ///
    /// # Errors
    /// [`Error::Busy`] when too many watches are open, [`Error::Draining`].
    pub(super) fn acquire(&self, app: &App) -> Result<OwnedSemaphorePermit, Error> {
        app.admit()?;
        self.permits.clone().try_acquire_owned().map_err(|_| Error::Busy {
            message: format!("{} watches are open, which is the limit", self.max),
            retry_after: Duration::from_secs(5),
        })
    }
}
