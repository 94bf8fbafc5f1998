//! Submitting jobs, once per idempotency key.

use std::collections::BTreeMap;

use bytes::Bytes;
use jiff::Timestamp;
use serde::Serialize;
use sqlx::SqliteConnection;

use super::jobs::{find, get_existing};
use super::snapshots::copy_snapshot;
use super::specs::JobSpec;
use super::transitions::{Transition, count_blockers, transition};
use super::webhooks::insert_webhooks;
use super::{Job, JobId, JobState, Result, Snapshot, Store, corrupt};
use crate::train_config::TrainConfig;

/// A job to submit.
#[derive(Clone, Debug)]
pub struct NewJob {
    /// The id.
    pub id: JobId,
    /// Who submits the job; `None`: nobody, on a server without keys.
    pub owner: Option<String>,
    /// Whether the job may publish under a name that another owner made.
    pub any_name: bool,
    /// The specification.
    pub spec: JobSpec,
    /// What people write about the job.
    pub notes: String,
    /// The job that makes this one; `None`: a caller makes it.
    pub parent: Option<JobId>,
    /// What it begins with, as [`JobSpec::init`] describes.
    pub beginning: Option<Beginning>,
    /// The current time.
    pub now: Timestamp,
    /// The idempotency key of the request, which belongs to the owner, and the SHA-256 of its body.
    pub idempotency: Option<(String, [u8; 32])>,
}

/// What a job begins with, instead of weights that are drawn.
#[derive(Clone, Debug)]
pub enum Beginning {
    /// A checkpoint as safetensors, and its SHA-256.
    Weights(String, Bytes),
    /// A copy of this snapshot.
    Snapshot(Snapshot),
}

impl NewJob {
    /// The owner of the idempotency key.
    fn owner(&self) -> &str {
        self.owner.as_deref().unwrap_or_default()
    }
}

/// The result of a submission.
#[derive(Clone, Debug, PartialEq)]
pub enum SubmitResult {
    /// The job was created and queued.
    Created(Job),
    /// A job with the same idempotency key and body exists.
    Existing(Job),
    /// A job with the same idempotency key and another body exists.
    Conflict,
}

pub(super) async fn find_submitted(
    db: &mut SqliteConnection,
    owner: Option<&str>,
    key: &str,
    body: &[u8; 32],
) -> Result<Option<SubmitResult>> {
    let sql = "SELECT k.body, j.id FROM idempotency_keys k JOIN jobs j ON j.number = k.job WHERE k.owner = ? AND k.key = ?";
    let query = sqlx::query_as(sql).bind(owner.unwrap_or_default()).bind(key);
    let first: Option<(Vec<u8>, String)> = query.fetch_optional(&mut *db).await?;
    let Some((first, id)) = first else { return Ok(None) };
    if first != body {
        return Ok(Some(SubmitResult::Conflict));
    }
    let id = JobId::parse(&id).ok_or_else(|| corrupt("job", &id, "not an id"))?;
    Ok(find(db, id).await?.map(SubmitResult::Existing))
}

impl Store {
    /// Queues a job.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn submit_job(&self, new: NewJob) -> Result<SubmitResult> {
        let mut tx = self.begin().await?;
        if let Some((key, body)) = &new.idempotency
            && let Some(first) = find_submitted(&mut tx, new.owner.as_deref(), key, body).await?
        {
            tx.abandon().await?;
            return Ok(first);
        }
        let job = insert(&mut tx, &new).await?;
        tx.commit().await?;
        Ok(SubmitResult::Created(job))
    }

    /// The weights that a job begins with, as safetensors; `None`: they are drawn.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn initial_weights(&self, job: JobId) -> Result<Option<Vec<u8>>> {
        let sql = "SELECT w.bytes FROM jobs j JOIN initial_weights w ON w.sha256 = j.init WHERE j.id = ?";
        Ok(sqlx::query_scalar(sql).bind(job.to_string()).fetch_optional(&self.read).await?)
    }

    /// The result of repeating a submission of `owner` with this idempotency key and SHA-256 of its body; `None` if the key is new.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn submitted_job(&self, owner: Option<&str>, key: &str, body: &[u8; 32]) -> Result<Option<SubmitResult>> {
        find_submitted(&mut *self.read.acquire().await?, owner, key, body).await
    }
}

