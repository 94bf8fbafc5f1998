//! The API keys of a running server, in memory. Authenticating a request costs one map lookup and one SHA-256, no query.
//!
//! Keys are never removed from memory. From the first key on every request needs a key until the server stops, even when all keys
//! are revoked or expired.

use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};
use std::sync::{Arc, PoisonError, RwLock};
use std::time::Duration;

use jiff::Timestamp;

use super::bucket::{Rate, TokenBucket};
use super::scope::{Scope, Scopes};
use super::secret;
use crate::clock::Clock;
use crate::service::Error;
use crate::serving::{Owner, Table, TableEntry};
use crate::store::{KeyRecord, Store};

/// All API keys, including revoked and expired ones.
#[derive(Debug)]
pub struct Keyring {
    /// Rate of keys that have no rate of their own.
    default_rate: Option<Rate>,
    /// Whether there is a key. Requests read only this flag while there is none.
    required: AtomicBool,
    /// Revision of the database table that `keys` was read at.
    revision: AtomicI64,
    keys: RwLock<HashMap<String, Arc<Key>>>,
}

#[derive(Debug)]
struct Key {
    id: String,
    /// Owner of what the key makes.
    owner: Owner,
    digest: [u8; 32],
    scopes: Scopes,
    limit: Option<(Rate, TokenBucket)>,
    revoked: AtomicBool,
    /// Milliseconds since the Unix epoch, like the two fields below.
    expires_at: AtomicI64,
    last_used_at: AtomicI64,
    /// Value of `last_used_at` in the database.
    stored_last_used_at: AtomicI64,
}

/// The sender of a request: an API key, or anybody (the default) on a server without keys. Transports put it into the extensions of
/// a request with a key.
#[derive(Clone, Debug, Default)]
pub struct Caller(Option<Arc<Key>>);

impl Keyring {
    /// A keyring without keys. `default_rate` applies to keys that have no rate of their own.
    pub fn new(default_rate: Option<Rate>) -> Self {
        Self { default_rate, required: AtomicBool::new(false), revision: AtomicI64::new(-1), keys: RwLock::default() }
    }

    /// Whether requests need an API key.
    pub fn required(&self) -> bool {
        self.required.load(Ordering::Relaxed)
    }

    /// Reads keys from the database if any was created, revoked or given another expiry since the last call. Costs one small query
    /// otherwise.
    ///
    /// # Errors
    /// [`Error::Internal`] when the database fails. The keys in memory stay as they are.
    pub async fn refresh(&self, store: &Store) -> Result<(), Error> {
        let revision = store.keys_revision().await?;
        if revision == self.revision.load(Ordering::Relaxed) {
            return Ok(());
        }
        let records = store.keys().await?;
        let mut keys = self.keys.write().unwrap_or_else(PoisonError::into_inner);
        // The server never deletes rows. A key whose row was deleted by hand counts as revoked.
        let deleted = keys.values().filter(|key| !records.iter().any(|record| record.id == key.id));
        deleted.for_each(|key| key.revoked.store(true, Ordering::Relaxed));
        for record in records {
            match keys.get(&record.id) {
                Some(key) => key.update(&record),
                None => drop(keys.insert(record.id.clone(), Arc::new(Key::new(record, self.default_rate)))),
            }
        }
        if !keys.is_empty() {
            self.required.store(true, Ordering::Relaxed);
        }
        self.revision.store(revision, Ordering::Relaxed);
        Ok(())
    }

    /// Identifies the caller by the API key `presented`.
    ///
    /// # Errors
    /// [`Error::Unauthenticated`] when the key is missing, unknown, wrong, revoked or expired.
    pub fn authenticate(&self, presented: Option<&str>, now: Timestamp) -> Result<Caller, Error> {
        const MISSING: Error =
            Error::Unauthenticated("an API key is required, as header authorization: Bearer KEY or x-api-key: KEY");
        const UNKNOWN: Error = Error::Unauthenticated("the API key is unknown");
        if !self.required() {
            return Ok(Caller::default());
        }
        let (id, secret) = secret::parse(presented.ok_or(MISSING)?).ok_or(UNKNOWN)?;
        let key = self.keys.read().unwrap_or_else(PoisonError::into_inner).get(id).cloned().ok_or(UNKNOWN)?;
        if !secret::verify(secret, &key.digest) {
            return Err(UNKNOWN);
        }
        key.check(now)?;
        Ok(Caller(Some(key)))
    }

