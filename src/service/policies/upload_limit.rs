//! The limit of uploads of checkpoints, which are held in memory until they are published.

use std::sync::Arc;

use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use crate::service::Error;

/// Maximum number of uploads at once.
const MAX_UPLOADS: usize = 4;

/// The limit, shared by all uploads.
#[derive(Debug)]
pub struct UploadLimit(Arc<Semaphore>);

/// Permits one upload. It is held with the bytes of the checkpoint until they are published, even if the caller disconnects.
#[derive(Debug)]
pub struct UploadPermit {
    _permit: OwnedSemaphorePermit,
}

impl UploadLimit {
    /// Takes a permit, before the body of the upload is read.
    ///
    /// # Errors
    /// [`Error::Busy`] when all permits are taken.
    pub fn acquire(&self) -> Result<UploadPermit, Error> {
        let permit = self.0.clone().try_acquire_owned();
        let busy = |_| Error::busy(format!("{MAX_UPLOADS} checkpoints are being uploaded, which is the limit"));
        Ok(UploadPermit { _permit: permit.map_err(busy)? })
    }
}

impl Default for UploadLimit {
    fn default() -> Self {
        Self(Arc::new(Semaphore::new(MAX_UPLOADS)))
    }
}
