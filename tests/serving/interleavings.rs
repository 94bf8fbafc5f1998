//! Random interleavings of calls to sessions, compared with a model. Calls are begun, polled, dropped and completed in any
//! order, while sessions expire, are closed, reopened and restarted, and new versions are published. The memory of a session
//! identifies the session, so the test detects responses from the memory of another session, from a step computed twice or
//! from a wrong version.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::task::Poll;

use futures::FutureExt;
use futures::future::BoxFuture;
use proptest::prelude::*;
use proptest::test_runner::TestRunner;
use qedgix::invalid::Invalid;
use qedgix::policy::{FleetStep, Policy, RequiredInput};
use qedgix::service::keys::Caller;
use qedgix::service::{App, Error, act, sessions};
use qedgix::serving::{FleetInput, SessionOptions};

use super::harness::{Server, scene};

/// A policy whose Q-values are the session's seed, the number of its steps, and the policy version.
struct IdentifyingPolicy {
    version: u64,
    /// Whether it is computed inline, or on the engine's threads.
    inline: bool,
}

impl Policy for IdentifyingPolicy {
    fn actions(&self) -> usize {
        3
    }
    fn needs(&self) -> RequiredInput {
        RequiredInput::Detections
    }
    fn env(&self) -> qedgix::policy::EnvParams {
        qedgix::policy::EnvParams::default()
    }
    fn check_fleet(&self, _: usize, _: usize) -> Result<(), Invalid> {
        Ok(())
    }
    fn memory_len(&self, _: usize, _: usize) -> usize {
        2
    }
    fn start(&self, _: usize, _: usize, seed: u64, memory: &mut [f32]) {
        memory.copy_from_slice(&[seed as f32, 0.0]);
    }
    fn is_cheap(&self) -> bool {
        self.inline
    }
    fn act(&self, turns: &mut [FleetStep<'_>]) {
        for turn in turns {
            turn.headings.fill(turn.memory[0] as u8 % 3);
            if let Some(q) = &mut turn.q_values {
                let values = [turn.memory[0], turn.memory[1], self.version as f32];
                q.chunks_exact_mut(3).for_each(|q| q.copy_from_slice(&values));
            }
            turn.memory[1] += 1.0;
        }
    }
}

/// Idle time after which a session expires, in seconds: the default of servers.
const TTL: u64 = 600;

#[derive(Clone, Copy, Debug)]
enum StepChoice {
    Absent,
    Next,
    Last,
    Wrong,
}

#[derive(Clone, Debug)]
enum Action {
    Open {
        name: u8,
        run: Option<u8>,
    },
    Act {
        name: u8,
        step: StepChoice,
        run: Option<u8>,
    },
    Close {
        name: u8,
    },
    /// Polls a call in flight once.
    Poll(prop::sample::Index),
    /// Drops a call in flight.
    Drop(prop::sample::Index),
    /// Time passes, in seconds.
    Pass(u64),
    /// Publishes a new version of the policy.
    Publish,
}

fn actions() -> impl Strategy<Value = Vec<Action>> {
    let name = || 0..3_u8;
    let run = || prop::option::weighted(0.2, 0..3_u8);
    let step = prop_oneof![4 => Just(StepChoice::Absent), 3 => Just(StepChoice::Next), 2 => Just(StepChoice::Last), 1 => Just(StepChoice::Wrong)];
    let action = prop_oneof![
        3 => (name(), run()).prop_map(|(name, run)| Action::Open { name, run }),
        8 => (name(), step, run()).prop_map(|(name, step, run)| Action::Act { name, step, run }),
        1 => name().prop_map(|name| Action::Close { name }),
        12 => any::<prop::sample::Index>().prop_map(Action::Poll),
        2 => any::<prop::sample::Index>().prop_map(Action::Drop),
        1 => (0..TTL * 3 / 2).prop_map(Action::Pass),
        1 => Just(Action::Publish),
    ];
    prop::collection::vec(action, 1..80)
}

/// Model of one session from its opening to its end. A name may have several, one after another.
#[derive(Debug)]
struct ModelSession {
    seed: u64,
    version: u64,
    run: Option<u8>,
    former: BTreeSet<u8>,
    steps: u64,
    ended: bool,
    used: u64,
}

impl ModelSession {
    fn begin(&mut self, run: u8) {
        self.former.extend(self.run.replace(run));
        self.steps = 0;
    }

    /// Returns `run` if it is new, and the error code if it is a former run.
    fn new_run(&self, run: Option<u8>) -> Result<Option<u8>, &'static str> {
        match run.filter(|run| self.run != Some(*run)) {
            Some(run) if self.former.contains(&run) => Err("run_fenced"),
            new => Ok(new),
        }
    }
}

