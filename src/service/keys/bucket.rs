//! Rate limits: a lock-free token bucket (GCRA) on nanosecond time stamps that the caller passes in.
//!
//! The crate `governor` implements the same algorithm, but lacks two features that API keys need. First, a batch is charged
//! after it was accepted, possibly with more requests than the burst; later requests then wait. `check_n` of governor refuses
//! such a charge. Second, rates of API keys may be fractions of a request per second; governor counts whole requests.

use std::ops::RangeInclusive;
use std::sync::atomic::{AtomicI64, Ordering};
use std::time::Duration;

/// A request rate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rate {
    /// Sustained requests per second.
    pub per_second: f64,
    /// Requests at once, after a pause.
    pub burst: f64,
}

impl Rate {
    /// Valid values of [`Rate::per_second`].
    pub const PER_SECOND: RangeInclusive<f64> = 0.001..=1e6;
    /// Valid values of [`Rate::burst`].
    pub const BURST: RangeInclusive<f64> = 1.0..=1e6;

    /// `burst` defaults to the requests of one second, at least 1.
    pub fn new(per_second: f64, burst: Option<f64>) -> Self {
        Self { per_second, burst: burst.unwrap_or(per_second.max(1.0)) }
    }
}

/// A token bucket, full at first. Its state is the time at which it is full again. All times are nanoseconds.
#[derive(Debug)]
pub struct TokenBucket {
    /// Time between two tokens.
    interval: i64,
    /// A token is left while `full_at` is at most this far in the future: the time to refill all tokens but one.
    burst_allowance: i64,
    full_at: AtomicI64,
}

impl TokenBucket {
    pub fn new(rate: Rate) -> Self {
        let interval = 1e9 / rate.per_second;
        Self {
            interval: interval as i64,
            burst_allowance: (interval * (rate.burst - 1.0)) as i64,
            full_at: AtomicI64::new(i64::MIN),
        }
    }

    /// Takes one token at `now`.
    ///
    /// # Errors
    /// The time until the next token when none is left.
    pub fn take(&self, now: i64) -> Result<(), Duration> {
        let take = |full_at: i64| (self.wait(full_at, now) <= 0).then(|| self.later(full_at, 1, now));
        let taken = self.full_at.fetch_update(Ordering::Relaxed, Ordering::Relaxed, take);
        taken.map(drop).map_err(|full_at| Duration::from_nanos(self.wait(full_at, now).unsigned_abs()))
    }

    /// Takes `tokens` at `now` even if fewer are left. The following calls of [`TokenBucket::take`] wait for the difference.
    pub fn charge(&self, tokens: u32, now: i64) {
        let charge = |full_at: i64| Some(self.later(full_at, tokens, now));
        // The update always succeeds, because `charge` always returns a value.
        let _ = self.full_at.fetch_update(Ordering::Relaxed, Ordering::Relaxed, charge);
    }

    fn wait(&self, full_at: i64, now: i64) -> i64 {
        full_at.saturating_sub(now).saturating_sub(self.burst_allowance)
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
    fn a_burst_is_allowed_then_the_rate() {
        let bucket = TokenBucket::new(Rate { per_second: 10.0, burst: 3.0 });
        for _ in 0..3 {
            assert_eq!(bucket.take(0), Ok(()));
        }
        assert_eq!(bucket.take(0), Err(Duration::from_millis(100)));
        assert_eq!(bucket.take(60 * MS), Err(Duration::from_millis(40)));
        assert_eq!(bucket.take(100 * MS), Ok(()));
        assert!(bucket.take(199 * MS).is_err());
        // After a long pause the bucket holds the burst, and not more.
        let later = 3600 * 1000 * MS;
        assert_eq!((0..9).filter(|_| bucket.take(later).is_ok()).count(), 3);
    }

    #[test]
    fn a_charge_beyond_the_burst_delays_later_requests() {
        let bucket = TokenBucket::new(Rate { per_second: 10.0, burst: 1.0 });
        assert_eq!(bucket.take(0), Ok(()));
        bucket.charge(19, 0);
        assert_eq!(bucket.take(0), Err(Duration::from_secs(2)));
        assert_eq!(bucket.take(2000 * MS), Ok(()));
    }

    #[test]
    fn extreme_values_do_not_overflow() {
        assert_eq!(Rate::new(0.5, None).burst, 1.0);
        assert_eq!(Rate::new(50.0, None).burst, 50.0);
        let slow = TokenBucket::new(Rate::new(*Rate::PER_SECOND.start(), Some(*Rate::BURST.end())));
        for _ in 0..10 {
            slow.charge(u32::MAX, i64::MAX - 1);
        }
        assert!(slow.take(i64::MIN).is_err());
    }
}
