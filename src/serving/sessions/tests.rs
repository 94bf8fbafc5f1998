use std::time::Duration;

use jiff::Timestamp;

use super::seed::session_seed;
use super::*;
use crate::clock::ManualClock;
use crate::invalid::Invalid;
use crate::policy::{EnvParams, Policy, RequiredInput};
use crate::serving::{Decision, FleetIds, FleetMemory, Limits, ListedUsers, PolicyRef, TaskOutput};

/// Its memory is the seed at first; it decides nothing.
struct SeedPolicy;

impl Policy for SeedPolicy {
    fn actions(&self) -> usize {
        8
    }
    fn needs(&self) -> RequiredInput {
        RequiredInput::Detections
    }
    fn env(&self) -> EnvParams {
        EnvParams::default()
    }
    fn check_fleet(&self, _: usize, _: usize) -> Result<(), Invalid> {
        Ok(())
    }
    fn memory_len(&self, uavs: usize, _: usize) -> usize {
        uavs
    }
    fn start(&self, _: usize, _: usize, seed: u64, memory: &mut [f32]) {
        memory.fill(seed as f32);
    }
    fn act(&self, _: &mut [crate::policy::FleetStep<'_>]) {}
}

fn policy(name: &str) -> Arc<LoadedPolicy> {
    let reference = PolicyRef { name: name.into(), version: 1, digest: [0; 32] };
    Arc::new(LoadedPolicy::baseline(reference, "", Arc::new(SeedPolicy), Timestamp::UNIX_EPOCH))
}

fn sessions(max: usize) -> (Sessions, impl Fn(u64)) {
    let time = ManualClock::new(Timestamp::UNIX_EPOCH);
    let sessions = Sessions::new(Limits { ttl: Duration::from_secs(600), max, memory: 1 << 20 }, time.clock());
    (sessions, move |seconds| time.advance(Duration::from_secs(seconds)))
}

fn named(id: &str) -> SessionOptions {
    SessionOptions { id: Some(id.into()), ..SessionOptions::default() }
}

fn code(error: &Error) -> &'static str {
    match error {
        Error::Precondition { code, .. } => code.as_str(),
        Error::NotFound { .. } => "unknown",
        Error::Conflict(_) => "exists",
        Error::Busy(_) => "busy",
        Error::Invalid(_) => "invalid",
        _ => "other",
    }
}

fn fleet(ids: [&str; 2]) -> FleetIds {
    FleetIds { uavs: ids.map(str::to_owned).to_vec(), users: vec!["user".into()] }
}

async fn begin<'a>(session: &'a Session, uavs: [&str; 2], step: Option<u64>, run: Option<&str>) -> Result<StepStart<'a>, Error> {
    let fleet = fleet(uavs);
    session.begin_step(Listed { fleet: &fleet, users: ListedUsers::Named }, step, run, 100).await
}

async fn step_once(session: &Session, step: Option<u64>, run: Option<&str>) -> Result<(u64, Vec<f32>), &'static str> {
    match begin(session, ["a", "b"], step, run).await {
        Err(error) => Err(code(&error)),
        Ok(StepStart::Repeated(answer)) => Ok((answer.step, answer.q_values)),
        Ok(StepStart::Next(next)) => {
            let memory = next.memory.clone().unpack(&SeedPolicy, (2, 1)).unwrap();
            let memory: Vec<f32> = memory.iter().map(|m| m + 1.0).collect();
            let decision = Decision { step: next.step, headings: vec![0, 0], q_values: memory.clone(), ..Decision::default() };
            next.commit(TaskOutput { memory: FleetMemory::Plain(memory), decision })
                .map(|answer| (answer.step, answer.q_values))
                .map_err(|e| code(&e))
        }
    }
}

