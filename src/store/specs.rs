//! Specifications of jobs. The store keeps each as a document that it does not read, so that a document of another version
//! affects nothing but its own job, and what lists and the queue need in columns.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use serde_json::Value;
use uuid::Uuid;

use super::named_enum::named_enum;
use super::{JobId, Webhook};
use crate::train_config::TrainConfig;

named_enum! {
    /// What a job does.
    JobKind {
        /// Trains a policy.
        Train = "train",
        /// Evaluates policies.
        Evaluate = "evaluate",
        /// Trains many policies.
        Sweep = "sweep",
        /// Trains and evaluates the policies of an experiment.
        Experiment = "experiment",
    }
}

named_enum! {
    /// What a job that does not begin anew begins with.
    InitKind {
        /// The weights of a checkpoint.
        Weights = "weights",
        /// The snapshot of another job, with its optimiser and replay.
        Snapshot = "snapshot",
    }
}

/// What a job that trains begins with, instead of weights that are drawn.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct JobInit {
    /// Weights or a snapshot.
    pub from: InitKind,
    /// The policy with these weights, as `NAME:VERSION`.
    pub policy: Option<String>,
    /// Id of the checkpoint with these weights.
    pub checkpoint: Option<Uuid>,
    /// The job that this one continues.
    pub job: Option<JobId>,
    /// Environment steps of training before.
    pub step: u64,
    /// SHA-256 of the weights or the snapshot, lower-case hexadecimal.
    pub sha256: String,
}

/// Where the policy of a job is published, and which alias moves to it.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PublishRule {
    /// Name of the policy; `None`: the name of the job.
    pub policy: Option<String>,
    /// Alias that moves to the new version.
    pub alias: Option<String>,
    /// The policy that the new version must be better than, or the alias stays.
    pub better_than: Option<String>,
}

/// The specification of a job, with all defaults filled in.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct JobSpec {
    /// What the job does.
    pub kind: JobKind,
    /// Display name, and name of the policy that the job publishes.
    pub name: Option<String>,
    /// Labels, which the server does not interpret.
    pub labels: BTreeMap<String, String>,
    /// Threads that the worker may use.
    pub threads: usize,
    /// Jobs with a higher priority start first.
    pub priority: i64,
    /// When the job is given up.
    #[serde(default)]
    pub limits: JobLimits,
    /// Jobs that must succeed before this one starts.
    #[serde(default)]
    pub after: Vec<JobId>,
    /// URLs to which the server sends a message when the job ends.
    #[serde(default)]
    pub webhooks: Vec<Webhook>,
    /// When training ends before all steps are done; `None`: never.
    #[serde(default)]
    pub stop: Option<EarlyStop>,
    /// What training begins with; `None`: weights that are drawn.
    #[serde(default)]
    pub init: Option<JobInit>,
    /// Where the policy is published; `None`: under the name of the job.
    #[serde(default)]
    pub publish: Option<PublishRule>,
    /// The complete training configuration of a job that trains.
    #[serde(default)]
    pub config: Option<TrainConfig>,
    /// What a job evaluates, as a document that the store does not read.
    #[serde(default)]
    pub evaluation: Option<Value>,
    /// What a sweep varies, as a document that the store does not read.
    #[serde(default)]
    pub sweep: Option<Value>,
    /// What an experiment compares, as a document that the store does not read.
    #[serde(default)]
    pub experiment: Option<Value>,
    /// What a job of an experiment reports when it has trained, as a document that the store does not read.
    #[serde(default)]
    pub report: Option<Value>,
    /// Number of the combination of its sweep, or of the run of its experiment, that the job has, from 0.
    #[serde(default)]
    pub point: Option<u64>,
    /// The amount of work of a job that does not train, in steps of its progress.
    #[serde(default)]
    pub work: u64,
}

impl JobSpec {
    /// A job that trains `config` with one thread.
    pub fn train(config: TrainConfig) -> Self {
        Self {
            kind: JobKind::Train,
            name: None,
            labels: BTreeMap::new(),
            threads: 1,
            priority: 0,
            limits: JobLimits::default(),
            after: Vec::new(),
            webhooks: Vec::new(),
            stop: None,
            init: None,
            publish: None,
            config: Some(config),
            evaluation: None,
            sweep: None,
            experiment: None,
            report: None,
            point: None,
            work: 0,
        }
    }
}

