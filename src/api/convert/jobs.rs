//! Messages of `JobService` and `WorkerService`.

use jiff::Timestamp;
use serde_json::{Value, json};

use super::response::timestamp;
use super::structs::to_struct;
use crate::invalid::Invalid;
use crate::jobs::Directive;
use crate::service::events::WatchedEvent;
use crate::service::jobs::{JobView, ListRequest, Waiting};
use crate::service::progress::Progress;
use crate::store::{
    Attempt, Checkpoint, CheckpointKind, JobEventKind, JobKind, JobSpec, JobState, Metric, MetricRow, MetricSummary,
    NewCheckpoint, PublishRule, StoredSpec, WorkerResult,
};
use crate::wire::v1;

impl From<JobState> for v1::JobState {
    fn from(state: JobState) -> Self {
        match state {
            JobState::Queued => Self::Queued,
            JobState::Running => Self::Running,
            JobState::Paused => Self::Paused,
            JobState::Cancelled => Self::Cancelled,
            JobState::Succeeded => Self::Succeeded,
            JobState::Failed => Self::Failed,
        }
    }
}

/// The request of a list.
///
/// # Errors
/// [`Invalid`] for a number without a state, and for a kind, an algorithm or a time that does not exist.
pub fn list_request(request: v1::ListJobsRequest) -> Result<ListRequest, Invalid> {
    let v1::ListJobsRequest { state, kind, algorithm, name, labels, parent, created_after, created_before, .. } = request;
    let v1::ListJobsRequest { sort, metrics, .. } = request;
    let known = |kind: &String| {
        JobKind::parse(kind)
            .ok_or_else(|| Invalid::new("kind", format!("{kind:?}"), format!("one of {}", JobKind::NAMES.join(", "))))
    };
    let algorithm = Some(algorithm).filter(|algorithm| !algorithm.is_empty());
    let read = |name: String| serde_json::from_value(name.into()).map_err(|e| Invalid::from_parser("algorithm", &e));
    Ok(ListRequest {
        state: state_filter(state)?,
        kind: Some(kind).filter(|kind| !kind.is_empty()).as_ref().map(known).transpose()?,
        algorithm: algorithm.map(read).transpose()?,
        name,
        labels,
        parent,
        created_after: created_after.map(|time| read_timestamp("created_after", time)).transpose()?,
        created_before: created_before.map(|time| read_timestamp("created_before", time)).transpose()?,
        sort,
        metrics,
    })
}

fn read_timestamp(field: &str, time: prost_types::Timestamp) -> Result<Timestamp, Invalid> {
    let invalid = || Invalid::new(field, format!("{} s, {} ns", time.seconds, time.nanos), "a time from year 1 to 9999");
    Timestamp::new(time.seconds, time.nanos).map_err(|_| invalid())
}

/// The state to filter by; `None` for `UNSPECIFIED`.
fn state_filter(state: i32) -> Result<Option<JobState>, Invalid> {
    let known = v1::JobState::try_from(state);
    Ok(Some(match known.map_err(|_| Invalid::new("state", state, "the number of a JobState"))? {
        v1::JobState::Unspecified => return Ok(None),
        v1::JobState::Queued => JobState::Queued,
        v1::JobState::Running => JobState::Running,
        v1::JobState::Paused => JobState::Paused,
        v1::JobState::Cancelled => JobState::Cancelled,
        v1::JobState::Succeeded => JobState::Succeeded,
        v1::JobState::Failed => JobState::Failed,
    }))
}

/// A job as `ListJobs` returns it: without environment and training configuration.
pub fn job_summary(view: JobView) -> v1::Job {
    job_message(view, |_| json!({}))
}

impl From<JobView> for v1::Job {
    fn from(view: JobView) -> Self {
        job_message(
            view,
            |JobSpec { limits, after, stop, init, publish, config, evaluation, sweep, experiment, point, webhooks, .. }| {
                let (environment, training) = config.as_ref().map(|config| (&config.environment, &config.training)).unzip();
                json!({
                    "environment": environment, "training": training, "max_attempts": limits.max_attempts, "timeout": limits.timeout,
                    "backoff": limits.backoff, "memory": limits.memory, "webhooks": webhooks, "after": after, "stop": stop, "init": init, "publish": publish.as_ref().map(publish_document), "evaluation": evaluation, "sweep": sweep, "experiment": experiment,
                    "point": point,
                })
            },
        )
    }
}

/// A rule of publication as it is submitted.
fn publish_document(rule: &PublishRule) -> Value {
    let PublishRule { policy, alias, better_than } = rule;
    let condition = better_than.as_ref().map(|better_than| json!({"better_than": better_than}));
    json!({"policy": policy, "alias": alias, "if": condition})
}

/// The message of a job, whose `spec` also has the fields that `details` selects.
fn job_message(view: JobView, details: impl Fn(&JobSpec) -> Value) -> v1::Job {
    let JobView { job, spec: decoded, progress, waiting, metrics } = view;
    let StoredSpec { kind, name, labels, threads, priority, algorithm, preset, seed, steps, document } = job.spec;
    let mut spec = json!({
        "kind": kind, "name": name, "labels": labels, "threads": threads, "priority": priority, "algorithm": algorithm,
        "preset": preset, "seed": seed,
    });
    let unreadable = match decoded {
        Ok(decoded) => {
            if let (Value::Object(all), Value::Object(more)) = (&mut spec, details(&decoded)) {
                all.extend(more);
            }
            None
        }
        Err(reason) => Some(v1::UnreadableSpec { reason: reason.to_string(), document }),
    };
    v1::Job {
        id: job.id.to_string(),
        state: v1::JobState::from(job.state).into(),
        reason: job.reason.unwrap_or_default(),
        spec: to_struct(&spec),
        step: job.step,
        steps,
        attempts: job.attempts,
        failures: job.failures,
        wanted: job.pending_action.map(|action| action.to_string()).unwrap_or_default(),
        policy: job.policy.unwrap_or_default(),
        created_at: Some(timestamp(job.created_at)),
        started_at: job.started_at.map(timestamp),
        ended_at: job.ended_at.map(timestamp),
        last_event_id: job.last_event,
        owner: job.owner.unwrap_or_default(),
        notes: job.notes,
        parent: job.parent.map(|parent| parent.to_string()).unwrap_or_default(),
        metrics: metrics.into_iter().map(|(name, summary)| (name, summary.into())).collect(),
        waiting: waiting.map(Into::into),
        unreadable,
        steps_per_second: progress.steps_per_second,
        seconds_left: progress.seconds_left(),
    }
}

