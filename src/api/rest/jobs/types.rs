//! Bodies of `/v1/jobs`: what is submitted, and how jobs, metrics, checkpoints, attempts and events are shown.

use std::collections::BTreeMap;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};
use utoipa::ToSchema;
use utoipa::openapi::RefOr;
use utoipa::openapi::schema::Schema;
use uuid::Uuid;

use crate::api::rest::config_schemas::{partial_training, schema};
use crate::api::rest::json;
use crate::env::EnvConfig;
use crate::jobs::evaluation::EvaluationRequest;
use crate::jobs::spec;
use crate::jobs::sweep::{self, SweepRequest};
use crate::learner;
use crate::service::jobs::{self, JobView};
use crate::store::{self, AttemptOutcome, CheckpointKind, JobId, JobKind, JobState, PendingAction, StoredSpec};
use crate::train_config::{Algorithm, Preset, Training};

/// A job to submit. All fields are optional.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(example = json!({"name": "my-policy", "algorithm": "qedgix", "training": {"steps": 20_000}, "seed": 1}))]
pub(super) struct JobRequest {
    #[schema(schema_with = optional_kind)]
    kind: Option<JobKind>,
    /// Name of the job and of the policy that it publishes.
    #[schema(pattern = "^[A-Za-z0-9][A-Za-z0-9._-]{0,62}$")]
    name: Option<String>,
    /// Labels, which the server does not interpret.
    #[serde(default, deserialize_with = "json::optional_texts")]
    #[schema(schema_with = labels)]
    labels: Option<BTreeMap<String, String>>,
    /// Notes for people.
    #[schema(max_length = 4000)]
    notes: Option<String>,
    /// Threads that the job may use.
    #[serde(default, deserialize_with = "json::optional_integer")]
    #[schema(minimum = 1)]
    threads: Option<usize>,
    /// Jobs with a higher priority start first. Default: 0.
    #[serde(default, deserialize_with = "json::optional_integer")]
    #[schema(minimum = -100, maximum = 100)]
    priority: Option<i64>,
    /// Consecutive attempts that fail without progress after which the job has failed. Default: the limit of the server.
    #[serde(default, deserialize_with = "json::optional_integer")]
    #[schema(minimum = 1, maximum = 1000)]
    max_attempts: Option<u32>,
    /// Seconds that all attempts together may run; then the job has failed. Default: no limit.
    #[serde(default, deserialize_with = "json::optional_integer")]
    #[schema(minimum = 1, maximum = 31_622_400)]
    timeout: Option<u64>,
    /// Seconds between a failed attempt and the next one. They double with every further failure, up to an hour. Default: 0.
    #[serde(default, deserialize_with = "json::optional_integer")]
    #[schema(minimum = 0, maximum = 31_622_400)]
    backoff: Option<u64>,
    /// Ids of the jobs that must succeed before this one starts. When one of them is cancelled or deleted, this job is cancelled.
    #[schema(value_type = Option<Vec<Uuid>>, max_items = 100)]
    after: Option<Vec<String>>,
    /// When training ends before all steps are done; the job then succeeds. Default: never.
    stop: Option<EarlyStop>,
    /// Default: `qedgix`.
    algorithm: Option<Algorithm>,
    /// The configuration that `environment` and `training` start from; default: `practical`.
    preset: Option<Preset>,
    /// Fields that replace those of the preset; the symbols `M`, `N`, `K`, `v`, `t` and `d` are accepted, too.
    #[serde(default, deserialize_with = "json::optional_object")]
    #[schema(value_type = Option<EnvConfig>)]
    environment: Option<Map<String, Value>>,
    /// Fields that replace those of the preset.
    #[serde(default, deserialize_with = "json::optional_object")]
    #[schema(schema_with = partial_training)]
    training: Option<Map<String, Value>>,
    /// What a job of the kind `evaluate` does; `environment` has the fields that differ from the default environment.
    evaluation: Option<Evaluation>,
    /// What a job of the kind `sweep` varies. The other fields are those of its jobs.
    sweep: Option<Sweep>,
    /// Seed of the training. Configuration and seed determine every metric and weight. Default: 1.
    #[serde(default, deserialize_with = "json::optional_integer")]
    seed: Option<u64>,
}

