//! What workers do: fetch their job, report, upload, learn what is wanted, finish. Each call shows the token of its attempt.

use sha2::{Digest, Sha256};
use uuid::Uuid;

use super::{App, Error, policies};
use crate::invalid::{Invalid, in_range};
use crate::jobs::{Directive, equal_secrets, token_digest};
use crate::recipe::TrainConfig;
use crate::store::{Ending, JobId, Lease, Metric, NewCheckpoint, OpenSnapshot, Snapshot, Wanted};

/// Largest piece of an upload, in bytes.
pub const CHUNK: usize = 1 << 20;
/// Largest checkpoint, in bytes.
const LARGEST_CHECKPOINT: u64 = 256 << 20;
/// Most metrics in one report.
const MOST_METRICS: usize = 10_000;

/// Who calls, as the call's metadata say.
#[derive(Clone, Debug)]
pub struct Credentials {
    /// The job.
    pub job: String,
    /// The attempt.
    pub attempt: String,
    /// The attempt's secret.
    pub token: String,
}

/// The work of an attempt.
#[derive(Clone, Debug)]
pub struct Work {
    /// What to train.
    pub config: TrainConfig,
    /// Threads it may use.
    pub threads: usize,
    /// The snapshot to go on from.
    pub snapshot: Option<Snapshot>,
    /// Time between snapshots.
    pub snapshot_every: std::time::Duration,
}

/// How a worker ends.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Finish {
    /// All steps are done.
    Succeeded,
    /// Stopped before the end, as asked.
    Stopped,
    /// Gave up.
    Failed {
        /// Why.
        reason: String,
        /// Whether it would come again.
        permanent: bool,
    },
}

/// The attempt that these credentials belong to, if it lasts.
///
/// # Errors
/// [`Error::Unauthenticated`] for wrong credentials, [`Error::Precondition`] for those of an attempt that is over.
pub async fn authenticate(app: &App, credentials: &Credentials) -> Result<Lease, Error> {
    const WRONG: Error = Error::Unauthenticated("this token is not that of an attempt at this job");
    let (Some(id), Ok(attempt)) = (JobId::parse(&credentials.job), credentials.attempt.parse()) else { return Err(WRONG) };
    let record = app.store.lease(id, attempt).await?.ok_or(WRONG)?;
    if !equal_secrets(&record.token, &token_digest(&credentials.token)) {
        return Err(WRONG);
    }
    if !record.live {
        return Err(fenced(record.lease));
    }
    app.jobs.heard(record.lease);
    Ok(record.lease)
}

fn fenced(lease: Lease) -> Error {
    let message = format!("attempt {} at job {} is over", lease.attempt, lease.id);
    Error::Precondition { code: "attempt_over", message }
}

fn must_live(live: bool, lease: Lease) -> Result<(), Error> {
    if live { Ok(()) } else { Err(fenced(lease)) }
}

/// The work of this attempt.
///
/// # Errors
/// The attempt is over.
pub async fn fetch(app: &App, lease: Lease) -> Result<Work, Error> {
    let job = app.store.job(lease.id).await?.ok_or_else(|| fenced(lease))?;
    let settings = app.jobs.settings();
    Ok(Work {
        threads: job.spec.threads.min(settings.cpu_budget),
        config: job.spec.config,
        snapshot: app.store.snapshot(lease.id).await?,
        snapshot_every: settings.snapshot_every,
    })
}

/// The newest snapshot of the job.
///
/// # Errors
/// There is none.
pub async fn snapshot(app: &App, lease: Lease) -> Result<Snapshot, Error> {
    app.store.snapshot(lease.id).await?.ok_or_else(|| Error::not_found("snapshot", lease.id.to_string()))
}

/// Chunk `number` of a snapshot, `None` behind the last.
///
/// # Errors
/// The database.
pub async fn snapshot_chunk(app: &App, snapshot: &Snapshot, number: u32) -> Result<Option<Vec<u8>>, Error> {
    Ok(app.store.snapshot_chunk(snapshot.id, number).await?)
}

