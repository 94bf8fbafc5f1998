//! The use cases of jobs: submit, get, list, edit, cancel, pause, resume, retry, delete, and read metrics, checkpoints and logs.

mod evaluation;
mod experiment;
mod init;
mod listing;
mod logs;
mod publication;
mod results;
mod retention;
mod sweep;
mod view;

use uuid::Uuid;

pub use listing::{ListRequest, list};
pub use logs::{LogLines, follow_logs, logs};
pub use results::result;
pub use retention::delete_old;
pub use view::{JobView, Waiting};

use super::keys::Caller;
use super::paging::parse_number;
use super::policies::{self, Publisher};
use super::{App, Error, Page, PageRequest};
use crate::error_code::ErrorCode;
use crate::invalid::Invalid;
use crate::jobs::memory::check as check_memory;
use crate::jobs::metric_names;
use crate::jobs::spec::{self, ContinueRequest, EditRequest, JobRequest};
use crate::store::{
    ActionResult, Beginning, Checkpoint, Job, JobAction, JobId, JobKind, JobSpec, JobState, MetricCursor, MetricRow, NewJob,
    PendingAction, SubmitResult, is_metric_name,
};
use init::InitialWeights;

/// Puts a job into the queue. Returns the job, which is in the database, and whether it is new: the same `idempotency_key` with
/// the same request returns the existing job.
///
/// # Errors
/// [`Error::Invalid`]: a field of the request, or the idempotency key. [`Error::Conflict`]: the key was used with another
/// request.
/// [`Error::PermissionDenied`]: another owner made the policy with the job's name. [`Error::Draining`].
pub async fn submit(
    app: &App,
    caller: &Caller,
    request: JobRequest,
    idempotency_key: Option<String>,
) -> Result<(JobView, bool), Error> {
    let (job, new) = submit_job(app, caller, request, idempotency_key).await?;
    Ok((view::view(app, job).await?, new))
}

async fn submit_job(
    app: &App,
    caller: &Caller,
    request: JobRequest,
    idempotency_key: Option<String>,
) -> Result<(Job, bool), Error> {
    let idempotency = match repeated(app, caller, idempotency_key, || request.digest()).await? {
        Ok(idempotency) => idempotency,
        Err(result) => return submitted(app, result),
    };
    if matches!(request.kind, Some(JobKind::Sweep | JobKind::Experiment)) {
        return submitted(app, sweep::submit(app, caller, request, idempotency).await?);
    }
    let (notes, init) = (request.notes.clone().unwrap_or_default(), request.init.clone());
    let mut spec = request.resolve(app.scheduler.cpu_budget())?;
    app.webhooks.check(&spec.webhooks)?;
    if let Some(evaluation) = spec.evaluation.take() {
        spec.evaluation = Some(evaluation::pin_versions(app, evaluation).await?);
    }
    let beginning = match init {
        Some(init) => Some(InitialWeights::find(app, caller, &init).await?.put_into(&mut spec)?),
        None => None,
    };
    add(app, caller, Addition { spec, notes, beginning, idempotency }).await
}

/// The idempotency key of a request with the SHA-256 of its body, or the result of the same request before.
async fn repeated(
    app: &App,
    caller: &Caller,
    key: Option<String>,
    digest: impl FnOnce() -> [u8; 32],
) -> Result<Result<Option<(String, [u8; 32])>, SubmitResult>, Error> {
    let Some(key) = key else { return Ok(Ok(None)) };
    let printable = key.bytes().all(|b| (b' '..=b'~').contains(&b));
    if key.is_empty() || key.len() > 255 || !printable {
        return Err(Invalid::new("idempotency_key", format!("{key:?}"), "1 to 255 printable ASCII characters").into());
    }
    let body = digest();
    // A repeated request returns its job, even if the server would not accept that job today.
    let before = app.store.submitted_job(caller.owner().id(), &key, &body).await?;
    Ok(before.map_or(Ok(Some((key, body))), Err))
}

/// A job to add to the queue.
struct Addition {
    spec: JobSpec,
    notes: String,
    beginning: Option<Beginning>,
    idempotency: Option<(String, [u8; 32])>,
}