impl From<JobRequest> for spec::JobRequest {
    fn from(request: JobRequest) -> Self {
        let JobRequest { kind, name, labels, notes, threads, priority, algorithm, preset, environment, training, seed, .. } =
            request;
        let JobRequest { max_attempts, timeout, backoff, after, stop, evaluation, sweep, .. } = request;
        let sweep = sweep.map(Into::into);
        let evaluation = evaluation.map(Into::into);
        let stop = stop.map(Into::into);
        Self {
            kind,
            name,
            labels,
            notes,
            threads,
            priority,
            max_attempts,
            timeout,
            backoff,
            after,
            stop,
            algorithm,
            preset,
            environment,
            training,
            evaluation,
            sweep,
            seed,
        }
    }
}

/// Values of fields, over which jobs are made. Exactly one of `grid`, `list` and `random` is required. A field is `algorithm`,
/// `preset`, `threads`, `environment.FIELD` or `training.FIELD`.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, remote = "Self")]
pub(super) struct Sweep {
    /// Values of each field; all combinations are tried.
    #[serde(default, deserialize_with = "json::optional_object")]
    #[schema(schema_with = grid)]
    grid: Option<Map<String, Value>>,
    /// The combinations themselves.
    #[schema(value_type = Option<Vec<Object>>, max_items = 500)]
    list: Option<Vec<Map<String, Value>>>,
    /// Combinations that are drawn.
    random: Option<RandomSweep>,
    /// Number of seeds of each combination, from the seed of the job on; default: 1. A sweep has at most 500 jobs.
    #[serde(default, deserialize_with = "json::optional_integer")]
    #[schema(minimum = 1, maximum = 100)]
    seeds: Option<u64>,
}

/// Combinations that are drawn from lists of values and from ranges.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, remote = "Self")]
struct RandomSweep {
    /// Number of combinations.
    #[serde(deserialize_with = "json::integer")]
    #[schema(minimum = 1, maximum = 500)]
    samples: u64,
    /// Seed of the draw; default: 1.
    #[serde(default, deserialize_with = "json::optional_integer")]
    seed: Option<u64>,
    /// What each field is drawn from: a list of values, or `{low, high, log, integer}`.
    #[serde(deserialize_with = "json::object")]
    #[schema(value_type = Object)]
    fields: Map<String, Value>,
}

json::objects_only!(Sweep, RandomSweep);

impl From<Sweep> for SweepRequest {
    fn from(Sweep { grid, list, random, seeds }: Sweep) -> Self {
        let random = random.map(|RandomSweep { samples, seed, fields }| sweep::RandomSweep { samples, seed, fields });
        Self { grid, list, random, seeds }
    }
}

fn grid() -> RefOr<Schema> {
    schema(json!({"type": ["object", "null"], "additionalProperties": {"type": "array", "minItems": 1}}))
}

/// Policies to compare on a frozen list of layouts, as `qedgix evaluate` does.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, remote = "Self")]
pub(super) struct Evaluation {
    /// Baselines, or policies of the server: NAME, NAME@ALIAS or NAME:VERSION. The versions are those of the submission.
    #[schema(min_items = 1, max_items = 32, example = json!(["qedgix", "sweep"]))]
    policies: Vec<String>,
    /// Name of the list of layouts; default: `eval-v1`.
    #[schema(schema_with = layout_lists)]
    layouts: Option<String>,
    /// Number of layouts, from the first; default: 256.
    #[serde(default, deserialize_with = "json::optional_integer")]
    #[schema(minimum = 1, maximum = 4096)]
    episodes: Option<usize>,
    /// A UAV that is lost; default: none.
    lose: Option<LostUav>,
    /// Standard deviation of the error of each observed coordinate, in units of the square's side; default: 0.
    #[schema(minimum = 0.0, maximum = 1.0)]
    position_noise: Option<f64>,
}

/// A UAV that from a slot on does not move, collect or detect, and is not detected. Both are counted from 0.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, remote = "Self")]
struct LostUav {
    #[serde(deserialize_with = "json::integer")]
    uav: usize,
    #[serde(deserialize_with = "json::integer")]
    slot: usize,
}

json::objects_only!(Evaluation, LostUav);

impl From<Evaluation> for EvaluationRequest {
    fn from(Evaluation { policies, layouts, episodes, lose, position_noise }: Evaluation) -> Self {
        let lose = lose.map(|LostUav { uav, slot }| learner::LostUav { uav, slot });
        Self { policies, layouts, episodes, lose, position_noise }
    }
}

