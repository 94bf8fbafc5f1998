//! Jobs as JSON and as messages of `JobService` and `WorkerService`. Both show the same fields.

use std::collections::BTreeMap;

use jiff::Timestamp;
use serde::Serialize;
use serde_json::Value;
use uuid::Uuid;

use super::response::timestamp;
use super::structs::to_struct;
use crate::invalid::Invalid;
use crate::jobs::Directive;
use crate::recipe::TrainConfig;
use crate::service::worker::Finish;
use crate::store::{
    Attempt, Checkpoint, CheckpointKind, Job, JobId, JobKind, JobSpec, JobState, Metric, MetricRow, NewCheckpoint, Outcome,
    Wanted,
};
use crate::wire::v1;

/// What a job does, in the fields it was submitted in.
#[derive(Debug, Serialize)]
pub struct SpecView<'a> {
    kind: JobKind,
    name: &'a Option<String>,
    labels: &'a BTreeMap<String, String>,
    threads: usize,
    priority: i64,
    /// `algorithm`, `preset`, `environment`, `training`, `seed`.
    #[serde(flatten)]
    config: &'a TrainConfig,
}

impl<'a> From<&'a JobSpec> for SpecView<'a> {
    fn from(spec: &'a JobSpec) -> Self {
        let JobSpec { kind, name, labels, threads, priority, config } = spec;
        Self { kind: *kind, name, labels, threads: *threads, priority: *priority, config }
    }
}

/// A job as REST shows it.
#[derive(Debug, Serialize)]
pub struct JobView<'a> {
    id: JobId,
    state: JobState,
    wanted: Option<Wanted>,
    reason: &'a Option<String>,
    progress: Progress,
    attempts: u32,
    failures: u32,
    policy: &'a Option<String>,
    last_event_id: u64,
    created_at: Timestamp,
    started_at: Option<Timestamp>,
    ended_at: Option<Timestamp>,
    #[serde(flatten)]
    spec: SpecView<'a>,
}

#[derive(Debug, Serialize)]
struct Progress {
    step: u64,
    steps: u64,
}

impl<'a> From<&'a Job> for JobView<'a> {
    fn from(job: &'a Job) -> Self {
        Self {
            id: job.id,
            state: job.state,
            wanted: job.wanted,
            reason: &job.reason,
            progress: Progress { step: job.step, steps: job.spec.config.training.steps },
            attempts: job.attempts,
            failures: job.failures,
            policy: &job.policy,
            last_event_id: job.last_event,
            created_at: job.created_at,
            started_at: job.started_at,
            ended_at: job.ended_at,
            spec: (&job.spec).into(),
        }
    }
}

/// A metric as REST shows it.
#[derive(Debug, Serialize)]
pub struct MetricView {
    name: String,
    step: u64,
    value: Option<f64>,
    at: Timestamp,
}

impl From<MetricRow> for MetricView {
    fn from(row: MetricRow) -> Self {
        let MetricRow { name, step, value, at } = row;
        Self { name, step, value, at }
    }
}

/// A checkpoint as REST shows it.
#[derive(Debug, Serialize)]
pub struct CheckpointView {
    id: Uuid,
    job: JobId,
    kind: CheckpointKind,
    attempt: u32,
    step: u64,
    sha256: String,
    size: u64,
    metrics: BTreeMap<String, f64>,
    config: Value,
    created_at: Timestamp,
}

impl From<Checkpoint> for CheckpointView {
    fn from(c: Checkpoint) -> Self {
        let Checkpoint { id, job, kind, attempt, step, sha256, size, metrics, config, created_at } = c;
        Self { id, job, kind, attempt, step, sha256, size, metrics, config, created_at }
    }
}

/// An attempt as REST shows it.
#[derive(Debug, Serialize)]
pub struct AttemptView {
    attempt: u32,
    started_at: Timestamp,
    ended_at: Option<Timestamp>,
    outcome: Option<Outcome>,
    reason: Option<String>,
    log: String,
}

