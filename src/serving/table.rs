//! A table of named things that expire when idle: sessions, environments. This file owns names and expiry; the entries own
//! the requests to them. Every owner has names of its own.
//!
//! The table's lock is held for look-ups, never during computations. An entry that has been idle for longer than the time to
//! live expires at the next look-up or at the next [`Table::remove_expired`]. The table remembers a bounded number of expired
//! names, so that a late request for one fails with "expired" instead of "not found".

use std::collections::{HashMap, VecDeque};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};
use std::time::Duration;

use uuid::Uuid;

use super::memory_budget::{MemoryBudget, MemoryCharge};
use super::{Error, Owner};
use crate::clock::Clock;
use crate::error_code::ErrorCode;

/// Limits of a table.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// Idle time after which entries expire.
    pub ttl: Duration,
    /// Maximum number of entries, and of expired names that are remembered.
    pub max: usize,
    /// Maximum number of bytes of all entries together.
    pub memory: usize,
}

/// An entry of a table.
pub trait TableEntry {
    /// The kind of entry in error messages, for example `session`.
    const KIND: &'static str;
    /// Error code for entries that have expired.
    const EXPIRED: ErrorCode;
    /// The flag that sets [`Limits::memory`].
    const MEMORY_FLAG: &'static str;

    /// Who made it.
    fn owner(&self) -> &Owner;

    /// Its name, unique among the entries of its owner.
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

/// Owner and id of an entry.
type Name = (Owner, String);

#[derive(Debug)]
struct Names<T> {
    /// The entries of each owner that has any, by id.
    open: HashMap<Owner, HashMap<String, Arc<T>>>,
    /// Number of entries of all owners.
    count: usize,
    /// Names of expired entries. A name can expire several times, so its latest expiry is identified by a serial number.
    expired: HashMap<Name, u64>,
    /// The last expiries, oldest first: serial number and name. When an expiry leaves this queue, its name is forgotten unless
    /// `expired` has a later one.
    expiries: VecDeque<(u64, Name)>,
    /// Serial number of the last expiry.
    expiry_count: u64,
}

impl<T: TableEntry> Names<T> {
    fn get(&self, owner: &Owner, id: &str) -> Option<&Arc<T>> {
        self.open.get(owner)?.get(id)
    }

    fn insert(&mut self, entry: &Arc<T>) {
        let (owner, id) = (entry.owner().clone(), entry.id().to_owned());
        let former = self.open.entry(owner).or_default().insert(id, entry.clone());
        self.count += usize::from(former.is_none());
    }

    fn remove(&mut self, owner: &Owner, id: &str) {
        let Some(names) = self.open.get_mut(owner) else { return };
        self.count -= usize::from(names.remove(id).is_some());
        if names.is_empty() {
            self.open.remove(owner);
        }
    }

    fn entries(&self) -> impl Iterator<Item = &Arc<T>> {
        self.open.values().flat_map(HashMap::values)
    }

