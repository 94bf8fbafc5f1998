//! The use cases of workers: fetch a task, report metrics, upload snapshots and checkpoints, receive directives, finish.
//! Every call carries the token of its attempt.

use serde_json::Value;
use sha2::{Digest, Sha256};
use uuid::Uuid;

use super::policies::{self, Publisher};
use super::{App, Error};
use crate::error_code::ErrorCode;
use crate::invalid::{Invalid, in_range};
use crate::jobs::evaluation::EvaluationSpec;
use crate::jobs::worker::RivalComparison;
use crate::jobs::{Directive, equal_secrets, token_digest};
use crate::policy::baselines;
use crate::store::{
    EarlyStop, EndedAttempt, InitKind, Job, JobId, Lease, LeaseRecord, Metric, NewCheckpoint, PartialSnapshot, PublishRule,
    Snapshot, WorkerResult, is_metric_name,
};
use crate::train_config::TrainConfig;

/// Maximum size of a chunk of an upload, in bytes.
pub const MAX_CHUNK: usize = 1 << 20;
/// Maximum size of a checkpoint, in bytes.
const MAX_CHECKPOINT: u64 = 256 << 20;
/// Maximum number of metrics in one report.
const MAX_METRICS: usize = 10_000;
/// Maximum size of the result of a job, in bytes.
const MAX_RESULT: usize = 3 << 20;
/// Most values that an early stop looks back to. Workers report fewer.
const MAX_OBSERVED: u32 = 50_000;

/// The credentials in the metadata of a call.
#[derive(Clone, Debug)]
pub struct Credentials {
    /// Id of the job.
    pub job: String,
    /// Number of the attempt.
    pub attempt: String,
    /// The attempt's secret.
    pub token: String,
}

/// What a worker needs to run an attempt.
#[derive(Clone, Debug)]
pub struct AttemptTask {
    /// The training configuration of a job that trains.
    pub config: Option<TrainConfig>,
    /// What a job evaluates.
    pub evaluation: Option<Value>,
    /// Threads that the worker may use.
    pub threads: usize,
    /// The snapshot to resume from.
    pub snapshot: Option<Snapshot>,
    /// Time between snapshots.
    pub snapshot_every: std::time::Duration,
    /// Whether training begins with weights of a checkpoint, unless there is a snapshot.
    pub initial_weights: bool,
    /// Most memory of the worker in bytes; `None`: no limit.
    pub memory: Option<u64>,
    /// What is evaluated after training.
    pub report: Option<Value>,
    /// Whether the best checkpoint is compared with a policy, see [`rival`].
    pub rival: bool,
    /// When training ends before all steps are done.
    pub stop: Option<EarlyStop>,
    /// The values that `stop` has observed up to the snapshot.
    pub observed: Vec<Metric>,
}

const WRONG: Error = Error::Unauthenticated("the token does not belong to this attempt");

/// The attempt that the credentials belong to. Counts as a heartbeat. The first call of the worker of a cluster begins its attempt.
///
/// # Errors
/// [`Error::Unauthenticated`] for wrong credentials, [`Error::Precondition`] when the attempt has ended.
pub async fn authenticate(app: &App, credentials: &Credentials) -> Result<Lease, Error> {
    let (Some(id), Ok(attempt)) = (JobId::parse(&credentials.job), credentials.attempt.parse()) else { return Err(WRONG) };
    let record = match app.store.lease(id, attempt).await? {
        Some(record) => record,
        None => begin_launched(app, id, attempt, token_digest(&credentials.token)).await?,
    };
    if !equal_secrets(&record.token, &token_digest(&credentials.token)) {
        return Err(WRONG);
    }
    if !record.active {
        return Err(attempt_ended(record.lease));
    }
    app.scheduler.record_heartbeat(record.lease);
    Ok(record.lease)
}

