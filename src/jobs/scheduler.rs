//! Starts queued jobs while their threads fit into the CPU budget, and supervises every attempt until its worker has ended.
//!
//! Highest priority first, then first come, first served. A job that does not fit yet holds back the jobs behind it, so that a job
//! with many threads does not wait forever; only what cannot delay it may start before it (`backfill`).

use std::collections::HashMap;
use std::convert::Infallible;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use futures::future::BoxFuture;
use jiff::Timestamp;
use tokio::sync::Notify;
use tokio_util::sync::CancellationToken;
use tracing::Instrument;

use super::backfill::backfill_limit;
use super::launched::{new_launch, resources};
use super::starting::{StartError, failed, new_token};
use super::{Launch, LogTail, RunningAttempt, Scheduler, WorkerExit, WorkerStatus, token_digest};
use crate::store::{EndedAttempt, Job, JobState, Lease, PendingAction, WorkerResult};

/// Why the scheduler kills a worker.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum KillReason {
    /// The worker did not stop within its grace period.
    GraceExpired,
    /// All attempts together ran for the timeout of the job.
    TimedOut,
    /// No heartbeat arrived within [`super::SchedulerConfig::heartbeat_timeout`].
    HeartbeatLost,
}

/// Time between two tries to use a database that fails.
const RETRY_DELAY: Duration = Duration::from_secs(1);

