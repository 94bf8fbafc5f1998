//! Answers of `PolicyService` as JSON: names of the protocol, bytes in base64, times as RFC 3339, durations as seconds
//! with an `s` (`"0.000021s"`), whole numbers as numbers.

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use bytes::Bytes;
use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use serde_json::Value;
use utoipa::ToSchema;

use super::schemas;
use crate::wire::v1;

/// Bytes, written in base64.
#[derive(Debug, ToSchema)]
#[schema(value_type = schemas::Base64Text)]
pub(super) struct Base64(pub(super) Bytes);

impl<'de> Deserialize<'de> for Base64 {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        let bytes = BASE64_STANDARD.decode(text).map_err(|e| D::Error::custom(format!("not base64: {e}")))?;
        Ok(Self(bytes.into()))
    }
}

impl Serialize for Base64 {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(&BASE64_STANDARD.encode(&self.0))
    }
}

#[derive(Debug, Serialize, ToSchema)]
pub(super) struct ActReply {
    /// One per UAV, in the order of the request.
    actions: Vec<Action>,
    #[schema(value_type = PolicyRef)]
    policy: Option<PolicyRef>,
    /// The step that was answered.
    step: u64,
    /// Memory for the next slot, for callers that keep it.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    recurrent_state: Option<Base64>,
    #[schema(value_type = Timings)]
    timings: Option<Timings>,
}

#[derive(Debug, Serialize, ToSchema)]
struct Action {
    uav_id: String,
    /// Heading h of 45 h degrees; 8 hovers, where the policy may.
    #[schema(maximum = 8)]
    heading_index: u32,
    /// Degrees counter-clockwise from +x; absent when hovering.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    heading_deg: Option<f64>,
    /// Value of each heading, on request, for policies that have values.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    q_values: Vec<f32>,
}

/// Exactly one version of one policy.
#[derive(Debug, Serialize, ToSchema)]
struct PolicyRef {
    name: String,
    #[schema(minimum = 1)]
    version: u64,
    /// SHA-256 of the checkpoint.
    #[schema(value_type = schemas::Sha256)]
    digest: String,
}

#[derive(Debug, Serialize, ToSchema)]
struct Timings {
    /// Waiting for the engine.
    #[schema(value_type = schemas::Seconds)]
    queue: Option<String>,
    /// Computing.
    #[schema(value_type = schemas::Seconds)]
    compute: Option<String>,
    /// Fleets computed together.
    batch_size: u32,
}

#[derive(Debug, Serialize, ToSchema)]
pub(super) struct Session {
    #[serde(rename = "session_id")]
    id: String,
    #[schema(value_type = PolicyRef)]
    policy: Option<PolicyRef>,
    /// Slots answered in the current run.
    steps: u64,
    #[schema(value_type = String, format = DateTime)]
    opened_at: Option<String>,
    /// Idle time after which it ends by itself.
    #[schema(value_type = schemas::Seconds)]
    ttl: Option<String>,
}

#[derive(Debug, Serialize, ToSchema)]
pub(super) struct Policy {
    #[schema(value_type = PolicyRef)]
    r#ref: Option<PolicyRef>,
    #[schema(value_type = PolicyKind)]
    kind: &'static str,
    description: String,
    /// Fleet sizes it serves; absent: any.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    uavs: Option<u32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    users: Option<u32>,
    /// 8, or 9 with hovering.
    #[schema(minimum = 8, maximum = 9)]
    headings: u32,
    #[schema(value_type = Needs)]
    needs: &'static str,
    /// In units of the square's side.
    detection_range: f64,
    /// Aliases that mean this version.
    aliases: Vec<String>,
    /// All versions of this name.
    versions: Vec<u64>,
    /// Whether this version can be asked.
    loaded: bool,
    /// Those of `versions` that can be asked.
    loaded_versions: Vec<u64>,
    /// Resolved training configuration of a checkpoint.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Object)]
    config: Option<Value>,
    /// Figures a checkpoint was taken at.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Object)]
    metrics: Option<Value>,
    #[schema(value_type = String, format = DateTime)]
    created_at: Option<String>,
}

