//! One slot of one fleet: an observation in, a heading per UAV out.

use std::sync::Arc;
use std::time::Instant;

use bytes::Bytes;
use tracing::level_filters::LevelFilter;

use super::sequences::{self, Sequence};
use super::{App, Error};
use crate::error_code::ErrorCode;
use crate::invalid::Invalid;
use crate::policy::Slot;
use crate::serving::{
    Answered, Fleet, HeldState, LoadedPolicy, Observation, Outcome, PolicySpec, Room, Seen, Session, Task, Timings, Turn, Which,
};

/// Observations of more nodes are prepared away from the threads that serve connections.
pub const LARGE: usize = 256;

/// What is asked.
#[derive(Clone, Debug)]
pub struct Request {
    /// Which policy; a session knows its own.
    pub policy: Option<PolicySpec>,
    /// What the fleet sees.
    pub observation: Observation,
    /// What it remembers.
    pub memory: Memory,
    /// The step, where the caller counts.
    pub step: Option<u64>,
    /// The run of a session; without meaning for memory that the caller keeps.
    pub run_id: Option<String>,
    /// Fixes what is random about the policy, at slot 0 of memory that the caller keeps.
    pub seed: Option<u64>,
}

/// Who keeps the memory.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Memory {
    /// The server, in this session.
    Session(String),
    /// The server, in a session that begins and ends with requests like this one.
    Sequence(Sequence),
    /// The caller: the bytes of the last answer, empty at slot 0.
    Held(Bytes),
}

/// What is answered. Headings and values are in canonical order of UAVs; `order` is the request's.
#[derive(Clone, Debug)]
pub struct Answer {
    /// Who decided.
    pub policy: Arc<LoadedPolicy>,
    /// Ids of UAVs in canonical order.
    pub uavs: Vec<String>,
    /// Canonical index of each UAV in the order of the request.
    pub order: Vec<u32>,
    /// The step that was answered.
    pub step: u64,
    /// Heading index of each UAV.
    pub headings: Vec<u8>,
    /// A values per UAV; NaN where the policy has none.
    pub q_values: Vec<f32>,
    /// Memory for the next slot, where the caller keeps it.
    pub state: Option<Bytes>,
    /// How long it took.
    pub timings: Timings,
}

/// Answers one slot.
///
/// # Errors
/// Everything in the table of errors that concerns policies and sessions.
pub async fn act(app: &App, request: Request, deadline: Option<Instant>) -> Result<Answer, Error> {
    app.admit()?;
    match &request.memory {
        Memory::Session(id) => {
            note("session", id);
            let session = app.sessions.get(id)?;
            within(deadline, in_session(app, &session, request, deadline)).await
        }
        Memory::Sequence(sequence) => {
            let sequence = sequence.clone();
            // Boxed, so that what it holds makes no other request larger.
            within(deadline, Box::pin(sequences::act(app, &sequence, request, deadline))).await
        }
        Memory::Held(state) => {
            let state = state.clone();
            with_held_state(app, &state, request, deadline).await
        }
    }
}

/// The engine watches its own queue; this is for the wait behind another slot of the same session.
async fn within(deadline: Option<Instant>, answer: impl Future<Output = Result<Answer, Error>>) -> Result<Answer, Error> {
    let Some(deadline) = deadline else { return answer.await };
    let passed = || Error::Deadline("behind another slot of the session");
    tokio::time::timeout_at(deadline.into(), answer).await.unwrap_or_else(|_| Err(passed()))
}

pub(super) async fn in_session(
    app: &App,
    session: &Session,
    request: Request,
    deadline: Option<Instant>,
) -> Result<Answer, Error> {
    if let Some(spec) = &request.policy {
        check_pinned(session.policy(), spec)?;
    }
    if let Some(seed) = request.seed {
        return Err(Invalid::new("seed", seed, "no value, because a session takes its seed when it is opened").into());
    }
    let Observation { fleet, uav_order, seen } = request.observation;
    let slot = slot_of(&fleet, seen, session.policy()).await?;
    let turn = TurnRequest { fleet, uav_order, slot, step: request.step, run_id: request.run_id };
    advance(app, session, turn, deadline).await
}

/// A slot that its policy can decide.
pub(super) struct TurnRequest {
    pub(super) fleet: Fleet,
    pub(super) uav_order: Vec<u32>,
    pub(super) slot: Slot,
    pub(super) step: Option<u64>,
    pub(super) run_id: Option<String>,
}

pub(super) async fn advance(app: &App, session: &Session, turn: TurnRequest, deadline: Option<Instant>) -> Result<Answer, Error> {
    let policy = session.policy().clone();
    let TurnRequest { fleet, uav_order: order, slot, step, run_id } = turn;
    let answered = match session.turn(&fleet, step, run_id.as_deref()).await? {
        Turn::Repeat(answered) => answered,
        Turn::Next(mut turn) => {
            let (memory, room) = (std::mem::take(&mut turn.memory), std::mem::take(&mut turn.room));
            let outcome = compute(app, Task::new(policy.clone(), slot, turn.step, memory, room), deadline).await?;
            turn.commit(outcome)
        }
    };
    let Answered { step, headings, q_values, timings } = answered;
    Ok(Answer { policy, uavs: fleet.uavs, order, step, headings, q_values, state: None, timings })
}

