//! `Act` with memory in a session.

use std::sync::Arc;
use std::time::Instant;

use super::compute;
use super::request::{Motion, Placed, Request, Response};
use crate::invalid::Invalid;
use crate::service::{App, Error};
use crate::serving::{
    FleetIds, Flight, Listed, ListedUsers, LoadedPolicy, PolicySpec, Session, StepStart, TableEntry, Task, TaskInput,
    VersionSelector,
};

pub(super) async fn act(app: &App, session: &Session, request: Request, deadline: Option<Instant>) -> Result<Response, Error> {
    if let Some(spec) = &request.policy {
        check_pinned(session.policy(), spec)?;
    }
    if let Some(seed) = request.seed {
        return Err(Invalid::new("seed", seed, "no value, because a session takes its seed when it is opened").into());
    }
    if let Some(options) = request.flight {
        let expected = "no value, because a session takes it when it is opened";
        return Err(Invalid::new(options.first_field(), "a value", expected).into());
    }
    let placed = Placed::new(request.input, session.policy(), session.flight(), request.return_motion)?;
    let step = SessionStep::new(placed, session.policy(), request.step, request.run_id)?;
    advance(app, session, SessionStep { explain: request.explain, ..step }, deadline).await
}

/// A step with the input of the session's policy.
pub(super) struct SessionStep {
    fleet: FleetIds,
    canonical_of_request: Vec<u32>,
    /// Which users the input lists.
    users: ListedUsers,
    input: TaskInput,
    speeds: Vec<f64>,
    endurance: Vec<f64>,
    flight: Option<Arc<Flight>>,
    motion: Option<Motion>,
    step: Option<u64>,
    run_id: Option<String>,
    explain: bool,
}

impl SessionStep {
    pub(super) fn new(placed: Placed, policy: &LoadedPolicy, step: Option<u64>, run_id: Option<String>) -> Result<Self, Invalid> {
        let sensing = placed.sensing(policy);
        let Placed { fleet, canonical_of_request, content, speeds, endurance, flight, motion } = placed;
        let users = content.listed_users();
        let input = content.into_task_input(fleet.size(), &*policy.implementation, sensing)?;
        let explain = false;
        Ok(Self { fleet, canonical_of_request, users, input, speeds, endurance, flight, motion, step, run_id, explain })
    }
}

/// Computes `step` and commits it, or returns the last decision if `step` repeats the last step.
pub(super) async fn advance(
    app: &App,
    session: &Session,
    step: SessionStep,
    deadline: Option<Instant>,
) -> Result<Response, Error> {
    let policy = session.policy().clone();
    let SessionStep { fleet, canonical_of_request, users, input, speeds, endurance, flight, motion, step, run_id, explain } =
        step;
    let listed = Listed { fleet: &fleet, users };
    let decision = match session.begin_step(listed, step, run_id.as_deref(), app.absent_after).await? {
        StepStart::Repeated(decision) => decision,
        StepStart::Next(mut pending) => {
            let (memory, buffers) = (std::mem::take(&mut pending.memory), std::mem::take(&mut pending.buffers));
            let task = Task::new(policy.clone(), input, pending.step, memory, buffers).with_change(pending.change.take());
            let task = Placed::in_world(task, flight.as_ref(), speeds, endurance);
            let task = if explain { task.explained(fleet.clone()) } else { task };
            pending.commit(compute::run(app, session.owner(), task, deadline).await?)?
        }
    };
    Ok(Response { policy, uavs: fleet.uavs, canonical_of_request, decision, recurrent_state: None, flight, motion })
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