/// Commits metrics and progress together.
///
/// # Errors
/// A metric that is none, or an attempt that is over.
pub async fn report(app: &App, lease: Lease, metrics: &[Metric], step: u64) -> Result<(), Error> {
    in_range("metrics", metrics.len(), 0..=MOST_METRICS)?;
    check_step("step", step)?;
    for (i, metric) in metrics.iter().enumerate() {
        if !is_metric_name(&metric.name) {
            let expected = "1 to 63 letters, digits, '_', '-', '/' and '.'";
            return Err(Invalid::new(format!("metrics[{i}].name"), format!("{:?}", metric.name), expected).into());
        }
        check_step(&format!("metrics[{i}].step"), metric.step)?;
    }
    must_live(app.store.report(lease, metrics, step, app.clock.now()).await?, lease)
}

pub(super) fn is_metric_name(name: &str) -> bool {
    let allowed = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-' | '/' | '.');
    (1..=63).contains(&name.len()) && name.chars().all(allowed)
}

fn check_step(field: &str, step: u64) -> Result<(), Invalid> {
    in_range(field, step, 0..=i64::MAX as u64)
}

/// What the worker shall do next.
///
/// # Errors
/// The attempt is over.
pub async fn heartbeat(app: &App, lease: Lease) -> Result<Directive, Error> {
    let job = app.store.job(lease.id).await?.ok_or_else(|| fenced(lease))?;
    Ok(app.jobs.directive(job.wanted))
}

/// Ends the attempt. A job that is done is published: its best policy.
///
/// # Errors
/// The attempt is over, or the checkpoint cannot be published.
pub async fn finish(app: &App, lease: Lease, finish: Finish) -> Result<(), Error> {
    let ending = match finish {
        Finish::Succeeded => succeed(app, lease).await?,
        Finish::Stopped => Ending::Stopped,
        Finish::Failed { reason, permanent } => {
            let reason = reason.chars().take(2000).collect();
            Ending::Failed { reason, max_attempts: if permanent { 1 } else { app.jobs.settings().max_attempts } }
        }
    };
    let job = app.store.end_attempt(lease, &ending, app.clock.now()).await?.ok_or_else(|| fenced(lease))?;
    tracing::info!(job = %job.id, attempt = lease.attempt, state = %job.state, reason = job.reason, "attempt over");
    app.jobs.changed(lease.job);
    Ok(())
}

/// Publishes what a job has made, unless it was cancelled meanwhile. Publishing the same again changes nothing, so a
/// server that dies in between loses nothing.
async fn succeed(app: &App, lease: Lease) -> Result<Ending, Error> {
    let job = app.store.job(lease.id).await?.ok_or_else(|| fenced(lease))?;
    if job.wanted == Some(Wanted::Cancel) {
        return Ok(Ending::Stopped);
    }
    let Some(checkpoint) = app.store.best_checkpoint(lease.id).await? else { return Ok(Ending::Succeeded(None)) };
    // The tail of an id is random; its head is the time, which jobs sent together share.
    let id = lease.id.to_string();
    let name = job.spec.name.unwrap_or_else(|| format!("job-{}", &id[id.len() - 8..]));
    match policies::publish(app, &name, checkpoint).await {
        Ok(policy) => Ok(Ending::Succeeded(Some(policy.to_string()))),
        // The same checkpoint would be refused again.
        Err(Error::Invalid(e)) => Ok(Ending::Failed { reason: format!("its policy cannot be published: {e}"), max_attempts: 1 }),
        Err(e) => Err(e),
    }
}

/// What an upload announces.
#[derive(Clone, Debug)]
pub struct Announced {
    /// Bytes.
    pub size: u64,
    /// SHA-256, lower-case hexadecimal.
    pub sha256: String,
}

/// Bytes on their way in, hashed as they come.
struct Incoming {
    announced: Announced,
    received: u64,
    hash: Sha256,
}

impl Incoming {
    fn new(announced: Announced) -> Self {
        Self { announced, received: 0, hash: Sha256::new() }
    }

