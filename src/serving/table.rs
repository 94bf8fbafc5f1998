//! Things that callers hold by name and that expire when idle: sessions, environments. This file owns their names and when
//! they are gone; what one may do with them is theirs.
//!
//! The table's lock is held for look-ups, never while anything is computed. What is idle for longer than the time to live
//! expires: on the next look at it, or when [`Table::sweep`] comes by. A bounded number of expired names is remembered, so
//! that a late caller is told what happened.

use std::collections::{HashMap, VecDeque};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};
use std::time::Duration;

use uuid::Uuid;

use super::Error;
use crate::clock::Clock;
use crate::error_code::ErrorCode;

/// Limits of a table.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// What is idle for longer expires.
    pub ttl: Duration,
    /// Most entries; as many expired names are remembered.
    pub max: usize,
}

/// What a table holds.
pub trait Entry {
    /// What it is called: `session`.
    const WHAT: &'static str;
    /// The code of the error for an expired entry.
    const EXPIRED: ErrorCode;

    /// Its name.
    fn id(&self) -> &str;

    /// Its last use.
    fn used(&self) -> &LastUse;

    /// Whether it is kept only for callers that repeat its last request; it goes after [`GRACE`], or when there is no room.
    fn over(&self) -> bool {
        false
    }
}

/// How long what is over is kept for callers that missed its last answer.
pub(super) const GRACE: Duration = Duration::from_secs(10);

/// When something was used last: milliseconds of monotonic time.
#[derive(Debug)]
pub struct LastUse(AtomicU64);

impl LastUse {
    pub(super) fn at(now: Duration) -> Self {
        Self(AtomicU64::new(now.as_millis() as u64))
    }

    pub(super) fn touch(&self, now: Duration) {
        self.0.fetch_max(now.as_millis() as u64, Ordering::Relaxed);
    }

    fn idle(&self, now: Duration) -> Duration {
        now.saturating_sub(Duration::from_millis(self.0.load(Ordering::Relaxed)))
    }
}

/// What [`Table::find_or_add`] found.
#[derive(Debug)]
pub(super) enum Found<T> {
    /// It was there.
    Existing(Arc<T>),
    /// It was made.
    New(Arc<T>),
}

#[derive(Debug)]
struct Names<T> {
    open: HashMap<String, Arc<T>>,
    /// Expired names, each with the number of its expiry.
    expired: HashMap<String, u64>,
    expiries: VecDeque<(u64, String)>,
    count: u64,
}

impl<T> Names<T> {
    fn bury(&mut self, id: String, room: usize) {
        self.open.remove(&id);
        self.count += 1;
        self.expired.insert(id.clone(), self.count);
        self.expiries.push_back((self.count, id));
        while self.expiries.len() > room {
            if let Some((count, id)) = self.expiries.pop_front()
                && self.expired.get(&id) == Some(&count)
            {
                self.expired.remove(&id);
            }
        }
    }
}

/// Everything of one kind that this server holds.
#[derive(Debug)]
pub struct Table<T> {
    limits: Limits,
    clock: Clock,
    names: RwLock<Names<T>>,
}

/// A name that nobody else has chosen.
pub(super) fn fresh_name() -> String {
    Uuid::now_v7().to_string()
}

impl<T: Entry> Table<T> {
    /// Nothing yet.
    pub fn new(limits: Limits, clock: Clock) -> Self {
        let names = Names { open: HashMap::new(), expired: HashMap::new(), expiries: VecDeque::new(), count: 0 };
        Self { limits, clock, names: RwLock::new(names) }
    }