async fn with_held_state(app: &App, state: &[u8], request: Request, deadline: Option<Instant>) -> Result<Answer, Error> {
    let Some(spec) = &request.policy else {
        return Err(Invalid::missing("policy", "NAME, NAME@ALIAS or NAME:VERSION, or a session_id").into());
    };
    let held = if state.is_empty() { None } else { Some(HeldState::decode(state)?) };
    let policy = match &held {
        None => app.registry.resolve(spec)?,
        Some(held) => version_of(app, spec, held)?,
    };
    let Observation { fleet, uav_order: order, seen } = request.observation;
    let slot = slot_of(&fleet, seen, &policy).await?;
    let step = held.as_ref().map_or(0, |held| held.step);
    if let Some(sent) = request.step.filter(|&sent| sent != step) {
        let message = format!("step {sent} does not go with this recurrent_state, which is of step {step}");
        return Err(Error::Precondition { code: ErrorCode::WrongStep, message });
    }
    let memory = if let Some(held) = held {
        memory_of(held, &fleet, &policy)?
    } else {
        let mut memory = vec![0.0; policy.policy.memory_len(slot.uavs(), slot.users())];
        policy.policy.start(slot.uavs(), slot.users(), request.seed.unwrap_or(0), &mut memory);
        memory
    };
    let outcome = compute(app, Task::new(policy.clone(), slot, step, memory, Room::default()), deadline).await?;
    let next = HeldState::new(policy.reference.digest, step.saturating_add(1), &fleet, outcome.memory);
    let (headings, q_values, timings) = (outcome.headings, outcome.q_values, outcome.timings);
    Ok(Answer { policy, uavs: fleet.uavs, order, step, headings, q_values, state: Some(next.encode()), timings })
}

/// A session stays with its version, so an alias that moved meanwhile still means it; another name or version does not.
fn check_pinned(pinned: &LoadedPolicy, spec: &PolicySpec) -> Result<(), Invalid> {
    let same_version = !matches!(spec.which, Which::Version(version) if version != pinned.reference.version);
    if spec.name == pinned.reference.name && same_version {
        return Ok(());
    }
    Err(Invalid::new("policy", spec, format!("{}, the policy of the session, or no value", pinned.reference)))
}

/// The version that wrote `held`: an episode stays with its version even if an alias moved or a newer one was published since.
fn version_of(app: &App, spec: &PolicySpec, held: &HeldState) -> Result<Arc<LoadedPolicy>, Error> {
    app.registry.pinned(spec, &held.digest)?.ok_or_else(|| {
        let expected = format!("the recurrent_state of an earlier response of {spec}");
        Invalid::new("recurrent_state", "the state of another policy or version", expected).into()
    })
}

fn memory_of(held: HeldState, fleet: &Fleet, policy: &LoadedPolicy) -> Result<Vec<f32>, Invalid> {
    let wrong = |value: &str| {
        let expected = "the recurrent_state of an earlier response to the same UAVs and users";
        Invalid::new("recurrent_state", value, expected)
    };
    let (uavs, users) = (fleet.uavs.len(), fleet.users.len());
    if (held.uavs as usize, held.users as usize) != (uavs, users) {
        return Err(wrong(&format!("the state of {} UAVs and {} users", held.uavs, held.users)));
    }
    if held.fleet != fleet.fingerprint() {
        return Err(wrong("the state of UAVs or users with other ids"));
    }
    if held.memory.len() != policy.policy.memory_len(uavs, users) {
        return Err(wrong("a state of another length"));
    }
    Ok(held.memory)
}

pub(super) async fn slot_of(fleet: &Fleet, seen: Seen, policy: &Arc<LoadedPolicy>) -> Result<Slot, Error> {
    let (uavs, users) = (fleet.uavs.len(), fleet.users.len());
    if uavs + users < LARGE {
        return Ok(seen.into_slot((uavs, users), &*policy.policy)?);
    }
    let policy = policy.clone();
    let prepared = tokio::task::spawn_blocking(move || seen.into_slot((uavs, users), &*policy.policy));
    Ok(prepared.await.map_err(Error::internal)??)
}

/// Tells the span of the request what it is about, if anybody reads it.
fn note(field: &'static str, value: &dyn std::fmt::Display) {
    if LevelFilter::current() >= LevelFilter::DEBUG {
        tracing::Span::current().record(field, tracing::field::display(value));
    }
}

async fn compute(app: &App, task: Task, deadline: Option<Instant>) -> Result<Outcome, Error> {
    note("policy", &task.policy().reference);
    Ok(app.engine.run(task, deadline).await?)
}