fn layout_lists() -> RefOr<Schema> {
    let names = learner::LAYOUT_LISTS.iter().map(|list| json!(list.name)).chain([Value::Null]);
    schema(json!({"type": ["string", "null"], "enum": names.collect::<Vec<_>>()}))
}

/// Ends training as soon as one of its conditions holds. At least one is required.
#[derive(Debug, Default, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, remote = "Self")]
pub(super) struct EarlyStop {
    /// The metric that is observed.
    #[schema(pattern = "^[A-Za-z0-9_/.-]{1,63}$", example = "eval/mean_aoi")]
    metric: String,
    /// A value is at most this.
    at_most: Option<f64>,
    /// A value is at least this.
    at_least: Option<f64>,
    /// This many values in a row are not better than the best before them.
    #[serde(default, deserialize_with = "json::optional_integer")]
    #[schema(minimum = 1, maximum = 1_000_000)]
    patience: Option<u64>,
}

json::objects_only!(Serialize + EarlyStop);

impl From<EarlyStop> for store::EarlyStop {
    fn from(EarlyStop { metric, at_most, at_least, patience }: EarlyStop) -> Self {
        Self { metric, at_most, at_least, patience }
    }
}

impl From<store::EarlyStop> for EarlyStop {
    fn from(store::EarlyStop { metric, at_most, at_least, patience }: store::EarlyStop) -> Self {
        Self { metric, at_most, at_least, patience }
    }
}

/// What to change of a job. What is absent stays; null is the default.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(example = json!({"labels": {"keep": "yes", "draft": null}, "notes": "the baseline of the talk"}))]
pub(super) struct JobEdit {
    /// Null: no name.
    #[serde(default, deserialize_with = "json::present")]
    #[schema(value_type = Option<String>, pattern = "^[A-Za-z0-9][A-Za-z0-9._-]{0,62}$")]
    name: Option<Option<String>>,
    /// Labels to add or to replace; labels that are null are removed. Null: all are removed.
    #[serde(default, deserialize_with = "json::present_texts")]
    #[schema(schema_with = label_changes)]
    labels: Option<Option<BTreeMap<String, Option<String>>>>,
    /// Null: 0.
    #[serde(default, deserialize_with = "json::present_integer")]
    #[schema(value_type = Option<i64>, minimum = -100, maximum = 100)]
    priority: Option<Option<i64>>,
    /// Null: none.
    #[serde(default, deserialize_with = "json::present")]
    #[schema(value_type = Option<String>, max_length = 4000)]
    notes: Option<Option<String>>,
}

impl From<JobEdit> for spec::EditRequest {
    fn from(JobEdit { name, labels, priority, notes }: JobEdit) -> Self {
        Self { name, labels, priority, notes }
    }
}

fn label_changes() -> RefOr<Schema> {
    schema(json!({
        "type": ["object", "null"], "maxProperties": 32,
        "propertyNames": {"type": "string", "pattern": "^[A-Za-z0-9][A-Za-z0-9._-]{0,62}$"},
        "additionalProperties": {"type": ["string", "null"], "pattern": "^[^\\u0000-\\u001f\\u007f-\\u009f]{0,255}$"}
    }))
}

/// A kind of jobs that this version runs.
pub(super) fn kind() -> RefOr<Schema> {
    schema(json!({"type": "string", "enum": [JobKind::Train, JobKind::Evaluate, JobKind::Sweep]}))
}

/// A kind of jobs that this version runs.
fn optional_kind() -> RefOr<Schema> {
    schema(json!({"type": ["string", "null"], "enum": [JobKind::Train, JobKind::Evaluate, JobKind::Sweep, null]}))
}

fn labels() -> RefOr<Schema> {
    schema(json!({
        "type": ["object", "null"], "maxProperties": 32,
        "propertyNames": {"type": "string", "pattern": "^[A-Za-z0-9][A-Za-z0-9._-]{0,62}$"},
        "additionalProperties": {"type": "string", "pattern": "^[^\\u0000-\\u001f\\u007f-\\u009f]{0,255}$"}
    }))
}

