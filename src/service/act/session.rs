//! `Act` with memory in a session.

use std::time::Instant;

use super::request::{Request, Response};
use super::slot;
use crate::invalid::Invalid;
use crate::policy::Slot;
use crate::service::{App, Error};
use crate::serving::{Fleet, LoadedPolicy, Observation, PolicySpec, Session, StepStart, Task, VersionSelector};

pub(super) async fn act(app: &App, session: &Session, request: Request, deadline: Option<Instant>) -> Result<Response, Error> {
    if let Some(spec) = &request.policy {
        check_pinned(session.policy(), spec)?;
    }
    if let Some(seed) = request.seed {
        return Err(Invalid::new("seed", seed, "no value, because a session takes its seed when it is opened").into());
    }
    let Observation { fleet, uav_order, content } = request.observation;
    let slot = slot::build(content, fleet.size(), session.policy()).await?;
    let step = SessionStep { fleet, uav_order, slot, step: request.step, run_id: request.run_id };
    advance(app, session, step, deadline).await
}

/// A step whose observation is converted for the session's policy.
pub(super) struct SessionStep {
    pub(super) fleet: Fleet,
    pub(super) uav_order: Vec<u32>,
    pub(super) slot: Slot,
    pub(super) step: Option<u64>,
    pub(super) run_id: Option<String>,
}

/// Computes `step` and commits it, or returns the last decision if `step` repeats the last step.
pub(super) async fn advance(
    app: &App,
    session: &Session,
    step: SessionStep,
    deadline: Option<Instant>,
) -> Result<Response, Error> {
    let policy = session.policy().clone();
    let SessionStep { fleet, uav_order: order, slot, step, run_id } = step;
    let decision = match session.begin_step(&fleet, step, run_id.as_deref()).await? {
        StepStart::Repeated(decision) => decision,
        StepStart::Next(mut pending) => {
            let (memory, buffers) = (std::mem::take(&mut pending.memory), std::mem::take(&mut pending.buffers));
            let task = Task::new(policy.clone(), slot, pending.step, memory, buffers);
            pending.commit(slot::compute(app, task, deadline).await?)
        }
    };
    Ok(Response { policy, uavs: fleet.uavs, order, decision, recurrent_state: None })
}

/// Checks that `spec` fits the session's version: the same name, and no other version. An alias always fits, because it may
/// have moved since the session was opened.
fn check_pinned(pinned: &LoadedPolicy, spec: &PolicySpec) -> Result<(), Invalid> {
    let same_version = !matches!(spec.version, VersionSelector::Version(version) if version != pinned.reference.version);
    if spec.name == pinned.reference.name && same_version {
        return Ok(());
    }
    Err(Invalid::new("policy", spec, format!("{}, the policy of the session, or no value", pinned.reference)))
}
