//! Published policies: names, immutable versions with their checkpoints, and which versions are unloaded.

use jiff::Timestamp;
use sqlx::sqlite::SqliteRow;
use sqlx::{Row, SqliteConnection};

use super::aliases::{AliasMove, move_alias};
use super::{Error, Store};

/// A published version with its checkpoint.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PolicyVersion {
    /// Name of the policy.
    pub name: String,
    /// Number of the version: 1, 2, ...
    pub version: u64,
    /// SHA-256 of `checkpoint`, in hexadecimal.
    pub digest: String,
    /// The checkpoint, as safetensors.
    pub checkpoint: Vec<u8>,
    /// When it was published, in milliseconds since the Unix epoch.
    pub created_at: i64,
}

/// A version to publish.
#[derive(Clone, Copy, Debug)]
pub struct NewPolicyVersion<'a> {
    /// Name of the policy; it may be new.
    pub name: &'a str,
    /// SHA-256 of `checkpoint`, in hexadecimal.
    pub digest: &'a str,
    /// The checkpoint, as safetensors.
    pub checkpoint: &'a [u8],
    /// What lists show of it, as JSON.
    pub info: &'a str,
    /// The current time.
    pub now: Timestamp,
    /// An alias to point to the version.
    pub alias: Option<&'a str>,
    /// Id of the caller's API key.
    pub by: Option<&'a str>,
    /// Who publishes it; `None`: nobody, on a server without keys. A new name belongs to this owner.
    pub owner: Option<&'a str>,
    /// Whether the name may be one that another owner made.
    pub any_name: bool,
}

/// A published version without its checkpoint.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct VersionKey {
    /// Name of the policy.
    pub name: String,
    /// Number of the version.
    pub version: u64,
    /// SHA-256 of its checkpoint, in hexadecimal.
    pub digest: String,
}

/// The result of a publication.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PublishedPolicy {
    /// Number of the version.
    pub version: u64,
    /// When it was published, in milliseconds since the Unix epoch.
    pub created_at: i64,
    /// Whether the version is new: the policy had none with this checkpoint.
    pub new: bool,
}

impl Store {
    /// Checks that the database answers. The query reads the schema, so a damaged file is noticed.
    ///
    /// # Errors
    /// [`Error`] when the database fails.
    pub async fn ping(&self) -> Result<(), Error> {
        sqlx::query("SELECT 1 FROM sqlite_schema LIMIT 1").execute(&self.read).await?;
        Ok(())
    }

    /// Publishes a checkpoint as a new version, or finds the version of the policy with this digest, and moves the alias to
    /// it, in one transaction. Returns `None`, and changes nothing, if another owner made the name.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn publish_policy(&self, new: NewPolicyVersion<'_>) -> Result<Option<PublishedPolicy>, Error> {
        let mut tx = self.begin().await?;
        if !may_publish(&mut tx, new).await? {
            tx.abandon().await?;
            return Ok(None);
        }
        let published = publish(&mut tx, new).await?;
        tx.commit().await?;
        Ok(Some(published))
    }

    /// Who made the name of a policy; the inner `None`: nobody. `None` if there is no such policy.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn policy_owner(&self, name: &str) -> Result<Option<Option<String>>, Error> {
        owner_of(&mut *self.read.acquire().await?, name).await
    }

    /// All versions, without their checkpoints.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn policy_versions(&self) -> Result<Vec<VersionKey>, Error> {
        let sql = "SELECT name, version, digest FROM policy_versions ORDER BY name, version";
        let rows: Vec<(String, i64, String)> = sqlx::query_as(sql).fetch_all(&self.read).await?;
        Ok(rows.into_iter().map(|(name, version, digest)| VersionKey { name, version: version as u64, digest }).collect())
    }

    /// What lists show of a version, as JSON; `None` if it was not stored yet.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn policy_info(&self, name: &str, version: u64) -> Result<Option<String>, Error> {
        let sql = "SELECT info FROM policy_infos WHERE name = ? AND version = ?";
        Ok(sqlx::query_scalar(sql).bind(name).bind(version as i64).fetch_optional(&self.read).await?)
    }

    /// Stores what lists show of a version, unless the version was deleted.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn store_policy_info(&self, name: &str, version: u64, info: &str) -> Result<(), Error> {
        let sql = "REPLACE INTO policy_infos (name, version, info)
                   SELECT name, version, ?3 FROM policy_versions WHERE name = ?1 AND version = ?2";
        let mut tx = self.begin().await?;
        sqlx::query(sql).bind(name).bind(version as i64).bind(info).execute(&mut *tx).await?;
        tx.commit().await
    }

    /// Deletes versions of a policy, in one transaction. Their numbers are never given to other versions.
    ///
    /// # Errors
    /// [`Error`](super::Error) when an alias points to one of them or the database fails.
    pub async fn delete_policy_versions(&self, name: &str, versions: &[u64]) -> Result<(), Error> {
        let mut tx = self.begin().await?;
        for &version in versions {
            let sql = "DELETE FROM policies_unloaded WHERE name = ? AND version = ?";
            sqlx::query(sql).bind(name).bind(version as i64).execute(&mut *tx).await?;
            let sql = "DELETE FROM followed_versions WHERE name = ? AND version = ?";
            sqlx::query(sql).bind(name).bind(version as i64).execute(&mut *tx).await?;
            let sql = "DELETE FROM policy_versions WHERE name = ? AND version = ?";
            sqlx::query(sql).bind(name).bind(version as i64).execute(&mut *tx).await?;
        }
        tx.commit().await
    }

    /// The version `version` of policy `name`.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn policy_version(&self, name: &str, version: u64) -> Result<Option<PolicyVersion>, Error> {
        let query = "SELECT name, version, digest, checkpoint, created_at FROM policy_versions WHERE name = ? AND version = ?";
        let row = sqlx::query(query).bind(name).bind(version as i64).fetch_optional(&self.read).await?;
        row.as_ref().map(read_version).transpose()
    }

    /// Marks versions of a policy as loaded or unloaded.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn set_policy_versions_loaded(
        &self,
        name: &str,
        versions: &[u64],
        loaded: bool,
        now: Timestamp,
    ) -> Result<(), Error> {
        let mut tx = self.begin().await?;
        for &version in versions {
            let query = if loaded {
                sqlx::query("DELETE FROM policies_unloaded WHERE name = ? AND version = ?").bind(name).bind(version as i64)
            } else {
                let sql = "INSERT INTO policies_unloaded (name, version, at) VALUES (?, ?, ?) ON CONFLICT DO NOTHING";
                sqlx::query(sql).bind(name).bind(version as i64).bind(now.as_millisecond())
            };
            query.execute(&mut *tx).await?;
        }
        tx.commit().await?;
        Ok(())
    }

    /// Names and numbers of the unloaded versions.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn unloaded_policies(&self) -> Result<Vec<(String, u64)>, Error> {
        let sql = "SELECT name, version FROM policies_unloaded ORDER BY name, version";
        let rows: Vec<(String, i64)> = sqlx::query_as(sql).fetch_all(&self.read).await?;
        Ok(rows.into_iter().map(|(name, version)| (name, version as u64)).collect())
    }
}

