//! A table of named things that expire when idle: sessions, environments. This file owns names and expiry; the entries own
//! the requests to them.
//!
//! The table's lock is held for look-ups, never during computations. An entry that has been idle for longer than the time to
//! live expires at the next look-up or at the next [`Table::remove_expired`]. The table remembers a bounded number of expired
//! names, so that a late request for one fails with "expired" instead of "not found".

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
    /// Idle time after which entries expire.
    pub ttl: Duration,
    /// Maximum number of entries, and of expired names that are remembered.
    pub max: usize,
}

/// An entry of a table.
pub trait TableEntry {
    /// The kind of entry in error messages, for example `session`.
    const KIND: &'static str;
    /// Error code for entries that have expired.
    const EXPIRED: ErrorCode;

    /// Its name.
    fn id(&self) -> &str;

    /// When it was last used.
    fn last_use(&self) -> &LastUse;

    /// Whether it has ended and is kept only to answer repetitions of its last request. The table removes it after
    /// [`REPEAT_WINDOW`], or when it needs room.
    fn is_ended(&self) -> bool {
        false
    }
}

/// How long entries that have ended answer repetitions of their last request.
pub(super) const REPEAT_WINDOW: Duration = Duration::from_secs(10);

/// Time of the last use, in milliseconds of monotonic time.
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

/// Result of [`Table::find_or_add`].
#[derive(Debug)]
pub(super) enum Lookup<T> {
    /// The entry existed.
    Found(Arc<T>),
    /// The entry is new.
    Added(Arc<T>),
}

#[derive(Debug)]
struct Names<T> {
    open: HashMap<String, Arc<T>>,
    /// Names of expired entries. A name can expire several times, so its latest expiry is identified by a serial number.
    expired: HashMap<String, u64>,
    /// The last expiries, oldest first: serial number and name. When an expiry leaves this queue, its name is forgotten unless
    /// `expired` has a later one.
    expiries: VecDeque<(u64, String)>,
    /// Serial number of the last expiry.
    expiry_count: u64,
}

impl<T> Names<T> {
    /// Removes entry `id` and remembers its name among the newest `capacity` expired ones.
    fn expire(&mut self, id: String, capacity: usize) {
        self.open.remove(&id);
        self.expiry_count += 1;
        self.expired.insert(id.clone(), self.expiry_count);
        self.expiries.push_back((self.expiry_count, id));
        while self.expiries.len() > capacity {
            if let Some((serial, id)) = self.expiries.pop_front()
                && self.expired.get(&id) == Some(&serial)
            {
                self.expired.remove(&id);
            }
        }
    }
}

/// All entries of one kind.
#[derive(Debug)]
pub struct Table<T> {
    limits: Limits,
    clock: Clock,
    names: RwLock<Names<T>>,
}

/// A new unique name.
pub(super) fn generate_id() -> String {
    Uuid::now_v7().to_string()
}

impl<T: TableEntry> Table<T> {
    /// An empty table.
    pub fn new(limits: Limits, clock: Clock) -> Self {
        let names = Names { open: HashMap::new(), expired: HashMap::new(), expiries: VecDeque::new(), expiry_count: 0 };
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
        entry.last_use().idle(now) > self.limits.ttl
    }

    /// Idle time after which entries expire.
    pub fn ttl(&self) -> Duration {
        self.limits.ttl
    }

    /// The clock that decides about expiry.
    pub(super) fn clock(&self) -> &Clock {
        &self.clock
    }

    /// Returns entry `id`. If there is none, adds the one that `make` creates.
    ///
    /// # Errors
    /// [`Error::Busy`] if the table is full.
    pub(super) fn find_or_add(&self, id: &str, make: impl FnOnce() -> T) -> Result<Lookup<T>, Error> {
        let now = self.clock.monotonic();
        let mut names = self.write();
        if let Some(existing) = names.open.get(id).filter(|entry| !self.is_idle(entry, now)) {
            return Ok(Lookup::Found(existing.clone()));
        }
        self.insert(&mut names, id, now, make).map(Lookup::Added)
    }

