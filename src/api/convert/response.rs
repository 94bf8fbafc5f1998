//! Responses of `PolicyService`.

use std::time::Duration;

use jiff::Timestamp;
use serde::Deserialize;

use super::structs::to_struct;
use crate::env::{Boundary, EnvConfig, Point};
use crate::policy::RequiredInput;
use crate::service::act;
use crate::service::policies::{PolicyDetails, VersionSummary};
use crate::serving::flight::degrees;
use crate::serving::{Constraint, Decision, NamedInfluence, Overruled, PolicyInfo, PolicyKind, PolicyRef, SessionInfo, Warning};
use crate::wire::v1;

/// The action of one UAV.
#[derive(Debug)]
pub struct Action {
    /// Id of the UAV.
    pub uav_id: String,
    /// Heading index.
    pub heading: u8,
    /// Direction in the coordinates of the caller, in degrees; `None` for hover.
    pub degrees: Option<f64>,
    /// Q-value of each heading; empty if not requested, or if the policy has none.
    pub q_values: Vec<f32>,
    /// Velocity, if requested.
    pub velocity: Option<Point>,
    /// Position after the slot, if requested and if the position is known.
    pub waypoint: Option<Point>,
    /// What constraints did to the heading, if anything.
    pub overruled: Option<Overruled>,
    /// Why, if that was asked for.
    pub influences: Vec<NamedInfluence>,
}

/// What a request wants of each UAV besides its heading.
#[derive(Clone, Copy, Debug, Default)]
pub struct Wanted {
    /// Q-values, if the policy has them.
    pub q_values: bool,
    /// Velocities.
    pub velocity: bool,
    /// Positions after the slot.
    pub waypoint: bool,
}

/// Takes the actions of all UAVs out of `response`, in the order of the request.
pub fn actions(response: &mut act::Response, wanted: Wanted) -> impl Iterator<Item = Action> {
    let width = response.policy.implementation.actions();
    let act::Response {
        canonical_of_request,
        uavs,
        decision: Decision { headings, q_values: values, overruled, influences, .. },
        flight,
        motion,
        ..
    } = response;
    canonical_of_request.iter().map(move |&uav| {
        let uav = uav as usize;
        let q = values.get(uav * width..(uav + 1) * width).unwrap_or_default();
        let heading = headings[uav];
        let speed = motion.as_ref().and_then(|motion| motion.speeds.get(uav).copied().flatten());
        let at = motion.as_ref().and_then(|motion| motion.positions[uav]).filter(|_| wanted.waypoint);
        Action {
            uav_id: std::mem::take(&mut uavs[uav]),
            heading,
            degrees: flight.as_ref().map_or_else(|| degrees(heading), |flight| flight.degrees(heading)),
            q_values: if wanted.q_values && q.iter().all(|q| q.is_finite()) { q.to_vec() } else { Vec::new() },
            velocity: flight.as_ref().filter(|_| wanted.velocity).map(|flight| flight.velocity(heading, speed)),
            overruled: of_uav(overruled, uav, |of| of.uav).first().cloned(),
            influences: of_uav(influences, uav, |of| of.uav).to_vec(),
            waypoint: flight.as_ref().zip(at).map(|(flight, at)| flight.waypoint(at, heading, speed)),
        }
    })
}

/// The entries of UAV `uav` in a list that is in the order of the UAVs.
fn of_uav<T>(list: &[T], uav: usize, of: impl Fn(&T) -> u32) -> &[T] {
    let begin = list.partition_point(|entry| (of(entry) as usize) < uav);
    &list[begin..begin + list[begin..].partition_point(|entry| of(entry) as usize == uav)]
}

/// The response, with what is wanted.
pub fn act_response(mut response: act::Response, wanted: Wanted) -> v1::ActResponse {
    let actions = actions(&mut response, wanted).map(Into::into).collect();
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

impl From<Action> for v1::Action {
    fn from(action: Action) -> Self {
        Self {
            heading_index: action.heading.into(),
            heading_deg: action.degrees,
            uav_id: action.uav_id,
            q_values: action.q_values,
            velocity: action.velocity.map(|[x, y]| v1::Velocity { x, y }),
            waypoint: action.waypoint.map(|[x, y]| v1::Position { x, y, z: None }),
            overruled: action.overruled.map(Into::into),
            influences: action.influences.into_iter().map(Into::into).collect(),
        }
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
            warnings: session.warnings.into_iter().map(Into::into).collect(),
        }
    }
}

impl From<NamedInfluence> for v1::Influence {
    fn from(of: NamedInfluence) -> Self {
        Self { node_id: of.node, message: of.message, change: of.change }
    }
}

impl From<Overruled> for v1::Overruled {
    fn from(overruled: Overruled) -> Self {
        let list = |constraints: Vec<Constraint>| constraints.into_iter().map(|of| v1::Constraint::from(of).into()).collect();
        Self {
            preferred_heading_index: overruled.preferred.into(),
            because: list(overruled.because),
            violates: list(overruled.violates),
        }
    }
}

impl From<Warning> for v1::Warning {
    fn from(warning: Warning) -> Self {
        Self { field: warning.field.to_owned(), message: warning.message }
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
            world: Some(world(&info)),
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

/// The environment that a policy was trained in, or made for.
pub fn environment(info: &PolicyInfo) -> EnvConfig {
    let trained = info.config.get("environment").and_then(|environment| EnvConfig::deserialize(environment).ok());
    trained.unwrap_or_else(|| EnvConfig { detection_range: info.detection_range, ..EnvConfig::default() })
}

fn world(info: &PolicyInfo) -> v1::World {
    let environment = environment(info);
    let boundary = match environment.boundary {
        Boundary::Clamp => v1::Boundary::Clamp,
        Boundary::Free => v1::Boundary::Free,
    };
    v1::World {
        slot_seconds: None,
        speed: Some(environment.speed),
        transmission_range: Some(environment.transmission_range),
        detection_range: Some(environment.detection_range),
        communication_range: Some(environment.ranges().communication),
        slots: Some(environment.slots as u32),
        boundary: boundary.into(),
    }
}

pub(super) fn duration(duration: Duration) -> prost_types::Duration {
    prost_types::Duration { seconds: duration.as_secs() as i64, nanos: duration.subsec_nanos() as i32 }
}

pub(super) fn timestamp(time: Timestamp) -> prost_types::Timestamp {
    prost_types::Timestamp { seconds: time.as_second(), nanos: time.subsec_nanosecond() }
}