/// Begins the attempt of a launch with this token.
async fn begin_launched(app: &App, id: JobId, attempt: u32, token: [u8; 32]) -> Result<LeaseRecord, Error> {
    if !app.store.is_launched(id, attempt, token).await? {
        return Err(WRONG);
    }
    if let Some(lease) = app.store.begin_launched(id, attempt, token, app.clock.now()).await? {
        tracing::info!(job = %id, attempt, "the worker of a cluster has called");
        app.scheduler.attempt_begun(lease);
    }
    // Another call of the same worker may have begun it, or the job is not queued any more.
    app.store.lease(id, attempt).await?.ok_or(WRONG)
}

fn attempt_ended(lease: Lease) -> Error {
    let message = format!("attempt {} of job {} has ended", lease.attempt, lease.job_id);
    Error::Precondition { code: ErrorCode::AttemptOver, message }
}

fn require_active(active: bool, lease: Lease) -> Result<(), Error> {
    if active { Ok(()) } else { Err(attempt_ended(lease)) }
}

/// The task of an attempt.
///
/// # Errors
/// [`Error::Precondition`] when the job was deleted.
pub async fn fetch(app: &App, lease: Lease) -> Result<AttemptTask, Error> {
    let job = app.store.job(lease.job_id).await?.ok_or_else(|| attempt_ended(lease))?;
    let spec = job.spec.decode().map_err(Error::internal)?;
    let snapshot = app.store.snapshot(lease.job_id).await?;
    let observed = match (&spec.stop, &snapshot) {
        (Some(stop), Some(snapshot)) => observed(app, lease, &stop.metric, snapshot.step).await?,
        _ => Vec::new(),
    };
    Ok(AttemptTask {
        threads: job.spec.threads.min(app.scheduler.cpu_budget()),
        config: spec.config,
        evaluation: spec.evaluation,
        snapshot,
        snapshot_every: app.scheduler.config().snapshot_every,
        initial_weights: spec.init.is_some_and(|init| init.from == InitKind::Weights),
        memory: spec.limits.memory,
        report: spec.report,
        rival: spec.publish.is_some_and(|rule| rule.better_than.is_some()),
        stop: spec.stop,
        observed,
    })
}

/// The values of a metric up to `step`, by step.
async fn observed(app: &App, lease: Lease, metric: &str, step: u64) -> Result<Vec<Metric>, Error> {
    let rows = app.store.metrics(lease.job_id, Some(metric), None, MAX_OBSERVED).await?;
    let rows = rows.into_iter().filter(|row| row.step <= step);
    Ok(rows.map(|row| Metric { name: row.name, step: row.step, value: row.value.unwrap_or(f64::NAN) }).collect())
}

/// The newest snapshot of the job.
///
/// # Errors
/// [`Error::NotFound`] when the job has none.
pub async fn snapshot(app: &App, lease: Lease) -> Result<Snapshot, Error> {
    app.store.snapshot(lease.job_id).await?.ok_or_else(|| Error::not_found("snapshot", lease.job_id.to_string()))
}

/// Chunk `index` of a snapshot; `None` after the last.
///
/// # Errors
/// [`Error::Internal`] when the database fails.
pub async fn snapshot_chunk(app: &App, snapshot: &Snapshot, index: u32) -> Result<Option<Vec<u8>>, Error> {
    Ok(app.store.snapshot_chunk(snapshot.id, index).await?)
}

/// The weights that the job begins with, as safetensors.
///
/// # Errors
/// [`Error::NotFound`] when the job begins with weights that are drawn.
pub async fn initial_weights(app: &App, lease: Lease) -> Result<Vec<u8>, Error> {
    let weights = app.store.initial_weights(lease.job_id).await?;
    weights.ok_or_else(|| Error::not_found("initial weights of the job", lease.job_id.to_string()))
}

/// The policy that the job must be better than, as it is now: the name of a baseline, or `NAME:VERSION` and its checkpoint. `None`: it
/// does not exist.
///
/// # Errors
/// [`Error::Internal`] when the database fails.
pub async fn rival(app: &App, lease: Lease) -> Result<Option<(String, Vec<u8>)>, Error> {
    let job = app.store.job(lease.job_id).await?.ok_or_else(|| attempt_ended(lease))?;
    let rule = job.spec.decode().map_err(Error::internal)?.publish.unwrap_or_default();
    let Some(rival) = rule.better_than else { return Ok(None) };
    if baselines::is_name(&rival) {
        return Ok(Some((rival, Vec::new())));
    }
    match policies::export(app, &rival.parse()?).await {
        Ok((reference, bytes)) => Ok(Some((format!("{}:{}", reference.name, reference.version), bytes))),
        Err(Error::NotFound { .. }) => Ok(None),
        Err(e) => Err(e),
    }
}

