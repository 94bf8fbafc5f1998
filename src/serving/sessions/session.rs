//! One session: a fleet's memory, its step and its run. Only one step runs at a time. Others wait and are checked afterwards,
//! so a retry that arrives before its first attempt has finished returns the result of the first attempt.

use std::borrow::Cow;
use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use jiff::Timestamp;
use tokio::sync::{Mutex, MutexGuard};

use super::seed::{run_hash, session_seed};
use crate::clock::Clock;
use crate::error_code::ErrorCode;
use crate::invalid::Invalid;
use crate::serving::memory_budget::MemoryCharge;
use crate::serving::table::{LastUse, TableEntry};
use crate::serving::{
    Decision, Error, FleetChange, FleetIds, FleetMemory, Flight, FlightOptions, ListedUsers, LoadedPolicy, OutputBuffers, Owner,
    PolicyRef, Roster, RosterRules, TaskOutput, UserMemory, Warning,
};

/// Maximum number of former runs that a session remembers, in order to reject them.
const MAX_FORMER_RUNS: usize = 64;
/// Bytes of a session without steps: its fields, names, former runs, and its place in the table.
pub(super) const EMPTY_SESSION: usize = 2048;

/// Description of a session.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SessionInfo {
    /// Who opened it.
    pub owner: Owner,
    /// Its name.
    pub id: String,
    /// The policy version that it is pinned to.
    pub policy: PolicyRef,
    /// Steps of the current run.
    pub steps: u64,
    /// When it was opened.
    pub opened_at: Timestamp,
    /// Idle time after which it expires.
    pub ttl: Duration,
    /// How its world differs from that of the policy.
    pub warnings: Vec<Warning>,
}

/// Options of opening a session.
#[derive(Clone, Debug, Default)]
pub struct SessionOptions {
    /// The session's name; generated if absent.
    pub id: Option<String>,
    /// The first run.
    pub run_id: Option<String>,
    /// Seed of the policy's random choices; derived from session and run if absent.
    pub seed: Option<u64>,
    /// The frame and the world of the fleet, if it has its own.
    pub flight: Option<Box<FlightOptions>>,
}

/// Who sends a step.
#[derive(Clone, Copy, Debug)]
pub struct Listed<'a> {
    /// The UAVs and users that it lists.
    pub fleet: &'a FleetIds,
    /// Which users these are.
    pub users: ListedUsers,
}

/// A fleet whose memory the server keeps, pinned to one policy version.
#[derive(Debug)]
pub struct Session {
    owner: Owner,
    id: String,
    policy: Arc<LoadedPolicy>,
    /// The frame and the world, if the fleet has its own, and the options that they follow from.
    flight: Option<(Arc<Flight>, Box<FlightOptions>)>,
    opened_at: Timestamp,
    clock: Clock,
    last_use: LastUse,
    /// Copy of `SessionState::steps`, readable during a step.
    steps: AtomicU64,
    /// Copy of `SessionState::ended`.
    ended: AtomicBool,
    state: Mutex<SessionState>,
}

#[derive(Debug)]
struct SessionState {
    /// All requests are rejected.
    closed: bool,
    /// Only the last step may be repeated.
    ended: bool,
    run_id: Option<String>,
    /// Hashes of former runs, newest last.
    former_runs: VecDeque<u64>,
    seed: Option<u64>,
    /// Steps of the current run.
    steps: u64,
    /// The ids of the last step.
    fleet: Option<FleetIds>,
    /// The members of a fleet that has changed.
    roster: Option<Roster>,
    /// Bytes of `fleet` and `roster`.
    fleet_bytes: usize,
    memory: FleetMemory,
    last: Option<Decision>,
    /// Buffers of earlier steps, for reuse.
    spare_memory: Vec<f32>,
    spare_buffers: OutputBuffers,
    /// The session's share of the memory for sessions.
    charge: MemoryCharge,
}

/// How [`Session::begin_step`] classifies a request.
#[derive(Debug)]
pub enum StepStart<'a> {
    /// The request repeats the last step, which had this decision.
    Repeated(Decision),
    /// The request is the next step.
    Next(PendingStep<'a>),
}

/// How a fleet differs from that of the last step.
#[derive(Default)]
struct Followed {
    /// The members after the step, if the fleet has changed.
    roster: Option<Roster>,
    change: Option<Box<FleetChange>>,
    /// The ids, if they differ from those of the last step.
    fleet: Option<FleetIds>,
}

