//! Jobs as JSON and as messages of `JobService` and `WorkerService`. Both show the same fields.

use std::collections::BTreeMap;

use jiff::Timestamp;
use serde::Serialize;
use serde_json::Value;
use utoipa::openapi::RefOr;
use utoipa::openapi::schema::{Object, ObjectBuilder, OneOfBuilder, Schema, SchemaType, Type};
use utoipa::{PartialSchema, ToSchema};
use uuid::Uuid;

use super::response::timestamp;
use super::structs::to_struct;
use crate::env::EnvConfig;
use crate::invalid::Invalid;
use crate::jobs::Directive;
use crate::store::{
    Attempt, AttemptOutcome, AttemptResult, Checkpoint, CheckpointKind, Job, JobId, JobKind, JobState, JobSummary, Metric,
    MetricRow, NewCheckpoint, PendingAction, SpecSummary,
};
use crate::train_config::{Algorithm, Preset, TrainConfig, Training};
use crate::wire::v1;

/// What may be asked of a job; all of it is optional.
// `jobs::spec` reads it, for both transports; a test holds the two together.
#[derive(Debug, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(example = json!({"name": "my-policy", "algorithm": "qedgix", "training": {"steps": 20_000}, "seed": 1}))]
#[allow(dead_code, reason = "it documents what is read field by field")]
pub struct JobRequest {
    kind: Option<Only>,
    /// Of the job, and of the policy that it publishes.
    #[schema(pattern = "^[A-Za-z0-9][A-Za-z0-9._-]{0,62}$")]
    name: Option<String>,
    /// For people.
    #[schema(schema_with = labels)]
    labels: Option<BTreeMap<String, String>>,
    /// Cores it may use.
    #[schema(minimum = 1)]
    threads: Option<usize>,
    /// Higher goes first.
    #[schema(minimum = -100, maximum = 100)]
    priority: Option<i64>,
    /// `qedgix` unless said otherwise.
    #[schema(value_type = Option<Algorithm>)]
    algorithm: Option<Algorithm>,
    /// What everything starts from that is not said: `practical` unless said otherwise.
    preset: Option<Preset>,
    /// Fields over those of the preset; the letters of the paper are understood, too.
    environment: Option<EnvConfig>,
    /// Fields over those of the preset.
    #[schema(schema_with = some_of_training)]
    training: Option<Training>,
    /// Fixes every metric and weight.
    #[schema(minimum = 0, maximum = 9_007_199_254_740_991_u64)]
    seed: Option<u64>,
}

/// The kinds of jobs that this version runs.
#[derive(Debug, ToSchema)]
#[schema(as = JobKind, rename_all = "lowercase")]
#[allow(dead_code, reason = "it documents what is read as a JobKind")]
enum Only {
    Train,
}

fn labels() -> Object {
    let text = |pattern| ObjectBuilder::new().schema_type(Type::String).pattern(Some(pattern));
    ObjectBuilder::new()
        .schema_type(SchemaType::from_iter([Type::Object, Type::Null]))
        .property_names(Some(text("^[A-Za-z0-9][A-Za-z0-9._-]{0,62}$")))
        .additional_properties(Some(text("^[^\\u0000-\\u001f\\u007f-\\u009f]{0,255}$")))
        .max_properties(Some(32))
        .build()
}

/// [`Training`] with none of its fields required, or null.
fn some_of_training() -> RefOr<Schema> {
    let mut schema = Training::schema();
    if let RefOr::T(Schema::Object(object)) = &mut schema {
        object.required.clear();
    }
    let null = ObjectBuilder::new().schema_type(Type::Null);
    OneOfBuilder::new().item(schema).item(null).into()
}

/// A job as lists return it: without its environment and its training configuration.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = JobSummary)]
pub struct SummaryView {
    #[schema(value_type = Uuid)]
    id: JobId,
    state: JobState,
    /// What a running job was asked to do and has not done yet.
    #[schema(required = true)]
    wanted: Option<PendingAction>,
    /// Why the job failed, or why its last attempt ended.
    #[schema(required = true)]
    reason: Option<String>,
    progress: Progress,
    /// Attempts begun.
    attempts: u32,
    /// Attempts that failed.
    failures: u32,
    /// `NAME:VERSION` of the published policy.
    #[schema(required = true)]
    policy: Option<String>,
    last_event_id: u64,
    created_at: Timestamp,
    #[schema(required = true)]
    started_at: Option<Timestamp>,
    #[schema(required = true)]
    ended_at: Option<Timestamp>,
    #[schema(value_type = Only)]
    kind: JobKind,
    #[schema(required = true)]
    name: Option<String>,
    labels: BTreeMap<String, String>,
    threads: usize,
    priority: i64,
    algorithm: Algorithm,
    preset: Preset,
    seed: u64,
}

