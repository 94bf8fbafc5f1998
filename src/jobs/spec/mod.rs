//! What a caller may request of a job. Both transports and the command line come here, so that they accept the same.

mod checks;
mod edit;

use std::collections::BTreeMap;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use sha2::{Digest, Sha256};

use self::checks::{
    MAX_MEMORY, MIN_MEMORY, check_labels, check_notes, check_priority, check_stop, resolve_dependencies, resolve_limits,
};
pub use self::checks::{MAX_NOTES, check_name};
pub use self::edit::EditRequest;
use super::evaluation::EvaluationRequest;
use super::memory;
use super::sweep::SweepRequest;
use super::webhooks::{self, WebhookRequest};
use crate::invalid::{Invalid, in_range};
use crate::store::{EarlyStop, JobKind, JobLimits, JobSpec, PublishRule};
use crate::train_config::{Algorithm, Preset, TrainConfig, floats_to_integers};

/// A job as it is submitted; what is absent has a default.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct JobRequest {
    /// What the job does; default: train.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub kind: Option<JobKind>,
    /// Name of the job and of the policy that it publishes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// Labels for people.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub labels: Option<BTreeMap<String, String>>,
    /// Notes for people.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub notes: Option<String>,
    /// CPU cores; default: 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub threads: Option<usize>,
    /// Higher runs first; default: 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub priority: Option<i64>,
    /// Consecutive attempts that fail without progress after which the job has failed; default: the server's limit.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_attempts: Option<u32>,
    /// Seconds that all attempts together may run; default: no limit.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub timeout: Option<u64>,
    /// Seconds between a failed attempt and the next one; default: 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub backoff: Option<u64>,
    /// Most memory of the worker in bytes; default: several times the estimate of a training run.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub memory: Option<u64>,
    /// URLs to which the server sends a message when the job ends; default: none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub webhooks: Option<Vec<WebhookRequest>>,
    /// Ids of the jobs that must succeed before this one starts.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub after: Option<Vec<String>>,
    /// When training ends before all steps are done.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stop: Option<EarlyStop>,
    /// What training begins with; default: weights that are drawn.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub init: Option<InitRequest>,
    /// Where the policy is published, and which alias moves to it; default: under the name of the job, and none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub publish: Option<PublishRequest>,
    /// Algorithm.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub algorithm: Option<Algorithm>,
    /// Preset that the configuration starts from.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub preset: Option<Preset>,
    /// Fields of the environment that replace those of the preset.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub environment: Option<Map<String, Value>>,
    /// Fields of the training configuration that replace those of the preset.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub training: Option<Map<String, Value>>,
    /// What a job of the kind `evaluate` does.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub evaluation: Option<EvaluationRequest>,
    /// What a job of the kind `sweep` varies.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sweep: Option<SweepRequest>,
    /// What a job of the kind `experiment` compares: the document of `qedgix experiment`, and `overrides`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub experiment: Option<Map<String, Value>>,
    /// Seed of every random stream; default: 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub seed: Option<u64>,
}

/// What training begins with; exactly one is given.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct InitRequest {
    /// A policy of the server: NAME, NAME@ALIAS or NAME:VERSION.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub policy: Option<String>,
    /// Id of a checkpoint of a job.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub checkpoint: Option<String>,
}

/// Where the policy of a job is published, and which alias moves to it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PublishRequest {
    /// Name of the policy; default: the name of the job.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub policy: Option<String>,
    /// Alias that moves to the new version when the job succeeds.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub alias: Option<String>,
    /// Condition of the move; default: none.
    #[serde(rename = "if", skip_serializing_if = "Option::is_none")]
    pub condition: Option<PromotionCondition>,
}

/// When an alias moves.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PromotionCondition {
    /// The policy (a baseline, NAME, NAME@ALIAS or NAME:VERSION) that the new version must be better than, as it is then.
    pub better_than: String,
}

