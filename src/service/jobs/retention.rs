//! Deletes jobs that ended long ago, with their metrics, logs and checkpoints. The versions that they published stay.

use jiff::SignedDuration;

use crate::service::{App, Error};
use crate::store::JobAction;

/// Jobs per look at the list.
const BATCH: u32 = 100;

/// Deletes the jobs that the rules of retention do not keep.
///
/// # Errors
/// [`Error::Internal`] when the database fails.
pub async fn delete_old(app: &App) -> Result<(), Error> {
    let (keep, keep_for) = (app.retention.jobs, app.retention.jobs_for);
    if keep == 0 && keep_for.is_zero() {
        return Ok(());
    }
    let mut deleted = 0_u64;
    loop {
        let now = app.clock.now();
        let age = SignedDuration::try_from(keep_for).ok().filter(|age| !age.is_zero());
        let before = age.and_then(|age| now.checked_sub(age).ok());
        let old = app.store.old_jobs(keep, before, BATCH).await?;
        for id in &old {
            // Somebody may have deleted or retried it meanwhile; then this does nothing.
            app.store.change_job(*id, JobAction::Delete, now).await?;
            deleted += 1;
            metrics::counter!("qedgix_jobs_deleted_total").increment(1);
        }
        if old.len() < BATCH as usize {
            break;
        }
    }
    if deleted > 0 {
        tracing::info!(deleted, "old jobs deleted (--keep-jobs, --keep-jobs-for)");
        app.scheduler.all_jobs_changed();
    }
    Ok(())
}
