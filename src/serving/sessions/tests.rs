use super::*;
use crate::clock::ManualClock;
use crate::invalid::Invalid;
use crate::policy::{Policy, RequiredInput};
use crate::serving::{Fleet, Limits, Outcome, Timings};

struct Nothing;

impl Policy for Nothing {
    fn actions(&self) -> usize {
        8
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
    Arc::new(LoadedPolicy::baseline(reference, "", Arc::new(Nothing), Timestamp::UNIX_EPOCH))
}

fn sessions(max: usize) -> (Sessions, impl Fn(u64)) {
    let time = ManualClock::new(Timestamp::UNIX_EPOCH);
    let sessions = Sessions::new(Limits { ttl: Duration::from_secs(600), max }, time.clock());
    (sessions, move |seconds| time.advance(Duration::from_secs(seconds)))
}

fn named(id: &str) -> Opened {
    Opened { id: Some(id.into()), ..Opened::default() }
}

fn code(error: &Error) -> &'static str {
    match error {
        Error::Precondition { code, .. } => code.as_str(),
        Error::Unknown { .. } => "unknown",
        Error::Exists(_) => "exists",
        Error::Busy(_) => "busy",
        Error::Invalid(_) => "invalid",
        _ => "other",
    }
}

fn fleet(ids: [&str; 2]) -> Fleet {
    Fleet { uavs: ids.map(str::to_owned).to_vec(), users: vec!["user".into()] }
}

async fn fly(session: &Session, step: Option<u64>, run: Option<&str>) -> Result<(u64, Vec<f32>), &'static str> {
    match session.turn(&fleet(["a", "b"]), step, run).await {
        Err(error) => Err(code(&error)),
        Ok(Turn::Repeat(answer)) => Ok((answer.step, answer.q_values)),
        Ok(Turn::Next(next)) => {
            let memory: Vec<f32> = next.memory.iter().map(|m| m + 1.0).collect();
            let outcome = Outcome { memory: memory.clone(), headings: vec![0, 0], q_values: memory, timings: Timings::default() };
            let answer = next.commit(outcome);
            Ok((answer.step, answer.q_values))
        }
    }
}

#[tokio::test]
async fn steps_follow_each_other_and_the_last_may_be_repeated() {
    let (sessions, _) = sessions(10);
    sessions.open(policy("p"), Opened { seed: Some(0), ..named("s") }).await.unwrap();
    let s = sessions.get("s").unwrap();
    assert_eq!(fly(&s, Some(1), None).await, Err("wrong_step"));
    assert_eq!(fly(&s, Some(0), None).await, Ok((0, vec![1.0; 2])));
    assert_eq!(fly(&s, Some(0), None).await, Ok((0, vec![1.0; 2])));
    assert_eq!(fly(&s, Some(1), None).await, Ok((1, vec![2.0; 2])));
    assert_eq!(fly(&s, None, None).await, Ok((2, vec![3.0; 2])));
    assert_eq!(fly(&s, Some(2), None).await, Ok((2, vec![3.0; 2])));
    for wrong in [0, 1, 4, u64::MAX] {
        assert_eq!(fly(&s, Some(wrong), None).await, Err("wrong_step"), "{wrong}");
    }
    assert_eq!(sessions.describe("s").unwrap().steps, 3);
}

#[tokio::test]
async fn a_turn_that_is_dropped_changes_nothing() {
    let (sessions, _) = sessions(10);
    sessions.open(policy("p"), Opened { seed: Some(0), run_id: Some("r1".into()), ..named("s") }).await.unwrap();
    let s = sessions.get("s").unwrap();
    fly(&s, Some(0), None).await.unwrap();
    drop(s.turn(&fleet(["a", "b"]), Some(1), None).await.unwrap());
    drop(s.turn(&fleet(["c", "d"]), Some(0), Some("r2")).await.unwrap());
    assert_eq!(fly(&s, Some(0), Some("r1")).await, Ok((0, vec![1.0; 2])));
    assert_eq!(fly(&s, Some(1), Some("r1")).await, Ok((1, vec![2.0; 2])));
}