/// A job without its environment and its training configuration.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct JobSummary {
    #[schema(value_type = Uuid)]
    id: JobId,
    /// Id of the API key that made it, or of the first of the keys that replaced each other; null: no key was required.
    #[schema(required = true)]
    owner: Option<String>,
    state: JobState,
    /// Pending action of a running job; null if there is none.
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
    /// Why it has not started; null unless the job is queued.
    #[schema(required = true)]
    waiting: Option<Waiting>,
    /// The best and the last value of each metric, by name. In lists: of the metrics that were asked for.
    metrics: BTreeMap<String, MetricSummary>,
    notes: String,
    /// Id of the job that made this one; null: a caller made it.
    #[schema(value_type = Option<Uuid>, required = true)]
    parent: Option<JobId>,
    created_at: Timestamp,
    #[schema(required = true)]
    started_at: Option<Timestamp>,
    #[schema(required = true)]
    ended_at: Option<Timestamp>,
    #[schema(schema_with = optional_kind)]
    kind: Option<String>,
    #[schema(required = true)]
    name: Option<String>,
    labels: BTreeMap<String, String>,
    threads: usize,
    priority: i64,
    /// Null, like `preset` and `seed`, if the job does not train, or if the specification is unreadable.
    #[schema(value_type = Option<Algorithm>, required = true)]
    algorithm: Option<String>,
    #[schema(value_type = Option<Preset>, required = true)]
    preset: Option<String>,
    #[schema(required = true)]
    seed: Option<u64>,
    /// Null, unless this version of the server cannot read the specification.
    #[schema(required = true)]
    unreadable: Option<UnreadableSpec>,
}

/// Why a queued job has not started.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct Waiting {
    /// In words.
    #[schema(example = "needs 2 threads, 1 free; 3 jobs before it")]
    reason: String,
    /// Threads that it needs.
    threads: usize,
    /// Threads of the CPU budget that no running job uses.
    threads_free: usize,
    /// Jobs before it in the queue.
    jobs_before: u64,
}

impl From<jobs::Waiting> for Waiting {
    fn from(waiting: jobs::Waiting) -> Self {
        let jobs::Waiting { reason, threads, threads_free, jobs_before } = waiting;
        Self { reason, threads, threads_free, jobs_before }
    }
}

/// The best and the last value of a metric. Values are null if none was finite.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct MetricSummary {
    /// The largest value of `eval/coverage`, `eval/fairness`, `q_tot` and `env_steps_per_s`, and the smallest of all other metrics.
    #[schema(required = true)]
    best: Option<f64>,
    /// Environment steps of the best value.
    #[schema(required = true)]
    best_step: Option<u64>,
    #[schema(required = true)]
    last: Option<f64>,
    last_step: u64,
}

impl From<store::MetricSummary> for MetricSummary {
    fn from(summary: store::MetricSummary) -> Self {
        let store::MetricSummary { best, best_step, last, last_step } = summary;
        Self { best, best_step, last, last_step }
    }
}

/// A specification that this version of the server cannot read, because another version has written it.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct UnreadableSpec {
    /// Why: the first field that is unknown or malformed.
    reason: String,
    /// The specification as stored.
    document: String,
}

#[derive(Debug, Serialize, ToSchema)]
struct Progress {
    /// Environment steps done.
    step: u64,
    /// Environment steps to do.
    steps: u64,
}

/// A job with its whole configuration.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct Job {
    #[serde(flatten)]
    summary: JobSummary,
    /// Null: the limit of the server.
    #[schema(required = true)]
    max_attempts: Option<u32>,
    /// Seconds that all attempts together may run; null: no limit.
    #[schema(required = true)]
    timeout: Option<u64>,
    /// Seconds between a failed attempt and the next one.
    backoff: u64,
    /// Jobs that must succeed before this one starts.
    #[schema(value_type = Vec<Uuid>)]
    after: Vec<JobId>,
    /// When training ends before all steps are done; null: never.
    #[schema(required = true)]
    stop: Option<EarlyStop>,
    /// Null, like `training`, if the job does not train, or if the specification is unreadable.
    #[schema(required = true)]
    environment: Option<EnvConfig>,
    #[schema(required = true)]
    training: Option<Training>,
    /// What a job of the kind `evaluate` compares; null for other kinds.
    #[schema(value_type = Option<Object>, required = true)]
    evaluation: Option<Value>,
    /// The combinations and the number of seeds of a sweep; null for other kinds.
    #[schema(value_type = Option<Object>, required = true)]
    sweep: Option<Value>,
    /// Number of the combination of its sweep that the job has, from 0; null without a sweep.
    #[schema(required = true)]
    point: Option<u64>,
}

