//! What a caller may change of a job.

use std::collections::BTreeMap;

use serde::{Deserialize, Deserializer};
use serde_json::Value;

use super::checks::{check_labels, check_name, check_notes, check_priority};
use super::from_json;
use crate::invalid::Invalid;
use crate::store::{Job, JobEdit};

/// What a caller changes of a job, as a JSON merge patch (RFC 7396): what is absent stays, and null means the default.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EditRequest {
    /// The name; null: no name.
    #[serde(deserialize_with = "present")]
    pub name: Option<Option<String>>,
    /// The labels to add or replace; those that are null are removed. Null: all are removed.
    #[serde(deserialize_with = "present")]
    pub labels: Option<Option<BTreeMap<String, Option<String>>>>,
    /// The priority; null: 0.
    #[serde(deserialize_with = "present")]
    pub priority: Option<Option<i64>>,
    /// The notes; null: none.
    #[serde(deserialize_with = "present")]
    pub notes: Option<Option<String>>,
}

/// For `deserialize_with`: tells null from absent.
fn present<'de, D: Deserializer<'de>, T: Deserialize<'de>>(deserializer: D) -> Result<Option<Option<T>>, D::Error> {
    Option::deserialize(deserializer).map(Some)
}

impl EditRequest {
    /// Reads a document, as [`JobRequest::from_json`] does.
    ///
    /// # Errors
    /// The first field that is unknown or of the wrong type.
    pub fn from_json(document: Value) -> Result<Self, Invalid> {
        from_json(document)
    }

    /// The edit of `job`.
    ///
    /// # Errors
    /// The first field whose value is not accepted.
    pub fn resolve(self, job: &Job) -> Result<JobEdit, Invalid> {
        if let Some(Some(name)) = &self.name {
            check_name("name", name)?;
        }
        let labels = self.labels.map(|changes| {
            let Some(changes) = changes else { return BTreeMap::new() };
            let mut labels = job.spec.labels.clone();
            for (key, value) in changes {
                match value {
                    Some(value) => drop(labels.insert(key, value)),
                    None => drop(labels.remove(&key)),
                }
            }
            labels
        });
        if let Some(labels) = &labels {
            check_labels(labels)?;
        }
        let priority = self.priority.map(Option::unwrap_or_default);
        check_priority(priority.unwrap_or_default())?;
        let notes = self.notes.map(Option::unwrap_or_default);
        check_notes(notes.as_deref().unwrap_or_default())?;
        Ok(JobEdit { name: self.name, labels, priority, notes })
    }
}