#[tokio::test]
async fn a_new_run_starts_over_and_fences_the_former() {
    let (sessions, _) = sessions(10);
    sessions.open(policy("p"), Opened { seed: Some(0), run_id: Some("r1".into()), ..named("s") }).await.unwrap();
    let s = sessions.get("s").unwrap();
    fly(&s, Some(0), Some("r1")).await.unwrap();
    fly(&s, Some(1), Some("r1")).await.unwrap();
    assert_eq!(fly(&s, Some(2), Some("r2")).await, Err("wrong_step"));
    assert_eq!(fly(&s, Some(2), Some("r1")).await, Ok((2, vec![3.0; 2])), "a refused run resets nothing");
    assert_eq!(fly(&s, Some(0), Some("r2")).await, Ok((0, vec![1.0; 2])));
    assert_eq!(fly(&s, Some(3), Some("r1")).await, Err("run_fenced"));
    assert_eq!(fly(&s, Some(0), Some("r1")).await, Err("run_fenced"));
    assert_eq!(fly(&s, Some(1), None).await, Ok((1, vec![2.0; 2])), "no run_id means the current run");
    let again = Opened { seed: Some(7), run_id: Some("r3".into()), ..named("s") };
    assert_eq!(sessions.open(policy("p"), again).await.unwrap().steps, 0);
    assert_eq!(fly(&s, Some(0), Some("r3")).await, Ok((0, vec![8.0; 2])));
    let fenced = Opened { run_id: Some("r2".into()), ..named("s") };
    assert_eq!(code(&sessions.open(policy("p"), fenced).await.unwrap_err()), "run_fenced");
}

#[tokio::test]
async fn ids_are_fixed_by_the_first_slot_of_a_run() {
    let (sessions, _) = sessions(10);
    sessions.open(policy("p"), named("s")).await.unwrap();
    let s = sessions.get("s").unwrap();
    fly(&s, None, None).await.unwrap();
    let other = s.turn(&fleet(["a", "c"]), None, None).await.map(|_| ()).unwrap_err();
    assert!(matches!(&other, Error::Invalid(e) if e.field == "uavs" && e.value.as_deref() == Some("\"c\" instead of \"b\"")));
    assert!(s.turn(&fleet(["a", "c"]), None, Some("another run")).await.is_ok());
}

#[tokio::test]
async fn opening_twice_is_a_retry_only_if_nothing_differs() {
    let (sessions, _) = sessions(10);
    let first = sessions.open(policy("p"), named("s")).await.unwrap();
    assert_eq!(sessions.open(policy("p"), named("s")).await.unwrap(), first);
    assert_eq!(code(&sessions.open(policy("q"), named("s")).await.unwrap_err()), "exists");
    let seeded = Opened { seed: Some(1), ..named("s") };
    assert_eq!(code(&sessions.open(policy("p"), seeded).await.unwrap_err()), "exists");
    fly(&sessions.get("s").unwrap(), None, None).await.unwrap();
    assert_eq!(code(&sessions.open(policy("p"), named("s")).await.unwrap_err()), "exists");
    assert_ne!(sessions.open(policy("p"), Opened::default()).await.unwrap().id, "s");
}

#[tokio::test]
async fn idle_sessions_expire_and_say_so() {
    let (sessions, pass) = sessions(2);
    sessions.open(policy("p"), named("s")).await.unwrap();
    pass(600);
    sessions.get("s").unwrap();
    pass(599);
    sessions.get("s").unwrap();
    pass(601);
    assert_eq!(code(&sessions.get("s").unwrap_err()), "session_expired");
    assert_eq!(code(&sessions.close("s").await.unwrap_err()), "session_expired");
    assert_eq!(code(&sessions.get("never").unwrap_err()), "unknown");
    sessions.open(policy("p"), named("s")).await.unwrap();
    assert!(sessions.get("s").is_ok(), "a name may be used again");
    sessions.close("s").await.unwrap();
    assert_eq!(code(&sessions.get("s").unwrap_err()), "unknown");
}

#[tokio::test]
async fn the_number_of_sessions_and_of_remembered_ones_is_bounded() {
    let (sessions, pass) = sessions(2);
    sessions.open(policy("p"), named("a")).await.unwrap();
    sessions.open(policy("p"), named("b")).await.unwrap();
    assert_eq!(code(&sessions.open(policy("p"), named("c")).await.unwrap_err()), "busy");
    pass(601);
    sessions.open(policy("p"), named("c")).await.unwrap();
    assert_eq!(sessions.len(), 1, "the idle ones made room");
    pass(601);
    sessions.sweep();
    assert!(sessions.is_empty());
    let codes = ["a", "b", "c"].map(|id| code(&sessions.get(id).unwrap_err()));
    assert_eq!(codes.iter().filter(|c| **c == "session_expired").count(), 2);
    assert_eq!(codes[2], "session_expired", "the last to expire is remembered");
}

#[tokio::test]
async fn a_waiting_caller_of_a_closed_session_is_told() {
    let (sessions, _) = sessions(2);
    sessions.open(policy("p"), named("s")).await.unwrap();
    let s = sessions.get("s").unwrap();
    sessions.close("s").await.unwrap();
    assert_eq!(fly(&s, None, None).await, Err("unknown"));
}
