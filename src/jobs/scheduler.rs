//! Starts queued jobs while their threads fit into the budget, and sees every attempt to its end.
//!
//! Order is strict: highest priority first, then first come. A job that does not fit yet holds back those behind it, so
//! that a wide job is not passed over for ever.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use futures::future::BoxFuture;
use jiff::Timestamp;
use tokio::sync::Notify;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;
use tracing::Instrument;

use super::{Exit, Jobs, Launch, LogTail, Running, token_digest};
use crate::store::{Ending, Job, JobState, Lease, Wanted};

/// Why an attempt's worker is being stopped by force.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Killed {
    /// It had been asked to stop and took too long.
    Disobedient,
    /// It was not heard of.
    Silent,
}

/// The database, or the system's source of random numbers.
type Fault = Box<dyn std::error::Error + Send + Sync>;

pub(super) fn used(all: &HashMap<i64, Running>) -> usize {
    all.values().map(|running| running.threads).sum()
}

impl Jobs {
    /// Runs until [`Jobs::drain`]. Workers reach this server's gRPC at `server`, as `http://127.0.0.1:50051`.
    pub async fn run(self, server: String) {
        while !self.draining() {
            let wake = self.0.wake.notified();
            let started = self.start_all(&server).await;
            self.0.able.send_replace(started.is_ok());
            if let Err(e) = started {
                tracing::error!(error = e, "the queue could not be read; trying again");
                tokio::time::sleep(Duration::from_secs(1)).await;
                continue;
            }
            tokio::select! {
                () = wake => {}
                () = self.0.draining.cancelled() => {}
            }
        }
    }

    async fn start_all(&self, server: &str) -> Result<(), Fault> {
        while !self.draining()
            && let Some(job) = self.0.store.head_of_queue().await?
            && let Some(running) = self.reserve(&job)
        {
            let begun = self.begin(&job).await;
            let Ok(Some((lease, token))) = begun else {
                // Cancelled or paused in the meantime, or a fault.
                self.release(job.number);
                begun?;
                continue;
            };
            let (jobs, span) = (self.clone(), tracing::info_span!("attempt", job = %lease.id, attempt = lease.attempt));
            let server = server.to_owned();
            let attempt = async move {
                let (log, kill) = (running.log.clone(), CancellationToken::new());
                jobs.see_through(Launch { lease, token, server, log, kill }, &running).await;
                jobs.release(lease.job);
                jobs.0.left.notify_waiters();
                jobs.0.wake.notify_one();
            };
            tokio::spawn(attempt.instrument(span));
        }
        Ok(())
    }

    /// Takes the threads for a job, if they are free. The number of threads changes no result, so a job that is wider than
    /// the budget (which was larger when it came) runs with what there is.
    fn reserve(&self, job: &Job) -> Option<Running> {
        let mut all = self.running();
        let budget = self.0.settings.cpu_budget;
        let threads = job.spec.threads.min(budget);
        // Its former worker may still be on its way out.
        if used(&all) + threads > budget || all.contains_key(&job.number) {
            return None;
        }
        let running = Running {
            attempt: job.attempts + 1,
            threads,
            log: LogTail::default(),
            changed: Arc::new(Notify::new()),
            heard: Arc::new(Mutex::new(Instant::now())),
        };
        all.insert(job.number, running.clone());
        Some(running)
    }

    fn release(&self, job: i64) {
        self.running().remove(&job);
    }

    async fn begin(&self, job: &Job) -> Result<Option<(Lease, String)>, Fault> {
        let mut secret = [0; 32];
        getrandom::fill(&mut secret)?;
        let token = hex::encode(secret);
        let lease = self.0.store.begin_attempt(job.id, token_digest(&token), Timestamp::now()).await?;
        Ok(lease.map(|lease| (lease, token)))
    }

    async fn see_through(&self, launch: Launch, running: &Running) {
        let (lease, kill) = (launch.lease, launch.kill.clone());
        tracing::info!(threads = running.threads, "starting a worker");
        let ending = match self.0.executor.start(launch).await {
            Ok(exit) => self.wait(lease, exit, &kill, running).await,
            Err(e) => self.failed(format!("the worker could not be started: {e}")),
        };
        self.end(lease, &ending, &running.log).await;
    }

    fn failed(&self, reason: String) -> Ending {
        Ending::Failed { reason, max_attempts: self.0.settings.max_attempts }
    }

    /// Waits for the worker's process, and ends it by force where that is needed.
    async fn wait(&self, lease: Lease, mut exit: BoxFuture<'_, Exit>, kill: &CancellationToken, running: &Running) -> Ending {
        let force = async {
            let why = self.reason_to_kill(lease, running).await;
            tracing::warn!(reason = ?why, "ending the worker by force");
            kill.cancel();
            why
        };
        tokio::select! {
            exit = &mut exit => self.failed(format!("the worker ended with {}", exit.0)),
            why = force => {
                exit.await;
                match why {
                    Killed::Disobedient => Ending::Stopped,
                    Killed::Silent => {
                        self.failed(format!("nothing was heard of the worker for {} s", self.0.settings.silence.as_secs_f64()))
                    }
                }
            }
        }
    }

    /// Resolves when the worker must be killed.
    async fn reason_to_kill(&self, lease: Lease, running: &Running) -> Killed {
        let settings = &self.0.settings;
        let mut deadline: Option<Instant> = None;
        let mut drained = false;
        loop {
            let heard = *running.heard.lock().unwrap_or_else(PoisonError::into_inner);
            let silent_at = heard + settings.silence;
            let next = deadline.map_or(silent_at, |deadline| deadline.min(silent_at));
            tokio::select! {
                () = running.changed.notified() => {}
                () = self.0.draining.cancelled(), if !drained => drained = true,
                () = tokio::time::sleep_until(next) => {
                    if deadline.is_some_and(|deadline| deadline <= Instant::now()) {
                        return Killed::Disobedient;
                    }
                    if *running.heard.lock().unwrap_or_else(PoisonError::into_inner) + settings.silence <= Instant::now() {
                        return Killed::Silent;
                    }
                    continue;
                }
            }
            let grace = match self.0.store.job(lease.id).await {
                Ok(Some(Job { state: JobState::Running, wanted, .. })) => match wanted {
                    Some(Wanted::Cancel) => Some(settings.cancel_grace),
                    Some(Wanted::Pause) => Some(settings.pause_grace),
                    None => drained.then_some(settings.pause_grace),
                },
                // The attempt is over; the process has no reason to stay.
                Ok(_) => Some(settings.cancel_grace),
                Err(e) => {
                    tracing::error!(error = %e, "the job could not be read");
                    None
                }
            };
            if let Some(grace) = grace {
                let by = Instant::now() + grace;
                deadline = Some(deadline.map_or(by, |deadline| deadline.min(by)));
            }
        }
    }

    /// Records the end of the process. It changes nothing where the worker has told its outcome itself.
    async fn end(&self, lease: Lease, ending: &Ending, log: &LogTail) {
        let text = log.text();
        loop {
            let ended = async {
                self.0.store.keep_log(lease, &text).await?;
                self.0.store.end_attempt(lease, ending, Timestamp::now()).await
            };
            match ended.await {
                Ok(Some(job)) => {
                    tracing::warn!(state = %job.state, reason = job.reason, "the worker ended without an outcome");
                    return;
                }
                Ok(None) => return,
                Err(e) => tracing::error!(error = %e, "the end of an attempt could not be written; trying again"),
            }
            tokio::time::sleep(Duration::from_secs(1)).await;
        }
    }
}