/// The checkpoint of a policy that the job evaluates, as safetensors.
///
/// # Errors
/// [`Error::NotFound`] when the version is deleted. [`Error::Invalid`] when the job does not evaluate it.
pub async fn policy(app: &App, lease: Lease, name: &str) -> Result<Vec<u8>, Error> {
    let job = app.store.job(lease.job_id).await?.ok_or_else(|| attempt_ended(lease))?;
    let evaluation = job.spec.decode().map_err(Error::internal)?.evaluation;
    let evaluation: Option<EvaluationSpec> = evaluation.map(serde_json::from_value).transpose().map_err(Error::internal)?;
    if !evaluation.is_some_and(|evaluation| evaluation.policies.iter().any(|policy| policy == name)) {
        return Err(Invalid::new("policy", format!("{name:?}"), "a policy that this job evaluates").into());
    }
    Ok(policies::export(app, &name.parse()?).await?.1)
}

/// Stores metrics and progress in one transaction.
///
/// # Errors
/// [`Error::Invalid`] for an invalid metric or step, [`Error::Precondition`] when the attempt has ended.
pub async fn report(app: &App, lease: Lease, metrics: &[Metric], step: u64) -> Result<(), Error> {
    in_range("metrics", metrics.len(), 0..=MAX_METRICS)?;
    check_step("step", step)?;
    for (i, metric) in metrics.iter().enumerate() {
        if !is_metric_name(&metric.name) {
            let expected = "1 to 63 letters, digits, '_', '-', '/' or '.'";
            return Err(Invalid::new(format!("metrics[{i}].name"), format!("{:?}", metric.name), expected).into());
        }
        check_step(&format!("metrics[{i}].step"), metric.step)?;
    }
    require_active(app.store.report(lease, metrics, step, app.clock.now()).await?, lease)
}

fn check_step(field: &str, step: u64) -> Result<(), Invalid> {
    in_range(field, step, 0..=i64::MAX as u64)
}

/// What the worker is to do next.
///
/// # Errors
/// [`Error::Precondition`] when the job was deleted.
pub async fn heartbeat(app: &App, lease: Lease) -> Result<Directive, Error> {
    let job = app.store.job(lease.job_id).await?.ok_or_else(|| attempt_ended(lease))?;
    Ok(app.scheduler.directive(job.pending_action))
}

/// Ends the attempt. The best policy of a job that succeeds is published in the same transaction, so no job is cancelled with a
/// published policy, and none succeeds without one.
///
/// # Errors
/// [`Error::Precondition`] when the attempt has ended, [`Error::Internal`] when the database fails.
pub async fn finish(app: &App, lease: Lease, result: WorkerResult, document: Option<String>) -> Result<(), Error> {
    if let Some(document) = &document {
        in_range("result", document.len(), 0..=MAX_RESULT)?;
        if !serde_json::from_str::<Value>(document).is_ok_and(|document| document.is_object()) {
            return Err(Invalid::new("result", document, "a JSON object").into());
        }
    }
    let document = document.as_deref();
    let result = match result {
        WorkerResult::EndedEarly { reason } => WorkerResult::EndedEarly { reason: first_characters(&reason) },
        WorkerResult::Failed { reason, permanent } => WorkerResult::Failed { reason: first_characters(&reason), permanent },
        result => result,
    };
    let job = match &result {
        WorkerResult::Succeeded | WorkerResult::EndedEarly { .. } => match new_version(app, lease).await {
            Ok(Some((version, promotion))) => {
                let promotion = promotion.map(|rule| promotion_of(rule, document)).transpose()?;
                policies::publish_and_end(app, version, policies::JobResult { ended: &result, promotion, document }, lease)
                    .await?
            }
            Ok(None) => end(app, lease, &result, document).await?,
            // Another attempt would fail with the same checkpoint.
            Err(Error::Invalid(e)) => {
                let reason = format!("the policy cannot be published: {e}");
                end(app, lease, &WorkerResult::Failed { reason, permanent: true }, None).await?
            }
            Err(e) => return Err(e),
        },
        WorkerResult::Stopped | WorkerResult::Failed { .. } => end(app, lease, &result, None).await?,
    };
    let job = job.ok_or_else(|| attempt_ended(lease))?;
    tracing::info!(job = %job.id, attempt = lease.attempt, state = %job.state, reason = job.reason, "attempt ended");
    app.scheduler.job_changed(lease.job_row);
    Ok(())
}

