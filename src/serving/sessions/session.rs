//! One session: a fleet's memory, its step and its run. One slot is in flight at a time; others wait for it and are
//! judged afterwards, so that a retry that overtakes its first attempt gets the first attempt's answer.

use std::collections::VecDeque;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use jiff::Timestamp;
use tokio::sync::{Mutex, MutexGuard};

use super::{Opened, SessionInfo};
use crate::clock::Clock;
use crate::error_code::ErrorCode;
use crate::serving::table::{Entry, LastUse};
use crate::serving::{Error, Fleet, LoadedPolicy, Outcome, Room, Timings};

/// Former runs that a session remembers, to refuse them.
const FORMER_RUNS: usize = 64;

/// A fleet whose memory the server keeps, pinned to one policy version.
#[derive(Debug)]
pub struct Session {
    id: String,
    policy: Arc<LoadedPolicy>,
    opened_at: Timestamp,
    clock: Clock,
    used: LastUse,
    /// Copy of `State::steps`, readable while a slot is in flight.
    steps: AtomicU64,
    /// Copy of `State::finished`.
    over: AtomicBool,
    state: Mutex<State>,
}

#[derive(Debug)]
struct State {
    ended: bool,
    /// Only the last step may be repeated.
    finished: bool,
    run_id: Option<String>,
    /// Hashes of former runs, newest last.
    former: VecDeque<u64>,
    seed: Option<u64>,
    /// Slots answered.
    steps: u64,
    /// Fixed by the first slot.
    fleet: Option<Fleet>,
    memory: Vec<f32>,
    last: Option<Answered>,
    /// Room of slots before the last.
    used_memory: Vec<f32>,
    used: Room,
}

/// What a slot was answered with; headings and values in canonical order of UAVs.
#[derive(Clone, Debug, PartialEq)]
pub struct Answered {
    /// The step.
    pub step: u64,
    /// Heading index of each UAV.
    pub headings: Vec<u8>,
    /// A values per UAV; NaN where the policy has none.
    pub q_values: Vec<f32>,
    /// How long it took.
    pub timings: Timings,
}

/// What a request to a session turned out to be.
#[derive(Debug)]
pub enum Turn<'a> {
    /// The last step again: its answer.
    Repeat(Answered),
    /// The next step: compute it, then [`NextTurn::commit`]. Dropped instead, the session stays as it was.
    Next(NextTurn<'a>),
}

/// The right to advance a session by one slot.
#[derive(Debug)]
pub struct NextTurn<'a> {
    session: &'a Session,
    state: MutexGuard<'a, State>,
    /// A run that starts the session over.
    new_run: Option<String>,
    fleet: Option<Fleet>,
    /// The step to answer.
    pub step: u64,
    /// A copy of the memory before it.
    pub memory: Vec<f32>,
    /// Room for the answer.
    pub room: Room,
}

impl Session {
    pub(super) fn new(id: String, policy: Arc<LoadedPolicy>, how: &Opened, clock: Clock) -> Self {
        let opened_at = clock.now();
        let state = State {
            ended: false,
            finished: false,
            run_id: how.run_id.clone(),
            former: VecDeque::new(),
            seed: how.seed,
            steps: 0,
            fleet: None,
            memory: Vec::new(),
            last: None,
            used_memory: Vec::new(),
            used: Room::default(),
        };
        let used = LastUse::at(clock.monotonic());
        let (steps, over) = (AtomicU64::new(0), AtomicBool::new(false));
        Self { id, policy, opened_at, clock, used, steps, over, state: Mutex::new(state) }
    }

    /// The policy version it is pinned to.
    pub fn policy(&self) -> &Arc<LoadedPolicy> {
        &self.policy
    }