impl PublishRequest {
    fn resolve(self) -> Result<PublishRule, Invalid> {
        let Self { policy, alias, condition } = self;
        if condition.is_some() && alias.is_none() {
            return Err(Invalid::missing("publish.alias", "the alias that moves if the condition holds"));
        }
        if let Some(policy) = &policy {
            check_name("publish.policy", policy)?;
        }
        Ok(PublishRule { policy, alias, better_than: condition.map(|condition| condition.better_than) })
    }
}

impl JobRequest {
    /// Reads a document. Whole numbers count as integers however they are written, because a `google.protobuf.Struct` has no
    /// integers.
    ///
    /// # Errors
    /// The first field that is unknown or of the wrong type.
    pub fn from_json(document: Value) -> Result<Self, Invalid> {
        from_json(document)
    }

    /// SHA-256 of the request in canonical form, by which the same request is recognised.
    pub fn digest(&self) -> [u8; 32] {
        digest(self)
    }

    /// The specification with every default filled in, without `init`, which only the server can look up.
    ///
    /// # Errors
    /// The first field that is out of range, or the first unknown or mistyped field of `environment` and `training`.
    pub fn resolve(self, cpu_budget: usize) -> Result<JobSpec, Invalid> {
        let kind = self.kind.unwrap_or(JobKind::Train);
        self.check_kind(kind)?;
        let (threads, priority) = (self.threads.unwrap_or(1), self.priority.unwrap_or(0));
        if !(1..=cpu_budget).contains(&threads) {
            let expected = format!("a number from 1 to {cpu_budget}, the server's CPU budget");
            return Err(Invalid::new("threads", threads, expected));
        }
        check_priority(priority)?;
        if let Some(name) = &self.name {
            check_name("name", name)?;
        }
        let labels = self.labels.unwrap_or_default();
        check_labels(&labels)?;
        check_notes(&self.notes.unwrap_or_default())?;
        let limits = JobLimits { memory: self.memory, ..resolve_limits(self.max_attempts, self.timeout, self.backoff)? };
        in_range("memory", self.memory.unwrap_or(MIN_MEMORY), MIN_MEMORY..=MAX_MEMORY)?;
        let after = resolve_dependencies(self.after.unwrap_or_default())?;
        if let Some(stop) = &self.stop {
            check_stop(stop)?;
        }
        let [environment, training] = [self.environment, self.training].map(|section| {
            let mut fields = section.unwrap_or_default();
            fields.values_mut().for_each(floats_to_integers);
            fields
        });
        let base = JobSpec {
            kind,
            name: self.name,
            labels,
            threads,
            priority,
            limits,
            after,
            webhooks: webhooks::resolve(self.webhooks.unwrap_or_default())?,
            stop: self.stop,
            init: None,
            publish: self.publish.map(PublishRequest::resolve).transpose()?,
            config: None,
            evaluation: None,
            sweep: None,
            experiment: None,
            report: None,
            point: None,
            work: 0,
        };
        if let Some(evaluation) = self.evaluation {
            let evaluation = evaluation.resolve(&environment)?;
            let work = evaluation.steps();
            let document = serde_json::to_value(evaluation).expect("an evaluation is plain data");
            return Ok(JobSpec { evaluation: Some(document), work, ..base });
        }
        let (algorithm, preset) = (self.algorithm.unwrap_or_default(), self.preset.unwrap_or_default());
        let config = TrainConfig::resolve(algorithm, preset, &environment, &training, self.seed.unwrap_or(1))?;
        let memory = Some(limits.memory.unwrap_or_else(|| memory::default_limit(&config, threads)));
        Ok(JobSpec { config: Some(config), limits: JobLimits { memory, ..limits }, ..base })
    }

