//! Supervises an attempt until its worker has ended: starts the worker, stores its output, kills it when it does not stop in time, and
//! records its end.

use std::convert::Infallible;
use std::time::Duration;

use futures::future::BoxFuture;
use tokio_util::sync::CancellationToken;

use super::starting::failed;
use super::{Launch, LogTail, RETRY_DELAY, RunningAttempt, Scheduler, WorkerExit};
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

/// Delays before a worker that could not be started is started again: the first, which doubles, and the longest.
const START_DELAY: [Duration; 2] = [Duration::from_millis(250), Duration::from_secs(5)];
/// Time in which a worker of a cluster ends after its attempt, before it is killed.
const CLUSTER_GRACE: Duration = Duration::from_secs(10);
/// Time in which output of a worker is collected before it is stored.
const LOG_DELAY: Duration = Duration::from_millis(100);
/// Time between two writes of a worker's output, and that time when the worker floods its output.
const LOG_INTERVAL: [Duration; 2] = [Duration::from_millis(400), Duration::from_secs(10)];

impl Scheduler {
    /// Starts a worker, waits for its end and records it.
    pub(super) async fn supervise(&self, launch: Launch, running: &RunningAttempt) {
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