impl Followed {
    /// In the first step of a run.
    fn first(listed: Listed<'_>, rules: &RosterRules<'_>) -> Self {
        let Listed { fleet, users } = listed;
        let open = users == ListedUsers::Detected && rules.policy.implementation.remembers_users();
        let roster = open.then(|| Roster::new(fleet, 0, true, UserMemory::of(rules.policy)));
        let change = roster.as_ref().map(|roster| Box::new(roster.advance(fleet, 0, rules).1));
        Self { roster, change, fleet: Some(fleet.clone()) }
    }
}

/// The next step of a session, which is locked meanwhile. [`PendingStep::commit`] completes the step; dropping it leaves the
/// session unchanged.
#[derive(Debug)]
pub struct PendingStep<'a> {
    session: &'a Session,
    state: MutexGuard<'a, SessionState>,
    /// The run that this step begins.
    new_run: Option<String>,
    /// The ids, if they differ from those of the last step.
    fleet: Option<FleetIds>,
    /// The members after the step, if the fleet has changed.
    roster: Option<Roster>,
    /// The step's index.
    pub step: u64,
    /// A copy of the memory before the step.
    pub memory: FleetMemory,
    /// How it changes, if the fleet has changed.
    pub change: Option<Box<FleetChange>>,
    /// Buffers for the output.
    pub buffers: OutputBuffers,
}

impl Session {
    /// `charge`: [`EMPTY_SESSION`] bytes. `flight`: that of the options.
    pub(super) fn new(
        (owner, id): (Owner, String),
        policy: Arc<LoadedPolicy>,
        (options, flight): (&SessionOptions, Option<Arc<Flight>>),
        charge: MemoryCharge,
        clock: Clock,
    ) -> Self {
        let opened_at = clock.now();
        let state = SessionState {
            closed: false,
            ended: false,
            run_id: options.run_id.clone(),
            former_runs: VecDeque::new(),
            seed: options.seed,
            steps: 0,
            fleet: None,
            roster: None,
            fleet_bytes: 0,
            memory: FleetMemory::default(),
            last: None,
            spare_memory: Vec::new(),
            spare_buffers: OutputBuffers::default(),
            charge,
        };
        let flight = flight.zip(options.flight.clone());
        let last_use = LastUse::at(clock.monotonic());
        let (steps, ended) = (AtomicU64::new(0), AtomicBool::new(false));
        Self { owner, id, policy, flight, opened_at, clock, last_use, steps, ended, state: Mutex::new(state) }
    }

    /// The policy version that the session is pinned to.
    pub fn policy(&self) -> &Arc<LoadedPolicy> {
        &self.policy
    }

    /// The frame and the world of the fleet, if it has its own.
    pub fn flight(&self) -> Option<&Arc<Flight>> {
        self.flight.as_ref().map(|(flight, _)| flight)
    }

