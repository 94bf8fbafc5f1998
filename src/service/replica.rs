//! A replica: a server that takes its policies from another server, the primary, and changes none itself.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use crate::clock::Clock;
use crate::store::{self, Store};

/// Longest time between two records of how old the copy is. After a restart the copy may seem older by this time.
const RECORD_INTERVAL: Duration = Duration::from_secs(30);

/// What a replica knows of its copy of the primary's policies.
#[derive(Debug)]
pub struct Replica {
    primary: String,
    /// None: there is no copy yet.
    copy: Mutex<Option<CopyAge>>,
    missing: AtomicUsize,
}

#[derive(Clone, Copy, Debug)]
struct CopyAge {
    /// Age of the copy at monotonic time `at`.
    age: Duration,
    at: Duration,
    /// Monotonic time of the last record in the database; None: by a former process.
    recorded: Option<Duration>,
}

impl Replica {
    /// The replica of the server at the address `primary`, with the copy that the database has.
    ///
    /// # Errors
    /// [`store::Error`] when the database fails.
    pub async fn open(primary: String, store: &Store, clock: &Clock) -> Result<Self, store::Error> {
        let copy = store.followed_until().await?.map(|until| {
            let age = Duration::try_from(clock.now().duration_since(until)).unwrap_or_default();
            CopyAge { age, at: clock.monotonic(), recorded: None }
        });
        Ok(Self { primary, copy: Mutex::new(copy), missing: AtomicUsize::new(0) })
    }

    /// REST address of the primary.
    pub fn primary(&self) -> &str {
        &self.primary
    }

    /// Time since the policies of this server were last known to be those of the primary; `None`: they never were.
    pub fn age(&self, clock: &Clock) -> Option<Duration> {
        let copy = (*self.copy.lock().unwrap_or_else(PoisonError::into_inner))?;
        Some(copy.age.saturating_add(clock.monotonic().saturating_sub(copy.at)))
    }

    /// Versions of the primary that could not be taken over.
    pub fn missing(&self) -> usize {
        self.missing.load(Ordering::Relaxed)
    }

    /// Records that the policies of this server are those of the primary, except for `missing` versions that cannot be taken over.
    ///
    /// # Errors
    /// [`store::Error`] when the database fails. The copy is up to date all the same.
    pub async fn confirm(&self, missing: usize, store: &Store, clock: &Clock) -> Result<(), store::Error> {
        let at = clock.monotonic();
        self.missing.store(missing, Ordering::Relaxed);
        let update = |recorded: Option<Duration>| {
            let mut copy = self.copy.lock().unwrap_or_else(PoisonError::into_inner);
            let recorded = recorded.or_else(|| copy.and_then(|copy| copy.recorded));
            *copy = Some(CopyAge { age: Duration::ZERO, at, recorded });
            recorded
        };
        let recorded = update(None);
        if recorded.is_none_or(|recorded| at.saturating_sub(recorded) >= RECORD_INTERVAL) {
            store.set_followed_until(clock.now()).await?;
            update(Some(at));
        }
        Ok(())
    }
}