impl From<MetricSummary> for v1::MetricSummary {
    fn from(summary: MetricSummary) -> Self {
        let MetricSummary { best, best_step, last, last_step } = summary;
        Self { best, best_step, last, last_step }
    }
}

impl From<Waiting> for v1::Waiting {
    fn from(waiting: Waiting) -> Self {
        let Waiting { reason, threads, threads_free, jobs_before } = waiting;
        Self { reason, threads: threads as u32, threads_free: threads_free as u32, jobs_before }
    }
}

impl From<Attempt> for v1::JobAttempt {
    fn from(attempt: Attempt) -> Self {
        Self {
            attempt: attempt.number,
            started_at: Some(timestamp(attempt.started_at)),
            ended_at: attempt.ended_at.map(timestamp),
            outcome: attempt.outcome.map(|outcome| outcome.to_string()).unwrap_or_default(),
            reason: attempt.reason.unwrap_or_default(),
            log: attempt.log,
        }
    }
}

impl From<Checkpoint> for v1::JobCheckpoint {
    fn from(checkpoint: Checkpoint) -> Self {
        let Checkpoint { id, job, kind, attempt, step, sha256, size, metrics, config: _, created_at } = checkpoint;
        let (id, job, kind) = (id.to_string(), job.to_string(), kind.to_string());
        let metrics = metrics.into_iter().collect();
        Self { id, job, kind, attempt, step, sha256, size, metrics, created_at: Some(timestamp(created_at)) }
    }
}

impl From<MetricRow> for v1::MetricRow {
    fn from(row: MetricRow) -> Self {
        Self { name: row.name, step: row.step, value: row.value, at: Some(timestamp(row.at)) }
    }
}

impl From<Progress> for v1::JobProgress {
    fn from(progress: Progress) -> Self {
        let Progress { step, steps, steps_per_second } = progress;
        Self { step, steps, steps_per_second, seconds_left: progress.seconds_left() }
    }
}

impl From<WatchedEvent> for v1::JobEvent {
    fn from(WatchedEvent { event, progress }: WatchedEvent) -> Self {
        use v1::job_event::What;
        let what = match event.kind {
            JobEventKind::State { state, attempt, reason, at } => What::State(v1::JobStateChange {
                state: v1::JobState::from(state).into(),
                attempt,
                reason: reason.unwrap_or_default(),
                at: Some(timestamp(at)),
            }),
            JobEventKind::Metrics(rows) => What::Metrics(v1::JobMetrics {
                rows: rows.into_iter().map(Into::into).collect(),
                progress: progress.map(Into::into),
            }),
        };
        Self { id: event.id, what: Some(what) }
    }
}

impl From<v1::ReportedMetric> for Metric {
    fn from(m: v1::ReportedMetric) -> Self {
        Self { name: m.name, step: m.step, value: m.value }
    }
}

impl From<Metric> for v1::ReportedMetric {
    fn from(m: Metric) -> Self {
        Self { name: m.name, step: m.step, value: m.value }
    }
}

impl From<Directive> for v1::Directive {
    fn from(directive: Directive) -> Self {
        match directive {
            Directive::Continue => Self::Continue,
            Directive::Cancel => Self::Cancel,
            Directive::Pause => Self::Pause,
        }
    }
}

impl TryFrom<v1::FinishRequest> for WorkerResult {
    type Error = Invalid;

    fn try_from(request: v1::FinishRequest) -> Result<Self, Invalid> {
        match request.outcome() {
            v1::Outcome::Succeeded if request.reason.is_empty() => Ok(Self::Succeeded),
            v1::Outcome::Succeeded => Ok(Self::EndedEarly { reason: request.reason }),
            v1::Outcome::Stopped => Ok(Self::Stopped),
            v1::Outcome::Failed => Ok(Self::Failed { reason: request.reason, permanent: request.permanent }),
            v1::Outcome::Unspecified => {
                Err(Invalid::new("outcome", request.outcome, "OUTCOME_SUCCEEDED, OUTCOME_STOPPED or OUTCOME_FAILED"))
            }
        }
    }
}

/// A checkpoint with the properties in the header, and no bytes yet.
impl TryFrom<v1::CheckpointHeader> for NewCheckpoint {
    type Error = Invalid;

    fn try_from(header: v1::CheckpointHeader) -> Result<Self, Invalid> {
        let kind = match header.kind() {
            v1::CheckpointKind::Best => CheckpointKind::Best,
            v1::CheckpointKind::Last => CheckpointKind::Last,
            v1::CheckpointKind::Unspecified => {
                return Err(Invalid::new("header.kind", header.kind, "CHECKPOINT_KIND_BEST or CHECKPOINT_KIND_LAST"));
            }
        };
        let metrics = header.metrics.into_iter().filter(|(_, value)| value.is_finite()).collect();
        Ok(Self { kind, step: header.step, sha256: header.sha256, metrics, bytes: Vec::new() })
    }
}
