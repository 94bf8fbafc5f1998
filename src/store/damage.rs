//! Damage of a database: what SQLite finds in its structure, and checkpoints whose content is not what was stored.

use sha2::{Digest, Sha256};
use sqlx::SqliteConnection;

use super::has_table;

/// Whether an error means that the file is damaged, or no database.
pub(super) fn is_damage(error: &sqlx::Error) -> bool {
    let code = error.as_database_error().and_then(|error| error.code()?.parse::<u32>().ok());
    // CORRUPT, NOTADB.
    matches!(code.map(|code| code & 0xff), Some(11 | 26))
}

/// The first damage of the structure of a database.
pub(super) async fn of_structure(database: &mut SqliteConnection) -> sqlx::Result<Option<String>> {
    let report: sqlx::Result<String> = sqlx::query_scalar("PRAGMA integrity_check(1)").fetch_one(database).await;
    match report {
        Ok(report) if report == "ok" => Ok(None),
        Ok(report) => Ok(Some(report.replace('\n', " "))),
        Err(error) if is_damage(&error) => Ok(Some(error.to_string())),
        Err(error) => Err(error),
    }
}

/// Checkpoints whose content does not have the digest with which it was stored. SQLite has no checksums, so that it does not
/// notice bits that have changed.
pub(super) async fn of_content(database: &mut SqliteConnection) -> sqlx::Result<Vec<String>> {
    let mut found = Vec::new();
    // A backup of an old version may lack a table.
    if has_table(database, "policy_versions").await? {
        let sql = "SELECT name, version, digest FROM policy_versions ORDER BY name, version";
        let versions: Vec<(String, i64, String)> = sqlx::query_as(sql).fetch_all(&mut *database).await?;
        for (name, version, digest) in versions {
            let sql = "SELECT checkpoint FROM policy_versions WHERE name = ? AND version = ?";
            let bytes: Vec<u8> = sqlx::query_scalar(sql).bind(&name).bind(version).fetch_one(&mut *database).await?;
            if hex::encode(Sha256::digest(&bytes)) != digest {
                found.push(format!("the checkpoint of policy {name}:{version} has changed"));
            }
        }
    }
    if has_table(database, "checkpoints").await? {
        let sql = "SELECT c.id, j.id AS job, c.kind, c.sha256 FROM checkpoints c JOIN jobs j ON j.number = c.job";
        let checkpoints: Vec<(String, String, String, String)> = sqlx::query_as(sql).fetch_all(&mut *database).await?;
        for (id, job, kind, sha256) in checkpoints {
            let sql = "SELECT bytes FROM checkpoints WHERE id = ?";
            let bytes: Vec<u8> = sqlx::query_scalar(sql).bind(&id).fetch_one(&mut *database).await?;
            if hex::encode(Sha256::digest(&bytes)) != sha256 {
                found.push(format!("the {kind} checkpoint of job {job} has changed"));
            }
        }
    }
    Ok(found)
}