#[tokio::test]
async fn steps_are_sequential_and_the_last_may_be_repeated() {
    let (sessions, _) = sessions(10);
    sessions.open(&Owner::NOBODY, policy("p"), SessionOptions { seed: Some(0), ..named("s") }).await.unwrap();
    let s = sessions.get(&Owner::NOBODY, "s").unwrap();
    assert_eq!(step_once(&s, Some(1), None).await, Err("wrong_step"));
    assert_eq!(step_once(&s, Some(0), None).await, Ok((0, vec![1.0; 2])));
    assert_eq!(step_once(&s, Some(0), None).await, Ok((0, vec![1.0; 2])));
    assert_eq!(step_once(&s, Some(1), None).await, Ok((1, vec![2.0; 2])));
    assert_eq!(step_once(&s, None, None).await, Ok((2, vec![3.0; 2])));
    assert_eq!(step_once(&s, Some(2), None).await, Ok((2, vec![3.0; 2])));
    for wrong in [0, 1, 4, u64::MAX] {
        assert_eq!(step_once(&s, Some(wrong), None).await, Err("wrong_step"), "{wrong}");
    }
    assert_eq!(sessions.describe(&Owner::NOBODY, "s").unwrap().steps, 3);
}

#[tokio::test]
async fn dropped_step_leaves_the_session_unchanged() {
    let (sessions, _) = sessions(10);
    sessions
        .open(&Owner::NOBODY, policy("p"), SessionOptions { seed: Some(0), run_id: Some("r1".into()), ..named("s") })
        .await
        .unwrap();
    let s = sessions.get(&Owner::NOBODY, "s").unwrap();
    step_once(&s, Some(0), None).await.unwrap();
    drop(begin(&s, ["a", "b"], Some(1), None).await.unwrap());
    drop(begin(&s, ["c", "d"], Some(1), None).await.unwrap());
    drop(begin(&s, ["c", "d"], Some(0), Some("r2")).await.unwrap());
    assert_eq!(step_once(&s, Some(0), Some("r1")).await, Ok((0, vec![1.0; 2])));
    assert_eq!(step_once(&s, Some(1), Some("r1")).await, Ok((1, vec![2.0; 2])));
}

#[tokio::test]
async fn new_run_restarts_the_session_and_fences_the_former_run() {
    let (sessions, _) = sessions(10);
    sessions
        .open(&Owner::NOBODY, policy("p"), SessionOptions { seed: Some(0), run_id: Some("r1".into()), ..named("s") })
        .await
        .unwrap();
    let s = sessions.get(&Owner::NOBODY, "s").unwrap();
    step_once(&s, Some(0), Some("r1")).await.unwrap();
    step_once(&s, Some(1), Some("r1")).await.unwrap();
    assert_eq!(step_once(&s, Some(2), Some("r2")).await, Err("wrong_step"));
    assert_eq!(step_once(&s, Some(2), Some("r1")).await, Ok((2, vec![3.0; 2])), "a rejected run does not reset the session");
    assert_eq!(step_once(&s, Some(0), Some("r2")).await, Ok((0, vec![1.0; 2])));
    assert_eq!(step_once(&s, Some(3), Some("r1")).await, Err("run_fenced"));
    assert_eq!(step_once(&s, Some(0), Some("r1")).await, Err("run_fenced"));
    assert_eq!(step_once(&s, Some(1), None).await, Ok((1, vec![2.0; 2])), "without run_id, the current run continues");
    let restarted = SessionOptions { seed: Some(7), run_id: Some("r3".into()), ..named("s") };
    assert_eq!(sessions.open(&Owner::NOBODY, policy("p"), restarted).await.unwrap().steps, 0);
    assert_eq!(step_once(&s, Some(0), Some("r3")).await, Ok((0, vec![8.0; 2])));
    let fenced = SessionOptions { run_id: Some("r2".into()), ..named("s") };
    assert_eq!(code(&sessions.open(&Owner::NOBODY, policy("p"), fenced).await.unwrap_err()), "run_fenced");
}