    /// Waits for the slot in flight, then judges a request for `step` of `run_id` by `fleet`.
    ///
    /// A repeated step gets the last answer whatever was observed: it has been flown.
    ///
    /// # Errors
    /// A step that is neither the last nor the next, a former run, other ids than in the run's first slot, or the session
    /// has ended.
    pub async fn turn<'a>(&'a self, fleet: &Fleet, step: Option<u64>, run_id: Option<&str>) -> Result<Turn<'a>, Error> {
        let mut state = self.state.lock().await;
        let missed = state.last.as_ref().filter(|last| state.finished && step == Some(last.step));
        if let (Some(last), Some(known)) = (missed, &state.fleet) {
            known.check_same(fleet)?;
            return Ok(Turn::Repeat(last.clone()));
        }
        if state.ended || state.finished {
            return Err(Error::unknown(Self::WHAT, &self.id));
        }
        let new_run = state.judge_run(&self.id, run_id)?;
        // A run that begins on an untouched session needs no reset, but is remembered all the same.
        let steps = if new_run.is_some() { 0 } else { state.steps };
        let step = step.unwrap_or(steps);
        if new_run.is_none() {
            if let Some(known) = &state.fleet {
                known.check_same(fleet)?;
            }
            if let Some(last) = state.last.as_ref().filter(|last| last.step == step) {
                return Ok(Turn::Repeat(last.clone()));
            }
        }
        if step != steps {
            return Err(wrong_step(&self.id, steps, step, new_run.is_some()));
        }
        let first = new_run.is_some() || state.fleet.is_none();
        let mut memory = std::mem::take(&mut state.used_memory);
        memory.clear();
        if first {
            let run = new_run.as_deref().or(state.run_id.as_deref());
            let seed = state.seed.unwrap_or_else(|| hash(&(&self.id, run)));
            let (uavs, users) = (fleet.uavs.len(), fleet.users.len());
            memory.resize(self.policy.policy.memory_len(uavs, users), 0.0);
            self.policy.policy.start(uavs, users, seed, &mut memory);
        } else {
            memory.extend_from_slice(&state.memory);
        }
        let room = std::mem::take(&mut state.used);
        Ok(Turn::Next(NextTurn { session: self, state, new_run, fleet: first.then(|| fleet.clone()), step, memory, room }))
    }

    /// What `OpenSession` with the name of this session does.
    pub(super) async fn reopen(&self, policy: &LoadedPolicy, how: &Opened) -> Result<(), Error> {
        let taken = |why: &str| {
            let message = format!("session {:?} exists {why}; close it, choose another name, or give a new run_id", self.id);
            Err(Error::Exists(message))
        };
        let mut state = self.state.lock().await;
        if state.ended {
            return taken("and is being closed");
        }
        if policy.reference.name != self.policy.reference.name {
            return taken(&format!("with policy {}", self.policy.reference));
        }
        match state.judge_run(&self.id, how.run_id.as_deref())? {
            Some(run) => {
                state.begin(run);
                state.seed = how.seed;
            }
            None if state.steps > 0 => return taken(&format!("and has flown {} slots", state.steps)),
            None if state.seed != how.seed || state.run_id != how.run_id => return taken("with another seed or run_id"),
            None => {}
        }
        self.steps.store(state.steps, Ordering::Relaxed);
        self.used.touch(self.clock.monotonic());
        Ok(())
    }

    pub(super) async fn end(&self) {
        self.state.lock().await.ended = true;
    }

    /// No slot follows; the last one may be asked for again for a moment, by its step.
    pub async fn finish(&self) {
        self.state.lock().await.finished = true;
        self.over.store(true, Ordering::Relaxed);
    }

    /// What a caller is told of it.
    pub fn info(&self, ttl: Duration) -> SessionInfo {
        SessionInfo {
            id: self.id.clone(),
            policy: self.policy.reference.clone(),
            steps: self.steps.load(Ordering::Relaxed),
            opened_at: self.opened_at,
            ttl,
        }
    }
}

impl Entry for Session {
    const WHAT: &'static str = "session";
    const EXPIRED: ErrorCode = ErrorCode::SessionExpired;

    fn id(&self) -> &str {
        &self.id
    }

    fn used(&self) -> &LastUse {
        &self.used
    }

    fn over(&self) -> bool {
        self.over.load(Ordering::Relaxed)
    }
}

impl State {
    /// `Some` if `run_id` names a run that has not been seen.
    fn judge_run(&self, id: &str, run_id: Option<&str>) -> Result<Option<String>, Error> {
        let Some(run_id) = run_id.filter(|run_id| self.run_id.as_deref() != Some(run_id)) else { return Ok(None) };
        if self.former.contains(&hash(&run_id)) {
            let message =
                format!("run {run_id:?} of session {id:?} was replaced by run {:?}", self.run_id.as_deref().unwrap_or(""));
            return Err(Error::precondition(ErrorCode::RunFenced, message));
        }
        Ok(Some(run_id.to_owned()))
    }

    /// Starts over as `run`.
    fn begin(&mut self, run: String) {
        if let Some(former) = self.run_id.replace(run) {
            self.former.push_back(hash(&former.as_str()));
            if self.former.len() > FORMER_RUNS {
                self.former.pop_front();
            }
        }
        self.steps = 0;
        self.fleet = None;
        self.memory = Vec::new();
        self.last = None;
    }
}

impl NextTurn<'_> {
    /// Makes `outcome` the session's last slot.
    pub fn commit(mut self, outcome: Outcome) -> Answered {
        if let Some(run) = self.new_run.take() {
            self.state.begin(run);
        }
        let answered =
            Answered { step: self.step, headings: outcome.headings, q_values: outcome.q_values, timings: outcome.timings };
        let state = &mut *self.state;
        if let Some(fleet) = self.fleet.take() {
            state.fleet = Some(fleet);
        }
        state.used_memory = std::mem::replace(&mut state.memory, outcome.memory);
        state.steps = self.step + 1;
        if let Some(Answered { headings, q_values, .. }) = state.last.replace(answered.clone()) {
            state.used = Room { headings, q_values };
        }
        self.session.steps.store(state.steps, Ordering::Relaxed);
        self.session.used.touch(self.session.clock.monotonic());
        answered
    }
}

fn wrong_step(id: &str, steps: u64, step: u64, new_run: bool) -> Error {
    let message = match steps {
        0 if new_run => format!("step {step} cannot begin a new run of session {id:?}; send step 0"),
        0 => format!("step {step} does not follow: session {id:?} has not flown yet; send step 0"),
        _ => format!("step {step} does not follow in session {id:?}; send {steps}, or {} to repeat the last", steps - 1),
    };
    Error::precondition(ErrorCode::WrongStep, message)
}

/// A hash that is the same in every process.
fn hash(value: &impl Hash) -> u64 {
    let mut hasher = DefaultHasher::new();
    value.hash(&mut hasher);
    hasher.finish()
}