/// A job with its whole configuration.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Job)]
pub struct JobView {
    #[serde(flatten)]
    summary: SummaryView,
    environment: EnvConfig,
    training: Training,
}

#[derive(Debug, Serialize, ToSchema)]
struct Progress {
    /// Environment steps done.
    step: u64,
    /// Environment steps to do.
    steps: u64,
}

impl From<JobSummary> for SummaryView {
    fn from(job: JobSummary) -> Self {
        let SpecSummary { kind, name, labels, threads, priority, algorithm, preset, seed, steps } = job.spec;
        Self {
            id: job.id,
            state: job.state,
            wanted: job.pending_action,
            reason: job.reason,
            progress: Progress { step: job.step, steps },
            attempts: job.attempts,
            failures: job.failures,
            policy: job.policy,
            last_event_id: job.last_event,
            created_at: job.created_at,
            started_at: job.started_at,
            ended_at: job.ended_at,
            kind,
            name,
            labels,
            threads,
            priority,
            algorithm,
            preset,
            seed,
        }
    }
}

impl From<Job> for JobView {
    fn from(job: Job) -> Self {
        let (summary, config) = job.split();
        Self { summary: summary.into(), environment: config.environment, training: config.training }
    }
}

/// A metric as REST shows it.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = MetricRow)]
pub struct MetricView {
    name: String,
    /// Environment steps.
    step: u64,
    /// Null where it was not a finite number.
    #[schema(required = true)]
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
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Checkpoint)]
pub struct CheckpointView {
    id: Uuid,
    #[schema(value_type = Uuid)]
    job: JobId,
    kind: CheckpointKind,
    attempt: u32,
    /// Environment steps it was taken at.
    step: u64,
    #[schema(pattern = "^[0-9a-f]{64}$")]
    sha256: String,
    /// Bytes.
    size: u64,
    /// Figures it was taken at.
    metrics: BTreeMap<String, f64>,
    /// The job's resolved training configuration.
    #[schema(value_type = Object)]
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
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Attempt)]
pub struct AttemptView {
    attempt: u32,
    started_at: Timestamp,
    #[schema(required = true)]
    ended_at: Option<Timestamp>,
    #[schema(required = true)]
    outcome: Option<AttemptOutcome>,
    #[schema(required = true)]
    reason: Option<String>,
    /// Last output of its worker.
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

impl From<JobSummary> for v1::Job {
    fn from(job: JobSummary) -> Self {
        let spec = serde_json::to_value(&job.spec).expect("a specification is plain data");
        Self {
            id: job.id.to_string(),
            state: v1::JobState::from(job.state).into(),
            reason: job.reason.unwrap_or_default(),
            spec: to_struct(&spec),
            step: job.step,
            steps: job.spec.steps,
            attempts: job.attempts,
            failures: job.failures,
            wanted: job.pending_action.map(|w| w.to_string()).unwrap_or_default(),
            policy: job.policy.unwrap_or_default(),
            created_at: Some(timestamp(job.created_at)),
            started_at: job.started_at.map(timestamp),
            ended_at: job.ended_at.map(timestamp),
            last_event_id: job.last_event,
        }
    }
}

impl From<Job> for v1::Job {
    fn from(job: Job) -> Self {
        let (summary, TrainConfig { environment, training, .. }) = job.split();
        let configuration = serde_json::json!({"environment": environment, "training": training});
        let mut job = Self::from(summary);
        job.spec.get_or_insert_default().fields.extend(to_struct(&configuration).unwrap_or_default().fields);
        job
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

impl TryFrom<v1::FinishRequest> for AttemptResult {
    type Error = Invalid;

    fn try_from(request: v1::FinishRequest) -> Result<Self, Invalid> {
        match request.outcome() {
            v1::Outcome::Succeeded => Ok(Self::Succeeded),
            v1::Outcome::Stopped => Ok(Self::Stopped),
            v1::Outcome::Failed => Ok(Self::Failed { reason: request.reason, permanent: request.permanent }),
            v1::Outcome::Unspecified => {
                Err(Invalid::new("outcome", request.outcome, "OUTCOME_SUCCEEDED, OUTCOME_STOPPED or OUTCOME_FAILED"))
            }
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
            v1::CheckpointKind::Unspecified => {
                return Err(Invalid::new("header.kind", header.kind, "CHECKPOINT_KIND_BEST or CHECKPOINT_KIND_LAST"));
            }
        };
        let metrics = header.metrics.into_iter().filter(|(_, value)| value.is_finite()).collect();
        Ok(Self { kind, step: header.step, sha256: header.sha256, metrics, bytes: Vec::new() })
    }
}
