//! Starts queued jobs while their threads fit into the CPU budget.
//!
//! Highest priority first, then first come, first served. A job that does not fit yet holds back the jobs behind it, so that a job
//! with many threads does not wait forever; only what cannot delay it may start before it (`backfill`).

use std::collections::HashMap;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use jiff::Timestamp;
use tokio::sync::Notify;
use tracing::Instrument;

use super::backfill::backfill_limit;
use super::launched::{new_launch, resources};
use super::starting::{StartError, new_token};
use super::{Launch, LogTail, RETRY_DELAY, RunningAttempt, Scheduler, WorkerStatus, token_digest};
use crate::store::{Job, Lease};

pub(super) fn threads_used(all: &HashMap<i64, RunningAttempt>) -> usize {
    all.values().map(|running| running.threads).sum()
}

impl Scheduler {
    /// Starts jobs until draining begins. Workers reach this server's gRPC at `server`, as `http://127.0.0.1:50051`.
    pub async fn run(self, server: String) {
        if self.0.executor.is_cluster() {
            self.adopt_launches(&server).await;
        }
        while !self.0.draining.begun() {
            let wake = self.0.wake.notified();
            let looked_at = self.0.clock.now();
            let started = self.start_all(&server).await;
            self.0.queue_readable.send_replace(started.is_ok());
            if let Err(e) = started {
                tracing::error!(error = e, "the queue could not be read; trying again");
                tokio::time::sleep(RETRY_DELAY).await;
                continue;
            }
            tokio::select! {
                () = wake => {}
                () = self.delayed(looked_at) => {}
                () = self.0.draining.wait() => {}
            }
        }
    }

    /// Returns when a job may start that could not start at `looked_at`, because it waits for a time. If that cannot be found out, the
    /// next wake-up looks again.
    async fn delayed(&self, looked_at: Timestamp) {
        match self.0.store.next_delayed(looked_at).await {
            Ok(Some(time)) => {
                let wait = Duration::try_from(time.duration_since(self.0.clock.now())).unwrap_or_default();
                self.0.clock.sleep_until(self.0.clock.monotonic().saturating_add(wait)).await;
            }
            Ok(None) | Err(_) => std::future::pending().await,
        }
    }

    /// The job to start next: the head of the queue if it fits, or else the first that cannot delay it.
    async fn next_to_start(&self) -> Result<Option<Job>, crate::store::Error> {
        let now = self.0.clock.now();
        let Some(head) = self.0.store.first_in_queue(usize::MAX, now).await? else { return Ok(None) };
        let budget = self.cpu_budget();
        let running: Vec<usize> = self.running().values().map(|running| running.threads).collect();
        let threads = head.spec.threads.min(budget);
        if running.iter().sum::<usize>() + threads <= budget {
            return Ok(Some(head));
        }
        match backfill_limit(budget, &running, threads) {
            0 => Ok(None),
            limit => self.0.store.first_in_queue(limit, now).await,
        }
    }

    async fn start_all(&self, server: &str) -> Result<(), StartError> {
        while let Some(job) = self.next_to_start().await? {
            if let Err(unreadable) = job.spec.decode() {
                tracing::error!(job = %job.id, reason = %unreadable, "the job cannot be started");
                self.0.store.fail_queued_job(&job, &unreadable.to_string(), self.0.clock.now()).await?;
                continue;
            }
            let Some(running) = self.reserve(&job) else { break };
            if self.0.executor.is_cluster() {
                self.launch(&job, server, running).await?;
                continue;
            }
            let begun = self.begin(&job).await;
            let Ok(Some((lease, token))) = begun else {
                // Cancelled or paused in the meantime, or an error.
                self.release(job.row_id);
                begun?;
                continue;
            };
            let (scheduler, span) = (self.clone(), tracing::info_span!("attempt", job = %lease.job_id, attempt = lease.attempt));
            let server = server.to_owned();
            let attempt = async move {
                let resources = resources(&job, running.threads);
                let launch = Launch { token, server, ..new_launch(lease, resources, &running) };
                scheduler.supervise(launch, &running).await;
                scheduler.release(lease.job_row);
            };
            tokio::spawn(attempt.instrument(span));
        }
        Ok(())
    }