/// A response: the step, and the Q-values of every UAV.
type ActResult = (u64, [f32; 3]);

enum CallKind {
    Open { seed: u64, run: Option<u8>, fresh: bool },
    Act { step: Option<u64>, run: Option<u8> },
    Close,
}

struct Call {
    session: usize,
    kind: CallKind,
    answer: BoxFuture<'static, Result<Option<ActResult>, Error>>,
}

struct Model {
    server: Server,
    app: Arc<App>,
    policy: String,
    inline: bool,
    now: u64,
    sessions: Vec<ModelSession>,
    names: BTreeMap<u8, usize>,
    expired: BTreeSet<u8>,
    version: u64,
    calls: Vec<Call>,
    /// Completed calls, to check that the test covers something.
    completed: usize,
}

impl Model {
    fn session(&self, name: u8) -> String {
        format!("{}-{name}", self.policy)
    }

    fn publish(&mut self) {
        self.version += 1;
        let policy = IdentifyingPolicy { version: self.version, inline: self.inline };
        self.server.add(&self.policy, self.version, Arc::new(policy));
    }

    /// The open session of `name`, or the error code.
    fn find(&mut self, name: u8) -> Result<usize, &'static str> {
        match self.names.get(&name) {
            Some(&session) if self.now - self.sessions[session].used <= TTL => {
                self.sessions[session].used = self.now;
                Ok(session)
            }
            Some(_) => {
                self.names.remove(&name);
                self.expired.insert(name);
                Err("session_expired")
            }
            None if self.expired.contains(&name) => Err("session_expired"),
            None => Err("not_found"),
        }
    }

    fn open(&mut self, name: u8, run: Option<u8>) {
        let seed = self.sessions.len() as u64 + 100;
        let known = self.names.get(&name).copied().filter(|&session| self.now - self.sessions[session].used <= TTL);
        let session = known.unwrap_or_else(|| {
            let (version, used) = (self.version, self.now);
            self.sessions.push(ModelSession { seed, version, run, former: BTreeSet::new(), steps: 0, ended: false, used });
            self.expired.remove(&name);
            self.names.insert(name, self.sessions.len() - 1);
            self.sessions.len() - 1
        });
        let (app, policy) = (self.app.clone(), self.policy.parse().unwrap());
        let how = SessionOptions {
            id: Some(self.session(name)),
            run_id: run.map(|run| run.to_string()),
            seed: Some(seed),
            ..SessionOptions::default()
        };
        let answer = async move { sessions::open(&app, &Caller::default(), &policy, how).await.map(|_| None) }.boxed();
        self.begin(Call { session, kind: CallKind::Open { seed, run, fresh: known.is_none() }, answer });
    }

    fn act(&mut self, name: u8, step: StepChoice, run: Option<u8>) {
        let found = self.find(name);
        let steps = found.map_or(0, |session| self.sessions[session].steps);
        let step = match step {
            StepChoice::Absent => None,
            StepChoice::Next => Some(steps),
            StepChoice::Last => Some(steps.saturating_sub(1)),
            StepChoice::Wrong => Some(steps + 3),
        };
        let request = act::Request {
            policy: None,
            input: FleetInput::try_from(scene(2, 3, self.now + steps)).unwrap(),
            memory: act::MemoryLocation::Session(self.session(name)),
            step,
            run_id: run.map(|run| run.to_string()),
            seed: None,
            flight: None,
            return_motion: false,
            explain: false,
        };
        let app = self.app.clone();
        let answer = async move {
            let answer = act::act(&app, &Caller::default(), request, None).await?;
            let values: [f32; 3] = answer.decision.q_values[..3].try_into().unwrap();
            assert_eq!(answer.decision.q_values[3..], values, "one fleet has one memory");
            assert_eq!(answer.decision.headings, [values[0] as u8 % 3; 2]);
            Ok(Some((answer.decision.step, values)))
        }
        .boxed();
        self.start(found, CallKind::Act { step, run }, answer);
    }

    fn close(&mut self, name: u8) {
        let found = self.find(name);
        if found.is_ok() {
            self.names.remove(&name);
        }
        let (app, id) = (self.app.clone(), self.session(name));
        let answer = async move { sessions::close(&app, &Caller::default(), &id).await.map(|_| None) }.boxed();
        self.start(found, CallKind::Close, answer);
    }

    /// Begins a call, or checks that it is rejected immediately.
    fn start(
        &mut self,
        found: Result<usize, &'static str>,
        kind: CallKind,
        answer: BoxFuture<'static, Result<Option<ActResult>, Error>>,
    ) {
        match found {
            Ok(session) => self.begin(Call { session, kind, answer }),
            Err(code) => {
                let refused = answer.now_or_never().expect("rejected immediately");
                assert_eq!(refused.map_err(|e| e.code().as_str()), Err(code));
            }
        }
    }

    /// The first poll looks up the session, so it belongs to the beginning of the call.
    fn begin(&mut self, call: Call) {
        self.calls.push(call);
        self.poll(self.calls.len() - 1);
    }

    fn poll(&mut self, at: usize) {
        let waker = futures::task::noop_waker();
        let polled = self.calls[at].answer.poll_unpin(&mut std::task::Context::from_waker(&waker));
        if let Poll::Ready(answer) = polled {
            let Call { session, kind, .. } = self.calls.swap_remove(at);
            let expected = self.expected_result(session, &kind);
            assert_eq!(answer.map_err(|e| e.code().as_str()), expected);
            self.completed += 1;
        }
    }

    /// The result of a call that completes now. Updates the model.
    fn expected_result(&mut self, session: usize, kind: &CallKind) -> Result<Option<ActResult>, &'static str> {
        let now = self.now;
        let session = &mut self.sessions[session];
        match *kind {
            CallKind::Close => session.ended = true,
            CallKind::Open { fresh: true, .. } => {}
            CallKind::Open { seed, run, .. } => {
                if session.ended {
                    return Err("already_exists");
                }
                match session.new_run(run)? {
                    Some(run) => {
                        session.begin(run);
                        session.seed = seed;
                        session.used = now;
                    }
                    // A retry.
                    None if session.steps == 0 && (session.seed, session.run) == (seed, run) => session.used = now,
                    None => return Err("already_exists"),
                }
            }
            CallKind::Act { step, run } => {
                if session.ended {
                    return Err("not_found");
                }
                let new = session.new_run(run)?;
                let steps = if new.is_some() { 0 } else { session.steps };
                let step = step.unwrap_or(steps);
                let result = Ok(Some((step, [session.seed as f32, step as f32, session.version as f32])));
                if new.is_none() && step + 1 == steps {
                    return result;
                }
                if step != steps {
                    return Err("wrong_step");
                }
                if let Some(run) = new {
                    session.begin(run);
                }
                session.steps = step + 1;
                session.used = now;
                return result;
            }
        }
        Ok(None)
    }

    async fn drain(&mut self) {
        while !self.calls.is_empty() {
            for at in (0..self.calls.len()).rev() {
                self.poll(at);
            }
            tokio::task::yield_now().await;
        }
    }
}