    /// Checks that the request has what its kind needs, and nothing that belongs to another kind.
    fn check_kind(&self, kind: JobKind) -> Result<(), Invalid> {
        let training = [
            ("algorithm", self.algorithm.is_some()),
            ("preset", self.preset.is_some()),
            ("training", self.training.is_some()),
            ("seed", self.seed.is_some()),
            ("stop", self.stop.is_some()),
            ("init", self.init.is_some()),
            ("publish", self.publish.is_some()),
        ];
        let unwanted: &[(&str, bool)] = match kind {
            JobKind::Train => &[
                ("evaluation", self.evaluation.is_some()),
                ("sweep", self.sweep.is_some()),
                ("experiment", self.experiment.is_some()),
            ],
            JobKind::Evaluate if self.evaluation.is_none() => {
                return Err(Invalid::missing("evaluation", "what a job of the kind evaluate does"));
            }
            JobKind::Evaluate => &training,
            // Its jobs are checked one by one.
            JobKind::Sweep | JobKind::Experiment => &[],
        };
        match unwanted.iter().find(|(_, given)| *given) {
            Some((field, _)) => Err(Invalid::new(*field, "a value", format!("no value in a job of the kind {kind}"))),
            None => Ok(()),
        }
    }
}

/// How a job that has ended is continued.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct ContinueRequest {
    /// Environment steps to train further.
    pub steps: u64,
}

/// Reads a document with whole numbers as integers.
fn from_json<T: DeserializeOwned>(mut document: Value) -> Result<T, Invalid> {
    floats_to_integers(&mut document);
    if !document.is_object() {
        return Err(Invalid::schema("job", document, "an object"));
    }
    serde_path_to_error::deserialize(document).map_err(|e| Invalid::from_parser(&e.path().to_string(), e.inner()))
}