    /// Reserves the threads of a job, if they are free. The number of threads does not affect results, so a job with more
    /// threads than the budget (which was larger when the job was submitted) runs with the whole budget.
    ///
    /// Returns `None` once draining has begun. That is checked under the lock, so [`Scheduler::drain`] either sees the
    /// attempt or prevents it.
    fn reserve(&self, job: &Job) -> Option<RunningAttempt> {
        let mut all = self.running();
        let budget = self.cpu_budget();
        let threads = job.spec.threads.min(budget);
        // The worker of the previous attempt may not have ended yet.
        if self.0.draining.begun() || threads_used(&all) + threads > budget || all.contains_key(&job.row_id) {
            return None;
        }
        let running = self.new_attempt(job, job.attempts + 1, threads);
        if !self.0.executor.is_cluster() {
            running.status.set_began(self.0.clock.monotonic());
        }
        all.insert(job.row_id, running.clone());
        Some(running)
    }

    /// Attempt `number` of a job, which runs on `threads` threads.
    pub(super) fn new_attempt(&self, job: &Job, number: u32, threads: usize) -> RunningAttempt {
        let timeout = job.spec.decode().ok().and_then(|spec| spec.limits.timeout);
        RunningAttempt {
            attempt: number,
            threads,
            log: LogTail::default(),
            job_changed: Arc::new(Notify::new()),
            status: WorkerStatus::default(),
            time_left: timeout.map(|seconds| Duration::from_secs(seconds).saturating_sub(job.ran)),
            last_heartbeat: Arc::new(Mutex::new(self.0.clock.monotonic())),
        }
    }

    pub(super) fn release(&self, job: i64) {
        self.running().remove(&job);
        self.0.removed.notify_waiters();
        self.0.wake.notify_one();
    }

    async fn begin(&self, job: &Job) -> Result<Option<(Lease, String)>, StartError> {
        let token = new_token()?;
        let lease = self.0.store.begin_attempt(job.id, token_digest(&token), self.0.clock.now()).await?;
        Ok(lease.map(|lease| (lease, token)))
    }
}

#[cfg(test)]
mod tests {
    use futures::FutureExt;
    use futures::future::BoxFuture;
    use jiff::Timestamp;
    use uuid::Uuid;

    use super::*;
    use crate::clock::{Clock, ManualClock};
    use crate::draining::Draining;
    use crate::jobs::{Executor, SchedulerConfig, WorkerExit};
    use crate::store::{JobId, JobSpec, JobState, NewJob, Store};
    use crate::train_config::{Algorithm, Preset, TrainConfig};

    /// Starts workers that run until they are killed.
    struct Endless;

    impl Executor for Endless {
        fn start(&self, launch: Launch) -> BoxFuture<'_, std::io::Result<BoxFuture<'static, WorkerExit>>> {
            let exit = async move {
                launch.kill.cancelled().await;
                WorkerExit::of_worker("killed by signal 9")
            };
            async { Ok(exit.boxed()) }.boxed()
        }
    }

