//! A token bucket without locks: how many requests per second, and how many at once.

use std::ops::RangeInclusive;
use std::sync::atomic::{AtomicI64, Ordering};
use std::time::Duration;

/// How often something may be asked for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rate {
    /// Per second, in the long run.
    pub per_second: f64,
    /// At once, after a pause.
    pub burst: f64,
}

impl Rate {
    /// What may be asked for per second.
    pub const PER_SECOND: RangeInclusive<f64> = 0.001..=1e6;
    /// What may be asked for at once.
    pub const BURST: RangeInclusive<f64> = 1.0..=1e6;

    /// Without `burst`, as many at once as one second allows.
    pub fn new(per_second: f64, burst: Option<f64>) -> Self {
        Self { per_second, burst: burst.unwrap_or(per_second.max(1.0)) }
    }
}

/// A bucket, full at first. It keeps the moment at which it would be full again; all times are nanoseconds.
#[derive(Debug)]
pub struct Bucket {
    /// Between two tokens.
    interval: i64,
    /// How far ahead that moment may be while there still is a token.
    slack: i64,
    full_at: AtomicI64,
}

impl Bucket {
    pub fn new(rate: Rate) -> Self {
        let interval = 1e9 / rate.per_second;
        Self { interval: interval as i64, slack: (interval * (rate.burst - 1.0)) as i64, full_at: AtomicI64::new(i64::MIN) }
    }

    /// Takes a token at `now`.
    ///
    /// # Errors
    /// There is none; when there will be one.
    pub fn take(&self, now: i64) -> Result<(), Duration> {
        let take = |full_at: i64| (self.wait(full_at, now) <= 0).then(|| self.later(full_at, 1, now));
        let taken = self.full_at.fetch_update(Ordering::Relaxed, Ordering::Relaxed, take);
        taken.map(drop).map_err(|full_at| Duration::from_nanos(self.wait(full_at, now).unsigned_abs()))
    }

    /// Takes `tokens` at `now`, whether or not there are so many: those who come next wait for them.
    pub fn charge(&self, tokens: u32, now: i64) {
        let charge = |full_at: i64| Some(self.later(full_at, tokens, now));
        // It never refuses.
        let _ = self.full_at.fetch_update(Ordering::Relaxed, Ordering::Relaxed, charge);
    }

    fn wait(&self, full_at: i64, now: i64) -> i64 {
        full_at.saturating_sub(now).saturating_sub(self.slack)
    }

    fn later(&self, full_at: i64, tokens: u32, now: i64) -> i64 {
        full_at.max(now).saturating_add(self.interval.saturating_mul(i64::from(tokens)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    #[test]
    fn bursts_then_the_rate() {
        let bucket = Bucket::new(Rate { per_second: 10.0, burst: 3.0 });
        for _ in 0..3 {
            assert_eq!(bucket.take(0), Ok(()));
        }
        assert_eq!(bucket.take(0), Err(Duration::from_millis(100)));
        assert_eq!(bucket.take(60 * MS), Err(Duration::from_millis(40)));
        assert_eq!(bucket.take(100 * MS), Ok(()));
        assert!(bucket.take(199 * MS).is_err());
        // After a long pause it is full, and not more than full.
        let later = 3600 * 1000 * MS;
        assert_eq!((0..9).filter(|_| bucket.take(later).is_ok()).count(), 3);
    }

    #[test]
    fn what_is_too_large_is_waited_for_afterwards() {
        let bucket = Bucket::new(Rate { per_second: 10.0, burst: 1.0 });
        assert_eq!(bucket.take(0), Ok(()));
        bucket.charge(19, 0);
        assert_eq!(bucket.take(0), Err(Duration::from_secs(2)));
        assert_eq!(bucket.take(2000 * MS), Ok(()));
    }

    #[test]
    fn extremes_do_not_overflow() {
        assert_eq!(Rate::new(0.5, None).burst, 1.0);
        assert_eq!(Rate::new(50.0, None).burst, 50.0);
        let slow = Bucket::new(Rate::new(*Rate::PER_SECOND.start(), Some(*Rate::BURST.end())));
        for _ in 0..10 {
            slow.charge(u32::MAX, i64::MAX - 1);
        }
        assert!(slow.take(i64::MIN).is_err());
    }
}