/// Where a policy comes from, as the protocol writes it.
#[derive(ToSchema)]
#[expect(dead_code, reason = "written by the protocol's types; this is their documentation")]
enum PolicyKind {
    #[schema(rename = "POLICY_KIND_CHECKPOINT")]
    Checkpoint,
    #[schema(rename = "POLICY_KIND_BASELINE")]
    Baseline,
}

/// What a policy must be told: detections; UAVs' own positions, too; a scene.
#[derive(ToSchema)]
#[expect(dead_code, reason = "written by the protocol's types; this is their documentation")]
enum Needs {
    #[schema(rename = "NEEDS_DETECTIONS")]
    Detections,
    #[schema(rename = "NEEDS_OWN_POSITIONS")]
    OwnPositions,
    #[schema(rename = "NEEDS_FULL_SCENE")]
    FullScene,
}

impl From<v1::ActResponse> for ActReply {
    fn from(answer: v1::ActResponse) -> Self {
        let action = |a: v1::Action| Action {
            uav_id: a.uav_id,
            heading_index: a.heading_index,
            heading_deg: a.heading_deg,
            q_values: a.q_values,
        };
        Self {
            actions: answer.actions.into_iter().map(action).collect(),
            policy: answer.policy.map(Into::into),
            step: answer.step,
            recurrent_state: Some(answer.recurrent_state).filter(|state| !state.is_empty()).map(Base64),
            timings: answer.timings.map(|t| Timings {
                queue: t.queue.map(|d| seconds(&d)),
                compute: t.compute.map(|d| seconds(&d)),
                batch_size: t.batch_size,
            }),
        }
    }
}

impl From<v1::PolicyRef> for PolicyRef {
    fn from(r: v1::PolicyRef) -> Self {
        Self { name: r.name, version: r.version, digest: r.digest }
    }
}

impl From<v1::Session> for Session {
    fn from(session: v1::Session) -> Self {
        Self {
            id: session.session_id,
            policy: session.policy.map(Into::into),
            steps: session.steps,
            opened_at: session.opened_at.and_then(|t| time(&t)),
            ttl: session.ttl.map(|d| seconds(&d)),
        }
    }
}

impl From<v1::Policy> for Policy {
    fn from(policy: v1::Policy) -> Self {
        Self {
            kind: policy.kind().as_str_name(),
            needs: policy.needs().as_str_name(),
            r#ref: policy.r#ref.map(Into::into),
            description: policy.description,
            uavs: policy.uavs,
            users: policy.users,
            headings: policy.headings,
            detection_range: policy.detection_range,
            aliases: policy.aliases,
            versions: policy.versions,
            loaded: policy.loaded,
            loaded_versions: policy.loaded_versions,
            config: policy.config.map(document),
            metrics: policy.metrics.map(document),
            created_at: policy.created_at.and_then(|t| time(&t)),
        }
    }
}

pub(super) fn seconds(duration: &prost_types::Duration) -> String {
    format!("{}.{:09}s", duration.seconds, duration.nanos)
}

pub(super) fn time(time: &prost_types::Timestamp) -> Option<String> {
    jiff::Timestamp::new(time.seconds, time.nanos).ok().map(|time| time.to_string())
}

pub(super) fn document(document: prost_types::Struct) -> Value {
    Value::Object(document.fields.into_iter().map(|(name, value)| (name, json(value))).collect())
}

fn json(value: prost_types::Value) -> Value {
    use prost_types::value::Kind;
    match value.kind {
        None | Some(Kind::NullValue(_)) => Value::Null,
        Some(Kind::BoolValue(b)) => b.into(),
        // A whole number was one before it travelled as a double.
        Some(Kind::NumberValue(n)) if n.fract() == 0.0 && n.abs() < 9e15 => (n as i64).into(),
        Some(Kind::NumberValue(n)) => n.into(),
        Some(Kind::StringValue(s)) => s.into(),
        Some(Kind::ListValue(list)) => list.values.into_iter().map(json).collect(),
        Some(Kind::StructValue(fields)) => document(fields),
    }
}