    /// Adds the entry that `make` creates under the name `id`, in place of the former entry of that name, if any.
    ///
    /// # Errors
    /// [`Error::Busy`] if the table is full.
    pub(super) fn replace(&self, id: &str, make: impl FnOnce() -> T) -> Result<Arc<T>, Error> {
        let now = self.clock.monotonic();
        self.insert(&mut self.write(), id, now, make)
    }

    fn insert(&self, names: &mut Names<T>, id: &str, now: Duration, make: impl FnOnce() -> T) -> Result<Arc<T>, Error> {
        let full = |names: &Names<T>| names.open.len() >= self.limits.max && !names.open.contains_key(id);
        if full(names) {
            self.remove_expired_names(names, now, Duration::ZERO);
        }
        if full(names) {
            return Err(Error::Busy(format!("{} {}s are open, the limit of this server", self.limits.max, T::KIND)));
        }
        names.expired.remove(id);
        let entry = Arc::new(make());
        names.open.insert(id.to_owned(), entry.clone());
        Ok(entry)
    }

    /// Returns entry `id`, and counts as a use of it.
    ///
    /// # Errors
    /// [`TableEntry::EXPIRED`] if it has expired, [`Error::NotFound`] if there is none.
    pub fn get(&self, id: &str) -> Result<Arc<T>, Error> {
        let now = self.clock.monotonic();
        {
            let names = self.read();
            match names.open.get(id) {
                Some(entry) if !self.is_idle(entry, now) => {
                    entry.last_use().touch(now);
                    return Ok(entry.clone());
                }
                None if !names.expired.contains_key(id) => return Err(Error::not_found(T::KIND, id)),
                _ => {}
            }
        }
        let mut names = self.write();
        if names.open.get(id).is_some_and(|entry| self.is_idle(entry, now)) {
            names.expire(id.to_owned(), self.limits.max);
        }
        let idle = self.limits.ttl.as_secs_f64();
        let message = format!("{} {id:?} expired after {idle} s without a request; open a new one", T::KIND);
        Err(Error::precondition(T::EXPIRED, message))
    }

    /// Removes `entry`, unless another entry has taken its name.
    pub(super) fn remove(&self, entry: &Arc<T>) {
        let mut names = self.write();
        if names.open.get(entry.id()).is_some_and(|current| Arc::ptr_eq(current, entry)) {
            names.open.remove(entry.id());
        }
    }

    /// At most `limit` entries with names after `after`, in order, and whether there are more.
    pub fn list(&self, after: &str, limit: usize) -> (Vec<Arc<T>>, bool) {
        let now = self.clock.monotonic();
        let names = self.read();
        let listed = |entry: &&Arc<T>| entry.id() > after && !entry.is_ended() && !self.is_idle(entry, now);
        let mut entries: Vec<&Arc<T>> = names.open.values().filter(listed).collect();
        entries.sort_unstable_by(|a, b| a.id().cmp(b.id()));
        let more = entries.len() > limit;
        (entries.into_iter().take(limit).cloned().collect(), more)
    }

    /// Number of entries, including idle ones that have not been removed yet.
    pub fn len(&self) -> usize {
        self.read().open.len()
    }

    /// Whether there is no entry.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Removes entries that have been idle for too long.
    pub fn remove_expired(&self) {
        let now = self.clock.monotonic();
        self.remove_expired_names(&mut self.write(), now, REPEAT_WINDOW);
    }

    fn remove_expired_names(&self, names: &mut Names<T>, now: Duration, repeat_window: Duration) {
        names.open.retain(|_, entry| !entry.is_ended() || entry.last_use().idle(now) < repeat_window);
        // An entry that a request holds is in use, however long the request takes.
        let expired = |entry: &Arc<T>| Arc::strong_count(entry) == 1 && self.is_idle(entry, now);
        let expired: Vec<String> = names.open.iter().filter(|(_, entry)| expired(entry)).map(|(id, _)| id.clone()).collect();
        for id in expired {
            names.expire(id, self.limits.max);
        }
    }
}