#[tokio::test]
async fn a_repetition_lists_the_same_uavs() {
    let (sessions, _) = sessions(10);
    sessions.open(&Owner::NOBODY, policy("p"), named("s")).await.unwrap();
    let s = sessions.get(&Owner::NOBODY, "s").unwrap();
    step_once(&s, None, None).await.unwrap();
    let other = begin(&s, ["a", "c"], Some(0), None).await.map(|_| ()).unwrap_err();
    assert!(matches!(&other, Error::Invalid(e) if e.field == "uavs" && e.value.as_deref() == Some("\"c\" instead of \"b\"")));
    let next = begin(&s, ["a", "c"], None, None).await;
    assert!(matches!(next, Ok(StepStart::Next(next)) if next.change.as_ref().is_some_and(|change| change.after == (3, 0))));
}

#[tokio::test]
async fn opening_twice_is_a_retry_only_with_equal_options() {
    let (sessions, _) = sessions(10);
    let first = sessions.open(&Owner::NOBODY, policy("p"), named("s")).await.unwrap();
    assert_eq!(sessions.open(&Owner::NOBODY, policy("p"), named("s")).await.unwrap(), first);
    assert_eq!(code(&sessions.open(&Owner::NOBODY, policy("q"), named("s")).await.unwrap_err()), "exists");
    let seeded = SessionOptions { seed: Some(1), ..named("s") };
    assert_eq!(code(&sessions.open(&Owner::NOBODY, policy("p"), seeded).await.unwrap_err()), "exists");
    step_once(&sessions.get(&Owner::NOBODY, "s").unwrap(), None, None).await.unwrap();
    assert_eq!(code(&sessions.open(&Owner::NOBODY, policy("p"), named("s")).await.unwrap_err()), "exists");
    assert_ne!(sessions.open(&Owner::NOBODY, policy("p"), SessionOptions::default()).await.unwrap().id, "s");
}

#[tokio::test]
async fn idle_session_expires_with_its_own_error() {
    let (sessions, pass) = sessions(2);
    sessions.open(&Owner::NOBODY, policy("p"), named("s")).await.unwrap();
    pass(600);
    sessions.get(&Owner::NOBODY, "s").unwrap();
    pass(599);
    sessions.get(&Owner::NOBODY, "s").unwrap();
    pass(601);
    assert_eq!(code(&sessions.get(&Owner::NOBODY, "s").unwrap_err()), "session_expired");
    assert_eq!(code(&sessions.close(&Owner::NOBODY, "s").await.unwrap_err()), "session_expired");
    assert_eq!(code(&sessions.get(&Owner::NOBODY, "never").unwrap_err()), "unknown");
    sessions.open(&Owner::NOBODY, policy("p"), named("s")).await.unwrap();
    assert!(sessions.get(&Owner::NOBODY, "s").is_ok(), "a name may be used again");
    sessions.close(&Owner::NOBODY, "s").await.unwrap();
    assert_eq!(code(&sessions.get(&Owner::NOBODY, "s").unwrap_err()), "unknown");
}

#[tokio::test]
async fn corrected_wall_time_neither_expires_nor_keeps_sessions() {
    let time = ManualClock::new(Timestamp::UNIX_EPOCH);
    let sessions = Sessions::new(Limits { ttl: Duration::from_secs(600), max: 2, memory: 1 << 20 }, time.clock());
    sessions.open(&Owner::NOBODY, policy("p"), named("s")).await.unwrap();
    time.set_wall(Timestamp::from_second(1_000_000).unwrap());
    sessions.get(&Owner::NOBODY, "s").unwrap();
    time.advance(Duration::from_secs(601));
    time.set_wall(Timestamp::UNIX_EPOCH);
    assert_eq!(code(&sessions.get(&Owner::NOBODY, "s").unwrap_err()), "session_expired");
}