    /// Waits for the step in flight, then checks a request for `step` of `run_id` by `fleet`.
    ///
    /// A repetition of the last step returns the last decision. The content of the request is ignored, except that it lists the same
    /// UAVs. `absent_after`: slots after which UAVs and users that are missing are forgotten.
    ///
    /// # Errors
    /// `wrong_step` if the step is neither the last nor the next, `run_fenced` if `run_id` names a former run,
    /// [`Error::Invalid`] if the policy does not accept other ids than those of the first step, [`Error::NotFound`] if the session is closed,
    /// [`Error::Busy`] if the memory of all sessions is exhausted.
    pub async fn begin_step<'a>(
        &'a self,
        listed: Listed<'_>,
        step: Option<u64>,
        run_id: Option<&str>,
        absent_after: u64,
    ) -> Result<StepStart<'a>, Error> {
        let fleet = listed.fleet;
        let mut state = self.state.lock().await;
        let repeated = state.last.as_ref().filter(|last| state.ended && step == Some(last.step));
        if let (Some(last), Some(known)) = (repeated, &state.fleet) {
            known.check_repeated(fleet)?;
            return Ok(StepStart::Repeated(last.clone()));
        }
        if state.closed || state.ended {
            return Err(Error::not_found(Self::KIND, &self.id));
        }
        let new_run = state.new_run(&self.id, run_id)?;
        let steps = if new_run.is_some() { 0 } else { state.steps };
        let step = step.unwrap_or(steps);
        if let (None, Some(known), Some(last)) = (&new_run, &state.fleet, state.last.as_ref().filter(|last| last.step == step)) {
            known.check_repeated(fleet)?;
            return Ok(StepStart::Repeated(last.clone()));
        }
        if step != steps {
            return Err(wrong_step(&self.id, steps, step, new_run.is_some()));
        }
        let policy = &*self.policy.implementation;
        let first = new_run.is_some() || state.fleet.is_none();
        let run = new_run.as_deref().or(state.run_id.as_deref());
        let seed = state.seed.unwrap_or_else(|| session_seed(&self.id, run));
        let rules = RosterRules { policy: &self.policy, absent_after, seed, listed: listed.users };
        let Followed { roster, change, fleet: ids } =
            if first { Followed::first(listed, &rules) } else { self.follow(&state, fleet, step, &rules)? };
        let buffer = std::mem::take(&mut state.spare_memory);
        let memory = if first {
            let memory = FleetMemory::initial(policy, fleet.size(), seed, buffer);
            // The step needs at least this much, so it is refused before it is computed. The charge of a former run remains.
            let needed = EMPTY_SESSION + fleet.bytes() + state_bytes(&memory, fleet.uavs.len(), policy.actions());
            let charge = state.charge.bytes().max(needed);
            state.charge.resize(charge)?;
            memory
        } else {
            state.memory.copy(buffer)
        };
        let buffers = std::mem::take(&mut state.spare_buffers);
        Ok(StepStart::Next(PendingStep { session: self, state, new_run, fleet: ids, roster, step, memory, change, buffers }))
    }

    /// How a fleet that lists `fleet` in `step` differs from that of the last step.
    fn follow(&self, state: &SessionState, fleet: &FleetIds, step: u64, rules: &RosterRules<'_>) -> Result<Followed, Invalid> {
        let Some(last) = &state.fleet else { return Ok(Followed::default()) };
        let other_ids = last != fleet;
        if other_ids {
            self.policy.check_same_fleet(last, fleet)?;
        } else if state.roster.is_none() {
            return Ok(Followed::default());
        }
        let users = UserMemory::of(rules.policy);
        if state.roster.is_none() && users == UserMemory::None && last.uavs == fleet.uavs {
            return Ok(Followed::default());
        }
        let made = || Roster::new(last, step.saturating_sub(1), false, users);
        let before = state.roster.as_ref().map_or_else(|| Cow::Owned(made()), Cow::Borrowed);
        let (roster, change) = before.advance(fleet, step, rules);
        Ok(Followed { roster: Some(roster), change: Some(Box::new(change)), fleet: other_ids.then(|| fleet.clone()) })
    }

    /// Handles another `OpenSession` with the name of this session. With a new run id it restarts the session; with the same
    /// options before the first step it is a retry and changes nothing.
    ///
    /// # Errors
    /// [`Error::Conflict`] otherwise, `run_fenced` for the id of an earlier run.
    pub(super) async fn retry_or_restart(&self, policy: &LoadedPolicy, options: &SessionOptions) -> Result<(), Error> {
        let taken = |reason: &str| {
            let message = format!("session {:?} exists {reason}; close it, choose another name, or give a new run_id", self.id);
            Err(Error::Conflict(message))
        };
        let mut state = self.state.lock().await;
        if state.closed {
            return taken("and is being closed");
        }
        if policy.reference.name != self.policy.reference.name {
            return taken(&format!("with policy {}", self.policy.reference));
        }
        if self.flight.as_ref().map(|(_, flight)| flight) != options.flight.as_ref() {
            return taken("with another frame, world or meaning of detections, or other constraints");
        }
        match state.new_run(&self.id, options.run_id.as_deref())? {
            Some(run) => {
                state.start_run(run);
                // Less than before, so this succeeds.
                state.charge.resize(EMPTY_SESSION)?;
                state.seed = options.seed;
            }
            None if state.steps > 0 => return taken(&format!("and has {} steps", state.steps)),
            None if state.seed != options.seed || state.run_id != options.run_id => return taken("with another seed or run_id"),
            None => {}
        }
        self.steps.store(state.steps, Ordering::Relaxed);
        self.last_use.touch(self.clock.monotonic());
        Ok(())
    }

    /// Rejects all later requests. Waits for the step in flight.
    pub(super) async fn close(&self) {
        self.state.lock().await.closed = true;
    }

    /// Rejects later steps. The last step may be repeated, by its index, for a short time.
    pub async fn end(&self) {
        self.state.lock().await.ended = true;
        self.ended.store(true, Ordering::Relaxed);
    }

    /// Describes the session.
    pub fn info(&self, ttl: Duration) -> SessionInfo {
        SessionInfo {
            owner: self.owner.clone(),
            id: self.id.clone(),
            policy: self.policy.reference.clone(),
            steps: self.steps.load(Ordering::Relaxed),
            opened_at: self.opened_at,
            ttl,
            warnings: self.flight().map_or_else(Vec::new, |flight| flight.warnings(&*self.policy.implementation)),
        }
    }
}