    /// Saves the time of last use of the keys that were used since the last call.
    ///
    /// # Errors
    /// [`Error::Internal`] when the database fails. The next call tries again.
    pub async fn save_last_used(&self, store: &Store) -> Result<(), Error> {
        let keys: Vec<Arc<Key>> = self.keys.read().unwrap_or_else(PoisonError::into_inner).values().cloned().collect();
        let changed = |key: &Arc<Key>| {
            let used_at = key.last_used_at.load(Ordering::Relaxed);
            (used_at != key.stored_last_used_at.load(Ordering::Relaxed)).then(|| (Arc::clone(key), used_at))
        };
        let used: Vec<(Arc<Key>, i64)> = keys.iter().filter_map(changed).collect();
        let rows = used.iter().filter_map(|(key, at)| Some((key.id.clone(), Timestamp::from_millisecond(*at).ok()?)));
        let rows: Vec<(String, Timestamp)> = rows.collect();
        if rows.is_empty() {
            return Ok(());
        }
        store.touch_keys(&rows).await?;
        used.iter().for_each(|(key, at)| key.stored_last_used_at.store(*at, Ordering::Relaxed));
        Ok(())
    }
}

impl Key {
    fn new(record: KeyRecord, default: Option<Rate>) -> Self {
        let own = record.rate.map(|rate| Rate::new(rate, record.burst));
        let used_at = record.last_used_at.map_or(i64::MIN, Timestamp::as_millisecond);
        let key = Self {
            digest: record.digest,
            scopes: Scopes::from_stored(&record.scopes),
            limit: own.or(default).map(|rate| (rate, TokenBucket::new(rate))),
            revoked: AtomicBool::new(false),
            expires_at: AtomicI64::new(i64::MAX),
            last_used_at: AtomicI64::new(used_at),
            stored_last_used_at: AtomicI64::new(used_at),
            owner: Owner::new(&record.owner),
            id: record.id.clone(),
        };
        key.update(&record);
        key
    }

    /// Takes over expiry and revocation, the only parts of a key that change.
    fn update(&self, record: &KeyRecord) {
        self.expires_at.store(record.expires_at.map_or(i64::MAX, Timestamp::as_millisecond), Ordering::Relaxed);
        self.revoked.store(record.revoked_at.is_some(), Ordering::Relaxed);
    }

    fn check(&self, now: Timestamp) -> Result<(), Error> {
        if self.revoked.load(Ordering::Relaxed) {
            return Err(Error::Unauthenticated("the API key is revoked"));
        }
        if now.as_millisecond() >= self.expires_at.load(Ordering::Relaxed) {
            return Err(Error::Unauthenticated("the API key is expired"));
        }
        Ok(())
    }
}

impl Caller {
    /// Public id of the API key, if there is one.
    pub fn key_id(&self) -> Option<&str> {
        self.0.as_ref().map(|key| key.id.as_str())
    }

    /// Owner of the sessions, environments and jobs that the caller makes.
    pub fn owner(&self) -> &Owner {
        static NOBODY: Owner = Owner::NOBODY;
        self.0.as_ref().map_or(&NOBODY, |key| &key.owner)
    }

    /// Whether the caller sees what others own and may change everything: everybody on a server without keys, and keys with the
    /// scope `admin`.
    pub fn is_admin(&self) -> bool {
        self.0.as_ref().is_none_or(|key| key.scopes.allows(Scope::Admin))
    }

    /// The owner whose things the caller sees; `None`: it sees those of all.
    pub fn sees(&self) -> Option<&Owner> {
        (!self.is_admin()).then(|| self.owner())
    }

