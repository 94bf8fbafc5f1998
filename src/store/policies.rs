//! Published policies: names, immutable versions with their checkpoints, aliases.

use sqlx::Row;
use sqlx::sqlite::SqliteRow;

use super::{Error, Store};

/// A published version, with the checkpoint's bytes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PolicyVersion {
    /// Name of the policy.
    pub name: String,
    /// From 1, one more for each new checkpoint.
    pub version: u64,
    /// SHA-256 of `checkpoint`, in hexadecimal.
    pub digest: String,
    /// Safetensors.
    pub checkpoint: Vec<u8>,
    /// Milliseconds since the epoch.
    pub created_at: i64,
}

/// A name for a version that may move.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PolicyAlias {
    /// Name of the policy.
    pub name: String,
    /// The alias.
    pub alias: String,
    /// The version it means.
    pub version: u64,
}

/// What to publish.
#[derive(Clone, Copy, Debug)]
pub struct NewPolicyVersion<'a> {
    /// Name of the policy, new or known.
    pub name: &'a str,
    /// SHA-256 of `checkpoint`, in hexadecimal.
    pub digest: &'a str,
    /// Safetensors.
    pub checkpoint: &'a [u8],
    /// Milliseconds since the epoch.
    pub now: i64,
}

impl Store {
    /// Checks that the database answers.
    ///
    /// # Errors
    /// It does not.
    pub async fn ping(&self) -> Result<(), Error> {
        sqlx::query("SELECT 1").execute(&self.read).await?;
        Ok(())
    }

    /// Stores a new version; where the name already has one of this digest, nothing changes. Returns the version's number
    /// and the time it was published at.
    ///
    /// # Errors
    /// The database fails.
    pub async fn publish_policy(&self, new: NewPolicyVersion<'_>) -> Result<(u64, i64), Error> {
        let mut tx = self.begin().await?;
        let known = sqlx::query("SELECT version, created_at FROM policy_versions WHERE name = ? AND digest = ?")
            .bind(new.name)
            .bind(new.digest)
            .fetch_optional(&mut *tx)
            .await?;
        if let Some(row) = known {
            return Ok((row.try_get::<i64, _>(0)? as u64, row.try_get(1)?));
        }
        sqlx::query("INSERT INTO policies (name, created_at) VALUES (?, ?) ON CONFLICT (name) DO NOTHING")
            .bind(new.name)
            .bind(new.now)
            .execute(&mut *tx)
            .await?;
        let row = sqlx::query(
            "INSERT INTO policy_versions (name, version, digest, checkpoint, created_at)
             SELECT ?1, COALESCE(MAX(version), 0) + 1, ?2, ?3, ?4 FROM policy_versions WHERE name = ?1
             RETURNING version",
        )
        .bind(new.name)
        .bind(new.digest)
        .bind(new.checkpoint)
        .bind(new.now)
        .fetch_one(&mut *tx)
        .await?;
        let version: i64 = row.try_get(0)?;
        tx.commit().await?;
        Ok((version as u64, new.now))
    }

    /// Names and numbers of all published versions.
    ///
    /// # Errors
    /// The database fails.
    pub async fn policy_versions(&self) -> Result<Vec<(String, u64)>, Error> {
        let rows = sqlx::query("SELECT name, version FROM policy_versions ORDER BY name, version").fetch_all(&self.read).await?;
        rows.iter().map(|row| Ok((row.try_get(0)?, row.try_get::<i64, _>(1)? as u64))).collect()
    }

    /// A published version with its checkpoint, if there is one.
    ///
    /// # Errors
    /// The database fails.
    pub async fn policy_version(&self, name: &str, version: u64) -> Result<Option<PolicyVersion>, Error> {
        let query = "SELECT name, version, digest, checkpoint, created_at FROM policy_versions WHERE name = ? AND version = ?";
        let row = sqlx::query(query).bind(name).bind(version as i64).fetch_optional(&self.read).await?;
        row.as_ref().map(read_version).transpose()
    }

    /// Lets `alias` of `name` mean `version`, which exists.
    ///
    /// # Errors
    /// The database fails, or there is no such version.
    pub async fn set_policy_alias(&self, name: &str, alias: &str, version: u64) -> Result<(), Error> {
        let query = "INSERT INTO policy_aliases (name, alias, version) VALUES (?, ?, ?)
                     ON CONFLICT (name, alias) DO UPDATE SET version = excluded.version";
        sqlx::query(query).bind(name).bind(alias).bind(version as i64).execute(&self.write).await?;
        Ok(())
    }

    /// All aliases.
    ///
    /// # Errors
    /// The database fails.
    pub async fn policy_aliases(&self) -> Result<Vec<PolicyAlias>, Error> {
        let rows =
            sqlx::query("SELECT name, alias, version FROM policy_aliases ORDER BY name, alias").fetch_all(&self.read).await?;
        let read = |row: &SqliteRow| -> Result<PolicyAlias, Error> {
            Ok(PolicyAlias { name: row.try_get(0)?, alias: row.try_get(1)?, version: row.try_get::<i64, _>(2)? as u64 })
        };
        rows.iter().map(read).collect()
    }
}

fn read_version(row: &SqliteRow) -> Result<PolicyVersion, Error> {
    Ok(PolicyVersion {
        name: row.try_get("name")?,
        version: row.try_get::<i64, _>("version")? as u64,
        digest: row.try_get("digest")?,
        checkpoint: row.try_get("checkpoint")?,
        created_at: row.try_get("created_at")?,
    })
}