impl From<JobView> for JobSummary {
    fn from(view: JobView) -> Self {
        Job::from(view).summary
    }
}

impl From<JobView> for Job {
    fn from(JobView { job, waiting, metrics }: JobView) -> Self {
        let decoded = job.spec.decode();
        let StoredSpec { kind, name, labels, threads, priority, algorithm, preset, seed, steps, document } = job.spec;
        let (spec, unreadable) = match decoded {
            Ok(spec) => (Some(spec), None),
            Err(reason) => (None, Some(UnreadableSpec { reason: reason.to_string(), document })),
        };
        let limits = spec.as_ref().map(|spec| spec.limits).unwrap_or_default();
        let point = spec.as_ref().and_then(|spec| spec.point);
        let (after, stop, config, evaluation, sweep) =
            spec.map_or_else(Default::default, |spec| (spec.after, spec.stop, spec.config, spec.evaluation, spec.sweep));
        let (environment, training) = config.map(|config| (config.environment, config.training)).unzip();
        let summary = JobSummary {
            id: job.id,
            owner: job.owner,
            state: job.state,
            wanted: job.pending_action,
            reason: job.reason,
            progress: Progress { step: job.step, steps },
            attempts: job.attempts,
            failures: job.failures,
            policy: job.policy,
            last_event_id: job.last_event,
            waiting: waiting.map(Into::into),
            metrics: metrics.into_iter().map(|(name, summary)| (name, summary.into())).collect(),
            notes: job.notes,
            parent: job.parent,
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
            unreadable,
        };
        Self {
            summary,
            max_attempts: limits.max_attempts,
            timeout: limits.timeout,
            backoff: limits.backoff,
            after,
            stop: stop.map(Into::into),
            environment,
            training,
            evaluation,
            sweep,
            point,
        }
    }
}

/// A metric at one step.
#[derive(Debug, Serialize, ToSchema)]
pub(in crate::api::rest) struct MetricRow {
    name: String,
    /// Environment steps.
    step: u64,
    /// Null if the value is not finite.
    #[schema(required = true)]
    value: Option<f64>,
    at: Timestamp,
}

impl From<store::MetricRow> for MetricRow {
    fn from(row: store::MetricRow) -> Self {
        let store::MetricRow { name, step, value, at } = row;
        Self { name, step, value, at }
    }
}

/// Metrics as a table: a header, then a line per row; an unknown value is empty. Names contain no comma.
pub(super) fn to_csv(rows: &[store::MetricRow]) -> String {
    use std::fmt::Write;
    let mut csv = String::from("name,step,value,at\n");
    for store::MetricRow { name, step, value, at } in rows {
        let value = value.map(|v| v.to_string()).unwrap_or_default();
        writeln!(csv, "{name},{step},{value},{at}").expect("writing to a string cannot fail");
    }
    csv
}

/// A checkpoint without its bytes.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct Checkpoint {
    id: Uuid,
    #[schema(value_type = Uuid)]
    job: JobId,
    kind: CheckpointKind,
    attempt: u32,
    /// Environment steps at which it was taken.
    step: u64,
    #[schema(pattern = "^[0-9a-f]{64}$")]
    sha256: String,
    /// Bytes.
    size: u64,
    /// Metrics of its evaluation.
    metrics: BTreeMap<String, f64>,
    /// The job's resolved training configuration.
    #[schema(value_type = Object)]
    config: Value,
    created_at: Timestamp,
}

impl From<store::Checkpoint> for Checkpoint {
    fn from(checkpoint: store::Checkpoint) -> Self {
        let store::Checkpoint { id, job, kind, attempt, step, sha256, size, metrics, config, created_at } = checkpoint;
        Self { id, job, kind, attempt, step, sha256, size, metrics, config, created_at }
    }
}

/// An attempt at a job by one worker process.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct Attempt {
    #[serde(rename = "attempt")]
    number: u32,
    started_at: Timestamp,
    #[schema(required = true)]
    ended_at: Option<Timestamp>,
    #[schema(required = true)]
    outcome: Option<AttemptOutcome>,
    #[schema(required = true)]
    reason: Option<String>,
    /// The end of the worker's output.
    log: String,
}

impl From<store::Attempt> for Attempt {
    fn from(attempt: store::Attempt) -> Self {
        let store::Attempt { number, started_at, ended_at, outcome, reason, log } = attempt;
        Self { number, started_at, ended_at, outcome, reason, log }
    }
}
