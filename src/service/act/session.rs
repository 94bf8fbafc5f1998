//! `Act` with memory in a session.

use std::time::Instant;

use super::compute;
use super::request::{Request, Response};
use crate::invalid::Invalid;
use crate::service::{App, Error};
use crate::serving::{
    FleetIds, FleetInput, LoadedPolicy, PolicySpec, Session, StepStart, TableEntry, Task, TaskInput, VersionSelector,
};

pub(super) async fn act(app: &App, session: &Session, request: Request, deadline: Option<Instant>) -> Result<Response, Error> {
    if let Some(spec) = &request.policy {
        check_pinned(session.policy(), spec)?;
    }
    if let Some(seed) = request.seed {
        return Err(Invalid::new("seed", seed, "no value, because a session takes its seed when it is opened").into());
    }
    let FleetInput { fleet, canonical_of_request, content } = request.input;
    let input = content.into_task_input(fleet.size(), &*session.policy().implementation)?;
    let step = SessionStep { fleet, canonical_of_request, input, step: request.step, run_id: request.run_id };
    advance(app, session, step, deadline).await
}

/// A step with the input of the session's policy.
pub(super) struct SessionStep {
    pub(super) fleet: FleetIds,
    pub(super) canonical_of_request: Vec<u32>,
    pub(super) input: TaskInput,
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
    let SessionStep { fleet, canonical_of_request, input, step, run_id } = step;
    let decision = match session.begin_step(&fleet, step, run_id.as_deref()).await? {
        StepStart::Repeated(decision) => decision,
        StepStart::Next(mut pending) => {
            let (memory, buffers) = (std::mem::take(&mut pending.memory), std::mem::take(&mut pending.buffers));
            let task = Task::new(policy.clone(), input, pending.step, memory, buffers);
            pending.commit(compute::run(app, session.owner(), task, deadline).await?)?
        }
    };
    Ok(Response { policy, uavs: fleet.uavs, canonical_of_request, decision, recurrent_state: None })
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
