//! Webhooks: URLs to which the server sends a message when a job ends. The message is written in the transaction that ends the job, and stays until
//! its receiver has accepted it, so neither a crash nor the deletion of the job loses it.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use sqlx::SqliteConnection;
use uuid::Uuid;

use super::named_enum::named_enum;
use super::{Result, Store, corrupt, timestamp};

named_enum! {
    /// How a job ends.
    JobEnd {
        /// All steps are done.
        Succeeded = "succeeded",
        /// Too many attempts failed.
        Failed = "failed",
        /// A caller cancelled it.
        Cancelled = "cancelled",
    }
}

/// Text that `Debug` hides.
#[derive(Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Secret(pub String);

impl From<String> for Secret {
    fn from(text: String) -> Self {
        Self(text)
    }
}

impl std::fmt::Debug for Secret {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("***")
    }
}

/// A URL to which the server sends a message when a job ends.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Webhook {
    /// The address.
    pub url: String,
    /// The ends after which a message is sent.
    pub events: Vec<JobEnd>,
    /// Whether messages are signed.
    pub signed: bool,
    /// Key of the signatures. It is in the table of webhooks only, not in the document of the job.
    #[serde(skip)]
    pub secret: Option<Secret>,
}

/// A message that its receiver has not accepted yet.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WebhookMessage {
    /// Row id.
    pub row_id: i64,
    /// Id of the message.
    pub id: String,
    /// Id of the job.
    pub job: String,
    /// The address of the receiver.
    pub url: String,
    /// Key of the signature.
    pub secret: Option<Secret>,
    /// The message as JSON.
    pub body: String,
    /// When the job ended.
    pub created_at: Timestamp,
    /// Tries so far.
    pub tries: u32,
}

from_row! {
    struct MessageRow {
        number: i64,
        id: String,
        job: String,
        url: String,
        secret: Option<String>,
        body: String,
        created_at: i64,
        tries: i64,
    }
}

/// Stores the webhooks of a new job.
pub(super) async fn insert_webhooks(db: &mut SqliteConnection, job: i64, webhooks: &[Webhook]) -> Result<()> {
    for (place, Webhook { url, events, secret, .. }) in webhooks.iter().enumerate() {
        let events = serde_json::to_string(events).map_err(|e| corrupt("webhook", url, e))?;
        let sql = "INSERT INTO webhooks (job, place, url, events, secret) VALUES (?, ?, ?, ?, ?)";
        let insert = sqlx::query(sql).bind(job).bind(place as i64).bind(url).bind(events);
        insert.bind(secret.as_ref().map(|secret| &secret.0)).execute(&mut *db).await?;
    }
    Ok(())
}

/// Writes the messages about the end of a job, which is in the state `state` now.
pub(super) async fn tell_end(db: &mut SqliteConnection, job: i64, state: &str, now: Timestamp) -> Result<()> {
    let sql = "SELECT w.url, w.secret FROM webhooks w, json_each(w.events) e WHERE w.job = ? AND e.value = ? ORDER BY w.place";
    let webhooks: Vec<(String, Option<String>)> = sqlx::query_as(sql).bind(job).bind(state).fetch_all(&mut *db).await?;
    if webhooks.is_empty() {
        return Ok(());
    }
    let (id, data) = described(db, job).await?;
    let body = json!({"type": format!("job.{state}"), "timestamp": now, "data": data}).to_string();
    for (url, secret) in webhooks {
        let sql = "INSERT INTO webhook_messages (id, job, url, secret, body, created_at, next_at) VALUES (?, ?, ?, ?, ?, ?6, ?6)";
        let insert = sqlx::query(sql).bind(format!("msg_{}", Uuid::now_v7().simple())).bind(&id).bind(url).bind(secret);
        insert.bind(&body).bind(now.as_millisecond()).execute(&mut *db).await?;
    }
    Ok(())
}

/// The id of a job, and what its messages say about it.
async fn described(db: &mut SqliteConnection, job: i64) -> Result<(String, Value)> {
    let sql = "SELECT id, json_object('id', id, 'name', name, 'kind', kind, 'state', state, 'reason', reason, 'policy', policy,
                                      'parent', parent, 'algorithm', algorithm, 'labels', json(labels), 'step', step, 'steps', steps),
                      created_at, started_at, ended_at FROM jobs WHERE number = ?";
    let row: (String, String, i64, Option<i64>, Option<i64>) = sqlx::query_as(sql).bind(job).fetch_one(db).await?;
    let (id, document, created_at, started_at, ended_at) = row;
    let mut data: Value = serde_json::from_str(&document).map_err(|e| corrupt("job", &id, e))?;
    for (field, time) in [("created_at", Some(created_at)), ("started_at", started_at), ("ended_at", ended_at)] {
        data[field] = json!(time.map(timestamp).transpose()?);
    }
    Ok((id, data))
}

impl Store {
    /// The messages that are due at `now`, at most `limit`, those first that are due for the longest time.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn due_webhook_messages(&self, now: Timestamp, limit: u32) -> Result<Vec<WebhookMessage>> {
        let sql = "SELECT number, id, job, url, secret, body, created_at, tries FROM webhook_messages
                   WHERE next_at <= ? ORDER BY next_at, number LIMIT ?";
        let rows: Vec<MessageRow> = sqlx::query_as(sql).bind(now.as_millisecond()).bind(limit).fetch_all(&self.read).await?;
        let message = |row: MessageRow| {
            let MessageRow { number, id, job, url, secret, body, created_at, tries } = row;
            let (secret, created_at, tries) = (secret.map(Secret), timestamp(created_at)?, tries as u32);
            Ok(WebhookMessage { row_id: number, id, job, url, secret, body, created_at, tries })
        };
        rows.into_iter().map(message).collect()
    }

    /// When the next message is due; `None` without messages.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn next_webhook_message(&self) -> Result<Option<Timestamp>> {
        let next: Option<i64> = sqlx::query_scalar("SELECT min(next_at) FROM webhook_messages").fetch_one(&self.read).await?;
        next.map(timestamp).transpose()
    }

    /// Makes all messages due at `now`.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn hurry_webhook_messages(&self, now: Timestamp) -> Result<()> {
        let mut tx = self.begin().await?;
        let sql = "UPDATE webhook_messages SET next_at = ?1 WHERE next_at > ?1";
        sqlx::query(sql).bind(now.as_millisecond()).execute(&mut *tx).await?;
        tx.commit().await
    }

    /// Deletes a message that was accepted or given up.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn delete_webhook_message(&self, row_id: i64) -> Result<()> {
        let mut tx = self.begin().await?;
        sqlx::query("DELETE FROM webhook_messages WHERE number = ?").bind(row_id).execute(&mut *tx).await?;
        tx.commit().await
    }

    /// Records a failed try of a message; the next one is due at `next`.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn retry_webhook_message(&self, row_id: i64, next: Timestamp) -> Result<()> {
        let mut tx = self.begin().await?;
        let sql = "UPDATE webhook_messages SET tries = tries + 1, next_at = ? WHERE number = ?";
        sqlx::query(sql).bind(next.as_millisecond()).bind(row_id).execute(&mut *tx).await?;
        tx.commit().await
    }
}