/// Delays before a worker that could not be started is started again: the first, which doubles, and the longest.
const START_DELAY: [Duration; 2] = [Duration::from_millis(250), Duration::from_secs(5)];
/// Time in which a worker of a cluster ends after its attempt, before it is killed.
const CLUSTER_GRACE: Duration = Duration::from_secs(10);
/// Time in which output of a worker is collected before it is stored.
const LOG_DELAY: Duration = Duration::from_millis(100);
/// Time between two writes of a worker's output, and that time when the worker floods its output.
const LOG_INTERVAL: [Duration; 2] = [Duration::from_millis(400), Duration::from_secs(10)];

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

    /// Starts a worker, waits for its end and records it.
    async fn supervise(&self, launch: Launch, running: &RunningAttempt) {
        let lease = launch.lease;
        tracing::info!(threads = running.threads, "starting a worker");
        let work = async {
            let Some(exit) = self.start_worker(&launch, running).await else { return WorkerResult::Stopped };
            self.wait(lease, exit, &launch.kill, running).await
        };
        let result = tokio::select! {
            result = work => result,
            never = self.store_log(lease, &running.log) => match never {},
        };
        self.end(lease, &result, &running.log).await;
    }

    /// Starts a worker. When that fails, the host is in trouble (no file descriptor, no memory, no program) and not the job, so it
    /// is tried again until it succeeds. Returns `None` if the job or this server is to stop before.
    async fn start_worker(&self, launch: &Launch, running: &RunningAttempt) -> Option<BoxFuture<'static, WorkerExit>> {
        let [mut delay, longest] = START_DELAY;
        loop {
            match self.0.executor.start(launch.clone()).await {
                Ok(exit) => return Some(exit),
                Err(error) => {
                    tracing::error!(%error, ?delay, "a worker could not be started; trying again");
                    metrics::counter!("qedgix_worker_start_failures_total").increment(1);
                    launch.log.push(format!("a worker could not be started: {error}; trying again in {delay:?}\n").as_bytes());
                }
            }
            if !self.wait_to_retry(launch.lease, running, delay).await {
                return None;
            }
            delay = (delay * 2).min(longest);
        }
    }

    /// Waits before a worker is started again. Returns false if the job or this server is to stop before.
    pub(super) async fn wait_to_retry(&self, lease: Lease, running: &RunningAttempt, delay: Duration) -> bool {
        let next = self.0.clock.monotonic().saturating_add(delay);
        loop {
            tokio::select! {
                () = self.0.clock.sleep_until(next) => return true,
                () = running.job_changed.notified() => {
                    if !matches!(self.grace(lease, running, false).await, Ok(None)) {
                        return false;
                    }
                }
                () = self.0.draining.wait() => return false,
            }
        }
    }

    /// Stores the output of the worker while it runs, so that it survives a crash of this server. Never returns.
    pub(super) async fn store_log(&self, lease: Lease, log: &LogTail) -> Infallible {
        let [short, long] = LOG_INTERVAL;
        let (mut stored, mut arrivals) = (0, log.subscribe());
        loop {
            // The sender lives in `log`. Output that arrived before this began has not been seen.
            if log.total() == stored {
                let _ = arrivals.changed().await;
            }
            arrivals.borrow_and_update();
            tokio::time::sleep(LOG_DELAY).await;
            let (total, text) = (log.total(), log.text());
            if let Err(error) = self.0.store.store_log(lease, &text).await {
                // The next output, or the end of the attempt, stores it.
                tracing::debug!(%error, "the output of a worker could not be stored");
            }
            let flood = total - stored > LogTail::LIMIT as u64;
            stored = total;
            tokio::time::sleep(if flood { long } else { short }).await;
        }
    }

    /// Waits for the end of the worker process, and kills it if it does not stop in time. Returns the result of an attempt whose
    /// worker has reported none.
    pub(super) async fn wait(
        &self,
        lease: Lease,
        mut exit: BoxFuture<'_, WorkerExit>,
        kill: &CancellationToken,
        running: &RunningAttempt,
    ) -> WorkerResult {
        let force = async {
            let reason = self.kill_reason(lease, running).await;
            tracing::warn!(?reason, "killing the worker");
            kill.cancel();
            reason
        };
        tokio::select! {
            exit = &mut exit => {
                if !exit.by_host {
                    return failed(format!("the worker ended with {}", exit.description));
                }
                tracing::warn!(reason = exit.description, "the host has ended the worker");
                running.log.push(format!("the host has ended the worker: {}\n", exit.description).as_bytes());
                running.status.set_waiting(Some(exit.description));
                WorkerResult::Stopped
            }
            reason = force => {
                exit.await;
                match reason {
                    KillReason::GraceExpired => WorkerResult::Stopped,
                    KillReason::TimedOut => {
                        WorkerResult::Failed { reason: "the job has run for its timeout".into(), permanent: true }
                    }
                    KillReason::HeartbeatLost => {
                        let timeout = self.0.config.heartbeat_timeout.as_secs_f64();
                        failed(format!("no heartbeat of the worker for {timeout} s"))
                    }
                }
            }
        }
    }

    /// Returns when the worker must be killed.
    ///
    /// The worker is not blamed for time in which this server did not run, because it was stopped or the machine was: after such a
    /// gap, the worker has the whole time for its next heartbeat, and what is left of its grace period.
    async fn kill_reason(&self, lease: Lease, running: &RunningAttempt) -> KillReason {
        let (config, clock) = (&self.0.config, &self.0.clock);
        let longest_gap = config.heartbeat_timeout / 4;
        let tick = (config.heartbeat_timeout / 16).clamp(Duration::from_millis(1), Duration::from_secs(1));
        let mut last_tick = clock.monotonic();
        let mut deadline: Option<Duration> = None;
        let mut drained = false;
        let cluster = self.0.executor.is_cluster();
        let next_tick = |last_tick: Duration, deadline: Option<Duration>| {
            [deadline, running.deadline()].into_iter().flatten().fold(last_tick.saturating_add(tick), Duration::min)
        };
        loop {
            let ticked = tokio::select! {
                () = running.job_changed.notified() => false,
                () = self.0.draining.wait(), if !drained && !cluster => {
                    drained = true;
                    false
                }
                () = clock.sleep_until(next_tick(last_tick, deadline)) => true,
            };
            let now = clock.monotonic();
            let gap = now.saturating_sub(last_tick);
            last_tick = now;
            if gap > longest_gap {
                tracing::warn!(seconds = gap.as_secs_f64(), "this server did not run; the lease of the worker is renewed");
                *running.last_heartbeat() = now;
                deadline = deadline.map(|deadline| deadline.saturating_add(gap));
            }
            if running.status.waiting().is_some() {
                // A worker that does not run sends no heartbeats.
                *running.last_heartbeat() = now;
            }
            if ticked {
                if deadline.is_some_and(|deadline| deadline <= now) {
                    return KillReason::GraceExpired;
                }
                if running.deadline().is_some_and(|deadline| deadline <= now) {
                    return KillReason::TimedOut;
                }
                if running.last_heartbeat().saturating_add(config.heartbeat_timeout) <= now {
                    return KillReason::HeartbeatLost;
                }
                continue;
            }
            match self.grace(lease, running, drained).await {
                Ok(Some(grace)) => {
                    let by = now.saturating_add(grace);
                    deadline = Some(deadline.map_or(by, |deadline| deadline.min(by)));
                }
                Ok(None) => {}
                Err(error) => tracing::error!(%error, "the job could not be read"),
            }
        }
    }

    /// The time that the worker has to stop; `None` while it may run.
    async fn grace(
        &self,
        lease: Lease,
        running: &RunningAttempt,
        drained: bool,
    ) -> Result<Option<Duration>, crate::store::Error> {
        let config = &self.0.config;
        let begun = running.status.began().is_some();
        Ok(match self.0.store.job(lease.job_id).await? {
            Some(Job { state: JobState::Running, pending_action, .. }) => match pending_action {
                Some(PendingAction::Cancel) => Some(config.cancel_grace),
                Some(PendingAction::Pause) => Some(config.pause_grace),
                None => drained.then_some(config.pause_grace),
            },
            // The job waits for its worker.
            Some(Job { state: JobState::Queued, attempts, .. }) if !begun && attempts + 1 == lease.attempt => None,
            // The attempt has ended, so its process has to end, too. A cluster notices later that a process has ended.
            _ if begun && self.0.executor.is_cluster() => Some(CLUSTER_GRACE),
            _ => Some(config.cancel_grace),
        })
    }

    /// Stores the log of the worker, and ends the attempt unless the worker has ended it. Retries until the database works.
    pub(super) async fn end(&self, lease: Lease, result: &WorkerResult, log: &LogTail) {
        let text = log.text();
        loop {
            let ended = async {
                self.0.store.store_log(lease, &text).await?;
                let (max_attempts, now) = (self.0.config.max_attempts, self.0.clock.now());
                self.0.store.end_attempt(EndedAttempt { lease, result, publish: None, document: None, max_attempts, now }).await
            };
            match ended.await {
                Ok(Some((job, _))) => {
                    tracing::warn!(state = %job.state, reason = job.reason, "the worker ended without reporting a result");
                    return;
                }
                Ok(None) => return,
                Err(e) => tracing::error!(error = %e, "the end of an attempt could not be recorded; trying again"),
            }
            tokio::time::sleep(RETRY_DELAY).await;
        }
    }
}

#[cfg(test)]
mod tests {
    use futures::FutureExt;
    use jiff::Timestamp;
    use uuid::Uuid;

    use super::*;
    use crate::clock::{Clock, ManualClock};
    use crate::draining::Draining;
    use crate::jobs::{Executor, SchedulerConfig};
    use crate::store::{JobId, JobSpec, NewJob, Store};
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
