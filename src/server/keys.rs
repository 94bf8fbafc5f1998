//! Background task that keeps the API keys of a running server in step with the database.

use std::sync::Arc;
use std::time::Duration;

use crate::service::App;

/// Time between two checks for changed keys.
const REFRESH_INTERVAL: Duration = Duration::from_secs(1);

/// The times of last use are saved at every so many refreshes.
const REFRESHES_PER_SAVE: u64 = 30;

/// Loads keys that another process created, revoked or rotated, and regularly saves when keys were last used.
pub(super) async fn follow(app: Arc<App>) {
    for refresh in 1_u64.. {
        tokio::time::sleep(REFRESH_INTERVAL).await;
        if let Err(error) = app.keys.refresh(&app.store).await {
            tracing::warn!(error = error.reason(), "cannot refresh API keys");
        }
        if refresh % REFRESHES_PER_SAVE == 0 {
            save_last_used(&app).await;
        }
    }
}

/// Saves when keys were last used.
pub(super) async fn save_last_used(app: &App) {
    if let Err(error) = app.keys.save_last_used(&app.store).await {
        tracing::warn!(error = error.reason(), "cannot save when API keys were last used");
    }
}
