//! The keys of a running server, in memory: a request costs a look into a map and one SHA-256, never a query.
//!
//! Keys never leave it. Once there is one, every request needs one for as long as the server runs, whatever becomes of the key.

use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};
use std::sync::{Arc, PoisonError, RwLock};

use jiff::Timestamp;

use super::bucket::{Bucket, Rate};
use super::scope::{Scope, Scopes};
use super::secret;
use crate::service::Error;
use crate::store::{KeyRecord, Store};

/// All keys that were ever made.
#[derive(Debug)]
pub struct Keyring {
    default: Option<Rate>,
    /// Whether there is a key: the one thing that is looked at where there is none.
    required: AtomicBool,
    /// Of the table that `keys` was read from.
    revision: AtomicI64,
    keys: RwLock<HashMap<String, Arc<Key>>>,
}

#[derive(Debug)]
struct Key {
    id: String,
    digest: [u8; 32],
    scopes: Scopes,
    limit: Option<(Rate, Bucket)>,
    revoked: AtomicBool,
    /// Milliseconds since the epoch, as are the following.
    expires_at: AtomicI64,
    used_at: AtomicI64,
    /// What of `used_at` is in the database.
    kept_at: AtomicI64,
}

/// Who asks: the key that was shown. Transports put it into the extensions of a request.
#[derive(Clone, Debug)]
pub struct Caller(Arc<Key>);

impl Keyring {
    /// Without keys; `default` limits those that have no rate of their own.
    pub fn new(default: Option<Rate>) -> Self {
        Self { default, required: AtomicBool::new(false), revision: AtomicI64::new(-1), keys: RwLock::default() }
    }

    /// Whether requests need a key.
    pub fn required(&self) -> bool {
        self.required.load(Ordering::Relaxed)
    }

    /// Takes over what was made, revoked or given another end since the last time. Cheap when nothing was.
    ///
    /// # Errors
    /// The database; the keys stay as they were.
    pub async fn refresh(&self, store: &Store) -> Result<(), Error> {
        let revision = store.keys_revision().await?;
        if revision == self.revision.load(Ordering::Relaxed) {
            return Ok(());
        }
        let records = store.keys().await?;
        let mut keys = self.keys.write().unwrap_or_else(PoisonError::into_inner);
        // Rows are not deleted; if somebody does so by hand, the key is over.
        let gone = keys.values().filter(|key| !records.iter().any(|record| record.id == key.id));
        gone.for_each(|key| key.revoked.store(true, Ordering::Relaxed));
        for record in records {
            match keys.get(&record.id) {
                Some(key) => key.end(&record),
                None => drop(keys.insert(record.id.clone(), Arc::new(Key::new(record, self.default)))),
            }
        }
        if !keys.is_empty() {
            self.required.store(true, Ordering::Relaxed);
        }
        self.revision.store(revision, Ordering::Relaxed);
        Ok(())
    }

    /// Who shows `presented`. `None` when no key is needed.
    ///
    /// # Errors
    /// [`Error::Unauthenticated`] for none, an unknown or a wrong one, and for one that is over.
    pub fn authenticate(&self, presented: Option<&str>, now: Timestamp) -> Result<Option<Caller>, Error> {
        const NONE: Error = Error::Unauthenticated("an API key is needed: authorization: Bearer KEY, or x-api-key: KEY");
        const UNKNOWN: Error = Error::Unauthenticated("this API key is not known here");
        if !self.required() {
            return Ok(None);
        }
        let (id, plain) = secret::split(presented.ok_or(NONE)?).ok_or(UNKNOWN)?;
        let key = self.keys.read().unwrap_or_else(PoisonError::into_inner).get(id).cloned().ok_or(UNKNOWN)?;
        if !secret::matches(plain, &key.digest) {
            return Err(UNKNOWN);
        }
        key.check(now)?;
        Ok(Some(Caller(key)))
    }

    /// Writes down when keys were last used, where that has changed.
    ///
    /// # Errors
    /// The database; it is tried again the next time.
    pub async fn keep_last_uses(&self, store: &Store) -> Result<(), Error> {
        let keys: Vec<Arc<Key>> = self.keys.read().unwrap_or_else(PoisonError::into_inner).values().cloned().collect();
        let changed = |key: &Arc<Key>| {
            let used_at = key.used_at.load(Ordering::Relaxed);
            (used_at != key.kept_at.load(Ordering::Relaxed)).then(|| (Arc::clone(key), used_at))
        };
        let used: Vec<(Arc<Key>, i64)> = keys.iter().filter_map(changed).collect();
        let rows = used.iter().filter_map(|(key, at)| Some((key.id.clone(), Timestamp::from_millisecond(*at).ok()?)));
        let rows: Vec<(String, Timestamp)> = rows.collect();
        if rows.is_empty() {
            return Ok(());
        }
        store.touch_keys(&rows).await?;
        used.iter().for_each(|(key, at)| key.kept_at.store(*at, Ordering::Relaxed));
        Ok(())
    }
}

