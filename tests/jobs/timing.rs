//! Times of the scheduler, with a clock that the test moves: timeouts of jobs, and pauses between attempts.

use std::sync::Arc;
use std::time::Duration;

use futures::FutureExt;
use futures::future::BoxFuture;
use jiff::Timestamp;
use qedgix::clock::ManualClock;
use qedgix::draining::Draining;
use qedgix::jobs::{Executor, Launch, Scheduler, SchedulerConfig, WorkerExit};
use qedgix::store::{Job, JobId, JobLimits, JobSpec, JobState, NewJob, Store};
use qedgix::train_config::{Algorithm, Preset, TrainConfig};

use super::harness::within;

/// Starts workers that run until they are killed, or that fail at once.
struct Workers {
    fail: bool,
}

impl Executor for Workers {
    fn start(&self, launch: Launch) -> BoxFuture<'_, std::io::Result<BoxFuture<'static, WorkerExit>>> {
        let fail = self.fail;
        let exit = async move {
            if !fail {
                launch.kill.cancelled().await;
            }
            WorkerExit::of_worker("an exit of the test")
        };
        async { Ok(exit.boxed()) }.boxed()
    }
}

/// A scheduler with one job with these limits.
struct Bed {
    time: ManualClock,
    store: Store,
    job: JobId,
    _dir: tempfile::TempDir,
}

impl Bed {
    async fn start(limits: JobLimits, fail: bool) -> Self {
        let dir = tempfile::tempdir().unwrap();
        let time = ManualClock::new(Timestamp::from_second(1_000).unwrap());
        let store = Store::open(dir.path()).await.unwrap();
        let job = JobId(uuid::Uuid::now_v7());
        let spec = JobSpec { limits, ..JobSpec::train(TrainConfig::preset(Algorithm::Qmix, Preset::Practical)) };
        let new = NewJob {
            id: job,
            owner: None,
            any_name: false,
            spec,
            notes: String::new(),
            parent: None,
            beginning: None,
            now: time.clock().now(),
            idempotency: None,
        };
        store.submit_job(new).await.unwrap();
        let config = SchedulerConfig::new(1);
        let workers = Arc::new(Workers { fail });
        let scheduler = Scheduler::open(store.clone(), config, workers, time.clock(), Draining::default()).await.unwrap();
        tokio::spawn(scheduler.run("http://127.0.0.1:1".into()));
        Self { time, store, job, _dir: dir }
    }

    async fn job(&self) -> Job {
        self.store.job(self.job).await.unwrap().unwrap()
    }

    /// Waits until the job is as wanted.
    async fn reaches(&self, wanted: impl Fn(&Job) -> bool) -> Job {
        // Row id of the only job.
        let mut changes = self.store.changes(1);
        within(async {
            loop {
                changes.borrow_and_update();
                let job = self.job().await;
                if wanted(&job) {
                    return job;
                }
                changes.changed().await.unwrap();
            }
        })
        .await
    }

    /// Lets time pass as a server that runs sees it: in small steps.
    async fn pass(&self, total: Duration) {
        for _ in 0..30 {
            self.time.advance(total / 30);
            for _ in 0..20 {
                tokio::task::yield_now().await;
            }
        }
    }
}

#[tokio::test]
async fn a_job_that_ran_for_its_timeout_has_failed() {
    let limits = JobLimits { timeout: Some(20), ..JobLimits::default() };
    let bed = Bed::start(limits, false).await;
    bed.reaches(|job| job.state == JobState::Running).await;
    bed.pass(Duration::from_secs(19)).await;
    assert_eq!(bed.job().await.state, JobState::Running);
    bed.pass(Duration::from_secs(2)).await;
    let job = bed.reaches(|job| job.state.ended()).await;
    assert_eq!((job.state, job.attempts), (JobState::Failed, 1), "no further attempt");
    assert!(job.reason.unwrap().contains("timeout"));
}

#[tokio::test]
async fn attempts_that_fail_are_repeated_after_pauses_that_double() {
    let limits = JobLimits { backoff: 100, max_attempts: Some(3), ..JobLimits::default() };
    let bed = Bed::start(limits, true).await;
    for (attempt, pause) in [(1, 100), (2, 200)] {
        let job = bed.reaches(|job| job.attempts == attempt && job.state == JobState::Queued).await;
        let due = job.not_before.unwrap().duration_since(bed.time.clock().now()).as_secs();
        assert!((pause - 1..=pause).contains(&due), "attempt {attempt}: {due} s");
        bed.pass(Duration::from_secs(pause as u64 + 1)).await;
    }
    let job = bed.reaches(|job| job.state.ended()).await;
    assert_eq!((job.state, job.attempts, job.failures), (JobState::Failed, 3, 3));
}
