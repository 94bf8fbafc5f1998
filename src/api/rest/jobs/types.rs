//! Bodies of responses of `/v1/jobs`: how jobs, metrics, checkpoints and attempts are shown.

use std::collections::BTreeMap;

use jiff::Timestamp;
use serde::Serialize;
use serde_json::Value;
use utoipa::ToSchema;
use uuid::Uuid;

use super::request::{EarlyStop, ends, optional_kind};
use crate::env::EnvConfig;
use crate::service::jobs::{self, JobView};
use crate::service::progress;
use crate::store::{self, AttemptOutcome, CheckpointKind, InitKind, JobEnd, JobId, JobState, PendingAction, StoredSpec};
use crate::train_config::{Algorithm, Preset, Training};

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
    /// Why the job failed, why its training ended early, or why its last attempt ended.
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

/// How far a job has come.
#[derive(Debug, Serialize, ToSchema)]
pub(in crate::api::rest) struct Progress {
    /// Environment steps done.
    step: u64,
    /// Environment steps to do, in whole iterations.
    steps: u64,
    /// Environment steps per second; null if they were not measured, or the job does not run.
    #[schema(required = true)]
    steps_per_second: Option<f64>,
    /// Seconds until all steps are done at this speed; null without one.
    #[schema(required = true)]
    seconds_left: Option<f64>,
}

impl From<progress::Progress> for Progress {
    fn from(progress: progress::Progress) -> Self {
        let seconds_left = progress.seconds_left();
        let progress::Progress { step, steps, steps_per_second } = progress;
        Self { step, steps, steps_per_second, seconds_left }
    }
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
    /// Most memory of the worker in bytes; null: no limit, or, of a sweep or an experiment, that of each of its jobs.
    #[schema(required = true)]
    memory: Option<u64>,
    /// URLs to which the server sends a message when the job ends.
    webhooks: Vec<Webhook>,
    /// Jobs that must succeed before this one starts.
    #[schema(value_type = Vec<Uuid>)]
    after: Vec<JobId>,
    /// When training ends before all steps are done; null: never.
    #[schema(required = true)]
    stop: Option<EarlyStop>,
    /// What training begins with; null: weights that are drawn.
    #[schema(required = true)]
    init: Option<JobInit>,
    /// Where the policy is published; null: under the name of the job, and no alias moves.
    #[schema(required = true)]
    publish: Option<PublishRule>,
    /// Null, like `training`, if the job does not train, or if the specification is unreadable.
    #[schema(required = true)]
    environment: Option<EnvConfig>,
    #[schema(required = true)]
    training: Option<Training>,
    /// What a job of the kind `evaluate` compares; null for other kinds.
    #[schema(value_type = Option<Object>, required = true)]
    evaluation: Option<Value>,
    /// Of a sweep, the combinations (`points`), the number of `seeds`, and the fields that its jobs share, as submitted (`base`); null
    /// for other kinds.
    #[schema(value_type = Option<Object>, required = true)]
    sweep: Option<Value>,
    /// What an experiment compares; null for other kinds.
    #[schema(value_type = Option<Object>, required = true)]
    experiment: Option<Value>,
    /// Number of the combination of its sweep, or of the run of its experiment, that the job has, from 0; null without one.
    #[schema(required = true)]
    point: Option<u64>,
}

/// A URL to which the server sends a message when the job ends.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = StoredWebhook)]
pub(super) struct Webhook {
    url: String,
    /// The ends after which a message is sent.
    #[schema(schema_with = ends)]
    events: Vec<JobEnd>,
    /// Whether messages are signed. The secret is never returned.
    signed: bool,
}

impl From<store::Webhook> for Webhook {
    fn from(store::Webhook { url, events, signed, secret: _ }: store::Webhook) -> Self {
        Self { url, events, signed }
    }
}