/// What is stored of a reason.
fn first_characters(reason: &str) -> String {
    reason.chars().take(2000).collect()
}

/// Ends the attempt without publishing anything.
async fn end(app: &App, lease: Lease, result: &WorkerResult, document: Option<&str>) -> Result<Option<Job>, Error> {
    let max_attempts = app.scheduler.config().max_attempts;
    let ended = EndedAttempt { lease, result, publish: None, document, max_attempts, now: app.clock.now() };
    Ok(app.store.end_attempt(ended).await?.map(|(job, _)| job))
}

/// The best policy of a job, under the name that it is published as; `None` if the job has no checkpoint.
async fn new_version(app: &App, lease: Lease) -> Result<Option<(policies::NewVersion, Option<PublishRule>)>, Error> {
    let job = app.store.job(lease.job_id).await?.ok_or_else(|| attempt_ended(lease))?;
    let Some(checkpoint) = app.store.best_checkpoint(lease.job_id).await? else { return Ok(None) };
    // The end of an id is random. Its beginning is the time, which jobs submitted together share.
    let id = lease.job_id.to_string();
    let rule = job.spec.decode().ok().and_then(|spec| spec.publish);
    let name = rule.as_ref().and_then(|rule| rule.policy.clone()).or(job.spec.name);
    let name = name.unwrap_or_else(|| format!("job-{}", &id[id.len() - 8..]));
    // The name was checked at submission. Another owner may have made it since, so it is checked again when it is published.
    let publisher = Publisher { owner: job.owner, any_name: job.any_name, key: None };
    let version = policies::NewVersion::from_bytes(app, publisher, &name, checkpoint).await?;
    Ok(Some((version, rule.filter(|rule| rule.alias.is_some()))))
}

/// The move of an alias that the rule of a job asks for, with the comparison that its worker has made.
fn promotion_of(rule: PublishRule, document: Option<&str>) -> Result<policies::Promotion, Error> {
    let comparison = document.map(serde_json::from_str::<RivalComparison>).transpose();
    let comparison = comparison.map_err(|e| Invalid::new("result", e, "a comparison with the rival"))?;
    Ok(policies::Promotion { alias: rule.alias.unwrap_or_default(), better_than: rule.better_than, comparison })
}

/// Size and digest that an upload declares.
#[derive(Clone, Debug)]
pub struct UploadHeader {
    /// Size in bytes.
    pub size: u64,
    /// SHA-256, lower-case hexadecimal.
    pub sha256: String,
}

/// Checks the data of an upload against its header.
struct UploadDigest {
    header: UploadHeader,
    received: u64,
    hash: Sha256,
}

impl UploadDigest {
    fn new(header: UploadHeader) -> Self {
        Self { header, received: 0, hash: Sha256::new() }
    }

    /// Adds the next chunk.
    async fn update(&mut self, bytes: &bytes::Bytes) -> Result<(), Error> {
        in_range("data", bytes.len(), 1..=MAX_CHUNK)?;
        self.received += bytes.len() as u64;
        if self.received > self.header.size {
            return Err(Invalid::new(
                "data",
                format!("{} bytes", self.received),
                format!("the {} bytes in the header", self.header.size),
            )
            .into());
        }
        let (mut hash, bytes) = (std::mem::take(&mut self.hash), bytes.clone());
        // Hashing a megabyte takes milliseconds, which is too long on a thread that serves connections.
        self.hash = tokio::task::spawn_blocking(move || {
            hash.update(&bytes);
            hash
        })
        .await
        .map_err(Error::internal)?;
        Ok(())
    }

