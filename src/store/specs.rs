//! Specifications of jobs. The store keeps each as a document that it does not read, so that a document of another version
//! affects nothing but its own job, and what lists and the queue need in columns.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::named_enum::named_enum;
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
    }
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
    /// The complete training configuration.
    pub config: TrainConfig,
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
        let mut parser = serde_json::Deserializer::from_str(&self.document);
        serde_path_to_error::deserialize(&mut parser).map_err(|error| {
            let reason = error.to_string();
            // The parser goes on with every field that it knows.
            UnreadableSpec(reason.split(", expected").next().unwrap_or(&reason).chars().take(MAX_REASON).collect())
        })
    }

    /// Bytes of the texts that a list shows.
    pub(super) fn shown_bytes(&self) -> usize {
        let labels: usize = self.labels.iter().map(|(key, value)| key.len() + value.len() + 8).sum();
        let document = if self.decode().is_ok() { 0 } else { self.document.len() };
        self.name.as_ref().map_or(0, String::len) + labels + document
    }
}