#[test]
fn interleaved_calls_behave_like_the_model() {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap();
    let mut server = Some(runtime.block_on(Server::start()));
    let (mut case, mut completed) = (0, 0);
    let mut runner = TestRunner::new(ProptestConfig { cases: 400, failure_persistence: None, ..ProptestConfig::default() });
    let cell = std::cell::RefCell::new((&mut server, &mut case, &mut completed));
    runner
        .run(&(actions(), any::<bool>()), |(actions, inline)| {
            let mut held = cell.borrow_mut();
            let (server, case, completed) = &mut *held;
            **case += 1;
            let server_now = server.take().expect("one case at a time");
            let app = server_now.app.clone();
            let mut model = Model {
                server: server_now,
                app,
                policy: format!("case-{case}"),
                inline,
                now: 0,
                sessions: Vec::new(),
                names: BTreeMap::new(),
                expired: BTreeSet::new(),
                version: 0,
                calls: Vec::new(),
                completed: 0,
            };
            model.publish();
            let outcome = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
                let _inside = runtime.enter();
                for action in actions {
                    match action {
                        Action::Open { name, run } => model.open(name, run),
                        Action::Act { name, step, run } => model.act(name, step, run),
                        Action::Close { name } => model.close(name),
                        Action::Publish => model.publish(),
                        Action::Pass(seconds) => {
                            model.now += seconds;
                            model.server.advance(seconds);
                        }
                        Action::Poll(which) if !model.calls.is_empty() => model.poll(which.index(model.calls.len())),
                        Action::Drop(which) if !model.calls.is_empty() => {
                            model.calls.swap_remove(which.index(model.calls.len()));
                        }
                        Action::Poll(_) | Action::Drop(_) => {}
                    }
                }
                runtime.block_on(model.drain());
            }));
            **completed += model.completed;
            model.calls.clear();
            **server = Some(model.server);
            outcome.map_err(|panic| {
                let text = panic.downcast_ref::<String>().cloned().unwrap_or_else(|| "see above".to_owned());
                TestCaseError::fail(text)
            })
        })
        .unwrap();
    assert!(completed > 2000, "{completed} calls were completed");
}
