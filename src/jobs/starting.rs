//! What starting a worker has in common here and in a cluster.

use crate::store::WorkerResult;

/// Why no attempt could begin: the database, or the system's source of random numbers.
pub(super) type StartError = Box<dyn std::error::Error + Send + Sync>;

/// A secret for a worker.
pub(super) fn new_token() -> Result<String, StartError> {
    let mut secret = [0; 32];
    getrandom::fill(&mut secret)?;
    Ok(hex::encode(secret))
}

/// A failure after which another attempt may succeed.
pub(super) fn failed(reason: String) -> WorkerResult {
    WorkerResult::Failed { reason, permanent: false }
}
