//! Bodies of requests of `/v1/jobs`: what is submitted, and what is edited.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};
use utoipa::ToSchema;
use utoipa::openapi::RefOr;
use utoipa::openapi::schema::Schema;

use crate::api::config_schemas::{partial_training, schema};
use crate::api::json;
use crate::api::rest::schemas;
use crate::env::EnvConfig;
use crate::jobs::evaluation::{EvaluationRequest, PlanRequest};
use crate::jobs::spec;
use crate::jobs::sweep::{self, SweepRequest};
use crate::jobs::webhooks::WebhookRequest;
use crate::learner;
use crate::store::{self, JobEnd, JobKind, Secret};
use crate::train_config::{Algorithm, Preset};

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
    /// Most memory of the worker in bytes. A worker that uses more is ended, and the job has failed. Default: several times the estimate
    /// of a training run; no limit for an evaluation.
    #[serde(default, deserialize_with = "json::optional_integer")]
    #[schema(minimum = 1_048_576, maximum = 1_125_899_906_842_624_u64)]
    memory: Option<u64>,
    /// URLs to which the server sends a message when the job ends. Default: none.
    #[schema(max_items = 8)]
    webhooks: Option<Vec<Webhook>>,
    /// Ids of the jobs that must succeed before this one starts. When one of them is cancelled or deleted, this job is cancelled.
    #[schema(value_type = Option<Vec<Uuid>>, max_items = 100)]
    after: Option<Vec<String>>,
    /// When training ends before all steps are done; the job then succeeds. Default: never.
    stop: Option<EarlyStop>,
    /// What training begins with. Default: weights that are drawn.
    init: Option<Init>,
    /// Where the policy is published when the job succeeds. Default: under the name of the job, and no alias moves.
    publish: Option<Publish>,
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
    /// What a job of the kind `experiment` compares: a file of `qedgix experiment` as JSON, and `overrides` with fields of `environment`
    /// and `training` that override those of all runs.
    #[serde(default, deserialize_with = "json::optional_object")]
    #[schema(value_type = Option<Object>)]
    experiment: Option<Map<String, Value>>,
    /// Seed of the training. Configuration and seed determine every metric and weight. Default: 1.
    #[serde(default, deserialize_with = "json::optional_integer")]
    seed: Option<u64>,
}

impl From<JobRequest> for spec::JobRequest {
    fn from(request: JobRequest) -> Self {
        let JobRequest { kind, name, labels, notes, threads, priority, algorithm, preset, environment, training, seed, .. } =
            request;
        let JobRequest {
            max_attempts,
            timeout,
            backoff,
            memory,
            webhooks,
            after,
            stop,
            init,
            publish,
            evaluation,
            sweep,
            experiment,
            ..
        } = request;
        let (init, publish) = (init.map(Into::into), publish.map(Into::into));
        let sweep = sweep.map(Into::into);
        let evaluation = evaluation.map(Into::into);
        let stop = stop.map(Into::into);
        let webhooks = webhooks.map(|webhooks| webhooks.into_iter().map(Into::into).collect());
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
            memory,
            webhooks,
            after,
            stop,
            init,
            publish,
            algorithm,
            preset,
            environment,
            training,
            evaluation,
            sweep,
            experiment,
            seed,
        }
    }
}

/// A URL to which the server sends a message when a job ends: a POST request with a JSON object. The host must have a public address, or
/// be one of `--webhook-allow` of the server.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, remote = "Self")]
pub(super) struct Webhook {
    /// An `http` or `https` URL without user and password.
    #[schema(max_length = 2000, pattern = "^https?://", example = "https://hooks.example/qedgix")]
    url: String,
    /// The ends after which a message is sent; default: all three.
    #[schema(schema_with = optional_ends)]
    events: Option<Vec<JobEnd>>,
    /// Key of the signatures (HMAC-SHA256): Base64 after `whsec_`, or any text. It is never returned. Default: messages are not signed.
    #[schema(value_type = Option<String>, pattern = "^[!-~]{1,255}$", write_only = true)]
    secret: Option<Secret>,
}

json::objects_only!(Webhook);

impl From<Webhook> for WebhookRequest {
    fn from(Webhook { url, events, secret }: Webhook) -> Self {
        Self { url, events, secret }
    }
}

/// How jobs end, each once.
pub(super) fn ends() -> RefOr<Schema> {
    schema(json!({"type": "array", "items": {"type": "string", "enum": JobEnd::NAMES}, "minItems": 1, "uniqueItems": true}))
}

fn optional_ends() -> RefOr<Schema> {
    let items = json!({"type": "string", "enum": JobEnd::NAMES});
    schema(json!({"type": ["array", "null"], "items": items, "minItems": 1, "uniqueItems": true}))
}

