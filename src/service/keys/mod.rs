//! API keys: who may ask for what, how often, until when.
//!
//! Keys are made and revoked in the database, also by another process while a server runs on it (`qedgix keys`); the server's
//! [`Keyring`] follows within about a second.

mod bucket;
mod keyring;
mod scope;
mod secret;

use std::path::Path;
use std::time::Duration;

use jiff::Timestamp;
use serde::Serialize;

pub use bucket::Rate;
pub use keyring::{Caller, Keyring};
pub use scope::{Scope, Scopes};

use super::Error;
use crate::invalid::{Invalid, in_range};
use crate::store::{self, KeyRecord, Store};

/// What a new key is to be.
#[derive(Clone, Debug)]
pub struct NewKey {
    /// What its owner calls it.
    pub name: String,
    /// What it opens.
    pub scopes: Scopes,
    /// How long it lasts; absent: until it is revoked.
    pub lifetime: Option<Duration>,
    /// Requests per second; absent: the server's default.
    pub rate: Option<f64>,
    /// Requests at once; absent: as many as one second allows.
    pub burst: Option<f64>,
}

/// What can be told of a key.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct KeyInfo {
    /// Public name.
    pub id: String,
    /// What its owner calls it.
    pub name: String,
    /// What it opens.
    pub scopes: Scopes,
    /// `active`, `expired` or `revoked`.
    pub state: &'static str,
    /// Requests per second, if not the server's default.
    pub rate: Option<f64>,
    /// Requests at once, if not as many as one second allows.
    pub burst: Option<f64>,
    /// When it was made.
    pub created_at: Timestamp,
    /// When it ends by itself.
    pub expires_at: Option<Timestamp>,
    /// When it was revoked.
    pub revoked_at: Option<Timestamp>,
    /// When it was last used, to within half a minute while a server runs.
    pub last_used_at: Option<Timestamp>,
}

/// A key that was just made.
pub struct Created {
    /// What can be told of it.
    pub info: KeyInfo,
    /// The whole key. Nobody can tell it again.
    pub key: String,
}

/// The database in `data_dir`, for a process that is not its server. One that is missing is made only to `create`.
///
/// # Errors
/// There is none, or it cannot be read.
pub async fn open(data_dir: &Path, create: bool) -> Result<Store, Error> {
    if create {
        std::fs::create_dir_all(data_dir).map_err(|e| Invalid::new("--data-dir", data_dir.display(), e.to_string()))?;
    } else if !data_dir.join(store::FILE).exists() {
        return Err(Invalid::new("--data-dir", data_dir.display(), "the data directory of a server").into());
    }
    Ok(Store::open(data_dir).await?)
}

/// Makes a key.
///
/// # Errors
/// A name, rate or lifetime that cannot be used.
pub async fn create(store: &Store, new: NewKey, now: Timestamp) -> Result<Created, Error> {
    let printable = new.name.chars().all(|c| !c.is_control());
    if new.name.is_empty() || new.name.len() > 128 || !printable {
        return Err(Invalid::new("name", format!("{:?}", new.name), "1 to 128 bytes of printable text").into());
    }
    if let Some(rate) = new.rate {
        in_range("rate", rate, Rate::PER_SECOND)?;
    }
    if let Some(burst) = new.burst {
        in_range("burst", burst, Rate::BURST)?;
    }
    let expires_at = new.lifetime.map(|lifetime| after(now, lifetime, "expires")).transpose()?;
    let plain = secret::Plain::generate().map_err(|e| Error::internal(e.to_string()))?;
    let record = KeyRecord {
        id: plain.id().to_owned(),
        name: new.name,
        digest: plain.digest(),
        scopes: new.scopes.to_string(),
        rate: new.rate,
        burst: new.burst,
        created_at: now,
        expires_at,
        revoked_at: None,
        last_used_at: None,
    };
    if !store.insert_key(&record).await? {
        return Err(Error::internal("two keys were given the same id"));
    }
    Ok(Created { info: info(record, now), key: plain.reveal() })
}

/// All keys, oldest first.
///
/// # Errors
/// The database.
pub async fn list(store: &Store, now: Timestamp) -> Result<Vec<KeyInfo>, Error> {
    Ok(store.keys().await?.into_iter().map(|record| info(record, now)).collect())
}

/// Ends a key at once, named by its id or in full. One that is over stays as it is.
///
/// # Errors
/// There is no such key.
pub async fn revoke(store: &Store, id: &str, now: Timestamp) -> Result<(), Error> {
    let id = secret::public(id);
    if store.revoke_key(id, now).await? { Ok(()) } else { Err(Error::not_found("API key", id)) }
}

/// Makes a key like another one, named by its id or in full, which ends after `grace`. The new one lasts as long as the old one did when it was made.
///
/// # Errors
/// There is no such key, or it is over.
pub async fn rotate(store: &Store, id: &str, grace: Duration, now: Timestamp) -> Result<Created, Error> {
    let id = secret::public(id);
    let old = store.keys().await?.into_iter().find(|key| key.id == id).ok_or_else(|| Error::not_found("API key", id))?;
    let state = state(&old, now);
    if state != "active" {
        let message = format!("the API key {id} is {state}; make a new one");
        return Err(Error::Precondition { code: "wrong_state", message });
    }
    let end = after(now, grace, "grace")?;
    let lifetime = old.expires_at.and_then(|at| Duration::try_from(at.duration_since(old.created_at)).ok());
    let scopes = Scopes::stored(&old.scopes);
    let created = create(store, NewKey { name: old.name, scopes, lifetime, rate: old.rate, burst: old.burst }, now).await?;
    store.end_key(id, end).await?;
    Ok(created)
}

fn after(now: Timestamp, time: Duration, field: &str) -> Result<Timestamp, Invalid> {
    let sum = now.checked_add(time);
    sum.map_err(|_| Invalid::new(field, format!("{} s", time.as_secs()), "a time that ends before the year 10000"))
}

fn state(record: &KeyRecord, now: Timestamp) -> &'static str {
    match (record.revoked_at, record.expires_at) {
        (Some(_), _) => "revoked",
        (None, Some(at)) if at <= now => "expired",
        _ => "active",
    }
}

fn info(record: KeyRecord, now: Timestamp) -> KeyInfo {
    KeyInfo {
        state: state(&record, now),
        scopes: Scopes::stored(&record.scopes),
        id: record.id,
        name: record.name,
        rate: record.rate,
        burst: record.burst,
        created_at: record.created_at,
        expires_at: record.expires_at,
        revoked_at: record.revoked_at,
        last_used_at: record.last_used_at,
    }
}
