//! What a replica has taken from its primary, and when it was last in step with it.

use std::collections::{BTreeMap, BTreeSet};

use jiff::Timestamp;
use sqlx::SqliteConnection;

use super::{Result, Store, timestamp};

/// A version of the primary.
#[derive(Clone, Copy, Debug)]
pub struct FollowedVersion<'a> {
    /// Name of the policy.
    pub name: &'a str,
    /// Number of the version, the same as on the primary.
    pub version: u64,
    /// SHA-256 of `checkpoint`, in hexadecimal.
    pub digest: &'a str,
    /// The checkpoint, as safetensors.
    pub checkpoint: &'a [u8],
    /// What lists show of it, as JSON.
    pub info: &'a str,
    /// When the primary published it.
    pub created_at: Timestamp,
}

impl Store {
    /// Stores a version of the primary.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the policy has a version with this number or this digest, or the database fails.
    pub async fn follow_version(&self, new: FollowedVersion<'_>) -> Result<()> {
        let (name, version, at) = (new.name, new.version as i64, new.created_at.as_millisecond());
        let mut tx = self.begin().await?;
        let sql = "INSERT INTO policies (name, created_at, last_version) VALUES (?, ?, ?)
                   ON CONFLICT (name) DO UPDATE SET last_version = max(last_version, excluded.last_version)";
        sqlx::query(sql).bind(name).bind(at).bind(version).execute(&mut *tx).await?;
        let sql = "INSERT INTO policy_versions (name, version, digest, checkpoint, created_at) VALUES (?, ?, ?, ?, ?)";
        let insert = sqlx::query(sql).bind(name).bind(version).bind(new.digest).bind(new.checkpoint).bind(at);
        insert.execute(&mut *tx).await?;
        let sql = "INSERT INTO policy_infos (name, version, info) VALUES (?, ?, ?)";
        sqlx::query(sql).bind(name).bind(version).bind(new.info).execute(&mut *tx).await?;
        mark(&mut tx, name, version).await?;
        tx.commit().await
    }

    /// Records that the primary has these versions, too.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn mark_followed(&self, name: &str, versions: &[u64]) -> Result<()> {
        let mut tx = self.begin().await?;
        for &version in versions {
            mark(&mut tx, name, version as i64).await?;
        }
        tx.commit().await
    }

    /// The versions that the primary has or had, by name.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn followed_versions(&self) -> Result<BTreeMap<String, BTreeSet<u64>>> {
        let sql = "SELECT name, version FROM followed_versions";
        let rows: Vec<(String, i64)> = sqlx::query_as(sql).fetch_all(&self.read).await?;
        let mut versions: BTreeMap<String, BTreeSet<u64>> = BTreeMap::new();
        for (name, version) in rows {
            versions.entry(name).or_default().insert(version as u64);
        }
        Ok(versions)
    }

    /// When this replica was last known to be in step with its primary; `None`: never.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn followed_until(&self) -> Result<Option<Timestamp>> {
        let at: Option<i64> = sqlx::query_scalar("SELECT at FROM followed_until").fetch_optional(&self.read).await?;
        at.map(timestamp).transpose()
    }

    /// Records that this replica is in step with its primary.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn set_followed_until(&self, at: Timestamp) -> Result<()> {
        let mut tx = self.begin().await?;
        let sql = "REPLACE INTO followed_until (id, at) VALUES (1, ?)";
        sqlx::query(sql).bind(at.as_millisecond()).execute(&mut *tx).await?;
        tx.commit().await
    }
}

async fn mark(db: &mut SqliteConnection, name: &str, version: i64) -> Result<()> {
    let sql = "INSERT INTO followed_versions (name, version) VALUES (?, ?) ON CONFLICT DO NOTHING";
    sqlx::query(sql).bind(name).bind(version).execute(db).await?;
    Ok(())
}