/// Checks a job against the server and adds it to the queue.
async fn add(app: &App, caller: &Caller, addition: Addition) -> Result<(Job, bool), Error> {
    let Addition { spec, notes, beginning, idempotency } = addition;
    if let Some(config) = &spec.config {
        check_memory(config, spec.threads, app.scheduler.config().memory)?;
    }
    if spec.kind == JobKind::Train {
        publication::check(app, caller, &spec).await?;
    }
    for (i, needed) in spec.after.iter().enumerate() {
        check_dependency(app, caller, i, *needed).await?;
    }
    app.admit()?;
    let Publisher { owner, any_name, .. } = caller.into();
    let id = JobId(Uuid::now_v7());
    let new = NewJob { id, owner, any_name, spec, notes, parent: None, beginning, now: app.clock.now(), idempotency };
    submitted(app, app.store.submit_job(new).await?)
}

/// Continues the training job `id`, which has ended, in a new job with the same configuration, name and labels. It begins with the
/// snapshot of that job if that is kept, or else with its last weights; [`JobInit`](crate::store::JobInit) of the new job says
/// which. Returns the job, and whether it is new, as [`submit`] does.
///
/// # Errors
/// [`Error::NotFound`]. [`Error::Precondition`]: the job has not ended, does not train, or has nothing to continue from. As [`submit`].
pub async fn continue_job(
    app: &App,
    caller: &Caller,
    id: &str,
    request: ContinueRequest,
    idempotency_key: Option<String>,
) -> Result<(JobView, bool), Error> {
    let idempotency = match repeated(app, caller, idempotency_key, || spec::digest(&(id, request))).await? {
        Ok(idempotency) => idempotency,
        Err(result) => {
            let (job, new) = submitted(app, result)?;
            return Ok((view::view(app, job).await?, new));
        }
    };
    let job = get(app, caller, id).await?;
    let (spec, beginning) = init::continued(app, caller, &job, request).await?;
    let addition = Addition { spec, notes: String::new(), beginning: Some(beginning), idempotency };
    let (job, new) = add(app, caller, addition).await?;
    Ok((view::view(app, job).await?, new))
}

fn submitted(app: &App, result: SubmitResult) -> Result<(Job, bool), Error> {
    match result {
        SubmitResult::Created(job) => {
            tracing::info!(job = %job.id, algorithm = job.spec.algorithm, threads = job.spec.threads, "job submitted");
            metrics::counter!("qedgix_jobs_submitted_total").increment(1);
            app.scheduler.job_changed(job.row_id);
            Ok((job, true))
        }
        SubmitResult::Existing(job) => Ok((job, false)),
        SubmitResult::Conflict => {
            let message = "this idempotency key was used with another job; use a new key for a new job".into();
            Err(Error::Conflict { code: ErrorCode::IdempotencyConflict, message })
        }
    }
}

/// Checks that a job can come after the job `needed`.
async fn check_dependency(app: &App, caller: &Caller, index: usize, needed: JobId) -> Result<(), Error> {
    let found = app.store.job(needed).await?.filter(|job| caller.sees_id(job.owner.as_deref()));
    match found.map(|job| job.state) {
        None => Err(Invalid::new(format!("after[{index}]"), needed, "the id of a job that exists").into()),
        Some(JobState::Cancelled) => {
            Err(Invalid::new(format!("after[{index}]"), needed, "a job that can still succeed; this one was cancelled").into())
        }
        Some(_) => Ok(()),
    }
}

fn parse_id(id: &str) -> Result<JobId, Error> {
    JobId::parse(id).ok_or_else(|| Error::not_found("job", id))
}

/// The job `id`, if the caller sees it.
///
/// # Errors
/// [`Error::NotFound`].
pub async fn get(app: &App, caller: &Caller, id: &str) -> Result<Job, Error> {
    let job = app.store.job(parse_id(id)?).await?.filter(|job| caller.sees_id(job.owner.as_deref()));
    job.ok_or_else(|| Error::not_found("job", id))
}

/// The job `id` as the caller sees it.
///
/// # Errors
/// [`Error::NotFound`].
pub async fn show(app: &App, caller: &Caller, id: &str) -> Result<JobView, Error> {
    view::view(app, get(app, caller, id).await?).await
}