/// Weights that training begins with: exactly one of `policy` and `checkpoint`. The agents must have the same architecture. The
/// mixer is taken over if it is the same, and drawn otherwise.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, remote = "Self")]
pub(super) struct Init {
    /// A policy of the server: NAME, NAME@ALIAS or NAME:VERSION. The version is that of the submission.
    #[schema(schema_with = schemas::nullable_policy_spec)]
    policy: Option<String>,
    /// Id of a checkpoint of a job.
    #[schema(value_type = Option<Uuid>)]
    checkpoint: Option<String>,
}

json::objects_only!(Init);

impl From<Init> for spec::InitRequest {
    fn from(Init { policy, checkpoint }: Init) -> Self {
        Self { policy, checkpoint }
    }
}

/// Where the policy of a job is published, and which alias moves to it in the same transaction. Moving an alias requires the scope
/// `admin`.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, remote = "Self")]
pub(super) struct Publish {
    /// Name of the policy; default: the name of the job.
    #[schema(pattern = "^[A-Za-z0-9][A-Za-z0-9._-]{0,62}$")]
    policy: Option<String>,
    /// Alias that moves to the new version.
    #[schema(schema_with = schemas::nullable_name)]
    alias: Option<String>,
    /// Condition of the move. Default: none.
    #[serde(rename = "if")]
    condition: Option<PromotionCondition>,
}

/// When an alias moves.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, remote = "Self")]
struct PromotionCondition {
    /// A baseline, or a policy of the server: NAME, NAME@ALIAS or NAME:VERSION, as it is when the job ends. The mean AoI of the best
    /// checkpoint on 256 layouts of `eval-v1` must be lower than its. It must exist, unless it is the policy that the job publishes.
    #[schema(schema_with = schemas::policy_spec)]
    better_than: String,
}

json::objects_only!(Publish, PromotionCondition);

impl From<Publish> for spec::PublishRequest {
    fn from(Publish { policy, alias, condition }: Publish) -> Self {
        let condition = condition.map(|PromotionCondition { better_than }| spec::PromotionCondition { better_than });
        Self { policy, alias, condition }
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
    #[schema(value_type = Option<Vec<Object>>, min_items = 1, max_items = 500)]
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
    schema(
        json!({"type": ["object", "null"], "minProperties": 1, "additionalProperties": {"type": "array", "minItems": 1, "uniqueItems": true}}),
    )
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
    /// How many UAVs the only policy needs, as `qedgix plan` does: fleets of 1, 2, 3, ... UAVs until one surely meets the target.
    plan: Option<Plan>,
}

/// The AoI that a fleet must keep, and the fleets to try.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, remote = "Self")]
struct Plan {
    /// 95th percentile of AoI over users and slots that the fleet must keep, in slots.
    #[schema(exclusive_minimum = 0.0, example = 10.0)]
    target_p95: f64,
    /// Largest fleet to try; default: 12.
    #[serde(default, deserialize_with = "json::optional_integer")]
    #[schema(minimum = 1, maximum = 256)]
    max_uavs: Option<usize>,
    /// Also loses a UAV at each of several times, of the fleet that meets the target and of the next larger one; default: false.
    failures: Option<bool>,
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

json::objects_only!(Evaluation, LostUav, Plan);

impl From<Evaluation> for EvaluationRequest {
    fn from(Evaluation { policies, layouts, episodes, lose, position_noise, plan }: Evaluation) -> Self {
        let lose = lose.map(|LostUav { uav, slot }| learner::LostUav { uav, slot });
        let plan = plan.map(|Plan { target_p95, max_uavs, failures }| PlanRequest { target_p95, max_uavs, failures });
        Self { policies, layouts, episodes, lose, position_noise, plan }
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
    #[schema(schema_with = schemas::metric_name)]
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

/// How a job is continued.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(example = json!({"steps": 20_000}))]
pub(super) struct JobContinuation {
    /// Environment steps to train further.
    #[serde(deserialize_with = "json::integer")]
    #[schema(minimum = 1, maximum = 1_000_000_000_000_u64)]
    steps: u64,
}

impl From<JobContinuation> for spec::ContinueRequest {
    fn from(JobContinuation { steps }: JobContinuation) -> Self {
        Self { steps }
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
    schema(json!({"type": "string", "enum": JobKind::NAMES}))
}

/// A kind of jobs that this version runs.
pub(super) fn optional_kind() -> RefOr<Schema> {
    let kinds = JobKind::NAMES.iter().map(|name| json!(name)).chain([Value::Null]);
    schema(json!({"type": ["string", "null"], "enum": kinds.collect::<Vec<_>>()}))
}

fn labels() -> RefOr<Schema> {
    schema(json!({
        "type": ["object", "null"], "maxProperties": 32,
        "propertyNames": {"type": "string", "pattern": "^[A-Za-z0-9][A-Za-z0-9._-]{0,62}$"},
        "additionalProperties": {"type": "string", "pattern": "^[^\\u0000-\\u001f\\u007f-\\u009f]{0,255}$"}
    }))
}
