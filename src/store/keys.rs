//! API keys: digests of their secrets and what they open.

use jiff::Timestamp;
use sqlx::Row;
use sqlx::sqlite::SqliteRow;

use super::{Result, Store, corrupt, timestamp};

/// An API key as it is kept.
#[derive(Clone, Debug, PartialEq)]
pub struct KeyRecord {
    /// Public name.
    pub id: String,
    /// What its owner calls it.
    pub name: String,
    /// SHA-256 of the secret.
    pub digest: [u8; 32],
    /// What it opens: names separated by commas.
    pub scopes: String,
    /// Requests per second; absent: the server's default.
    pub rate: Option<f64>,
    /// Requests at once; absent: as many as one second allows.
    pub burst: Option<f64>,
    /// When it was made.
    pub created_at: Timestamp,
    /// When it ends by itself.
    pub expires_at: Option<Timestamp>,
    /// When it was revoked.
    pub revoked_at: Option<Timestamp>,
    /// When it was last shown, to within the time between two writes of it.
    pub last_used_at: Option<Timestamp>,
}

/// The revision that a change of a key gets, as SQL.
macro_rules! next_revision {
    () => {
        "(SELECT COALESCE(MAX(revision), 0) + 1 FROM api_keys)"
    };
}

impl Store {
    /// Keeps a new key; false when the id is taken.
    ///
    /// # Errors
    /// The database.
    pub async fn insert_key(&self, key: &KeyRecord) -> Result<bool> {
        let sql = concat!(
            "INSERT INTO api_keys (id, name, digest, scopes, rate, burst, created_at, expires_at, revision)
             VALUES (?, ?, ?, ?, ?, ?, ?, ?, ",
            next_revision!(),
            ") ON CONFLICT (id) DO NOTHING"
        );
        let done = sqlx::query(sql)
            .bind(&key.id)
            .bind(&key.name)
            .bind(key.digest.as_slice())
            .bind(&key.scopes)
            .bind(key.rate)
            .bind(key.burst)
            .bind(key.created_at.as_millisecond())
            .bind(key.expires_at.map(Timestamp::as_millisecond))
            .execute(&self.write)
            .await?;
        Ok(done.rows_affected() == 1)
    }

    /// All keys, in the order in which they were made.
    ///
    /// # Errors
    /// The database.
    pub async fn keys(&self) -> Result<Vec<KeyRecord>> {
        let sql = "SELECT id, name, digest, scopes, rate, burst, created_at, expires_at, revoked_at, last_used_at
                   FROM api_keys ORDER BY created_at, id";
        sqlx::query(sql).fetch_all(&self.read).await?.iter().map(read).collect()
    }

    /// A number that changes whenever a key is made, revoked or given another end; 0 while there is none.
    ///
    /// # Errors
    /// The database.
    pub async fn keys_revision(&self) -> Result<i64> {
        let row = sqlx::query("SELECT COALESCE(MAX(revision), 0) FROM api_keys").fetch_one(&self.read).await?;
        Ok(row.try_get(0)?)
    }

    /// Revokes a key at `now`; false when there is none. One that is revoked already stays as it is.
    ///
    /// # Errors
    /// The database.
    pub async fn revoke_key(&self, id: &str, now: Timestamp) -> Result<bool> {
        let sql =
            concat!("UPDATE api_keys SET revoked_at = COALESCE(revoked_at, ?), revision = ", next_revision!(), " WHERE id = ?");
        let done = sqlx::query(sql).bind(now.as_millisecond()).bind(id).execute(&self.write).await?;
        Ok(done.rows_affected() == 1)
    }

    /// Lets a key end at `at` if it does not end before.
    ///
    /// # Errors
    /// The database.
    pub async fn end_key(&self, id: &str, at: Timestamp) -> Result<()> {
        let sql = concat!(
            "UPDATE api_keys SET expires_at = MIN(COALESCE(expires_at, ?1), ?1), revision = ",
            next_revision!(),
            " WHERE id = ?2"
        );
        sqlx::query(sql).bind(at.as_millisecond()).bind(id).execute(&self.write).await?;
        Ok(())
    }

    /// Notes when keys were last used.
    ///
    /// # Errors
    /// The database.
    pub async fn touch_keys(&self, used: &[(String, Timestamp)]) -> Result<()> {
        let mut tx = self.begin().await?;
        for (id, at) in used {
            let sql = "UPDATE api_keys SET last_used_at = MAX(COALESCE(last_used_at, ?1), ?1) WHERE id = ?2";
            sqlx::query(sql).bind(at.as_millisecond()).bind(id).execute(&mut *tx).await?;
        }
        Ok(tx.commit().await?)
    }
}

fn read(row: &SqliteRow) -> Result<KeyRecord> {
    let id: String = row.try_get("id")?;
    let digest: Vec<u8> = row.try_get("digest")?;
    let digest = digest.try_into().map_err(|_| corrupt("API key", &id, "its digest has not 32 bytes"))?;
    let time = |column| row.try_get::<Option<i64>, _>(column)?.map(timestamp).transpose();
    Ok(KeyRecord {
        digest,
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