    async fn with_a_job(clock: Clock) -> (tempfile::TempDir, Scheduler, JobId) {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).await.unwrap();
        let config = TrainConfig::preset(Algorithm::Qmix, Preset::Practical);
        let spec = JobSpec::train(config);
        let id = JobId(Uuid::from_u128(1));
        store
            .submit_job(NewJob {
                id,
                owner: None,
                any_name: false,
                spec,
                notes: String::new(),
                parent: None,
                beginning: None,
                now: clock.now(),
                idempotency: None,
            })
            .await
            .unwrap();
        let config = SchedulerConfig { max_attempts: 1, ..SchedulerConfig::new(1) };
        let scheduler = Scheduler::open(store, config, Arc::new(Endless), clock, Draining::default()).await.unwrap();
        (dir, scheduler, id)
    }

    #[tokio::test]
    async fn no_attempt_starts_after_drain_has_seen_none() {
        let (_dir, scheduler, _) = with_a_job(Clock::system()).await;
        // The scheduler has read the queue and is about to reserve the threads when the server drains.
        let job = scheduler.next_to_start().await.unwrap().unwrap();
        scheduler.drain(Duration::from_secs(30)).await;
        assert!(scheduler.reserve(&job).is_none());
    }

    #[tokio::test]
    async fn drain_does_not_wait_for_an_attempt_that_could_not_begin() {
        let (_dir, scheduler, _) = with_a_job(Clock::system()).await;
        let job = scheduler.next_to_start().await.unwrap().unwrap();
        scheduler.reserve(&job).unwrap();
        let mut drain = std::pin::pin!(scheduler.drain(Duration::from_secs(3600)));
        assert!(futures::poll!(&mut drain).is_pending());
        scheduler.release(job.row_id);
        assert!(futures::poll!(&mut drain).is_ready());
    }

    #[tokio::test]
    async fn heartbeats_are_timed_by_monotonic_time_and_attempts_by_wall_time() {
        let time = ManualClock::new(Timestamp::from_second(1_000).unwrap());
        let (_dir, scheduler, id) = with_a_job(time.clock()).await;
        let running = tokio::spawn(scheduler.clone().run("http://127.0.0.1:1".into()));
        let mut changes = scheduler.0.store.changes(1);
        while scheduler.0.store.job(id).await.unwrap().unwrap().state != JobState::Running {
            changes.changed().await.unwrap();
        }
        // A correction of the wall time by a day does not kill the worker. The attempt ends at the corrected time.
        time.set_wall(Timestamp::from_second(90_000).unwrap());
        for _ in 0..100 {
            tokio::task::yield_now().await;
        }
        assert_eq!(scheduler.0.store.job(id).await.unwrap().unwrap().state, JobState::Running);
        pass(&time, scheduler.config().heartbeat_timeout).await;
        while scheduler.0.store.job(id).await.unwrap().unwrap().state != JobState::Failed {
            changes.changed().await.unwrap();
        }
        let attempt = scheduler.0.store.attempts(id).await.unwrap().remove(0);
        assert_eq!(attempt.started_at.as_second(), 1_000);
        assert_eq!(attempt.ended_at.unwrap().as_second(), 90_030);
        running.abort();
    }

    /// Lets time pass as a server that runs sees it: in small steps.
    async fn pass(time: &ManualClock, total: Duration) {
        for _ in 0..30 {
            time.advance(total / 30);
            for _ in 0..20 {
                tokio::task::yield_now().await;
            }
        }
    }

    #[tokio::test]
    async fn a_worker_is_not_blamed_for_the_pauses_of_its_server() {
        let time = ManualClock::new(Timestamp::from_second(1_000).unwrap());
        let (_dir, scheduler, id) = with_a_job(time.clock()).await;
        let running = tokio::spawn(scheduler.clone().run("http://127.0.0.1:1".into()));
        let mut changes = scheduler.0.store.changes(1);
        while scheduler.0.store.job(id).await.unwrap().unwrap().state != JobState::Running {
            changes.changed().await.unwrap();
        }
        let timeout = scheduler.config().heartbeat_timeout;
        for _ in 0..3 {
            // The server was stopped for longer than the lease, and then runs for a part of it.
            time.advance(timeout * 10);
            pass(&time, timeout / 2).await;
        }
        assert_eq!(scheduler.0.store.job(id).await.unwrap().unwrap().state, JobState::Running);
        pass(&time, timeout).await;
        while scheduler.0.store.job(id).await.unwrap().unwrap().state != JobState::Failed {
            changes.changed().await.unwrap();
        }
        running.abort();
    }
}
