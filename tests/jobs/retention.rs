//! Old jobs are deleted by the rules of retention, and what others still need stays.

use jiff::{SignedDuration, Timestamp};
use qedgix::store::{EndedAttempt, JobAction, JobId, JobSpec, NewJob, Store, SubmitResult, WorkerResult};
use qedgix::train_config::{Algorithm, Preset, TrainConfig};
use serde_json::json;

use super::harness::{Rest, with, within};
use super::process::{POLL, Process, serve};

fn at(second: i64) -> Timestamp {
    Timestamp::UNIX_EPOCH + SignedDuration::from_secs(second)
}

fn new(spec: JobSpec, parent: Option<JobId>) -> NewJob {
    NewJob {
        id: JobId(uuid::Uuid::now_v7()),
        owner: None,
        any_name: false,
        spec,
        notes: String::new(),
        beginning: None,
        parent,
        now: at(0),
        idempotency: None,
    }
}

fn spec() -> JobSpec {
    JobSpec::train(TrainConfig::preset(Algorithm::Qmix, Preset::Practical))
}

async fn submit(store: &Store, spec: JobSpec) -> JobId {
    let SubmitResult::Created(job) = store.submit_job(new(spec, None)).await.unwrap() else { panic!("a new job") };
    job.id
}

/// Ends a queued job at this second.
async fn end(store: &Store, job: JobId, second: i64, permanent: Option<&str>) {
    let lease = store.begin_attempt(job, [0; 32], at(second)).await.unwrap().unwrap();
    let failed = permanent.map(|reason| WorkerResult::Failed { reason: reason.into(), permanent: true });
    let result = &failed.unwrap_or(WorkerResult::Succeeded);
    let ended = EndedAttempt { lease, result, publish: None, document: None, max_attempts: 1, now: at(second) };
    store.end_attempt(ended).await.unwrap().unwrap();
}

#[tokio::test]
async fn what_ended_first_is_deleted_first_and_what_others_need_stays() {
    let dir = tempfile::tempdir().unwrap();
    let store = Store::open(dir.path()).await.unwrap();
    let mut ended = Vec::new();
    for second in [30, 10, 20] {
        let job = submit(&store, spec()).await;
        end(&store, job, second, None).await;
        ended.push(job);
    }
    let running = submit(&store, spec()).await;
    // A failed job that another one waits for.
    let needed = submit(&store, spec()).await;
    end(&store, needed, 5, Some("by the test")).await;
    let waiting = submit(&store, JobSpec { after: vec![needed], ..spec() }).await;
    let old = async |keep, before| store.old_jobs(keep, before, 10).await.unwrap();

    assert_eq!(old(0, None).await, []);
    assert_eq!(old(2, None).await, [ended[1]]);
    assert_eq!(old(1, None).await, [ended[1], ended[2]]);
    assert_eq!(old(0, Some(at(20))).await, [ended[1]]);
    assert_eq!(old(9, Some(at(21))).await, [ended[1], ended[2]]);
    assert_eq!(store.old_jobs(1, None, 1).await.unwrap(), [ended[1]]);
    store.change_job(waiting, JobAction::Cancel, at(40)).await.unwrap();
    assert_eq!(old(0, Some(at(10))).await, [needed]);
    assert!(!old(0, Some(at(1000))).await.contains(&running));
}

#[tokio::test]
async fn the_jobs_of_a_sweep_go_with_it_and_not_before() {
    let dir = tempfile::tempdir().unwrap();
    let store = Store::open(dir.path()).await.unwrap();
    let sweep = new(JobSpec { kind: qedgix::store::JobKind::Sweep, config: None, ..spec() }, None);
    let id = sweep.id;
    let jobs: Vec<NewJob> = (0..2).map(|_| new(spec(), Some(id))).collect();
    let children: Vec<JobId> = jobs.iter().map(|job| job.id).collect();
    store.submit_sweep(sweep, &jobs).await.unwrap();
    let waiting = submit(&store, JobSpec { after: vec![children[0]], ..spec() }).await;
    let old = async || store.old_jobs(0, Some(at(1000)), 10).await.unwrap();
    end(&store, children[0], 1, Some("by the test")).await;
    assert_eq!(old().await, [], "the sweep lives");
    end(&store, children[1], 2, None).await;
    assert_eq!(old().await, [], "a job comes after one of its jobs");
    // Deleting the sweep anyway cancels what waits for a job that will never succeed.
    store.change_job(id, JobAction::Delete, at(3)).await.unwrap();
    assert_eq!(store.job(waiting).await.unwrap().unwrap().state, qedgix::store::JobState::Cancelled);
    assert_eq!(old().await, [waiting]);
}

#[tokio::test]
async fn a_server_deletes_old_jobs_and_keeps_their_policies() {
    let dir = tempfile::tempdir().unwrap();
    let start = async |flags: &[&str]| {
        let mut command = serve(dir.path());
        command.args(["--cpu-budget", "1"]).args(flags);
        let process = Process::start(command).await;
        let rest = Rest::new(format!("http://{}", process.http));
        (process, rest)
    };
    let (mut process, rest) = start(&[]).await;
    for seed in [1, 2] {
        let id = rest.submit(&with(&json!({"name": "mine", "seed": seed}))).await;
        rest.reaches(&id, "succeeded").await;
    }
    process.terminate().await;
    let (_process, rest) = start(&["--keep-jobs", "1"]).await;
    within(async {
        while rest.get("/v1/jobs").await["jobs"].as_array().unwrap().len() > 1 {
            tokio::time::sleep(POLL).await;
        }
    })
    .await;
    assert_eq!(rest.get("/v1/jobs").await["jobs"][0]["policy"], "mine:2");
    let first = rest.request(reqwest::Method::GET, "/v1/policies/mine:1/export").send().await.unwrap();
    assert!(first.status().is_success(), "{first:?}");
    let metrics = rest.request(reqwest::Method::GET, "/metrics").send().await.unwrap().text().await.unwrap();
    assert!(metrics.lines().any(|line| line == "qedgix_jobs_deleted_total 1"), "{metrics}");
}