    /// Removes an entry and remembers its name among the newest `capacity` expired ones.
    fn expire(&mut self, name: Name, capacity: usize) {
        self.remove(&name.0, &name.1);
        self.expiry_count += 1;
        self.expired.insert(name.clone(), self.expiry_count);
        self.expiries.push_back((self.expiry_count, name));
        while self.expiries.len() > capacity {
            if let Some((serial, name)) = self.expiries.pop_front()
                && self.expired.get(&name) == Some(&serial)
            {
                self.expired.remove(&name);
            }
        }
    }
}

/// All entries of one kind.
#[derive(Debug)]
pub struct Table<T> {
    limits: Limits,
    memory: Arc<MemoryBudget>,
    clock: Clock,
    names: RwLock<Names<T>>,
}

/// The name of an entry in the order of lists.
fn name_of<T: TableEntry>(entry: &Arc<T>) -> (&str, &Owner) {
    (entry.id(), entry.owner())
}

/// A new unique name.
pub(super) fn generate_id() -> String {
    Uuid::now_v7().to_string()
}

impl<T: TableEntry> Table<T> {
    /// An empty table.
    pub fn new(limits: Limits, clock: Clock) -> Self {
        let (open, expired, expiries) = (HashMap::new(), HashMap::new(), VecDeque::new());
        let names = Names { open, count: 0, expired, expiries, expiry_count: 0 };
        let memory = MemoryBudget::new(limits.memory, T::KIND, T::MEMORY_FLAG);
        Self { limits, memory, clock, names: RwLock::new(names) }
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

    /// Bytes that all entries take.
    pub fn memory_used(&self) -> usize {
        self.memory.used()
    }

    /// Takes `bytes` for an entry of `owner`, from idle ones if necessary.
    ///
    /// # Errors
    /// [`Error::Busy`] if they are not free, or the owner may not take so many.
    pub(super) fn charge_memory(&self, owner: &Owner, bytes: usize) -> Result<MemoryCharge, Error> {
        self.memory.charge(owner, bytes).or_else(|_| {
            self.remove_expired();
            self.memory.charge(owner, bytes)
        })
    }

    /// Returns entry `id` of `owner`. If there is none, adds the one of this name that `make` creates.
    ///
    /// # Errors
    /// [`Error::Busy`] if the table is full.
    pub(super) fn find_or_add(&self, owner: &Owner, id: &str, make: impl FnOnce() -> T) -> Result<Lookup<T>, Error> {
        let now = self.clock.monotonic();
        let mut names = self.write();
        if let Some(existing) = names.get(owner, id).filter(|entry| !self.is_idle(entry, now)) {
            return Ok(Lookup::Found(existing.clone()));
        }
        self.insert(&mut names, (owner, id), now, make).map(Lookup::Added)
    }

    /// Adds the entry of `owner` named `id` that `make` creates, in place of the former entry of that name, if any.
    ///
    /// # Errors
    /// [`Error::Busy`] if the table is full.
    pub(super) fn replace(&self, owner: &Owner, id: &str, make: impl FnOnce() -> T) -> Result<Arc<T>, Error> {
        let now = self.clock.monotonic();
        self.insert(&mut self.write(), (owner, id), now, make)
    }

    fn insert(
        &self,
        names: &mut Names<T>,
        (owner, id): (&Owner, &str),
        now: Duration,
        make: impl FnOnce() -> T,
    ) -> Result<Arc<T>, Error> {
        let full = |names: &Names<T>| names.count >= self.limits.max && names.get(owner, id).is_none();
        if full(names) {
            self.remove_expired_names(names, now, Duration::ZERO);
        }
        if full(names) {
            return Err(Error::Busy(format!("{} {}s are open, the limit of this server", self.limits.max, T::KIND)));
        }
        names.expired.remove(&(owner.clone(), id.to_owned()));
        let entry = Arc::new(make());
        names.insert(&entry);
        Ok(entry)
    }

    /// Returns entry `id` of `owner`, and counts as a use of it.
    ///
    /// # Errors
    /// [`TableEntry::EXPIRED`] if it has expired, [`Error::NotFound`] if there is none.
    pub fn get(&self, owner: &Owner, id: &str) -> Result<Arc<T>, Error> {
        let now = self.clock.monotonic();
        {
            let names = self.read();
            match names.get(owner, id) {
                Some(entry) if !self.is_idle(entry, now) => {
                    entry.last_use().touch(now);
                    return Ok(entry.clone());
                }
                None if !names.expired.contains_key(&(owner.clone(), id.to_owned())) => {
                    return Err(Error::not_found(T::KIND, id));
                }
                _ => {}
            }
        }
        let mut names = self.write();
        if names.get(owner, id).is_some_and(|entry| self.is_idle(entry, now)) {
            names.expire((owner.clone(), id.to_owned()), self.limits.max);
        }
        let idle = self.limits.ttl.as_secs_f64();
        let message = format!("{} {id:?} expired after {idle} s without a request; open a new one", T::KIND);
        Err(Error::precondition(T::EXPIRED, message))
    }

    /// Returns entry `id` of `owner` if it is open. This does not count as a use of it.
    pub(super) fn peek(&self, owner: &Owner, id: &str) -> Option<Arc<T>> {
        let now = self.clock.monotonic();
        self.read().get(owner, id).filter(|entry| !self.is_idle(entry, now)).cloned()
    }

    /// Removes `entry`, unless another entry has taken its name.
    pub(super) fn remove(&self, entry: &Arc<T>) {
        let mut names = self.write();
        if names.get(entry.owner(), entry.id()).is_some_and(|current| Arc::ptr_eq(current, entry)) {
            names.remove(entry.owner(), entry.id());
        }
    }

    /// Removes `entry` as [`Table::remove`] does, and gives its name back to `former`, from which it was taken.
    pub(super) fn replace_with(&self, entry: &Arc<T>, former: &Arc<T>) {
        let mut names = self.write();
        if names.get(entry.owner(), entry.id()).is_some_and(|current| Arc::ptr_eq(current, entry)) {
            names.insert(former);
        }
    }

    /// Whether `owner` has an entry `id` that is open.
    pub fn contains(&self, owner: &Owner, id: &str) -> bool {
        self.read().get(owner, id).is_some()
    }

    /// An owner of an open entry `id`: the first in order, if several have one.
    pub fn owner_of(&self, id: &str) -> Option<Owner> {
        let names = self.read();
        names.open.iter().filter(|(_, entries)| entries.contains_key(id)).map(|(owner, _)| owner).min().cloned()
    }

    /// At most `limit` entries in order of ids and owners, and whether there are more: those after the name `after`, of one
    /// owner or of all.
    pub fn list(&self, of: Option<&Owner>, after: (&str, &Owner), limit: usize) -> (Vec<Arc<T>>, bool) {
        let now = self.clock.monotonic();
        let names = self.read();
        let listed = |entry: &&Arc<T>| name_of(entry) > after && !entry.is_ended() && !self.is_idle(entry, now);
        let of_owner = of.and_then(|owner| names.open.get(owner)).into_iter().flat_map(HashMap::values);
        let of_all = of.is_none().then(|| names.entries()).into_iter().flatten();
        let mut entries: Vec<&Arc<T>> = of_owner.chain(of_all).filter(listed).collect();
        entries.sort_unstable_by(|a, b| name_of(a).cmp(&name_of(b)));
        let more = entries.len() > limit;
        (entries.into_iter().take(limit).cloned().collect(), more)
    }

    /// Number of entries, including idle ones that have not been removed yet.
    pub fn len(&self) -> usize {
        self.read().count
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
        let name = |entry: &Arc<T>| (entry.owner().clone(), entry.id().to_owned());
        let over = |entry: &&Arc<T>| entry.is_ended() && entry.last_use().idle(now) >= repeat_window;
        let over: Vec<Name> = names.entries().filter(over).map(name).collect();
        over.iter().for_each(|(owner, id)| names.remove(owner, id));
        // An entry that a request holds is in use, however long the request takes.
        let expired = |entry: &&Arc<T>| Arc::strong_count(entry) == 1 && self.is_idle(entry, now);
        let expired: Vec<Name> = names.entries().filter(expired).map(name).collect();
        for name in expired {
            names.expire(name, self.limits.max);
        }
    }
}
