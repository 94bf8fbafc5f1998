//! Sessions against a model: calls begun, polled once, dropped and finished in any order, sessions that expire, are closed,
//! opened again and started over, aliases that move. Memories carry the stamp of the session they belong to, so an answer
//! from another session's memory, from a step flown twice or from the wrong version is seen.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::task::Poll;

use futures::FutureExt;
use futures::future::BoxFuture;
use proptest::prelude::*;
use proptest::test_runner::TestRunner;
use qedgix::invalid::Invalid;
use qedgix::policy::{FleetStep, Policy, RequiredInput};
use qedgix::service::{App, Error, act, sessions};
use qedgix::serving::{Observation, SessionOptions};

use super::harness::{Server, scene};

/// Answers with what its memory says: Q-values are the session's stamp, the slots flown, the version.
struct Stamped {
    version: u64,
    /// Whether callers compute it, or threads of the engine.
    by_callers: bool,
}

impl Policy for Stamped {
    fn actions(&self) -> usize {
        3
    }
    fn needs(&self) -> RequiredInput {
        RequiredInput::Detections
    }
    fn detection_range(&self) -> f64 {
        0.28
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
        self.by_callers
    }
    fn act(&self, turns: &mut [FleetStep<'_>]) {
        for turn in turns {
            turn.headings.fill(turn.memory[0] as u8 % 3);
            if let Some(q) = &mut turn.q_values {
                let told = [turn.memory[0], turn.memory[1], self.version as f32];
                q.chunks_exact_mut(3).for_each(|q| q.copy_from_slice(&told));
            }
            turn.memory[1] += 1.0;
        }
    }
}

/// Idle time after which a session expires, as servers have it by default, in seconds.
const TTL: u64 = 600;

#[derive(Clone, Copy, Debug)]
enum Step {
    Unsaid,
    Next,
    Last,
    Wrong,
}

#[derive(Clone, Debug)]
enum Deed {
    Open {
        name: u8,
        run: Option<u8>,
    },
    Act {
        name: u8,
        step: Step,
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
    /// A new version becomes what the policy's name means.
    Publish,
}

fn deeds() -> impl Strategy<Value = Vec<Deed>> {
    let name = || 0..3_u8;
    let run = || prop::option::weighted(0.2, 0..3_u8);
    let step = prop_oneof![4 => Just(Step::Unsaid), 3 => Just(Step::Next), 2 => Just(Step::Last), 1 => Just(Step::Wrong)];
    let deed = prop_oneof![
        3 => (name(), run()).prop_map(|(name, run)| Deed::Open { name, run }),
        8 => (name(), step, run()).prop_map(|(name, step, run)| Deed::Act { name, step, run }),
        1 => name().prop_map(|name| Deed::Close { name }),
        12 => any::<prop::sample::Index>().prop_map(Deed::Poll),
        2 => any::<prop::sample::Index>().prop_map(Deed::Drop),
        1 => (0..TTL * 3 / 2).prop_map(Deed::Pass),
        1 => Just(Deed::Publish),
    ];
    prop::collection::vec(deed, 1..80)
}

/// One session from its opening to its end; a name may have several, one after another.
#[derive(Debug)]
struct Life {
    seed: u64,
    version: u64,
    run: Option<u8>,
    former: BTreeSet<u8>,
    steps: u64,
    ended: bool,
    used: u64,
}

impl Life {
    fn begin(&mut self, run: u8) {
        self.former.extend(self.run.replace(run));
        self.steps = 0;
    }

    /// The run that is new, if it is; the code of the error if it is a former one.
    fn judge(&self, run: Option<u8>) -> Result<Option<u8>, &'static str> {
        match run.filter(|run| self.run != Some(*run)) {
            Some(run) if self.former.contains(&run) => Err("run_fenced"),
            new => Ok(new),
        }
    }
}

/// What an answer says: step, and the values of every UAV.
type Told = (u64, [f32; 3]);

enum Asked {
    Open { seed: u64, run: Option<u8>, fresh: bool },
    Act { step: Option<u64>, run: Option<u8> },
    Close,
}

struct Call {
    life: usize,
    asked: Asked,
    answer: BoxFuture<'static, Result<Option<Told>, Error>>,
}

struct Model {
    server: Server,
    app: Arc<App>,
    policy: String,
    by_callers: bool,
    now: u64,
    lives: Vec<Life>,
    names: BTreeMap<u8, usize>,
    expired: BTreeSet<u8>,
    version: u64,
    calls: Vec<Call>,
    /// Answers given, to know that the test tests something.
    answered: usize,
}

impl Model {
    fn session(&self, name: u8) -> String {
        format!("{}-{name}", self.policy)
    }

