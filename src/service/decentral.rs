//! The use cases `Encode` and `Decide`: one UAV decides alone (`serving::decentral`). The caller keeps its state; the server keeps nothing.

use std::sync::Arc;
use std::time::Instant;

use bytes::Bytes;

use super::{App, Error, policies};
use crate::env::Point;
use crate::error_code::ErrorCode;
use crate::invalid::Invalid;
use crate::policy::Reach;
use crate::service::keys::Caller;
use crate::serving::decentral::{self, DecidedAlone, Member, Message, Observation, Slot, UavState};
use crate::serving::{FleetIds, FleetMemory, Flight, FlightOptions, LoadedPolicy, Node, NodeDetection, PolicySpec};

/// A request for the first half of a slot.
#[derive(Clone, Debug)]
pub struct EncodeRequest {
    /// The policy.
    pub policy: PolicySpec,
    /// The ids of all UAVs, without a state.
    pub uav_ids: Vec<String>,
    /// The ids of all users, without a state.
    pub user_ids: Vec<String>,
    /// What the UAV observes.
    pub observation: Node<Vec<NodeDetection>>,
    /// The state after the previous slot; empty: none.
    pub state: Bytes,
    /// The seed, without a state.
    pub seed: Option<u64>,
    /// The slot, if the caller counts.
    pub step: Option<u64>,
    /// The frame and the world.
    pub flight: Option<Box<FlightOptions>>,
}

/// What a UAV sends, and what it waits for.
#[derive(Clone, Debug)]
pub struct Encoded {
    /// The policy version.
    pub policy: Arc<LoadedPolicy>,
    /// The slot.
    pub step: u64,
    /// The state for [`decide`].
    pub state: Bytes,
    /// The message to others.
    pub message: Bytes,
    /// Number of links within which messages are needed; `None`: of all UAVs.
    pub message_links: Option<u32>,
    /// Distance within which messages are needed, in units of the caller; `None`: any.
    pub message_range: Option<f64>,
}

/// A request for the second half of a slot.
#[derive(Clone, Debug)]
pub struct DecideRequest {
    /// The policy.
    pub policy: PolicySpec,
    /// The state after [`encode`].
    pub state: Bytes,
    /// The messages of other UAVs.
    pub messages: Vec<Bytes>,
    /// The frame and the world.
    pub flight: Option<Box<FlightOptions>>,
}

/// The decision of a UAV.
#[derive(Clone, Debug)]
pub struct Decided {
    /// The policy version.
    pub policy: Arc<LoadedPolicy>,
    /// The slot.
    pub step: u64,
    /// Id of the UAV.
    pub uav: String,
    /// Its position in the unit square, where known.
    pub position: Option<Point>,
    /// Its own speed in units of the caller per second, where it has one.
    pub speed: Option<f64>,
    /// Heading and Q-values.
    pub decision: DecidedAlone,
    /// Ids of UAVs that it detects and whose messages are missing.
    pub missing: Vec<String>,
    /// The state for the next slot.
    pub state: Bytes,
    /// The frame and the world.
    pub flight: Flight,
}

/// Takes what a UAV observes, and returns its message.
///
/// # Errors
/// [`Error::Draining`]; [`Error::NotFound`] for an unknown policy; [`Error::Invalid`]; [`Error::Precondition`] for a wrong step and for
/// unloaded policies; [`Error::Busy`] and [`Error::Deadline`] of the engine.
pub async fn encode(app: &App, caller: &Caller, request: EncodeRequest, deadline: Option<Instant>) -> Result<Encoded, Error> {
    app.admit()?;
    let state = if request.state.is_empty() { None } else { Some(UavState::decode(&request.state)?) };
    let policy = resolve(app, &request.policy, state.as_ref()).await?;
    let (uavs, users) = state.as_ref().map_or((request.uav_ids.len(), request.user_ids.len()), |state| state.ids.size());
    let cost = super::act::decoding_cost(uavs + users, request.observation.detections.len());
    let work = {
        let policy = policy.clone();
        move || encode_with(policy, state, request)
    };
    let encoded = super::act::decode(app, caller, cost, deadline, work).await??;
    check_size(app, encoded.state.len())?;
    Ok(encoded)
}

