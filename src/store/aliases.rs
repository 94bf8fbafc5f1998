//! Aliases of policies with their history. An alias and its history change in one transaction.

use jiff::Timestamp;
use sqlx::SqliteConnection;

use super::{Result, Store, timestamp};

/// An alias: a movable name of a version.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PolicyAlias {
    /// Name of the policy.
    pub name: String,
    /// The alias.
    pub alias: String,
    /// The version that the alias points to.
    pub version: u64,
}

/// A move of an alias.
#[derive(Clone, Copy, Debug)]
pub struct AliasMove<'a> {
    /// Name of the policy.
    pub name: &'a str,
    /// The alias.
    pub alias: &'a str,
    /// The version to point to, which must exist; `None` deletes the alias.
    pub to: Option<u64>,
    /// When the alias moves.
    pub at: Timestamp,
    /// Id of the caller's API key.
    pub by: Option<&'a str>,
}

/// An entry in the history of a policy's aliases.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AliasHistoryEntry {
    /// Id; later moves have larger ids.
    pub id: i64,
    /// The alias.
    pub alias: String,
    /// The version that the alias points to after the move; `None` if it was deleted.
    pub version: Option<u64>,
    /// The version that the alias pointed to before; `None` if it was new.
    pub previous: Option<u64>,
    /// When the alias moved.
    pub at: Timestamp,
    /// Id of the caller's API key.
    pub by: Option<String>,
}

from_row! {
    struct AliasHistoryRow {
        id: i64,
        alias: String,
        version: Option<i64>,
        previous: Option<i64>,
        at: i64,
        by: Option<String>,
    }
}

/// Selects entries of the history.
#[derive(Clone, Copy, Debug)]
pub struct AliasHistoryFilter<'a> {
    /// Name of the policy.
    pub name: &'a str,
    /// Only moves of this alias.
    pub alias: Option<&'a str>,
    /// Only moves with ids below this.
    pub before: Option<i64>,
}

/// Moves an alias and appends to its history. Returns the version that the alias pointed to before. If that is the new
/// version, nothing changes.
pub(super) async fn move_alias(db: &mut SqliteConnection, m: AliasMove<'_>) -> Result<Option<u64>> {
    let sql = "SELECT version FROM policy_aliases WHERE name = ? AND alias = ?";
    let previous: Option<i64> = sqlx::query_scalar(sql).bind(m.name).bind(m.alias).fetch_optional(&mut *db).await?;
    let to = m.to.map(|version| version as i64);
    if previous != to {
        if let Some(version) = to {
            let sql = "INSERT INTO policy_aliases (name, alias, version) VALUES (?, ?, ?)
                       ON CONFLICT (name, alias) DO UPDATE SET version = excluded.version";
            sqlx::query(sql).bind(m.name).bind(m.alias).bind(version).execute(&mut *db).await?;
        } else {
            let sql = "DELETE FROM policy_aliases WHERE name = ? AND alias = ?";
            sqlx::query(sql).bind(m.name).bind(m.alias).execute(&mut *db).await?;
        }
        let sql = "INSERT INTO alias_moves (name, alias, version, previous, at, by) VALUES (?, ?, ?, ?, ?, ?)";
        sqlx::query(sql)
            .bind(m.name)
            .bind(m.alias)
            .bind(to)
            .bind(previous)
            .bind(m.at.as_millisecond())
            .bind(m.by)
            .execute(&mut *db)
            .await?;
    }
    Ok(previous.map(|version| version as u64))
}

impl Store {
    /// Moves an alias and appends to its history, in one transaction. Returns the version that the alias pointed to before.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the version does not exist or the database fails.
    pub async fn move_policy_alias(&self, m: AliasMove<'_>) -> Result<Option<u64>> {
        let mut tx = self.begin().await?;
        let previous = move_alias(&mut tx, m).await?;
        tx.commit().await?;
        Ok(previous)
    }

    /// All aliases.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn policy_aliases(&self) -> Result<Vec<PolicyAlias>> {
        let sql = "SELECT name, alias, version FROM policy_aliases ORDER BY name, alias";
        let rows: Vec<(String, String, i64)> = sqlx::query_as(sql).fetch_all(&self.read).await?;
        Ok(rows.into_iter().map(|(name, alias, version)| PolicyAlias { name, alias, version: version as u64 }).collect())
    }

    /// At most `limit` moves of aliases, newest first.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn alias_history(&self, filter: AliasHistoryFilter<'_>, limit: u32) -> Result<Vec<AliasHistoryEntry>> {
        let all = "SELECT id, alias, version, previous, at, by FROM alias_moves
                   WHERE name = ?1 AND id < ?2 ORDER BY id DESC LIMIT ?3";
        let of_alias = "SELECT id, alias, version, previous, at, by FROM alias_moves
                        WHERE name = ?1 AND id < ?2 AND alias = ?4 ORDER BY id DESC LIMIT ?3";
        let AliasHistoryFilter { name, alias, before } = filter;
        let query = sqlx::query_as(if alias.is_some() { of_alias } else { all });
        let query = query.bind(name).bind(before.unwrap_or(i64::MAX)).bind(limit);
        let query = if let Some(alias) = alias { query.bind(alias) } else { query };
        let rows: Vec<AliasHistoryRow> = query.fetch_all(&self.read).await?;
        let read = |row: AliasHistoryRow| {
            let AliasHistoryRow { id, alias, version, previous, at, by } = row;
            let (version, previous) = (version.map(|v| v as u64), previous.map(|v| v as u64));
            Ok(AliasHistoryEntry { id, alias, version, previous, at: timestamp(at)?, by })
        };
        rows.into_iter().map(read).collect()
    }
}
