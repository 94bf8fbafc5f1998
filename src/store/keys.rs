//! API keys: the digests of their secrets, their scopes and their limits.

use jiff::Timestamp;
use sqlx::sqlite::SqliteRow;
use sqlx::{Row, SqliteConnection};

use super::{Result, Store, corrupt, timestamp};

/// An API key as stored.
#[derive(Clone, Debug, PartialEq)]
pub struct KeyRecord {
    /// Public id.
    pub id: String,
    /// Owner of what the key makes: its own id, or the id of a key that it replaces or accompanies.
    pub owner: String,
    /// Display name.
    pub name: String,
    /// SHA-256 of the secret.
    pub digest: [u8; 32],
    /// Scopes: names separated by commas.
    pub scopes: String,
    /// Requests per second; `None` is the server's default.
    pub rate: Option<f64>,
    /// Requests at once; `None` is as many as one second allows.
    pub burst: Option<f64>,
    /// When it was created.
    pub created_at: Timestamp,
    /// When it expires.
    pub expires_at: Option<Timestamp>,
    /// When it was revoked.
    pub revoked_at: Option<Timestamp>,
    /// When it was last used. Written from time to time.
    pub last_used_at: Option<Timestamp>,
}

impl Store {
    /// Stores a new key. Returns false if its id is taken.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn insert_key(&self, key: &KeyRecord) -> Result<bool> {
        let mut tx = self.begin().await?;
        let inserted = insert(&mut tx, key).await?;
        tx.commit().await?;
        Ok(inserted)
    }

    /// Stores a new key and lets the key `old` expire at `expires_at`, unless it expires earlier, in one transaction. Returns
    /// false, and changes nothing, if `old` is not active at the creation of `new` or the id of `new` is taken.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn rotate_key(&self, old: &str, new: &KeyRecord, expires_at: Timestamp) -> Result<bool> {
        let mut tx = self.begin().await?;
        let sql = "UPDATE api_keys SET expires_at = MIN(COALESCE(expires_at, ?1), ?1),
                   revision = (SELECT COALESCE(MAX(revision), 0) + 1 FROM api_keys)
                   WHERE id = ?2 AND revoked_at IS NULL AND (expires_at IS NULL OR expires_at > ?3)";
        let update = sqlx::query(sql).bind(expires_at.as_millisecond()).bind(old).bind(new.created_at.as_millisecond());
        let expires = update.execute(&mut *tx).await?.rows_affected() == 1;
        let rotated = expires && insert(&mut tx, new).await?;
        if rotated {
            tx.commit().await?;
        } else {
            tx.abandon().await?;
        }
        Ok(rotated)
    }

    /// All keys, oldest first.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn keys(&self) -> Result<Vec<KeyRecord>> {
        let sql = "SELECT id, COALESCE(owner, id) AS owner, name, digest, scopes, rate, burst, created_at, expires_at, revoked_at, last_used_at
                   FROM api_keys ORDER BY created_at, id";
        sqlx::query(sql).fetch_all(&self.read).await?.iter().map(read).collect()
    }

    /// A number that increases whenever a key is created, revoked, or gets another expiry; 0 without keys.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn keys_revision(&self) -> Result<i64> {
        let row = sqlx::query("SELECT COALESCE(MAX(revision), 0) FROM api_keys").fetch_one(&self.read).await?;
        Ok(row.try_get(0)?)
    }

    /// Revokes a key at `now`. A revoked key keeps its time. Returns false if there is no such key.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn revoke_key(&self, id: &str, now: Timestamp) -> Result<bool> {
        let sql = "UPDATE api_keys SET revoked_at = COALESCE(revoked_at, ?),
                   revision = (SELECT COALESCE(MAX(revision), 0) + 1 FROM api_keys) WHERE id = ?";
        let mut tx = self.begin().await?;
        let done = sqlx::query(sql).bind(now.as_millisecond()).bind(id).execute(&mut *tx).await?;
        tx.commit().await?;
        Ok(done.rows_affected() == 1)
    }

    /// Stores when keys were last used.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn touch_keys(&self, used: &[(String, Timestamp)]) -> Result<()> {
        let mut tx = self.begin().await?;
        for (id, at) in used {
            let sql = "UPDATE api_keys SET last_used_at = MAX(COALESCE(last_used_at, ?1), ?1) WHERE id = ?2";
            sqlx::query(sql).bind(at.as_millisecond()).bind(id).execute(&mut *tx).await?;
        }
        tx.commit().await
    }
}

async fn insert(db: &mut SqliteConnection, key: &KeyRecord) -> Result<bool> {
    let sql = "INSERT INTO api_keys (id, owner, name, digest, scopes, rate, burst, created_at, expires_at, revision)
               VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, (SELECT COALESCE(MAX(revision), 0) + 1 FROM api_keys))
               ON CONFLICT (id) DO NOTHING";
    let done = sqlx::query(sql)
        .bind(&key.id)
        .bind(&key.owner)
        .bind(&key.name)
        .bind(key.digest.as_slice())
        .bind(&key.scopes)
        .bind(key.rate)
        .bind(key.burst)
        .bind(key.created_at.as_millisecond())
        .bind(key.expires_at.map(Timestamp::as_millisecond))
        .execute(&mut *db)
        .await?;
    Ok(done.rows_affected() == 1)
}

fn read(row: &SqliteRow) -> Result<KeyRecord> {
    let id: String = row.try_get("id")?;
    let digest: Vec<u8> = row.try_get("digest")?;
    let digest = digest.try_into().map_err(|_| corrupt("API key", &id, "its digest does not have 32 bytes"))?;
    let time = |column| row.try_get::<Option<i64>, _>(column)?.map(timestamp).transpose();
    Ok(KeyRecord {
        digest,
        owner: row.try_get("owner")?,
        name: row.try_get("name")?,
        scopes: row.try_get("scopes")?,
        rate: row.try_get("rate")?,
        burst: row.try_get("burst")?,
        created_at: timestamp(row.try_get("created_at")?)?,
        expires_at: time("expires_at")?,
        revoked_at: time("revoked_at")?,
        last_used_at: time("last_used_at")?,
        id,
    })
}
