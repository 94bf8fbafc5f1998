//! How long a connection may live: until it is idle, too old, or the server stops.

use std::time::Duration;

use tokio_util::sync::CancellationToken;

use crate::clock::Clock;

/// Limits of the life of a connection.
#[derive(Clone, Copy, Debug)]
pub(super) struct LifeLimits {
    /// Time without a request.
    pub(super) idle: Duration,
    /// Age at which the caller is asked to use another connection.
    pub(super) age: Duration,
    /// Time for requests in flight after that.
    pub(super) grace: Duration,
    /// Time between two checks.
    pub(super) tick: Duration,
}

/// What to do with a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Verdict {
    /// Nothing.
    Stay,
    /// Ask the caller to use another connection, and answer the requests in flight.
    Leave,
    /// Close it.
    Close,
}

/// The life of one connection.
pub(super) struct Lifetime {
    limits: LifeLimits,
    clock: Clock,
    stop: CancellationToken,
    /// Whether the connection is from the reserve: it has one request.
    single: bool,
    /// When its age is reached.
    old_at: Duration,
    /// When it was last seen with a request.
    used: Duration,
    /// Whether there was a request since the last check.
    requested: bool,
    closing_since: Option<Duration>,
}

impl Lifetime {
    /// A connection that opens now. `jitter`, from 0 to 1, distributes the ages of connections that opened together.
    pub(super) fn new(limits: LifeLimits, clock: Clock, stop: CancellationToken, single: bool, jitter: f64) -> Self {
        let now = clock.monotonic();
        let age = limits.age.mul_f64(0.9 + 0.2 * jitter);
        Self { limits, clock, stop, single, old_at: now + age, used: now, requested: false, closing_since: None }
    }

    pub(super) fn stop(&self) -> &CancellationToken {
        &self.stop
    }

    pub(super) fn tick(&self) -> Duration {
        self.limits.tick
    }

    pub(super) fn now(&self) -> Duration {
        self.clock.monotonic()
    }

    pub(super) fn is_single(&self) -> bool {
        self.single
    }

    pub(super) fn is_closing(&self) -> bool {
        self.closing_since.is_some()
    }

    /// There is a new request.
    pub(super) fn requested(&mut self) {
        self.requested = true;
    }

    /// The caller is asked to leave because of `reason`.
    pub(super) fn begin_close(&mut self, reason: &'static str) {
        self.closing_since = Some(self.now());
        metrics::counter!("qedgix_connections_ended_total", "reason" => reason).increment(1);
    }

    /// To be called regularly. `busy`: there is a request in flight.
    pub(super) fn check(&mut self, busy: bool) -> Verdict {
        let now = self.now();
        if std::mem::take(&mut self.requested) || busy {
            self.used = now;
        }
        if let Some(since) = self.closing_since {
            // A stopping server has a limit of its own.
            let over = !self.stop.is_cancelled() && now.saturating_sub(since) >= self.limits.grace;
            return if over { Verdict::Close } else { Verdict::Stay };
        }
        let reason = if now.saturating_sub(self.used) >= self.limits.idle {
            "idle"
        } else if now >= self.old_at {
            "age"
        } else {
            return Verdict::Stay;
        };
        self.begin_close(reason);
        Verdict::Leave
    }
}

#[cfg(test)]
mod tests {
    use jiff::Timestamp;

    use super::*;
    use crate::clock::ManualClock;

    const LIMITS: LifeLimits = LifeLimits {
        idle: Duration::from_secs(60),
        age: Duration::from_secs(1000),
        grace: Duration::from_secs(30),
        tick: Duration::from_secs(1),
    };

    fn at_noon() -> ManualClock {
        ManualClock::new(Timestamp::UNIX_EPOCH)
    }

    fn open(time: &ManualClock, jitter: f64) -> Lifetime {
        Lifetime::new(LIMITS, time.clock(), CancellationToken::new(), false, jitter)
    }

    #[test]
    fn a_connection_without_requests_ends_and_one_with_requests_stays() {
        let time = at_noon();
        let (mut idle, mut used, mut busy) = (open(&time, 0.0), open(&time, 0.0), open(&time, 0.0));
        time.advance(Duration::from_secs(59));
        used.requested();
        assert_eq!([idle.check(false), used.check(false), busy.check(true)], [Verdict::Stay; 3]);
        time.advance(Duration::from_secs(1));
        assert_eq!([idle.check(false), used.check(false), busy.check(true)], [Verdict::Leave, Verdict::Stay, Verdict::Stay]);
        time.advance(Duration::from_secs(59));
        assert_eq!([idle.check(false), used.check(false), busy.check(true)], [Verdict::Close, Verdict::Leave, Verdict::Stay]);
    }

    #[test]
    fn an_old_connection_ends_with_a_grace_and_jitter() {
        let time = at_noon();
        let mut all = [0.0, 0.5, 1.0].map(|jitter| open(&time, jitter));
        let mut after = |seconds| {
            time.advance(Duration::from_secs(seconds));
            all.each_mut().map(|connection| connection.check(true))
        };
        assert_eq!(after(899), [Verdict::Stay; 3]);
        assert_eq!(after(1), [Verdict::Leave, Verdict::Stay, Verdict::Stay]);
        assert_eq!(after(29), [Verdict::Stay; 3]);
        assert_eq!(after(1), [Verdict::Close, Verdict::Stay, Verdict::Stay]);
        assert_eq!(after(171)[1..], [Verdict::Leave; 2]);
    }

    #[test]
    fn a_stopping_server_does_not_shorten_the_time_for_requests_in_flight() {
        let time = at_noon();
        let mut connection = open(&time, 0.0);
        connection.stop().cancel();
        connection.begin_close("shutdown");
        time.advance(Duration::from_secs(10_000));
        assert_eq!(connection.check(true), Verdict::Stay);
    }
}
