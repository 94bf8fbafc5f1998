//! The time of day, handed in, so that tests of expiry move time instead of waiting.

use std::sync::Arc;
use std::time::Instant;

use jiff::Timestamp;

/// A clock that never goes backwards.
#[derive(Clone)]
pub struct Clock(Arc<dyn Fn() -> Timestamp + Send + Sync>);

impl Clock {
    /// The system's time at start, advanced by its monotonic clock: a corrected wall clock neither expires nor revives
    /// sessions.
    pub fn system() -> Self {
        let (wall, start) = (Timestamp::now(), Instant::now());
        Self::new(move || wall.checked_add(start.elapsed()).unwrap_or(Timestamp::MAX))
    }

    /// A clock that tells what `now` tells.
    pub fn new(now: impl Fn() -> Timestamp + Send + Sync + 'static) -> Self {
        Self(Arc::new(now))
    }

    /// Now.
    pub fn now(&self) -> Timestamp {
        (self.0)()
    }
}

impl std::fmt::Debug for Clock {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Clock({})", self.now())
    }
}