impl Key {
    fn new(record: KeyRecord, default: Option<Rate>) -> Self {
        let own = record.rate.map(|rate| Rate::new(rate, record.burst));
        let used_at = record.last_used_at.map_or(i64::MIN, Timestamp::as_millisecond);
        let key = Self {
            digest: record.digest,
            scopes: Scopes::stored(&record.scopes),
            limit: own.or(default).map(|rate| (rate, Bucket::new(rate))),
            revoked: AtomicBool::new(false),
            expires_at: AtomicI64::new(i64::MAX),
            used_at: AtomicI64::new(used_at),
            kept_at: AtomicI64::new(used_at),
            id: record.id.clone(),
        };
        key.end(&record);
        key
    }

    fn end(&self, record: &KeyRecord) {
        self.expires_at.store(record.expires_at.map_or(i64::MAX, Timestamp::as_millisecond), Ordering::Relaxed);
        self.revoked.store(record.revoked_at.is_some(), Ordering::Relaxed);
    }

    fn check(&self, now: Timestamp) -> Result<(), Error> {
        if self.revoked.load(Ordering::Relaxed) {
            return Err(Error::Unauthenticated("this API key was revoked"));
        }
        if now.as_millisecond() >= self.expires_at.load(Ordering::Relaxed) {
            return Err(Error::Unauthenticated("this API key has expired"));
        }
        Ok(())
    }
}

impl Caller {
    /// Public name of the key.
    pub fn id(&self) -> &str {
        &self.0.id
    }

    /// Checks that the key still is good, for answers that go on for a while.
    ///
    /// # Errors
    /// [`Error::Unauthenticated`] when it was revoked or has expired.
    pub fn check(&self, now: Timestamp) -> Result<(), Error> {
        self.0.check(now)
    }

    /// Checks that what needs `scope` is open to this key.
    ///
    /// # Errors
    /// [`Error::PermissionDenied`], which names the scope.
    pub fn authorize(&self, scope: Scope) -> Result<(), Error> {
        if self.0.scopes.open(scope) {
            return Ok(());
        }
        let (scope, id, scopes) = (scope.name(), self.id(), self.0.scopes);
        Err(Error::PermissionDenied(format!("this needs the scope {scope}; the API key {id} has {scopes}")))
    }

    /// Counts a request at `now` against the key's rate.
    ///
    /// # Errors
    /// [`Error::Busy`]: too many too soon.
    pub fn spend(&self, now: Timestamp) -> Result<(), Error> {
        let key = &self.0;
        let ms = now.as_millisecond();
        // A second is as exact as anybody asks for; most requests write nothing.
        if ms.saturating_sub(key.used_at.load(Ordering::Relaxed)) >= 1000 {
            key.used_at.store(ms, Ordering::Relaxed);
        }
        let Some((rate, bucket)) = &key.limit else { return Ok(()) };
        bucket.take(nanoseconds(now)).map_err(|retry_after| {
            let message = format!("the API key {} is limited to {} requests per second", key.id, rate.per_second);
            Error::Busy { message, retry_after }
        })
    }

    /// Counts what a request that was let in turned out to be made of, beyond the request itself. It is not refused for that;
    /// those that follow wait for it.
    pub fn charge(&self, requests: u32, now: Timestamp) {
        if let Some((_, bucket)) = &self.0.limit {
            bucket.charge(requests, nanoseconds(now));
        }
    }

    /// For the next message of a stream that this key opened: checks that the key still is good, and counts it.
    ///
    /// # Errors
    /// [`Error::Unauthenticated`] when the key is over, [`Error::Busy`] when it asks too often.
    pub fn again(&self, now: Timestamp) -> Result<(), Error> {
        self.check(now)?;
        self.spend(now)
    }
}

fn nanoseconds(time: Timestamp) -> i64 {
    i64::try_from(time.as_nanosecond()).unwrap_or(i64::MAX)
}
