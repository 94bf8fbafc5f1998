//! What lists show of a version. It is stored beside the checkpoint, so that lists do not read checkpoints.

use std::sync::Arc;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::stored::StoredVersion;
use crate::policy::RequiredInput;
use crate::service::{App, Error};
use crate::serving::{PolicyInfo, PolicyKind, PolicyRef, VersionDetails};

/// A policy version with its aliases and sibling versions.
#[derive(Clone, Debug)]
pub struct PolicyDetails {
    /// Description of the version.
    pub info: Arc<PolicyInfo>,
    /// Whether requests for it are accepted.
    pub loaded: bool,
    /// Aliases that point to this version.
    pub aliases: Vec<String>,
    /// The newest versions of this name, oldest first and at most [`MAX_SIBLINGS`](crate::serving::MAX_SIBLINGS), and whether each
    /// is loaded.
    pub versions: Vec<(u64, bool)>,
    /// Number of all versions of this name.
    pub version_count: usize,
}

/// A [`PolicyInfo`] as stored: without name, version and digest, which are columns.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct StoredInfo {
    description: String,
    uavs: Option<u32>,
    users: Option<u32>,
    actions: usize,
    needs: RequiredInput,
    detection_range: f64,
    config: Value,
    metrics: Value,
    created_at: Timestamp,
}

/// The document to store.
pub(super) fn to_json(info: &PolicyInfo) -> Result<String, Error> {
    let info = info.clone();
    let PolicyInfo { description, uavs, users, actions, needs, detection_range, config, metrics, created_at, .. } = info;
    let stored = StoredInfo { description, uavs, users, actions, needs, detection_range, config, metrics, created_at };
    serde_json::to_string(&stored).map_err(Error::internal)
}

fn from_json(reference: PolicyRef, text: &str) -> serde_json::Result<PolicyInfo> {
    let stored = serde_json::from_str(text)?;
    let StoredInfo { description, uavs, users, actions, needs, detection_range, config, metrics, created_at } = stored;
    let kind = PolicyKind::Checkpoint;
    Ok(PolicyInfo { reference, kind, description, uavs, users, actions, needs, detection_range, config, metrics, created_at })
}

/// Completes what the registry knows of a version.
pub(super) async fn complete(app: &App, details: VersionDetails) -> Result<PolicyDetails, Error> {
    let VersionDetails { state, info, aliases, versions, version_count } = details;
    let info = match info {
        Some(info) => info,
        None => Arc::new(stored(app, state.reference).await?),
    };
    Ok(PolicyDetails { info, loaded: state.loaded, aliases, versions, version_count })
}

/// The stored description. Reads the checkpoint if an older version of this program published it, or wrote the description.
async fn stored(app: &App, reference: PolicyRef) -> Result<PolicyInfo, Error> {
    let PolicyRef { name, version, .. } = &reference;
    let text = app.store.policy_info(name, *version).await?;
    if let Some(info) = text.and_then(|text| from_json(reference.clone(), &text).ok()) {
        return Ok(info);
    }
    let info = StoredVersion::read(&app.store, name, *version).await?.describe().await?;
    app.store.store_policy_info(name, *version, &to_json(&info)?).await?;
    Ok(info)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_description_is_read_as_it_was_written() {
        let info = PolicyInfo {
            reference: PolicyRef { name: "mine".into(), version: 3, digest: [3; 32] },
            kind: PolicyKind::Checkpoint,
            description: "Qmix".into(),
            uavs: Some(3),
            users: None,
            actions: 9,
            needs: RequiredInput::OwnPositions,
            detection_range: 0.1 + 0.2,
            config: serde_json::json!({"seed": u64::MAX}),
            metrics: serde_json::json!({"mean_aoi": 1.0 / 3.0}),
            created_at: Timestamp::UNIX_EPOCH,
        };
        let read = from_json(info.reference.clone(), &to_json(&info).unwrap()).unwrap();
        assert_eq!(format!("{read:?}"), format!("{info:?}"));
        assert!(from_json(info.reference, r#"{"description": "of another version of this program"}"#).is_err());
    }
}