impl From<Attempt> for AttemptView {
    fn from(a: Attempt) -> Self {
        let Attempt { number, started_at, ended_at, outcome, reason, log } = a;
        Self { attempt: number, started_at, ended_at, outcome, reason, log }
    }
}

/// Metrics as a table: a header, then a row each; an unknown value is empty. Names hold no comma.
pub fn to_csv(rows: &[MetricRow]) -> String {
    use std::fmt::Write;
    let mut csv = String::from("name,step,value,at\n");
    for MetricRow { name, step, value, at } in rows {
        let value = value.map(|v| v.to_string()).unwrap_or_default();
        writeln!(csv, "{name},{step},{value},{at}").expect("a string takes everything");
    }
    csv
}

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

/// A filter: absent where unspecified.
///
/// # Errors
/// A number that names no state.
pub fn state_filter(state: i32) -> Result<Option<JobState>, Invalid> {
    let known = v1::JobState::try_from(state);
    Ok(Some(match known.map_err(|_| Invalid::new("state", state, "a JobState"))? {
        v1::JobState::Unspecified => return Ok(None),
        v1::JobState::Queued => JobState::Queued,
        v1::JobState::Running => JobState::Running,
        v1::JobState::Paused => JobState::Paused,
        v1::JobState::Cancelled => JobState::Cancelled,
        v1::JobState::Succeeded => JobState::Succeeded,
        v1::JobState::Failed => JobState::Failed,
    }))
}

impl From<Job> for v1::Job {
    fn from(job: Job) -> Self {
        let spec = serde_json::to_value(SpecView::from(&job.spec)).expect("a specification is plain data");
        Self {
            id: job.id.to_string(),
            state: v1::JobState::from(job.state).into(),
            reason: job.reason.unwrap_or_default(),
            spec: to_struct(&spec),
            step: job.step,
            steps: job.spec.config.training.steps,
            attempts: job.attempts,
            failures: job.failures,
            wanted: job.wanted.map(|w| w.to_string()).unwrap_or_default(),
            policy: job.policy.unwrap_or_default(),
            created_at: Some(timestamp(job.created_at)),
            started_at: job.started_at.map(timestamp),
            ended_at: job.ended_at.map(timestamp),
            last_event_id: job.last_event,
        }
    }
}

impl From<MetricRow> for v1::MetricRow {
    fn from(row: MetricRow) -> Self {
        Self { name: row.name, step: row.step, value: row.value, at: Some(timestamp(row.at)) }
    }
}

impl From<v1::ReportedMetric> for Metric {
    fn from(m: v1::ReportedMetric) -> Self {
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

impl TryFrom<v1::FinishRequest> for Finish {
    type Error = Invalid;

    fn try_from(request: v1::FinishRequest) -> Result<Self, Invalid> {
        match request.outcome() {
            v1::Outcome::Succeeded => Ok(Self::Succeeded),
            v1::Outcome::Stopped => Ok(Self::Stopped),
            v1::Outcome::Failed => Ok(Self::Failed { reason: request.reason, permanent: request.permanent }),
            v1::Outcome::Unspecified => Err(Invalid::new("outcome", request.outcome, "succeeded, stopped or failed")),
        }
    }
}

/// The checkpoint that a header announces, its bytes still to come.
impl TryFrom<v1::CheckpointHeader> for NewCheckpoint {
    type Error = Invalid;

    fn try_from(header: v1::CheckpointHeader) -> Result<Self, Invalid> {
        let kind = match header.kind() {
            v1::CheckpointKind::Best => CheckpointKind::Best,
            v1::CheckpointKind::Last => CheckpointKind::Last,
            v1::CheckpointKind::Unspecified => return Err(Invalid::new("header.kind", header.kind, "best or last")),
        };
        let metrics = header.metrics.into_iter().filter(|(_, value)| value.is_finite()).collect();
        Ok(Self { kind, step: header.step, sha256: header.sha256, metrics, bytes: Vec::new() })
    }
}
