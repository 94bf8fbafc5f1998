//! A bound on lines: whoever floods the server must not flood its log.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

/// Lines per second that pass.
const LINES: u64 = 20;

/// Lets some lines of every second pass and counts the others.
pub struct Valve {
    opened: Instant,
    /// The second it is, times 2^32, plus the lines in it.
    now: AtomicU64,
    muted: AtomicU64,
}

impl Valve {
    /// An open one.
    pub fn new() -> Self {
        Self { opened: Instant::now(), now: AtomicU64::new(0), muted: AtomicU64::new(0) }
    }

    /// Whether a line may be written now; if so, how many were not since the last one.
    pub fn pass(&self) -> Option<u64> {
        self.pass_at(self.opened.elapsed().as_secs())
    }

    fn pass_at(&self, second: u64) -> Option<u64> {
        let next = |now: u64| Some(if now >> 32 == second { now.saturating_add(1) } else { (second << 32) + 1 });
        let before = self.now.fetch_update(Ordering::Relaxed, Ordering::Relaxed, next).unwrap_or_default();
        if before >> 32 == second && before & 0xffff_ffff >= LINES {
            self.muted.fetch_add(1, Ordering::Relaxed);
            return None;
        }
        Some(self.muted.swap(0, Ordering::Relaxed))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flood_leaves_a_count() {
        let valve = Valve::new();
        let passed = (0..1000).filter(|_| valve.pass_at(0).is_some()).count();
        assert_eq!(passed as u64, LINES);
        assert_eq!(valve.pass_at(1), Some(1000 - LINES));
        assert_eq!(valve.pass_at(1), Some(0));
        assert_eq!((0..1000).filter(|_| valve.pass_at(7).is_some()).count() as u64, LINES);
    }
}
