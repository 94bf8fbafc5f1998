//! A limit on log lines per second, so that a flood of refused requests does not flood the log.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

/// Lines allowed per second.
const LINES: u64 = 20;

/// Allows the first [`LINES`] lines of every second and counts the suppressed ones.
pub struct LogLimiter {
    created: Instant,
    /// The current second in the upper 32 bits, the lines in it in the lower.
    second_and_lines: AtomicU64,
    suppressed: AtomicU64,
}

impl LogLimiter {
    /// A limiter that has allowed no line yet.
    pub fn new() -> Self {
        Self { created: Instant::now(), second_and_lines: AtomicU64::new(0), suppressed: AtomicU64::new(0) }
    }

    /// Returns the number of lines suppressed since the last allowed one, or nothing if this line is suppressed.
    pub fn allow(&self) -> Option<u64> {
        self.allow_at(self.created.elapsed().as_secs())
    }

    fn allow_at(&self, second: u64) -> Option<u64> {
        let next = |now: u64| Some(if now >> 32 == second { now.saturating_add(1) } else { (second << 32) + 1 });
        let before = self.second_and_lines.fetch_update(Ordering::Relaxed, Ordering::Relaxed, next).unwrap_or_default();
        if before >> 32 == second && before & 0xffff_ffff >= LINES {
            self.suppressed.fetch_add(1, Ordering::Relaxed);
            return None;
        }
        Some(self.suppressed.swap(0, Ordering::Relaxed))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn suppressed_lines_are_counted() {
        let limiter = LogLimiter::new();
        let allowed = (0..1000).filter(|_| limiter.allow_at(0).is_some()).count();
        assert_eq!(allowed as u64, LINES);
        assert_eq!(limiter.allow_at(1), Some(1000 - LINES));
        assert_eq!(limiter.allow_at(1), Some(0));
        assert_eq!((0..1000).filter(|_| limiter.allow_at(7).is_some()).count() as u64, LINES);
    }
}
