//! The time, injected, so that tests move it instead of waiting.
//!
//! Two kinds of time, which must not be mixed: wall time for what is stored or shown, and compared with what is stored;
//! monotonic time for idle times, timeouts and rates.

use std::sync::Arc;
use std::time::{Duration, Instant};

use jiff::Timestamp;
use tokio::sync::watch;

/// A source of wall time and monotonic time; cheap to clone.
#[derive(Clone, Debug)]
pub struct Clock(Source);

#[derive(Clone, Debug)]
enum Source {
    System { origin: Instant },
    Manual(ManualClock),
}

impl Clock {
    /// The clocks of the system.
    pub fn system() -> Self {
        Self(Source::System { origin: Instant::now() })
    }

    /// Wall time: for what is stored or shown. It jumps when the system's time is corrected, as it does for every other
    /// process that works with the same data.
    pub fn now(&self) -> Timestamp {
        match &self.0 {
            Source::System { .. } => Timestamp::now(),
            Source::Manual(manual) => manual.0.borrow().wall,
        }
    }

    /// Monotonic time since an arbitrary origin: for idle times, timeouts and rates. It never jumps.
    pub fn monotonic(&self) -> Duration {
        match &self.0 {
            Source::System { origin } => origin.elapsed(),
            Source::Manual(manual) => manual.0.borrow().monotonic,
        }
    }

    /// Returns when [`Clock::monotonic`] has reached `deadline`.
    pub async fn sleep_until(&self, deadline: Duration) {
        match &self.0 {
            Source::System { origin } => match origin.checked_add(deadline) {
                Some(deadline) => tokio::time::sleep_until(deadline.into()).await,
                None => std::future::pending().await,
            },
            Source::Manual(manual) => {
                let mut times = manual.0.subscribe();
                // The sender lives in `manual`.
                let _ = times.wait_for(|times| times.monotonic >= deadline).await;
            }
        }
    }
}

/// Moves the time of a [`Clock`] by hand; cheap to clone.
#[derive(Clone, Debug)]
pub struct ManualClock(Arc<watch::Sender<Times>>);

#[derive(Clone, Copy, Debug)]
struct Times {
    wall: Timestamp,
    monotonic: Duration,
}

impl ManualClock {
    /// A clock that stands still at wall time `now`.
    pub fn new(now: Timestamp) -> Self {
        Self(Arc::new(watch::Sender::new(Times { wall: now, monotonic: Duration::ZERO })))
    }

    /// The clock that this moves.
    pub fn clock(&self) -> Clock {
        Clock(Source::Manual(self.clone()))
    }

    /// Lets `time` pass.
    ///
    /// # Panics
    /// The wall time would be after the year 9999.
    pub fn advance(&self, time: Duration) {
        self.0.send_modify(|times| {
            times.wall = times.wall.checked_add(time).expect("tests stay before the year 10000");
            times.monotonic += time;
        });
    }

    /// Corrects the wall time, as an administrator or NTP does; no time passes.
    pub fn set_wall(&self, now: Timestamp) {
        self.0.send_modify(|times| times.wall = now);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_corrected_wall_time_does_not_move_the_monotonic_time() {
        let manual = ManualClock::new(Timestamp::UNIX_EPOCH);
        let clock = manual.clock();
        manual.advance(Duration::from_secs(5));
        assert_eq!((clock.now().as_second(), clock.monotonic()), (5, Duration::from_secs(5)));
        manual.set_wall(Timestamp::from_second(1000).unwrap());
        assert_eq!((clock.now().as_second(), clock.monotonic()), (1000, Duration::from_secs(5)));
    }

    #[tokio::test]
    async fn sleepers_wake_when_the_time_is_moved() {
        let manual = ManualClock::new(Timestamp::UNIX_EPOCH);
        let clock = manual.clock();
        let mut sleep = std::pin::pin!(clock.sleep_until(Duration::from_secs(10)));
        manual.advance(Duration::from_secs(9));
        assert!(futures::poll!(&mut sleep).is_pending());
        manual.advance(Duration::from_secs(1));
        sleep.await;
        // What has passed already does not wait.
        clock.sleep_until(Duration::ZERO).await;
        Clock::system().sleep_until(Duration::ZERO).await;
    }
}
