//! What people do with jobs: submit, look, cancel, pause, resume, forget.

use serde_json::Value;
use uuid::Uuid;

use super::paging::{self, number};
use super::worker::is_metric_name;
use super::{App, Error, Page, PageRequest, policies};
use crate::invalid::Invalid;
use crate::jobs::spec;
use crate::store::{
    Attempt, Changed, Checkpoint, Job, JobId, JobState, JobSummary, MetricCursor, MetricRow, NewJob, Submitted, Verb, Wanted,
};

/// Puts a job into the queue and tells whether it is new: the same `key` with the same document is the same job.
/// What is returned is on the disk.
///
/// # Errors
/// A document that is no job, a key that came with another document, a server that drains.
pub async fn submit(app: &App, document: Value, key: Option<String>) -> Result<(Job, bool), Error> {
    if let Some(key) = &key {
        let printable = key.bytes().all(|b| (b' '..=b'~').contains(&b));
        if key.is_empty() || key.len() > 255 || !printable {
            return Err(Invalid::new("idempotency_key", format!("{key:?}"), "1 to 255 printable ASCII characters").into());
        }
    }
    let request = spec::parse(document, app.jobs.settings().cpu_budget)?;
    if let Some(name) = &request.spec.name {
        // Found out now rather than when the policy is trained.
        policies::check_publishable(name)?;
    }
    app.admit()?;
    let id = JobId(Uuid::now_v7());
    let idempotency = key.map(|key| (key, request.digest));
    let new = NewJob { id, spec: request.spec, now: app.clock.now(), idempotency };
    match app.store.submit_job(new).await? {
        Submitted::New(job) => {
            tracing::info!(job = %job.id, algorithm = ?job.spec.config.algorithm, threads = job.spec.threads, "submitted");
            metrics::counter!("qedgix_jobs_submitted_total").increment(1);
            app.jobs.changed(job.number);
            Ok((job, true))
        }
        Submitted::Again(job) => Ok((job, false)),
        Submitted::Conflict => {
            let message = "this idempotency key came with another job before; use a new key for a new job".into();
            Err(Error::Conflict { code: "idempotency_conflict", message })
        }
    }
}

fn parse_id(id: &str) -> Result<JobId, Error> {
    JobId::parse(id).ok_or_else(|| Error::not_found("job", id))
}

/// The job `id`.
///
/// # Errors
/// There is none.
pub async fn get(app: &App, id: &str) -> Result<Job, Error> {
    app.store.job(parse_id(id)?).await?.ok_or_else(|| Error::not_found("job", id))
}

/// Summaries of jobs, newest first.
///
/// # Errors
/// [`Error::Invalid`]: the page size is over 1000, or no page returned the token.
pub async fn list(app: &App, state: Option<JobState>, page: &PageRequest) -> Result<Page<JobSummary>, Error> {
    let (limit, before) = (page.usual_limit()?, page.position(number)?);
    let (jobs, more) = app.store.job_summaries(state, before, limit, paging::MAX_BYTES).await?;
    Ok(Page::new(jobs, more, |job| job.number.to_string()))
}

/// Does `verb` to the job `id`. A running job is told; it changes when its worker has stopped.
///
/// # Errors
/// There is no such job, or it is not in a state for the verb.
pub async fn change(app: &App, id: &str, verb: Verb) -> Result<Job, Error> {
    if verb == Verb::Resume {
        app.admit()?;
    }
    match app.store.change_job(parse_id(id)?, verb, app.clock.now()).await? {
        Changed::Done(job) => {
            tracing::info!(job = %job.id, state = %job.state, ?verb, "changed");
            app.jobs.changed(job.number);
            Ok(*job)
        }
        Changed::Missing => Err(Error::not_found("job", id)),
        Changed::Refused(job) => {
            let allowed = match verb {
                Verb::Cancel => "only a job that has not ended can be cancelled",
                Verb::Pause => "only a queued or running job can be paused",
                Verb::Resume => "only a paused job can be resumed",
                Verb::Delete => "only a job that has ended can be deleted; cancel it first",
            };
            let doing = match job.wanted {
                Some(Wanted::Cancel) => " and being cancelled",
                Some(Wanted::Pause) => " and being paused",
                None => "",
            };
            let message = format!("job {id} is {}{doing}; {allowed}", job.state);
            Err(Error::Precondition { code: "wrong_state", message })
        }
    }
}

/// Metrics of a job in order of name and step, 10 000 rows to a page by default.
///
/// # Errors
/// [`Error::NotFound`]: there is no such job. [`Error::Invalid`]: the page size is over 100 000, or no page returned the token.
pub async fn metrics(app: &App, id: &str, name: Option<&str>, page: &PageRequest) -> Result<Page<MetricRow>, Error> {
    let (limit, after) = (page.limit(10_000, 100_000)?, page.position(parse_metric_cursor)?);
    let job = get(app, id).await?;
    let mut rows = app.store.metrics(job.id, name, after.as_ref(), limit as u32 + 1).await?;
    let more = rows.len() > limit;
    rows.truncate(limit);
    Ok(Page::new(rows, more, |row| format!("{}@{}", row.name, row.step)))
}

fn parse_metric_cursor(cursor: &str) -> Option<MetricCursor> {
    let (name, step) = cursor.rsplit_once('@')?;
    let step = number(step)? as u64;
    Some(MetricCursor { name: name.to_owned(), step }).filter(|_| is_metric_name(name))
}

/// Checkpoints of a job, without their bytes, oldest first.
///
/// # Errors
/// There is no such job.
pub async fn checkpoints(app: &App, id: &str) -> Result<Vec<Checkpoint>, Error> {
    let job = get(app, id).await?;
    Ok(app.store.checkpoints(job.id).await?)
}

/// One checkpoint with its bytes.
///
/// # Errors
/// There is none.
pub async fn checkpoint(app: &App, id: &str) -> Result<(Checkpoint, Vec<u8>), Error> {
    let missing = || Error::not_found("checkpoint", id);
    app.store.checkpoint(Uuid::try_parse(id).map_err(|_| missing())?).await?.ok_or_else(missing)
}

/// All attempts at a job with the last output of their workers, oldest first.
///
/// # Errors
/// There is no such job.
pub async fn logs(app: &App, id: &str) -> Result<Vec<Attempt>, Error> {
    let job = get(app, id).await?;
    let mut attempts = app.store.attempts(job.id).await?;
    for attempt in &mut attempts {
        if let Some(log) = app.jobs.live_log(job.number, attempt.number) {
            attempt.log = log;
        }
    }
    Ok(attempts)
}