pub(super) async fn insert(tx: &mut SqliteConnection, new: &NewJob) -> Result<Job> {
    let spec = serde_json::to_string(&new.spec).map_err(|e| corrupt("job", new.id, e))?;
    let now = new.now.as_millisecond();
    let NewJob { id, owner, any_name, spec: JobSpec { kind, name, labels, threads, priority, config, work, .. }, .. } = new;
    let labels_document = serde_json::to_string(labels).map_err(|e| corrupt("job", id, e))?;
    let sql = "INSERT INTO jobs
               (id, owner, any_name, state, notes, parent, spec, threads, priority, created_at, kind, name, labels, algorithm,
                preset, seed, steps)
               VALUES (?, ?, ?, 'queued', ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)";
    let row_id = sqlx::query(sql)
        .bind(id.to_string())
        .bind(owner)
        .bind(any_name)
        .bind(&new.notes)
        .bind(new.parent.map(|parent| parent.to_string()))
        .bind(spec)
        .bind(*threads as i64)
        .bind(priority)
        .bind(now)
        .bind(kind.as_str())
        .bind(name)
        .bind(labels_document)
        .bind(config.as_ref().and_then(|config| text_of(&config.algorithm)))
        .bind(config.as_ref().and_then(|config| text_of(&config.preset)))
        .bind(config.as_ref().map(|config| config.seed.to_string()))
        .bind(config.as_ref().map_or(*work, TrainConfig::total_steps) as i64)
        .execute(&mut *tx)
        .await?
        .last_insert_rowid();
    set_labels(tx, row_id, labels).await?;
    match &new.beginning {
        Some(Beginning::Weights(sha256, bytes)) => set_weights(tx, row_id, sha256, bytes).await?,
        Some(Beginning::Snapshot(snapshot)) => copy_snapshot(tx, row_id, snapshot, now).await?,
        None => {}
    }
    for needed in &new.spec.after {
        let sql = "INSERT INTO job_dependencies (job, needs) SELECT ?, number FROM jobs WHERE id = ?";
        sqlx::query(sql).bind(row_id).bind(needed.to_string()).execute(&mut *tx).await?;
    }
    insert_webhooks(tx, row_id, &new.spec.webhooks).await?;
    count_blockers(tx, row_id).await?;
    transition(tx, Transition { job: row_id, to: JobState::Queued, attempt: 0, reason: None, now: new.now }).await?;
    if let Some((key, body)) = &new.idempotency {
        let sql = "INSERT INTO idempotency_keys (owner, key, body, job, created_at) VALUES (?, ?, ?, ?, ?)";
        sqlx::query(sql).bind(new.owner()).bind(key).bind(body.as_slice()).bind(row_id).bind(now).execute(&mut *tx).await?;
    }
    get_existing(tx, new.id).await
}

/// Makes these the weights that a job begins with.
async fn set_weights(db: &mut SqliteConnection, job: i64, sha256: &str, bytes: &[u8]) -> Result<()> {
    let sql = "INSERT INTO initial_weights (sha256, bytes) VALUES (?, ?) ON CONFLICT DO NOTHING";
    sqlx::query(sql).bind(sha256).bind(bytes).execute(&mut *db).await?;
    sqlx::query("UPDATE jobs SET init = ? WHERE number = ?").bind(sha256).bind(job).execute(&mut *db).await?;
    Ok(())
}

/// Makes these the labels by which the job is found.
pub(super) async fn set_labels(db: &mut SqliteConnection, job: i64, labels: &BTreeMap<String, String>) -> Result<()> {
    sqlx::query("DELETE FROM job_labels WHERE job = ?").bind(job).execute(&mut *db).await?;
    for (key, value) in labels {
        let sql = "INSERT INTO job_labels (key, value, job) VALUES (?, ?, ?)";
        sqlx::query(sql).bind(key).bind(value).bind(job).execute(&mut *db).await?;
    }
    Ok(())
}

/// The name of a value in documents.
pub(super) fn text_of(value: &impl Serialize) -> Option<String> {
    serde_json::to_value(value).ok()?.as_str().map(str::to_owned)
}