/// When a job is given up, and how soon an attempt follows one that failed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct JobLimits {
    /// Consecutive attempts that fail without progress after which the job has failed; `None`: the server's limit.
    pub max_attempts: Option<u32>,
    /// Seconds that all attempts together may run; `None`: no limit.
    pub timeout: Option<u64>,
    /// Seconds between a failed attempt and the next one. They double with every further failure, up to an hour.
    pub backoff: u64,
    /// Most memory of the worker in bytes; `None`: no limit.
    #[serde(default)]
    pub memory: Option<u64>,
}

impl JobLimits {
    /// Longest time between two attempts, in seconds.
    const LONGEST_BACKOFF: u64 = 3600;

    /// Seconds before the next attempt after `failures` consecutive failures.
    pub fn delay(&self, failures: u32) -> u64 {
        let factor = 1_u64.checked_shl(failures.saturating_sub(1)).unwrap_or(u64::MAX);
        self.backoff.saturating_mul(factor).min(Self::LONGEST_BACKOFF.max(self.backoff))
    }
}

/// Ends training before all steps are done: as soon as one of its conditions holds.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EarlyStop {
    /// The metric that is observed.
    pub metric: String,
    /// A value is at most this.
    pub at_most: Option<f64>,
    /// A value is at least this.
    pub at_least: Option<f64>,
    /// This many values in a row are not better than the best before them.
    pub patience: Option<u64>,
}

/// A specification as stored. `None` is unknown: the document was unreadable when its columns were filled.
#[derive(Clone, Debug, PartialEq)]
pub struct StoredSpec {
    /// As in [`JobSpec`].
    pub kind: Option<String>,
    /// As in [`JobSpec`].
    pub name: Option<String>,
    /// As in [`JobSpec`].
    pub labels: BTreeMap<String, String>,
    /// As in [`JobSpec`].
    pub threads: usize,
    /// As in [`JobSpec`].
    pub priority: i64,
    /// As in [`TrainConfig`].
    pub algorithm: Option<String>,
    /// As in [`TrainConfig`].
    pub preset: Option<String>,
    /// As in [`TrainConfig`].
    pub seed: Option<u64>,
    /// Environment steps of the training.
    pub steps: u64,
    /// The whole specification: a [`JobSpec`] as JSON, unless another version has written it.
    pub document: String,
}

/// A specification that this version cannot read.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("this version cannot read the specification of the job: {0}")]
pub struct UnreadableSpec(String);

/// Longest reason of an [`UnreadableSpec`], in characters.
const MAX_REASON: usize = 300;

impl StoredSpec {
    /// Reads the document.
    ///
    /// # Errors
    /// [`UnreadableSpec`] names the field that this version does not know or cannot read.
    pub fn decode(&self) -> Result<JobSpec, UnreadableSpec> {
        if let Ok(spec) = serde_json::from_str(&self.document) {
            return Ok(spec);
        }
        // Once more, to find the field.
        let mut parser = serde_json::Deserializer::from_str(&self.document);
        serde_path_to_error::deserialize(&mut parser).map_err(|error| {
            let reason = error.to_string();
            // The parser goes on with every field that it knows.
            UnreadableSpec(reason.split(", expected").next().unwrap_or(&reason).chars().take(MAX_REASON).collect())
        })
    }

    /// Bytes of the texts that a list shows. `readable`: whether this version can read the document.
    pub(super) fn shown_bytes(&self, readable: bool) -> usize {
        let labels: usize = self.labels.iter().map(|(key, value)| key.len() + value.len() + 8).sum();
        let document = if readable { 0 } else { self.document.len() };
        self.name.as_ref().map_or(0, String::len) + labels + document
    }
}

#[cfg(test)]
mod tests {
    use super::JobLimits;

    #[test]
    fn back_off_doubles_up_to_an_hour() {
        let delays = |backoff: u64| [0, 1, 2, 3, 100, u32::MAX].map(|n| JobLimits { backoff, ..JobLimits::default() }.delay(n));
        assert_eq!(delays(0), [0; 6]);
        assert_eq!(delays(10), [10, 10, 20, 40, 3600, 3600]);
        assert_eq!(delays(7200), [7200; 6]);
    }
}