#[tokio::test]
async fn numbers_of_open_and_of_expired_sessions_are_bounded() {
    let (sessions, pass) = sessions(2);
    sessions.open(&Owner::NOBODY, policy("p"), named("a")).await.unwrap();
    sessions.open(&Owner::NOBODY, policy("p"), named("b")).await.unwrap();
    assert_eq!(code(&sessions.open(&Owner::NOBODY, policy("p"), named("c")).await.unwrap_err()), "busy");
    pass(601);
    sessions.open(&Owner::NOBODY, policy("p"), named("c")).await.unwrap();
    assert_eq!(sessions.len(), 1, "idle sessions were removed");
    pass(601);
    sessions.remove_expired();
    assert!(sessions.is_empty());
    let codes = ["a", "b", "c"].map(|id| code(&sessions.get(&Owner::NOBODY, id).unwrap_err()));
    assert_eq!(codes.iter().filter(|c| **c == "session_expired").count(), 2);
    assert_eq!(codes[2], "session_expired", "the newest expired name is remembered");
}

#[tokio::test]
async fn step_of_a_closed_session_is_rejected() {
    let (sessions, _) = sessions(2);
    sessions.open(&Owner::NOBODY, policy("p"), named("s")).await.unwrap();
    let s = sessions.get(&Owner::NOBODY, "s").unwrap();
    sessions.close(&Owner::NOBODY, "s").await.unwrap();
    assert_eq!(step_once(&s, None, None).await, Err("unknown"));
}

#[tokio::test]
async fn memory_of_all_sessions_is_bounded_in_bytes() {
    let time = ManualClock::new(Timestamp::UNIX_EPOCH);
    let limits = Limits { ttl: Duration::from_secs(600), max: 1000, memory: 16 << 10 };
    let sessions = Sessions::new(limits, time.clock());
    let mut opened = 0;
    while sessions.open(&Owner::NOBODY, policy("p"), named(&opened.to_string())).await.is_ok() {
        opened += 1;
    }
    assert!((4..=8).contains(&opened), "{opened} sessions");
    assert!(sessions.memory_used() <= 16 << 10);
    // A retry succeeds although no memory is left.
    assert!(sessions.open(&Owner::NOBODY, policy("p"), named("0")).await.is_ok());
    let session = sessions.get(&Owner::NOBODY, "0").unwrap();
    let mut taken = sessions.charge_memory(&Owner::NOBODY, (16 << 10) - sessions.memory_used()).unwrap();
    assert_eq!(step_once(&session, Some(0), None).await, Err("busy"), "the first step needs memory");
    assert_eq!(sessions.describe(&Owner::NOBODY, "0").unwrap().steps, 0);
    sessions.close(&Owner::NOBODY, "1").await.unwrap();
    assert_eq!(step_once(&session, Some(0), None).await, Ok((0, vec![session_seed("0", None) as f32 + 1.0; 2])));
    // The memory of a policy may grow. Refused, the step leaves the session as it was.
    taken.resize(taken.bytes() + (16 << 10) - sessions.memory_used()).unwrap();
    let StepStart::Next(next) = begin(&session, ["a", "b"], Some(1), None).await.unwrap() else { panic!("the next step") };
    let decision = Decision { step: 1, headings: vec![0, 0], ..Decision::default() };
    let memory = FleetMemory::Plain(vec![0.0; 100]);
    assert_eq!(next.commit(TaskOutput { memory: memory.clone(), decision: decision.clone() }).map_err(|e| code(&e)), Err("busy"));
    drop(taken);
    let StepStart::Next(next) = begin(&session, ["a", "b"], Some(1), None).await.unwrap() else { panic!("the next step") };
    assert!(next.memory.bytes() < 100);
    next.commit(TaskOutput { memory, decision }).unwrap();
    drop(session);
    // Idle sessions give way to new ones.
    time.advance(Duration::from_secs(601));
    drop(sessions.charge_memory(&Owner::NOBODY, 16 << 10).unwrap());
    assert_eq!((sessions.len(), sessions.memory_used()), (0, 0));
}