/// Edits the name, the labels, the priority or the notes of the job `id`, in any state.
///
/// # Errors
/// [`Error::NotFound`]. [`Error::Invalid`]: a field of the request. [`Error::PermissionDenied`]: another owner made the policy with
/// the new name.
pub async fn edit(app: &App, caller: &Caller, id: &str, request: EditRequest) -> Result<JobView, Error> {
    let job = get(app, caller, id).await?;
    let edit = request.resolve(&job)?;
    if let Some(Some(name)) =
        edit.name.as_ref().filter(|_| !job.state.ended() && job.spec.kind.as_deref() == Some(JobKind::Train.as_str()))
    {
        policies::check_publishable(name)?;
        policies::check_owner(app, &Publisher::from(caller), name).await?;
    }
    let edited = app.store.edit_job(job.id, edit).await?.ok_or_else(|| Error::not_found("job", id))?;
    app.scheduler.job_changed(edited.row_id);
    view::view(app, edited).await
}

/// Applies `action` to the job `id`. A running job gets a pending action and changes when its worker has stopped.
///
/// # Errors
/// [`Error::NotFound`], or [`Error::Precondition`] when the state of the job does not allow the action.
pub async fn change(app: &App, caller: &Caller, id: &str, action: JobAction) -> Result<JobView, Error> {
    if matches!(action, JobAction::Resume | JobAction::Retry) {
        app.admit()?;
    }
    match app.store.change_job(get(app, caller, id).await?.id, action, app.clock.now()).await? {
        ActionResult::Accepted(job) => {
            tracing::info!(job = %job.id, state = %job.state, ?action, "job changed");
            app.scheduler.all_jobs_changed();
            view::view(app, *job).await
        }
        ActionResult::NotFound => Err(Error::not_found("job", id)),
        ActionResult::WrongState(job) => {
            let allowed = match action {
                JobAction::Cancel => "only a job that has not ended can be cancelled",
                JobAction::Pause => "only a queued or running job can be paused",
                JobAction::Resume => "only a paused job can be resumed",
                JobAction::Retry => "only a failed job can be retried",
                JobAction::Delete => "only a job that has ended can be deleted; cancel it first",
            };
            let pending = match job.pending_action {
                Some(PendingAction::Cancel) => " and being cancelled",
                Some(PendingAction::Pause) => " and being paused",
                None => "",
            };
            let message = format!("job {id} is {}{pending}; {allowed}", job.state);
            Err(Error::Precondition { code: ErrorCode::WrongState, message })
        }
    }
}

/// Metrics of a job in order of name and step, 10 000 rows to a page by default.
///
/// # Errors
/// [`Error::NotFound`]: there is no such job. [`Error::Invalid`]: the page size is over 100 000, the token is invalid, or the job has no
/// metric of this name and training jobs report none.
pub async fn metrics(
    app: &App,
    caller: &Caller,
    id: &str,
    name: Option<&str>,
    page: &PageRequest,
) -> Result<Page<MetricRow>, Error> {
    let (limit, after) = (page.limit(10_000, 100_000)?, page.parse_token(parse_metric_cursor)?);
    let job = get(app, caller, id).await?;
    let mut rows = app.store.metrics(job.id, name, after.as_ref(), limit as u32 + 1).await?;
    if let Some(name) = name.filter(|name| rows.is_empty() && after.is_none() && !metric_names::is_known(name)) {
        let reported = app.store.job_metric_summaries(job.row_id, view::MAX_METRICS).await?;
        let reported: Vec<&str> = reported.iter().map(|(name, _)| name.as_str()).collect();
        let known = if reported.is_empty() { metric_names::all().collect() } else { reported };
        return Err(metric_names::unknown("name", name, known).into());
    }
    let more = rows.len() > limit;
    rows.truncate(limit);
    Ok(Page::new(rows, more, |row| format!("{}@{}", row.name, row.step)))
}

fn parse_metric_cursor(cursor: &str) -> Option<MetricCursor> {
    let (name, step) = cursor.rsplit_once('@')?;
    let step = parse_number(step)? as u64;
    Some(MetricCursor { name: name.to_owned(), step }).filter(|_| is_metric_name(name))
}

/// Checkpoints of a job without their bytes, oldest first.
///
/// # Errors
/// [`Error::NotFound`].
pub async fn checkpoints(app: &App, caller: &Caller, id: &str) -> Result<Vec<Checkpoint>, Error> {
    let job = get(app, caller, id).await?;
    Ok(app.store.checkpoints(job.id).await?)
}