/// What training begins with.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct JobInit {
    /// The weights of a checkpoint, or the snapshot of another job with its optimiser and replay.
    #[schema(value_type = String, pattern = "^(weights|snapshot)$")]
    from: InitKind,
    /// NAME:VERSION of the policy with these weights.
    #[schema(required = true)]
    policy: Option<String>,
    /// Id of the checkpoint with these weights.
    #[schema(required = true)]
    checkpoint: Option<Uuid>,
    /// The job that this one continues.
    #[schema(value_type = Option<Uuid>, required = true)]
    job: Option<JobId>,
    /// Environment steps of training before.
    step: u64,
    #[schema(pattern = "^[0-9a-f]{64}$")]
    sha256: String,
}

impl From<store::JobInit> for JobInit {
    fn from(store::JobInit { from, policy, checkpoint, job, step, sha256 }: store::JobInit) -> Self {
        Self { from, policy, checkpoint, job, step, sha256 }
    }
}

/// Where the policy of a job is published, and which alias moves to it.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct PublishRule {
    /// Null: the name of the job.
    #[schema(required = true)]
    policy: Option<String>,
    #[schema(required = true)]
    alias: Option<String>,
    /// Condition of the move; null: none.
    #[serde(rename = "if")]
    #[schema(required = true)]
    condition: Option<PromotionCondition>,
}

#[derive(Debug, Serialize, ToSchema)]
#[schema(as = StoredPromotionCondition)]
struct PromotionCondition {
    better_than: String,
}

impl From<store::PublishRule> for PublishRule {
    fn from(store::PublishRule { policy, alias, better_than }: store::PublishRule) -> Self {
        Self { policy, alias, condition: better_than.map(|better_than| PromotionCondition { better_than }) }
    }
}

impl From<JobView> for JobSummary {
    fn from(view: JobView) -> Self {
        Job::from(view).summary
    }
}

impl From<JobView> for Job {
    fn from(JobView { job, spec: decoded, progress, waiting, metrics }: JobView) -> Self {
        let StoredSpec { kind, name, labels, threads, priority, algorithm, preset, seed, document, .. } = job.spec;
        let (spec, unreadable) = match decoded {
            Ok(spec) => (Some(spec), None),
            Err(reason) => (None, Some(UnreadableSpec { reason: reason.to_string(), document })),
        };
        let limits = spec.as_ref().map(|spec| spec.limits).unwrap_or_default();
        let point = spec.as_ref().and_then(|spec| spec.point);
        let experiment = spec.as_ref().and_then(|spec| spec.experiment.clone());
        let webhooks = spec.as_ref().map(|spec| spec.webhooks.clone()).unwrap_or_default();
        let (init, publish) = spec.as_ref().map(|spec| (spec.init.clone(), spec.publish.clone())).unwrap_or_default();
        let (after, stop, config, evaluation, sweep) =
            spec.map_or_else(Default::default, |spec| (spec.after, spec.stop, spec.config, spec.evaluation, spec.sweep));
        let (environment, training) = config.map(|config| (config.environment, config.training)).unzip();
        let summary = JobSummary {
            id: job.id,
            owner: job.owner,
            state: job.state,
            wanted: job.pending_action,
            reason: job.reason,
            progress: progress.into(),
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
            memory: limits.memory,
            webhooks: webhooks.into_iter().map(Into::into).collect(),
            after,
            stop: stop.map(Into::into),
            init: init.map(Into::into),
            publish: publish.map(Into::into),
            environment,
            training,
            evaluation,
            sweep,
            experiment,
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

/// The first line of metrics as a table.
pub(super) const CSV_HEADER: &str = "name,step,value,at\n";

/// Adds a line of a table per row; an unknown value is empty. Names contain no comma.
pub(super) fn add_csv(csv: &mut String, rows: &[store::MetricRow]) {
    use std::fmt::Write;
    for store::MetricRow { name, step, value, at } in rows {
        let value = value.map(|v| v.to_string()).unwrap_or_default();
        writeln!(csv, "{name},{step},{value},{at}").expect("writing to a string cannot fail");
    }
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