    /// Whether the caller sees what the owner with this id has.
    pub fn sees_id(&self, owner: Option<&str>) -> bool {
        self.sees().is_none_or(|own| own.id() == owner)
    }

    /// The owner whose entry `id` the caller means: its own, or with `admin` that of another owner if its own has none.
    pub(in crate::service) fn owner_among<T: TableEntry>(&self, table: &Table<T>, id: &str) -> Owner {
        let other = || if self.sees_other_owners() { table.owner_of(id) } else { None };
        let own = self.owner();
        if table.contains(own, id) { own.clone() } else { other().unwrap_or_else(|| own.clone()) }
    }

    fn sees_other_owners(&self) -> bool {
        self.0.is_some() && self.is_admin()
    }

    /// The token of the page after an entry. It contains the owner only where a list has those of several.
    pub(in crate::service) fn list_token(&self, owner: &Owner, id: &str) -> String {
        if self.sees_other_owners() { format!("{}/{id}", owner.id().unwrap_or_default()) } else { id.to_owned() }
    }

    /// The owner and the id in a token; any text is a position in the list.
    pub(in crate::service) fn list_position<'a>(&self, token: &'a str) -> (Owner, &'a str) {
        match token.split_once('/').filter(|_| self.sees_other_owners()) {
            Some(("", id)) => (Owner::NOBODY, id),
            Some((owner, id)) => (Owner::new(owner), id),
            None => (self.owner().clone(), token),
        }
    }

    /// Checks that the key is still valid. Streams call this repeatedly.
    ///
    /// # Errors
    /// [`Error::Unauthenticated`] when the key is revoked or expired.
    pub fn check(&self, now: Timestamp) -> Result<(), Error> {
        self.0.as_ref().map_or(Ok(()), |key| key.check(now))
    }

    /// Checks that the key has `scope`.
    ///
    /// # Errors
    /// [`Error::PermissionDenied`] when it does not.
    pub fn authorize(&self, scope: Scope) -> Result<(), Error> {
        let Some(key) = self.0.as_ref().filter(|key| !key.scopes.allows(scope)) else { return Ok(()) };
        let (scope, id, scopes) = (scope.name(), &key.id, key.scopes);
        let message = format!("this operation requires the scope {scope}; the API key {id} has {scopes}");
        Err(Error::PermissionDenied { message, scope })
    }

    /// Counts one request against the rate of the key.
    ///
    /// # Errors
    /// [`Error::Busy`] when the key is over its rate.
    pub fn acquire(&self, clock: &Clock) -> Result<(), Error> {
        let Some(key) = &self.0 else { return Ok(()) };
        let ms = clock.now().as_millisecond();
        // One second of precision is enough, and most requests write nothing.
        if ms.saturating_sub(key.last_used_at.load(Ordering::Relaxed)) >= 1000 {
            key.last_used_at.store(ms, Ordering::Relaxed);
        }
        let Some((rate, bucket)) = &key.limit else { return Ok(()) };
        bucket.take(nanoseconds(clock.monotonic())).map_err(|retry_after| {
            let message = format!("the API key {} is limited to {} requests per second", key.id, rate.per_second);
            Error::Busy { message, retry_after }
        })
    }

    /// Counts `requests` more after an accepted request turned out to contain them (the slots of a batch). The request is not
    /// refused; later requests of the key wait.
    pub fn charge(&self, requests: u32, clock: &Clock) {
        if let Some((_, bucket)) = self.0.as_ref().and_then(|key| key.limit.as_ref()) {
            bucket.charge(requests, nanoseconds(clock.monotonic()));
        }
    }

    /// Checks that the key is still valid and counts one request: for the next message of an open stream.
    ///
    /// # Errors
    /// [`Error::Unauthenticated`] when the key is revoked or expired, [`Error::Busy`] when it is over its rate.
    pub fn check_and_acquire(&self, clock: &Clock) -> Result<(), Error> {
        self.check(clock.now())?;
        self.acquire(clock)
    }
}

fn nanoseconds(time: Duration) -> i64 {
    i64::try_from(time.as_nanos()).unwrap_or(i64::MAX)
}
