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

    /// Names and numbers of all versions.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn policy_versions(&self) -> Result<Vec<(String, u64)>, Error> {
        let rows = sqlx::query("SELECT name, version FROM policy_versions ORDER BY name, version").fetch_all(&self.read).await?;
        rows.iter().map(|row| Ok((row.try_get(0)?, row.try_get::<i64, _>(1)? as u64))).collect()
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
    let sql = "INSERT INTO policies (name, created_at, owner) VALUES (?, ?, ?) ON CONFLICT (name) DO NOTHING";
    sqlx::query(sql).bind(new.name).bind(created_at).bind(new.owner).execute(&mut *db).await?;
    let sql = "INSERT INTO policy_versions (name, version, digest, checkpoint, created_at)
               SELECT ?1, COALESCE(MAX(version), 0) + 1, ?2, ?3, ?4 FROM policy_versions WHERE name = ?1
               RETURNING version";
    let query = sqlx::query_scalar(sql).bind(new.name).bind(new.digest).bind(new.checkpoint).bind(created_at);
    let version: i64 = query.fetch_one(&mut *db).await?;
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