fn encode_with(policy: Arc<LoadedPolicy>, state: Option<UavState>, request: EncodeRequest) -> Result<Encoded, Error> {
    let implementation = &*policy.implementation;
    let EncodeRequest { uav_ids, user_ids, observation, seed, step, flight, .. } = request;
    let flight = flight_of(flight, &policy)?;
    let mut state = if let Some(state) = state {
        let given = [("uav_ids", !uav_ids.is_empty()), ("user_ids", !user_ids.is_empty()), ("seed", seed.is_some())];
        if let Some((field, _)) = given.into_iter().find(|(_, given)| *given) {
            return Err(Invalid::new(field, "a value", "no value, because the state has it").into());
        }
        if state.observation.is_some() {
            return Err(Invalid::new("state", "a state after Encode", "the state after Decide, or none").into());
        }
        check_step(step, &state)?;
        decentral::check(implementation, state.ids.size())?;
        state
    } else {
        let ids = FleetIds::new(uav_ids, user_ids)?;
        decentral::check(implementation, ids.size())?;
        let (digest, seed) = (policy.reference.digest, seed.unwrap_or(0));
        let memory = FleetMemory::default();
        UavState { digest, seed, step: step.unwrap_or(0), uav: u32::MAX, ids, observation: None, memory }
    };
    let (uav, observed) = Observation::new(observation, &state.ids, &flight)?;
    let size = state.ids.size();
    let memory = if state.uav == u32::MAX {
        decentral::first_memory(implementation, size, state.seed, uav)
    } else {
        if state.uav != uav {
            let id = &state.ids.uavs[uav as usize];
            return Err(Invalid::new("observation.id", format!("{id:?}"), "the UAV of the state").into());
        }
        own_memory(std::mem::take(&mut state.memory), &policy, size.1)?
    };
    // Checked now, so that the UAV does not send what others cannot use.
    let slot = Slot { policy: implementation, env: flight.env, size, seed: state.seed, step: state.step };
    slot.check(&Member { uav, observation: &observed, memory: &memory })?;
    let memory = FleetMemory::Plain(memory);
    let step = state.step;
    let message = Message { mission: state.mission(), step, uav, observation: observed.clone(), memory: memory.clone() };
    let message = message.encode(implementation, size);
    let state = UavState { uav, observation: Some(observed), memory, ..state }.encode(implementation);
    let reach = implementation.reach();
    let message_links = if let Reach::Links(links) = reach { Some(links as u32) } else { None };
    let message_range = reach.range(&flight.env).map(|range| flight.length(range));
    Ok(Encoded { policy, step, state, message, message_links, message_range })
}

/// Takes the messages of other UAVs, and returns the heading.
///
/// # Errors
/// As [`encode`].
pub async fn decide(app: &App, caller: &Caller, request: DecideRequest, deadline: Option<Instant>) -> Result<Decided, Error> {
    app.admit()?;
    let state = UavState::decode(&request.state)?;
    let policy = resolve(app, &request.policy, Some(&state)).await?;
    let (uavs, users) = state.ids.size();
    decentral::check(&*policy.implementation, (uavs, users))?;
    if request.messages.len() > MAX_MESSAGES {
        let expected = format!("at most {MAX_MESSAGES}");
        return Err(Invalid::new("messages", format!("{} messages", request.messages.len()), expected).into());
    }
    let bytes: usize = request.messages.iter().map(Bytes::len).sum();
    let cost = policy.implementation.work(uavs, users, bytes / 20);
    let work = {
        let policy = policy.clone();
        move || decide_with(policy, state, request)
    };
    let decided = app.engine.call(caller.owner(), cost, deadline, work).await??;
    check_size(app, decided.state.len())?;
    Ok(decided)
}