    fn publish(&mut self) {
        self.version += 1;
        let policy = Stamped { version: self.version, by_callers: self.by_callers };
        self.server.add(&self.policy, self.version, Arc::new(policy));
    }

    /// The open session of `name`, or the code of the error; as the table has it.
    fn find(&mut self, name: u8) -> Result<usize, &'static str> {
        match self.names.get(&name) {
            Some(&life) if self.now - self.lives[life].used <= TTL => {
                self.lives[life].used = self.now;
                Ok(life)
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
        let seed = self.lives.len() as u64 + 100;
        let known = self.names.get(&name).copied().filter(|&life| self.now - self.lives[life].used <= TTL);
        let life = known.unwrap_or_else(|| {
            let (version, used) = (self.version, self.now);
            self.lives.push(Life { seed, version, run, former: BTreeSet::new(), steps: 0, ended: false, used });
            self.expired.remove(&name);
            self.names.insert(name, self.lives.len() - 1);
            self.lives.len() - 1
        });
        let (app, policy) = (self.app.clone(), self.policy.parse().unwrap());
        let how = SessionOptions { id: Some(self.session(name)), run_id: run.map(|run| run.to_string()), seed: Some(seed) };
        let answer = async move { sessions::open(&app, &policy, how).await.map(|_| None) }.boxed();
        self.begin(Call { life, asked: Asked::Open { seed, run, fresh: known.is_none() }, answer });
    }

    fn act(&mut self, name: u8, step: Step, run: Option<u8>) {
        let found = self.find(name);
        let steps = found.map_or(0, |life| self.lives[life].steps);
        let step = match step {
            Step::Unsaid => None,
            Step::Next => Some(steps),
            Step::Last => Some(steps.saturating_sub(1)),
            Step::Wrong => Some(steps + 3),
        };
        let request = act::Request {
            policy: None,
            observation: Observation::try_from(scene(2, 3, self.now + steps)).unwrap(),
            memory: act::Memory::Session(self.session(name)),
            step,
            run_id: run.map(|run| run.to_string()),
            seed: None,
        };
        let app = self.app.clone();
        let answer = async move {
            let answer = act::act(&app, request, None).await?;
            let values: [f32; 3] = answer.decision.q_values[..3].try_into().unwrap();
            assert_eq!(answer.decision.q_values[3..], values, "one fleet, one memory");
            assert_eq!(answer.decision.headings, [values[0] as u8 % 3; 2]);
            Ok(Some((answer.decision.step, values)))
        }
        .boxed();
        self.start(found, Asked::Act { step, run }, answer);
    }

    fn close(&mut self, name: u8) {
        let found = self.find(name);
        if found.is_ok() {
            self.names.remove(&name);
        }
        let (app, id) = (self.app.clone(), self.session(name));
        let answer = async move { sessions::close(&app, &id).await.map(|_| None) }.boxed();
        self.start(found, Asked::Close, answer);
    }

    /// Begins a call that finds a session, or is refused at once.
    fn start(
        &mut self,
        found: Result<usize, &'static str>,
        asked: Asked,
        answer: BoxFuture<'static, Result<Option<Told>, Error>>,
    ) {
        match found {
            Ok(life) => self.begin(Call { life, asked, answer }),
            Err(code) => {
                let refused = answer.now_or_never().expect("refused at once");
                assert_eq!(refused.map_err(|e| e.code().as_str()), Err(code));
            }
        }
    }

    /// The first poll finds the session, so it is part of the beginning.
    fn begin(&mut self, call: Call) {
        self.calls.push(call);
        self.poll(self.calls.len() - 1);
    }

    fn poll(&mut self, at: usize) {
        let waker = futures::task::noop_waker();
        let polled = self.calls[at].answer.poll_unpin(&mut std::task::Context::from_waker(&waker));
        if let Poll::Ready(answer) = polled {
            let Call { life, asked, .. } = self.calls.swap_remove(at);
            let expected = self.expect(life, &asked);
            assert_eq!(answer.map_err(|e| e.code().as_str()), expected);
            self.answered += 1;
        }
    }

    /// What a call is answered that ends now; the model moves on.
    fn expect(&mut self, life: usize, asked: &Asked) -> Result<Option<Told>, &'static str> {
        let now = self.now;
        let life = &mut self.lives[life];
        match *asked {
            Asked::Close => life.ended = true,
            Asked::Open { fresh: true, .. } => {}
            Asked::Open { seed, run, .. } => {
                if life.ended {
                    return Err("already_exists");
                }
                match life.judge(run)? {
                    Some(run) => {
                        life.begin(run);
                        life.seed = seed;
                        life.used = now;
                    }
                    // Asked the same once more.
                    None if life.steps == 0 && (life.seed, life.run) == (seed, run) => life.used = now,
                    None => return Err("already_exists"),
                }
            }
            Asked::Act { step, run } => {
                if life.ended {
                    return Err("not_found");
                }
                let new = life.judge(run)?;
                let steps = if new.is_some() { 0 } else { life.steps };
                let step = step.unwrap_or(steps);
                let told = Ok(Some((step, [life.seed as f32, step as f32, life.version as f32])));
                if new.is_none() && step + 1 == steps {
                    return told;
                }
                if step != steps {
                    return Err("wrong_step");
                }
                if let Some(run) = new {
                    life.begin(run);
                }
                life.steps = step + 1;
                life.used = now;
                return told;
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
fn no_interleaving_mixes_two_sessions() {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap();
    let mut server = Some(runtime.block_on(Server::start()));
    let (mut case, mut answered) = (0, 0);
    let mut runner = TestRunner::new(ProptestConfig { cases: 400, failure_persistence: None, ..ProptestConfig::default() });
    let cell = std::cell::RefCell::new((&mut server, &mut case, &mut answered));
    runner
        .run(&(deeds(), any::<bool>()), |(deeds, by_callers)| {
            let mut held = cell.borrow_mut();
            let (server, case, answered) = &mut *held;
            **case += 1;
            let server_now = server.take().expect("one case at a time");
            let app = server_now.app.clone();
            let mut model = Model {
                server: server_now,
                app,
                policy: format!("case-{case}"),
                by_callers,
                now: 0,
                lives: Vec::new(),
                names: BTreeMap::new(),
                expired: BTreeSet::new(),
                version: 0,
                calls: Vec::new(),
                answered: 0,
            };
            model.publish();
            let outcome = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
                let _inside = runtime.enter();
                for deed in deeds {
                    match deed {
                        Deed::Open { name, run } => model.open(name, run),
                        Deed::Act { name, step, run } => model.act(name, step, run),
                        Deed::Close { name } => model.close(name),
                        Deed::Publish => model.publish(),
                        Deed::Pass(seconds) => {
                            model.now += seconds;
                            model.server.pass(seconds);
                        }
                        Deed::Poll(which) if !model.calls.is_empty() => model.poll(which.index(model.calls.len())),
                        Deed::Drop(which) if !model.calls.is_empty() => {
                            model.calls.swap_remove(which.index(model.calls.len()));
                        }
                        Deed::Poll(_) | Deed::Drop(_) => {}
                    }
                }
                runtime.block_on(model.drain());
            }));
            **answered += model.answered;
            model.calls.clear();
            **server = Some(model.server);
            outcome.map_err(|panic| {
                let text = panic.downcast_ref::<String>().cloned().unwrap_or_else(|| "see above".to_owned());
                TestCaseError::fail(text)
            })
        })
        .unwrap();
    assert!(answered > 2000, "{answered} calls were answered");
}