/// Whether the name is new, belongs to the publisher, or the publisher may use any name.
pub(super) async fn may_publish(db: &mut SqliteConnection, new: NewPolicyVersion<'_>) -> Result<bool, Error> {
    Ok(new.any_name || owner_of(db, new.name).await?.is_none_or(|owner| owner.as_deref() == new.owner))
}

async fn owner_of(db: &mut SqliteConnection, name: &str) -> Result<Option<Option<String>>, Error> {
    Ok(sqlx::query_scalar("SELECT owner FROM policies WHERE name = ?").bind(name).fetch_optional(db).await?)
}

/// Publishes a checkpoint as a new version, or finds the version of the policy with this digest, and moves the alias to it.
pub(super) async fn publish(db: &mut SqliteConnection, new: NewPolicyVersion<'_>) -> Result<PublishedPolicy, Error> {
    let sql = "SELECT version, created_at FROM policy_versions WHERE name = ? AND digest = ?";
    let known: Option<(i64, i64)> = sqlx::query_as(sql).bind(new.name).bind(new.digest).fetch_optional(&mut *db).await?;
    let published = match known {
        Some((version, created_at)) => PublishedPolicy { version: version as u64, created_at, new: false },
        None => insert(db, new).await?,
    };
    if let Some(alias) = new.alias {
        let NewPolicyVersion { name, now: at, by, .. } = new;
        move_alias(db, AliasMove { name, alias, to: Some(published.version), at, by }).await?;
    }
    Ok(published)
}

async fn insert(db: &mut SqliteConnection, new: NewPolicyVersion<'_>) -> Result<PublishedPolicy, Error> {
    let created_at = new.now.as_millisecond();
    let sql = "INSERT INTO policies (name, created_at, owner, last_version) VALUES (?, ?, ?, 1)
               ON CONFLICT (name) DO UPDATE SET last_version = last_version + 1 RETURNING last_version";
    let insert = sqlx::query_scalar(sql).bind(new.name).bind(created_at).bind(new.owner);
    let version: i64 = insert.fetch_one(&mut *db).await?;
    let sql = "INSERT INTO policy_versions (name, version, digest, checkpoint, created_at) VALUES (?, ?, ?, ?, ?)";
    let insert = sqlx::query(sql).bind(new.name).bind(version).bind(new.digest).bind(new.checkpoint).bind(created_at);
    insert.execute(&mut *db).await?;
    let sql = "INSERT INTO policy_infos (name, version, info) VALUES (?, ?, ?)";
    sqlx::query(sql).bind(new.name).bind(version).bind(new.info).execute(&mut *db).await?;
    Ok(PublishedPolicy { version: version as u64, created_at, new: true })
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
