//! Responses of `PolicyService`.

use std::time::Duration;

use jiff::Timestamp;

use super::structs::to_struct;
use crate::env::EnvConfig;
use crate::policy::RequiredInput;
use crate::service::act;
use crate::service::policies::{PolicyDetails, VersionSummary};
use crate::serving::{Decision, PolicyKind, PolicyRef, SessionInfo};
use crate::wire::v1;

/// The action of one UAV.
#[derive(Debug)]
pub struct Action {
    /// Id of the UAV.
    pub uav_id: String,
    /// Heading index.
    pub heading: u8,
    /// Q-value of each heading; empty if not requested, or if the policy has none.
    pub q_values: Vec<f32>,
}

/// The direction of a heading in degrees, counter-clockwise from +x; `None` for hover.
pub fn degrees(heading: u8) -> Option<f64> {
    /// Number of headings with a direction; the next index is hover.
    const COMPASS: u8 = EnvConfig::COMPASS as u8;
    (heading < COMPASS).then(|| 360.0 / f64::from(COMPASS) * f64::from(heading))
}

/// Takes the actions of all UAVs out of `response`, in the order of the request.
pub fn actions(response: &mut act::Response, q_values: bool) -> impl Iterator<Item = Action> {
    let width = response.policy.implementation.actions();
    let act::Response { canonical_of_request, uavs, decision: Decision { headings, q_values: values, .. }, .. } = response;
    canonical_of_request.iter().map(move |&uav| {
        let uav = uav as usize;
        let q = values.get(uav * width..(uav + 1) * width).unwrap_or_default();
        Action {
            uav_id: std::mem::take(&mut uavs[uav]),
            heading: headings[uav],
            q_values: if q_values && q.iter().all(|q| q.is_finite()) { q.to_vec() } else { Vec::new() },
        }
    })
}

/// The response, with Q-values if `q_values` were requested and the policy has them.
pub fn act_response(mut response: act::Response, q_values: bool) -> v1::ActResponse {
    let action = |action: Action| v1::Action {
        heading_index: action.heading.into(),
        heading_deg: degrees(action.heading),
        uav_id: action.uav_id,
        q_values: action.q_values,
    };
    let actions = actions(&mut response, q_values).map(action).collect();
    let act::Response { policy, decision: Decision { step, timings, .. }, recurrent_state, .. } = response;
    v1::ActResponse {
        actions,
        policy: Some((&policy.reference).into()),
        step,
        recurrent_state: recurrent_state.unwrap_or_default(),
        timings: Some(v1::Timings {
            queue: Some(duration(timings.queue)),
            compute: Some(duration(timings.compute)),
            batch_size: timings.batch_size,
        }),
    }
}

impl From<&PolicyRef> for v1::PolicyRef {
    fn from(policy: &PolicyRef) -> Self {
        Self { name: policy.name.clone(), version: policy.version, digest: policy.digest_hex() }
    }
}

impl From<SessionInfo> for v1::Session {
    fn from(session: SessionInfo) -> Self {
        Self {
            session_id: session.id,
            policy: Some((&session.policy).into()),
            steps: session.steps,
            opened_at: Some(timestamp(session.opened_at)),
            ttl: Some(duration(session.ttl)),
            owner: session.owner.id().unwrap_or_default().to_owned(),
        }
    }
}

impl From<VersionSummary> for v1::PolicyVersion {
    fn from(version: VersionSummary) -> Self {
        let VersionSummary { reference, loaded, aliases } = version;
        Self { r#ref: Some((&reference).into()), loaded, aliases }
    }
}

impl From<PolicyDetails> for v1::Policy {
    fn from(described: PolicyDetails) -> Self {
        let PolicyDetails { info, loaded, aliases, versions, version_count } = described;
        let needs = match info.needs {
            RequiredInput::Detections => v1::Needs::Detections,
            RequiredInput::OwnPositions => v1::Needs::OwnPositions,
            RequiredInput::FullScene => v1::Needs::FullScene,
        };
        let kind = match info.kind {
            PolicyKind::Checkpoint => v1::PolicyKind::Checkpoint,
            PolicyKind::Baseline => v1::PolicyKind::Baseline,
        };
        Self {
            r#ref: Some((&info.reference).into()),
            kind: kind.into(),
            description: info.description.clone(),
            uavs: info.uavs,
            users: info.users,
            headings: info.actions as u32,
            needs: needs.into(),
            detection_range: info.detection_range,
            aliases,
            loaded,
            loaded_versions: versions.iter().filter(|(_, loaded)| *loaded).map(|(version, _)| *version).collect(),
            versions: versions.into_iter().map(|(version, _)| version).collect(),
            version_count: version_count as u64,
            config: to_struct(&info.config),
            metrics: to_struct(&info.metrics),
            created_at: Some(timestamp(info.created_at)),
        }
    }
}

pub(super) fn duration(duration: Duration) -> prost_types::Duration {
    prost_types::Duration { seconds: duration.as_secs() as i64, nanos: duration.subsec_nanos() as i32 }
}

pub(super) fn timestamp(time: Timestamp) -> prost_types::Timestamp {
    prost_types::Timestamp { seconds: time.as_second(), nanos: time.subsec_nanosecond() }
}
