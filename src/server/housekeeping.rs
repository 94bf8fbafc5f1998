//! Work in the background: expiry of sessions and environments, upkeep of metrics, the rules of retention, space of the database file
//! that nothing uses any more, and messages of webhooks.

use std::collections::VecDeque;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use crate::inflight::Budget;
use crate::service::{App, jobs, policies, webhooks};
use crate::store::{self, Store};
use crate::telemetry;

/// Works until it is aborted. `ttl`: the shorter of the idle times of sessions and environments.
pub(super) async fn run(app: Arc<App>, ttl: Duration, budget: Arc<Budget>) {
    tokio::join!(expire(&app, ttl, &budget), apply_retention(&app), give_back_space(&app), webhooks::deliver(&app));
}

/// Expires idle sessions and environments, and maintains metrics.
async fn expire(app: &App, ttl: Duration, budget: &Budget) {
    let inflight = metrics::gauge!("qedgix_inflight_bytes");
    let dropped_lines = metrics::counter!("qedgix_log_lines_dropped_total");
    let mut reported = telemetry::dropped_log_lines();
    let mut sweep = tokio::time::interval((ttl / 4).clamp(Duration::from_secs(1), Duration::from_secs(30)));
    // Recorded durations stay in memory until this moves them into their histogram buckets.
    let mut upkeep = tokio::time::interval(Duration::from_secs(5));
    loop {
        tokio::select! {
            _ = sweep.tick() => {
                app.sessions.remove_expired();
                app.environments.table().remove_expired();
            }
            _ = upkeep.tick() => {
                telemetry::install_metrics().run_upkeep();
                inflight.set(budget.used() as f64);
                let dropped = telemetry::dropped_log_lines();
                dropped_lines.absolute(dropped);
                if std::mem::replace(&mut reported, dropped) != dropped {
                    tracing::warn!(lines = dropped, "log lines were dropped since the start, because standard error was not read");
                }
            }
        }
    }
}

/// Applies the rules of retention at the start and every minute.
async fn apply_retention(app: &App) {
    let mut tick = tokio::time::interval(Duration::from_secs(60));
    loop {
        tick.tick().await;
        let applied = async {
            jobs::delete_old(app).await?;
            policies::delete_excess_versions(app).await?;
            let mut after = 0;
            while let Some(next) = policies::delete_excess_checkpoints(app, after).await? {
                after = next;
            }
            Ok::<_, crate::service::Error>(())
        };
        if let Err(error) = applied.await {
            tracing::warn!(reason = error.reason(), "old jobs, versions and checkpoints cannot be deleted; trying again later");
        }
    }
}

/// Gives pages of the database file back that stayed free for a minute. Running jobs replace their snapshots all the time and use
/// pages again that are free for a moment.
async fn give_back_space(app: &App) {
    let mut tick = tokio::time::interval(Duration::from_secs(5));
    let mut free = FreePages::default();
    loop {
        tick.tick().await;
        let given_back = async {
            let pages = free.add(app.store.free_pages().await?);
            for _ in 0..pages.div_ceil(Store::STEP_PAGES) {
                app.store.give_back_step().await?;
            }
            Ok::<_, store::Error>(pages)
        };
        match given_back.await {
            Ok(0) => {}
            Ok(pages) => tracing::info!(pages, "free space of the database file given back"),
            Err(error) => tracing::debug!(%error, "free space of the database file cannot be given back"),
        }
    }
}

/// Numbers of free pages that were seen in the last minute.
#[derive(Debug, Default)]
struct FreePages(VecDeque<u64>);

impl FreePages {
    /// Numbers that it remembers: one every 5 s.
    const SEEN: usize = 12;

    /// Adds a number. Returns how many pages stayed free since the oldest one; 0 if that is too short ago, or not worth a step.
    fn add(&mut self, free: u64) -> u64 {
        self.0.push_back(free);
        if self.0.len() < Self::SEEN {
            return 0;
        }
        let idle = self.0.iter().copied().min().unwrap_or(0);
        if idle < Store::STEP_PAGES {
            self.0.pop_front();
            return 0;
        }
        self.0.clear();
        idle
    }
}

/// Rewrites a database file of an older version once, so that it can give back free space, if the disk has room for two copies.
pub(super) async fn prepare_file(store: &Store, dir: &Path) -> Result<(), store::Error> {
    if store.can_give_back().await? {
        return Ok(());
    }
    let size = std::fs::metadata(dir.join(store::FILE)).map_or(u64::MAX, |file| file.len());
    let room = rustix::fs::statvfs(dir).map_or(0, |disk| disk.f_bavail.saturating_mul(disk.f_frsize));
    if room < size.saturating_mul(2).saturating_add(MARGIN) {
        tracing::warn!(
            size,
            room,
            "no room to rewrite the database file; space of deleted records is used again, not given back"
        );
        return Ok(());
    }
    tracing::info!(size, "rewriting the database file of an older version, once");
    if let Err(error) = store.rewrite().await {
        tracing::warn!(%error, "the database file cannot be rewritten; trying again at the next start");
    }
    Ok(())
}

/// Bytes that stay free on the disk while the database file is rewritten.
const MARGIN: u64 = 64 << 20;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_pages_that_stayed_free_are_given_back() {
        let mut pages = FreePages::default();
        let mut add_all = |free: u64, times: usize| (0..times).map(|_| pages.add(free)).sum::<u64>();
        assert_eq!(add_all(10_000, 11), 0, "not yet a minute");
        assert_eq!(add_all(300, 1), 300, "a snapshot uses the others in between");
        assert_eq!(add_all(300, 11), 0, "the minute begins anew");
        assert_eq!(add_all(100, 1) + add_all(9_000, 11), 0);
        assert_eq!(add_all(9_000, 1), 9_000);
    }
}