impl TableEntry for Session {
    const KIND: &'static str = "session";
    const EXPIRED: ErrorCode = ErrorCode::SessionExpired;
    const MEMORY_FLAG: &'static str = "--session-memory";

    fn owner(&self) -> &Owner {
        &self.owner
    }

    fn id(&self) -> &str {
        &self.id
    }

    fn last_use(&self) -> &LastUse {
        &self.last_use
    }

    fn is_ended(&self) -> bool {
        self.ended.load(Ordering::Relaxed)
    }
}

impl SessionState {
    /// Returns `run_id` if it names a run that this session has not had.
    fn new_run(&self, id: &str, run_id: Option<&str>) -> Result<Option<String>, Error> {
        let Some(run_id) = run_id.filter(|run_id| self.run_id.as_deref() != Some(run_id)) else { return Ok(None) };
        if self.former_runs.contains(&run_hash(run_id)) {
            let current = self.run_id.as_deref().unwrap_or("");
            let message = format!("run {run_id:?} of session {id:?} was replaced by run {current:?}");
            return Err(Error::precondition(ErrorCode::RunFenced, message));
        }
        Ok(Some(run_id.to_owned()))
    }

    /// Restarts the session as `run`.
    fn start_run(&mut self, run: String) {
        if let Some(former) = self.run_id.replace(run) {
            self.former_runs.push_back(run_hash(&former));
            if self.former_runs.len() > MAX_FORMER_RUNS {
                self.former_runs.pop_front();
            }
        }
        self.steps = 0;
        self.fleet = None;
        self.roster = None;
        self.memory = FleetMemory::default();
        self.last = None;
    }
}

impl PendingStep<'_> {
    /// Completes the step with `output`. Returns the decision.
    ///
    /// # Errors
    /// [`Error::Busy`] if the memory of all sessions is exhausted. The session is unchanged.
    pub fn commit(mut self, output: TaskOutput) -> Result<Decision, Error> {
        let TaskOutput { memory, decision } = output;
        let state = &mut *self.state;
        let fleet_bytes = match (&self.fleet, &self.roster) {
            (None, None) => state.fleet_bytes,
            (fleet, roster) => {
                let ids = fleet.as_ref().or(state.fleet.as_ref()).map_or(0, FleetIds::bytes);
                ids + roster.as_ref().map_or(0, Roster::bytes)
            }
        };
        let decided = state_bytes(&memory, decision.headings.len(), self.session.policy.implementation.actions());
        state.charge.resize(EMPTY_SESSION + fleet_bytes + decided)?;
        if let Some(run) = self.new_run.take() {
            state.start_run(run);
        }
        if let Some(fleet) = self.fleet.take() {
            state.fleet = Some(fleet);
        }
        // A roster stays: the fleet is not that of slot 0 again.
        if self.roster.is_some() {
            state.roster = self.roster.take();
        }
        state.fleet_bytes = fleet_bytes;
        state.spare_memory = std::mem::replace(&mut state.memory, memory).into_buffer();
        state.steps = self.step + 1;
        if let Some(Decision { headings, q_values, .. }) = state.last.replace(decision.clone()) {
            state.spare_buffers = OutputBuffers { headings, q_values };
        }
        self.session.steps.store(state.steps, Ordering::Relaxed);
        self.session.last_use.touch(self.session.clock.monotonic());
        Ok(decision)
    }
}

/// Bytes of a memory, its copy for the next step if it is plain, and two sets of output buffers.
fn state_bytes(memory: &FleetMemory, uavs: usize, actions: usize) -> usize {
    let copies = if memory.is_plain() { 2 } else { 1 };
    copies * memory.bytes() + 2 * uavs * (1 + actions * size_of::<f32>())
}

fn wrong_step(id: &str, steps: u64, step: u64, new_run: bool) -> Error {
    let message = match steps {
        0 if new_run => format!("step {step} cannot begin a new run of session {id:?}; send step 0"),
        0 => format!("step {step} is out of order: session {id:?} has no steps yet; send step 0"),
        _ => format!("step {step} is out of order in session {id:?}; send {steps}, or {} to repeat the last step", steps - 1),
    };
    Error::precondition(ErrorCode::WrongStep, message)
}