    /// Takes the next piece.
    async fn take(&mut self, bytes: &bytes::Bytes) -> Result<(), Error> {
        in_range("data", bytes.len(), 1..=CHUNK)?;
        self.received += bytes.len() as u64;
        if self.received > self.announced.size {
            return Err(Invalid::new("data", self.received, format!("the {} bytes announced", self.announced.size)).into());
        }
        let (mut hash, bytes) = (std::mem::take(&mut self.hash), bytes.clone());
        // A megabyte takes milliseconds: too long for a thread that serves.
        self.hash = tokio::task::spawn_blocking(move || {
            hash.update(&bytes);
            hash
        })
        .await
        .map_err(Error::internal)?;
        Ok(())
    }

    /// Checks that all came, unharmed.
    fn finish(self) -> Result<Announced, Error> {
        if self.received != self.announced.size {
            return Err(Invalid::new("data", self.received, format!("the {} bytes announced", self.announced.size)).into());
        }
        let sha256 = hex::encode(self.hash.finalize());
        if sha256 != self.announced.sha256 {
            return Err(Invalid::new("sha256", &self.announced.sha256, format!("{sha256}, that of the data received")).into());
        }
        Ok(self.announced)
    }
}

/// A snapshot on its way in.
pub struct SnapshotUpload {
    lease: Lease,
    open: OpenSnapshot,
    incoming: Incoming,
}

impl SnapshotUpload {
    /// Begins.
    ///
    /// # Errors
    /// The attempt is over.
    pub async fn begin(app: &App, lease: Lease, step: u64, announced: Announced) -> Result<Self, Error> {
        check_step("header.step", step)?;
        in_range("header.size", announced.size, 1..=i64::MAX as u64)?;
        let open = app.store.open_snapshot(lease, step, app.clock.now()).await?.ok_or_else(|| fenced(lease))?;
        Ok(Self { lease, open, incoming: Incoming::new(announced) })
    }

    /// Takes the next piece.
    ///
    /// # Errors
    /// Too much data, or the attempt is over.
    pub async fn push(&mut self, app: &App, bytes: bytes::Bytes) -> Result<(), Error> {
        self.incoming.take(&bytes).await?;
        app.jobs.heard(self.lease);
        must_live(app.store.extend_snapshot(&mut self.open, &bytes).await?, self.lease)
    }

    /// Makes it the job's snapshot.
    ///
    /// # Errors
    /// What came is not what was announced, or the attempt is over.
    pub async fn complete(self, app: &App) -> Result<(), Error> {
        let announced = self.incoming.finish()?;
        must_live(app.store.complete_snapshot(self.open, &announced.sha256).await?, self.lease)
    }
}

/// A checkpoint on its way in; `bytes` of `new` grow.
pub struct CheckpointUpload {
    lease: Lease,
    new: NewCheckpoint,
    incoming: Incoming,
}

impl CheckpointUpload {
    /// Begins.
    ///
    /// # Errors
    /// It is too large.
    pub fn begin(lease: Lease, new: NewCheckpoint, size: u64) -> Result<Self, Error> {
        check_step("header.step", new.step)?;
        in_range("header.size", size, 1..=LARGEST_CHECKPOINT)?;
        let announced = Announced { size, sha256: new.sha256.clone() };
        Ok(Self { lease, new, incoming: Incoming::new(announced) })
    }

    /// Takes the next piece.
    ///
    /// # Errors
    /// Too much data.
    pub async fn push(&mut self, bytes: bytes::Bytes) -> Result<(), Error> {
        self.incoming.take(&bytes).await?;
        self.new.bytes.extend_from_slice(&bytes);
        Ok(())
    }

    /// Keeps it and tells its id.
    ///
    /// # Errors
    /// What came is not what was announced, or the attempt is over.
    pub async fn complete(self, app: &App) -> Result<Uuid, Error> {
        self.incoming.finish()?;
        app.store.keep_checkpoint(self.lease, self.new, app.clock.now()).await?.ok_or_else(|| fenced(self.lease))
    }
}