    fn read(&self) -> RwLockReadGuard<'_, Names<T>> {
        // Nothing panics while holding the lock for writing.
        self.names.read().unwrap_or_else(PoisonError::into_inner)
    }

    fn write(&self) -> RwLockWriteGuard<'_, Names<T>> {
        self.names.write().unwrap_or_else(PoisonError::into_inner)
    }

    fn is_idle(&self, entry: &T, now: Duration) -> bool {
        entry.used().idle(now) > self.limits.ttl
    }

    /// Idle time after which entries expire.
    pub fn ttl(&self) -> Duration {
        self.limits.ttl
    }

    /// What entries tell the time by.
    pub(super) fn clock(&self) -> &Clock {
        &self.clock
    }

    /// The entry `id`, or the one that `make` makes.
    ///
    /// # Errors
    /// There are too many.
    pub(super) fn find_or_add(&self, id: &str, make: impl FnOnce() -> T) -> Result<Found<T>, Error> {
        let now = self.clock.monotonic();
        let mut names = self.write();
        if let Some(existing) = names.open.get(id).filter(|entry| !self.is_idle(entry, now)) {
            return Ok(Found::Existing(existing.clone()));
        }
        self.insert(&mut names, id, now, make).map(Found::New)
    }

    /// The entry that `make` makes, from now on called `id`; whoever holds the one that was called so keeps it.
    ///
    /// # Errors
    /// There are too many.
    pub(super) fn replace(&self, id: &str, make: impl FnOnce() -> T) -> Result<Arc<T>, Error> {
        let now = self.clock.monotonic();
        self.insert(&mut self.write(), id, now, make)
    }

    fn insert(&self, names: &mut Names<T>, id: &str, now: Duration, make: impl FnOnce() -> T) -> Result<Arc<T>, Error> {
        let full = |names: &Names<T>| names.open.len() >= self.limits.max && !names.open.contains_key(id);
        if full(names) {
            self.sweep_names(names, now, Duration::ZERO);
        }
        if full(names) {
            return Err(Error::Busy(format!("{} {}s are open, the most this server holds", self.limits.max, T::WHAT)));
        }
        names.expired.remove(id);
        let entry = Arc::new(make());
        names.open.insert(id.to_owned(), entry.clone());
        Ok(entry)
    }

    /// The entry `id`; asking keeps it alive.
    ///
    /// # Errors
    /// It expired, or there is none.
    pub fn get(&self, id: &str) -> Result<Arc<T>, Error> {
        let now = self.clock.monotonic();
        {
            let names = self.read();
            match names.open.get(id) {
                Some(entry) if !self.is_idle(entry, now) => {
                    entry.used().touch(now);
                    return Ok(entry.clone());
                }
                None if !names.expired.contains_key(id) => return Err(Error::unknown(T::WHAT, id)),
                _ => {}
            }
        }
        let mut names = self.write();
        if names.open.get(id).is_some_and(|entry| self.is_idle(entry, now)) {
            names.bury(id.to_owned(), self.limits.max);
        }
        let idle = self.limits.ttl.as_secs_f64();
        let message = format!("{} {id:?} expired after {idle} s without a request; open a new one", T::WHAT);
        Err(Error::precondition(T::EXPIRED, message))
    }

    /// Forgets `entry`, unless its name is another's by now; whoever holds it keeps it.
    pub(super) fn remove(&self, entry: &Arc<T>) {
        let mut names = self.write();
        if names.open.get(entry.id()).is_some_and(|there| Arc::ptr_eq(there, entry)) {
            names.open.remove(entry.id());
        }
    }

    /// Entries with names after `after`, in order, at most `limit`, and whether there are more.
    pub fn list(&self, after: &str, limit: usize) -> (Vec<Arc<T>>, bool) {
        let now = self.clock.monotonic();
        let names = self.read();
        let alive = |entry: &&Arc<T>| entry.id() > after && !entry.over() && !self.is_idle(entry, now);
        let mut entries: Vec<&Arc<T>> = names.open.values().filter(alive).collect();
        entries.sort_unstable_by(|a, b| a.id().cmp(b.id()));
        let more = entries.len() > limit;
        (entries.into_iter().take(limit).cloned().collect(), more)
    }

    /// Number of entries, those included that are about to expire.
    pub fn len(&self) -> usize {
        self.read().open.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Forgets what is idle for too long.
    pub fn sweep(&self) {
        let now = self.clock.monotonic();
        self.sweep_names(&mut self.write(), now, GRACE);
    }

    fn sweep_names(&self, names: &mut Names<T>, now: Duration, grace: Duration) {
        names.open.retain(|_, entry| !entry.over() || entry.used().idle(now) < grace);
        // What somebody holds is in use, however long the slot in flight takes.
        let gone = |entry: &Arc<T>| Arc::strong_count(entry) == 1 && self.is_idle(entry, now);
        let gone: Vec<String> = names.open.iter().filter(|(_, entry)| gone(entry)).map(|(id, _)| id.clone()).collect();
        for id in gone {
            names.bury(id, self.limits.max);
        }
    }
}
