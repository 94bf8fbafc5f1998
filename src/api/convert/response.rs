//! Answers of `PolicyService`.

use std::time::Duration;

use jiff::Timestamp;

use super::structs::to_struct;
use crate::policy::RequiredInput;
use crate::service::act;
use crate::serving::{Decision, PolicyDetails, PolicyKind, PolicyRef, SessionInfo};
use crate::wire::v1;

/// Degrees between two headings.
const DEGREES: f64 = 45.0;
/// Headings of the compass; the ninth action hovers.
const COMPASS: u8 = 8;

/// The direction of a heading, in degrees counter-clockwise from +x; none when hovering.
pub fn degrees(heading: u8) -> Option<f64> {
    (heading < COMPASS).then(|| DEGREES * f64::from(heading))
}

/// The answer, with Q-values if `values` were asked for and the policy has them.
pub fn act_response(answer: act::Response, values: bool) -> v1::ActResponse {
    let act::Response { policy, uavs, order, decision, recurrent_state } = answer;
    let Decision { step, headings, q_values, timings } = decision;
    let actions = policy.policy.actions();
    let mut ids = uavs;
    let actions = order
        .iter()
        .map(|&uav| {
            let uav = uav as usize;
            let heading = headings[uav];
            let q = q_values.get(uav * actions..(uav + 1) * actions).unwrap_or_default();
            v1::Action {
                uav_id: std::mem::take(&mut ids[uav]),
                heading_index: u32::from(heading),
                heading_deg: degrees(heading),
                q_values: if values && q.iter().all(|q| q.is_finite()) { q.to_vec() } else { Vec::new() },
            }
        })
        .collect();
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
        }
    }
}

impl From<PolicyDetails> for v1::Policy {
    fn from(described: PolicyDetails) -> Self {
        let PolicyDetails { info, loaded, aliases, versions } = described;
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
            headings: info.headings as u32,
            needs: needs.into(),
            detection_range: info.detection_range,
            aliases,
            loaded,
            loaded_versions: versions.iter().filter(|(_, loaded)| *loaded).map(|(version, _)| *version).collect(),
            versions: versions.into_iter().map(|(version, _)| version).collect(),
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
