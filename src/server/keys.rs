//! Keeps the keys of a running server in step with the database.

use std::error::Error;
use std::sync::Arc;
use std::time::Duration;

use crate::service::App;

/// Pause between two looks whether keys have changed.
const PAUSE: Duration = Duration::from_secs(1);

/// Pauses between two times that the last uses are written down.
const USES: u64 = 30;

/// Notices keys that were made, revoked or given an end elsewhere, and now and then writes down when keys were used.
pub(super) async fn follow(app: Arc<App>) {
    for pause in 1_u64.. {
        tokio::time::sleep(PAUSE).await;
        if let Err(error) = app.keys.refresh(&app.store).await {
            tracing::warn!(error = &error as &dyn Error, "API keys could not be read again");
        }
        if pause % USES == 0 {
            keep_last_uses(&app).await;
        }
    }
}

/// Writes down when keys were used.
pub(super) async fn keep_last_uses(app: &App) {
    if let Err(error) = app.keys.keep_last_uses(&app.store).await {
        tracing::warn!(error = &error as &dyn Error, "the last uses of API keys could not be written down");
    }
}
