//! Checkpoints of jobs, by their own ids.

use uuid::Uuid;

use super::keys::Caller;
use super::{App, Error};
use crate::serving::Owner;
use crate::store::Checkpoint;

/// The checkpoint `id` with its bytes, if the caller sees its job.
///
/// # Errors
/// [`Error::NotFound`].
pub async fn get(app: &App, caller: &Caller, id: &str) -> Result<(Checkpoint, Vec<u8>), Error> {
    let missing = || Error::not_found("checkpoint", id);
    app.store
        .checkpoint(Uuid::try_parse(id).map_err(|_| missing())?, caller.sees().and_then(Owner::id))
        .await?
        .ok_or_else(missing)
}