/// Maximum number of messages in a request.
const MAX_MESSAGES: usize = 4096;

fn decide_with(policy: Arc<LoadedPolicy>, state: UavState, request: DecideRequest) -> Result<Decided, Error> {
    let implementation = &*policy.implementation;
    let flight = flight_of(request.flight, &policy)?;
    let (size, mission) = (state.ids.size(), state.mission());
    let UavState { digest, seed, step, uav, .. } = state;
    let mut heard = vec![false; size.0];
    heard[uav as usize] = true;
    let mut others = Vec::new();
    for (i, bytes) in request.messages.iter().enumerate() {
        let message = Message::decode(i, bytes, &state, &mission)?;
        if !std::mem::replace(&mut heard[message.uav as usize], true) {
            let field = |error: Invalid| Invalid { field: format!("messages[{i}]"), ..error };
            others.push((message.uav, message.observation, own_memory(message.memory, &policy, size.1).map_err(field)?));
        }
    }
    // A fixed order, whatever the order of arrival.
    others.sort_by_key(|(uav, ..)| *uav);
    let Some(observation) = state.observation else {
        return Err(Invalid::new("state", "a state after Decide", "the state after Encode").into());
    };
    let memory = own_memory(state.memory, &policy, size.1)?;
    let slot = Slot { policy: implementation, env: flight.env, size, seed, step };
    let members: Vec<Member<'_>> =
        others.iter().map(|(uav, observation, memory)| Member { uav: *uav, observation, memory }).collect();
    let mut decision = slot.decide(&Member { uav, observation: &observation, memory: &memory }, &members)?;
    let memory = FleetMemory::Plain(std::mem::take(&mut decision.memory));
    let missing = decision.missing.iter().map(|&uav| state.ids.uavs[uav as usize].clone()).collect();
    let next = UavState { digest, seed, step: step.saturating_add(1), uav, ids: state.ids, observation: None, memory };
    Ok(Decided {
        step,
        uav: next.ids.uavs[uav as usize].clone(),
        position: observation.position,
        speed: observation.speed.map(|speed| flight.speed_out(speed)),
        decision,
        missing,
        state: next.encode(implementation),
        flight,
        policy,
    })
}

async fn resolve(app: &App, spec: &PolicySpec, state: Option<&UavState>) -> Result<Arc<LoadedPolicy>, Error> {
    match state {
        None => policies::resolve(app, spec).await,
        Some(state) => policies::pinned(app, spec, &state.digest, "state").await,
    }
}

fn flight_of(options: Option<Box<FlightOptions>>, policy: &LoadedPolicy) -> Result<Flight, Invalid> {
    let policy = &*policy.implementation;
    options.map_or_else(|| Ok(Flight::plain(policy)), |options| Flight::new(&options, policy))
}

/// The numbers of a memory of one UAV.
fn own_memory(memory: FleetMemory, policy: &LoadedPolicy, users: usize) -> Result<Vec<f32>, Invalid> {
    let wrong = |error: Invalid| Invalid { field: "state".into(), ..error };
    memory.unpack(&*policy.implementation, (1, users)).map_err(wrong)
}

fn check_step(sent: Option<u64>, state: &UavState) -> Result<(), Error> {
    let Some(sent) = sent.filter(|&sent| sent != state.step) else { return Ok(()) };
    let message = format!("step {sent} does not match the state, which belongs to step {}", state.step);
    Err(Error::Precondition { code: ErrorCode::WrongStep, message })
}

/// The caller has to be able to send the state back.
fn check_size(app: &App, bytes: usize) -> Result<(), Error> {
    let limit = app.max_message_size / 8 * 5;
    if bytes <= limit {
        return Ok(());
    }
    let message =
        format!("the state of this UAV has {bytes} bytes, and a request can return at most {limit} (5/8 of --max-message-size)");
    Err(Error::TooLarge { message, limit: Some(limit as u64) })
}