    /// Checks size and digest of the whole.
    fn verify(self) -> Result<UploadHeader, Error> {
        if self.received != self.header.size {
            return Err(Invalid::new(
                "data",
                format!("{} bytes", self.received),
                format!("the {} bytes in the header", self.header.size),
            )
            .into());
        }
        let sha256 = hex::encode(self.hash.finalize());
        if sha256 != self.header.sha256 {
            return Err(Invalid::new("sha256", &self.header.sha256, format!("{sha256}, the SHA-256 of the data")).into());
        }
        Ok(self.header)
    }
}

/// An upload of a snapshot.
pub struct SnapshotUpload {
    lease: Lease,
    partial: PartialSnapshot,
    digest: UploadDigest,
}

impl SnapshotUpload {
    /// Begins an upload of a snapshot taken at `step`.
    ///
    /// # Errors
    /// [`Error::Invalid`] for a step or size out of range, [`Error::Precondition`] when the attempt has ended.
    pub async fn begin(app: &App, lease: Lease, step: u64, header: UploadHeader) -> Result<Self, Error> {
        check_step("header.step", step)?;
        in_range("header.size", header.size, 1..=i64::MAX as u64)?;
        let partial = app.store.begin_snapshot(lease, step, app.clock.now()).await?.ok_or_else(|| attempt_ended(lease))?;
        Ok(Self { lease, partial, digest: UploadDigest::new(header) })
    }

    /// Adds the next chunk.
    ///
    /// # Errors
    /// [`Error::Invalid`] for more data than declared, [`Error::Precondition`] when the attempt has ended.
    pub async fn push(&mut self, app: &App, bytes: bytes::Bytes) -> Result<(), Error> {
        self.digest.update(&bytes).await?;
        app.scheduler.record_heartbeat(self.lease);
        require_active(app.store.append_snapshot(&mut self.partial, &bytes).await?, self.lease)
    }

    /// Makes it the job's snapshot.
    ///
    /// # Errors
    /// [`Error::Invalid`] when size or digest differ from the header, [`Error::Precondition`] when the attempt has ended.
    pub async fn complete(self, app: &App) -> Result<(), Error> {
        let header = self.digest.verify()?;
        require_active(app.store.complete_snapshot(self.partial, &header.sha256).await?, self.lease)
    }
}

/// An upload of a checkpoint.
pub struct CheckpointUpload {
    lease: Lease,
    /// The checkpoint; its `bytes` grow with every chunk.
    new: NewCheckpoint,
    digest: UploadDigest,
}

impl CheckpointUpload {
    /// Begins an upload of a checkpoint of `size` bytes.
    ///
    /// # Errors
    /// [`Error::Invalid`] for a step or size out of range.
    pub fn begin(lease: Lease, new: NewCheckpoint, size: u64) -> Result<Self, Error> {
        check_step("header.step", new.step)?;
        in_range("header.size", size, 1..=MAX_CHECKPOINT)?;
        let header = UploadHeader { size, sha256: new.sha256.clone() };
        Ok(Self { lease, new, digest: UploadDigest::new(header) })
    }

    /// Adds the next chunk.
    ///
    /// # Errors
    /// [`Error::Invalid`] for more data than declared.
    pub async fn push(&mut self, bytes: bytes::Bytes) -> Result<(), Error> {
        self.digest.update(&bytes).await?;
        self.new.bytes.extend_from_slice(&bytes);
        Ok(())
    }

    /// Stores the checkpoint and returns its id.
    ///
    /// # Errors
    /// [`Error::Invalid`] when size or digest differ from the header, [`Error::Precondition`] when the attempt has ended.
    pub async fn complete(self, app: &App) -> Result<Uuid, Error> {
        self.digest.verify()?;
        app.store.store_checkpoint(self.lease, self.new, app.clock.now()).await?.ok_or_else(|| attempt_ended(self.lease))
    }
}
