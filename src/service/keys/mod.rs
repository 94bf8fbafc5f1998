//! API keys: their scopes, rates and expiry.
//!
//! `qedgix keys` creates and revokes keys in the database, also while a server runs on the same data directory. The
//! [`Keyring`] of the server notices changes within about a second.

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
use crate::error_code::ErrorCode;
use crate::files;
use crate::invalid::{Invalid, in_range};
use crate::store::{self, KeyRecord, Store};

/// Properties of a new key.
#[derive(Clone, Debug)]
pub struct NewKey {
    /// Name for people.
    pub name: String,
    /// What the key allows.
    pub scopes: Scopes,
    /// Id of a key whose sessions, environments, jobs and policy names it shares; `None`: it has its own.
    pub owner: Option<String>,
    /// Time until the key expires; `None`: it never expires.
    pub lifetime: Option<Duration>,
    /// Requests per second; `None`: the default of the server.
    pub rate: Option<f64>,
    /// Requests at once; `None`: the requests of one second.
    pub burst: Option<f64>,
}

/// A key without its secret.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct KeyInfo {
    /// Public id.
    pub id: String,
    /// Name for people.
    pub name: String,
    /// What the key allows.
    pub scopes: Scopes,
    /// Owner of what the key makes: its id, or that of a key that it replaces or accompanies.
    pub owner: String,
    /// `active`, `expired` or `revoked`.
    pub state: &'static str,
    /// Requests per second; `None`: the default of the server.
    pub rate: Option<f64>,
    /// Requests at once; `None`: the requests of one second.
    pub burst: Option<f64>,
    /// Time of creation.
    pub created_at: Timestamp,
    /// Time of expiry, if any.
    pub expires_at: Option<Timestamp>,
    /// Time of revocation, if any.
    pub revoked_at: Option<Timestamp>,
    /// Time of last use. A running server saves it every 30 seconds.
    pub last_used_at: Option<Timestamp>,
}

/// A new key.
pub struct CreatedKey {
    /// The key without its secret.
    pub info: KeyInfo,
    /// The whole key. It is not stored and cannot be shown again.
    pub key: String,
}

/// What a process other than the server opens the database for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Purpose {
    /// Reading, also on a read-only file system.
    Read,
    /// Changing a database that exists.
    Change,
    /// Changing; a missing database is created.
    Create,
}

/// Why the database was not opened.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// There is no database, or the directory cannot be created.
    #[error(transparent)]
    Invalid(#[from] Invalid),
    /// The user of this process may not read it.
    #[error(transparent)]
    Denied(#[from] files::Denied),
    /// It cannot be opened.
    #[error(transparent)]
    Store(#[from] store::Error),
}

/// Opens the database in `data_dir`, for a process other than its server.
///
/// # Errors
/// [`OpenError`].
pub async fn open_store(data_dir: &Path, purpose: Purpose) -> Result<Store, OpenError> {
    let database = data_dir.join(store::FILE);
    if purpose == Purpose::Create {
        files::create_private_dir(data_dir)
            .map_err(|e| Invalid::new("--data-dir", data_dir.display(), format!("a directory that can be created ({e})")))?;
    }
    files::check_access(&database, false)?;
    if purpose != Purpose::Create && !database.exists() {
        return Err(Invalid::new("--data-dir", data_dir.display(), "a data directory of a server").into());
    }
    Ok(if purpose == Purpose::Read { Store::open_to_read(data_dir).await? } else { Store::open(data_dir).await? })
}

/// Creates a key.
///
/// # Errors
/// [`Error::Invalid`] when the name, rate, burst or lifetime is out of range; [`Error::NotFound`] when there is no key `owner`.
pub async fn create(store: &Store, mut new: NewKey, now: Timestamp) -> Result<CreatedKey, Error> {
    if let Some(owner) = &mut new.owner {
        let id = secret::id_of(owner);
        let key = store.keys().await?.into_iter().find(|key| key.id == id);
        *owner = key.ok_or_else(|| Error::not_found("API key", id))?.owner;
    }
    let (record, key) = generate(new, now)?;
    if !store.insert_key(&record).await? {
        return Err(Error::internal("two API keys have the same id"));
    }
    Ok(CreatedKey { info: info(record, now), key })
}

/// Generates a key. Returns its record and the whole key.
fn generate(new: NewKey, now: Timestamp) -> Result<(KeyRecord, String), Error> {
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
    let plain = secret::PlainKey::generate().map_err(|e| Error::internal(e.to_string()))?;
    let record = KeyRecord {
        owner: new.owner.unwrap_or_else(|| plain.id().to_owned()),
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
    Ok((record, plain.to_text()))
}

/// All keys, oldest first.
///
/// # Errors
/// [`Error::Internal`] when the database fails.
pub async fn list(store: &Store, now: Timestamp) -> Result<Vec<KeyInfo>, Error> {
    Ok(store.keys().await?.into_iter().map(|record| info(record, now)).collect())
}

/// Revokes a key, given as its id or in full. A key that is already revoked or expired stays as it is.
///
/// # Errors
/// [`Error::NotFound`] when there is no such key.
pub async fn revoke(store: &Store, id: &str, now: Timestamp) -> Result<(), Error> {
    let id = secret::id_of(id);
    if store.revoke_key(id, now).await? { Ok(()) } else { Err(Error::not_found("API key", id)) }
}

/// Replaces a key, given as its id or in full: in one transaction, creates a key with the same properties, owner and lifetime, and
/// lets the old key expire after `grace`.
///
/// # Errors
/// [`Error::NotFound`] when there is no such key, [`Error::Precondition`] when it is revoked or expired.
pub async fn rotate(store: &Store, id: &str, grace: Duration, now: Timestamp) -> Result<CreatedKey, Error> {
    let id = secret::id_of(id);
    let old = store.keys().await?.into_iter().find(|key| key.id == id).ok_or_else(|| Error::not_found("API key", id))?;
    let not_active = |state| {
        let message = format!("the API key {id} is {state}; create a new one");
        Error::Precondition { code: ErrorCode::WrongState, message }
    };
    let state = state(&old, now);
    if state != "active" {
        return Err(not_active(state));
    }
    let end = after(now, grace, "grace")?;
    let lifetime = old.expires_at.and_then(|at| Duration::try_from(at.duration_since(old.created_at)).ok());
    let scopes = Scopes::from_stored(&old.scopes);
    let new = NewKey { name: old.name, scopes, owner: Some(old.owner), lifetime, rate: old.rate, burst: old.burst };
    let (record, key) = generate(new, now)?;
    if !store.rotate_key(id, &record, end).await? {
        // The key was active when it was read.
        return Err(not_active("revoked"));
    }
    Ok(CreatedKey { info: info(record, now), key })
}

fn after(now: Timestamp, time: Duration, field: &str) -> Result<Timestamp, Invalid> {
    let sum = now.checked_add(time);
    sum.map_err(|_| Invalid::new(field, format!("{} s", time.as_secs()), "a duration that ends before the year 10000"))
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
        scopes: Scopes::from_stored(&record.scopes),
        id: record.id,
        owner: record.owner,
        name: record.name,
        rate: record.rate,
        burst: record.burst,
        created_at: record.created_at,
        expires_at: record.expires_at,
        revoked_at: record.revoked_at,
        last_used_at: record.last_used_at,
    }
}