/// SHA-256 of a request in canonical form.
pub fn digest(request: &impl Serialize) -> [u8; 32] {
    let mut document = serde_json::to_value(request).expect("a request is plain data");
    floats_to_integers(&mut document);
    // Objects are ordered by key, so this is canonical.
    Sha256::digest(document.to_string()).into()
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn resolve(document: Value) -> Result<JobSpec, Invalid> {
        JobRequest::from_json(document)?.resolve(2)
    }

    #[test]
    fn defaults_are_filled_in() {
        let spec = resolve(json!({})).unwrap();
        assert_eq!((spec.kind, spec.threads, spec.priority), (JobKind::Train, 1, 0));
        let config = spec.config.unwrap();
        assert_eq!((config.seed, config.environment.uavs), (1, 3));
        let memory = |document| resolve(document).unwrap().limits.memory;
        assert!(memory(json!({})) < memory(json!({"training": {"buffer": 50_000}})));
        assert_eq!(memory(json!({"memory": 1 << 30})), Some(1 << 30));
        assert_eq!(memory(json!({"kind": "evaluate", "evaluation": {"policies": ["sweep"]}})), None);
    }

    #[test]
    fn invalid_fields_are_reported_by_name() {
        let cases = [
            (json!([]), "job", true),
            (json!({"algoritm": "qmix"}), "algoritm", true),
            (json!({"algorithm": "dqn"}), "algorithm", true),
            (json!({"kind": "dance"}), "kind", true),
            (json!({"kind": "evaluate"}), "evaluation", false),
            (json!({"evaluation": {"policies": ["sweep"]}}), "evaluation", false),
            (json!({"kind": "evaluate", "evaluation": {"policies": ["sweep"]}, "seed": 1}), "seed", false),
            (json!({"kind": "evaluate", "evaluation": {"policies": []}}), "evaluation.policies", false),
            (json!({"kind": "evaluate", "evaluation": {"policies": ["sweep"], "layouts": "x"}}), "evaluation.layouts", false),
            (json!({"kind": "evaluate", "evaluation": {"policies": ["sweep"], "episodes": 257}}), "evaluation.episodes", false),
            (
                json!({"kind": "evaluate", "evaluation": {"policies": ["sweep"], "lose": {"uav": 3, "slot": 0}}}),
                "evaluation.lose.uav",
                false,
            ),
            (json!({"kind": "evaluate", "evaluation": {"policies": "sweep"}}), "evaluation.policies", true),
            (
                json!({"kind": "evaluate", "environment": {"uavs": 0}, "evaluation": {"policies": ["a"]}}),
                "environment.uavs",
                false,
            ),
            (json!({"environment": 3}), "environment", true),
            (json!({"environment": {"uvas": 3}}), "environment.uvas", true),
            (json!({"environment": {"uavs": "three"}}), "environment.uavs", true),
            (json!({"environment": {"uavs": 0}}), "environment.uavs", false),
            (json!({"training": {"gamma": 1.5}}), "training.gamma", false),
            (json!({"threads": 3}), "threads", false),
            (json!({"threads": 0}), "threads", false),
            (json!({"threads": -1}), "threads", true),
            (json!({"priority": 101}), "priority", false),
            (json!({"seed": 1.5}), "seed", true),
            (json!({"seed": -1}), "seed", true),
            (json!({"name": ""}), "name", false),
            (json!({"name": "a:b"}), "name", false),
            (json!({"name": "x".repeat(64)}), "name", false),
            (json!({"labels": {"a": 1}}), "labels.a", true),
            (json!({"labels": {"a b": "c"}}), "labels", false),
            (json!({"labels": {"a": "\n"}}), "labels.a", false),
            (json!({"max_attempts": 0}), "max_attempts", false),
            (json!({"timeout": 0}), "timeout", false),
            (json!({"timeout": -1}), "timeout", true),
            (json!({"backoff": u64::MAX}), "backoff", false),
            (json!({"memory": 1000}), "memory", false),
            (json!({"memory": "2G"}), "memory", true),
            (json!({"after": ["me"]}), "after[0]", false),
            (json!({"after": [null]}), "after[0]", true),
            (json!({"stop": {"metric": "loss"}}), "stop.at_most", false),
            (json!({"stop": {"metric": "a b", "patience": 1}}), "stop.metric", false),
            (json!({"stop": {"metric": "eval/mean_ao", "patience": 1}}), "stop.metric", false),
            (json!({"stop": {"metric": "loss", "patience": 0}}), "stop.patience", false),
            (json!({"stop": {"metric": "loss", "atmost": 0}}), "stop.atmost", true),
            (json!({"notes": "a\u{0}b"}), "notes", false),
            (json!({"notes": "x".repeat(4001)}), "notes", false),
        ];
        for (document, field, schema) in cases {
            let e = resolve(document.clone()).expect_err("must be refused");
            assert_eq!((e.field.as_str(), e.is_schema()), (field, schema), "{document}: {e}");
        }
    }

    #[test]
    fn the_nearest_metric_is_suggested() {
        let refused = resolve(json!({"stop": {"metric": "eval/mean_ao", "patience": 1}})).unwrap_err().to_string();
        assert!(refused.ends_with("did you mean eval/mean_aoi?"), "{refused}");
    }

    #[test]
    fn the_same_body_has_the_same_digest_however_it_is_written() {
        let digest = |text: &str| JobRequest::from_json(serde_json::from_str(text).unwrap()).unwrap().digest();
        assert_eq!(digest(r#"{"seed": 2, "threads": 1}"#), digest(r#"{"threads":1.0,"seed":2.0, "name": null}"#));
        assert_ne!(digest(r#"{"seed": 2}"#), digest(r#"{"seed": 3}"#));
    }

    #[test]
    fn seeds_are_exact() {
        let config = resolve(json!({"seed": u64::MAX})).unwrap().config.unwrap();
        assert_eq!(serde_json::to_value(config).unwrap()["seed"], u64::MAX);
    }

    #[test]
    fn a_configuration_survives_json_to_the_bit() {
        // Numbers whose shortest decimal form has more than 2^53 units: the ones that hasty parsers round twice.
        let text = r#"{"environment": {"slots": 11, "speed": 0.09232400000000001}, "training": {"gamma": 0.9232400000000001}}"#;
        let config = resolve(serde_json::from_str(text).unwrap()).unwrap().config.unwrap();
        assert_eq!(config.training.gamma, 0.923_240_000_000_000_1);
        assert_eq!(config.environment.reward_scale, Some(1.0 / 11.0));
        let again: TrainConfig = serde_json::from_str(&serde_json::to_string(&config).unwrap()).unwrap();
        assert_eq!(again, config);
    }
}
