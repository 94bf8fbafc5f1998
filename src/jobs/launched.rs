//! Workers of a cluster: they wait in a queue of their own and outlive this server.
//!
//! A job whose worker waits stays queued. The attempt begins with the first call of the worker (`service::worker`). Until then,
//! whatever goes wrong is the cluster's trouble: the worker is launched again, with back-off, and no attempt is lost.

use std::time::Duration;

use tokio_util::sync::CancellationToken;
use tracing::Instrument;

use super::starting::{StartError, failed, new_token};
use super::{Launch, RETRY_DELAY, Resources, RunningAttempt, Scheduler, memory, token_digest};
use crate::store::{Job, LaunchRecord, Lease, WorkerResult};

/// Delays before a worker is launched again: the first, which doubles, and the longest.
const LAUNCH_DELAY: [Duration; 2] = [Duration::from_secs(1), Duration::from_secs(60)];

/// What a worker of a job needs.
pub(super) fn resources(job: &Job, threads: usize) -> Resources {
    Resources { threads, memory: memory::request(job.spec.decode().ok().as_ref(), threads) }
}

/// A launch that is not sent yet.
pub(super) fn new_launch(lease: Lease, resources: Resources, running: &RunningAttempt) -> Launch {
    Launch {
        lease,
        token: String::new(),
        server: String::new(),
        resources,
        name: String::new(),
        started_before: false,
        status: running.status.clone(),
        log: running.log.clone(),
        kill: CancellationToken::new(),
    }
}

impl Scheduler {
    /// Follows the workers that an earlier server has launched. Retries until the database works.
    pub(super) async fn adopt_launches(&self, server: &str) {
        loop {
            match self.try_adopt_launches(server).await {
                Ok(()) => return,
                Err(error) => tracing::error!(%error, "the workers of the cluster cannot be read; trying again"),
            }
            tokio::time::sleep(RETRY_DELAY).await;
        }
    }

    async fn try_adopt_launches(&self, server: &str) -> Result<(), crate::store::Error> {
        for LaunchRecord { lease, name, began_at } in self.0.store.launches().await? {
            let Some(job) = self.0.store.job(lease.job_id).await? else { continue };
            let threads = job.spec.threads.min(self.cpu_budget());
            let mut running = self.new_attempt(&job, lease.attempt, threads);
            if let Some(began_at) = began_at {
                let ran = Duration::try_from(self.0.clock.now().duration_since(began_at)).unwrap_or_default();
                running.time_left = running.time_left.map(|left| left.saturating_sub(ran));
                running.status.set_began(self.0.clock.monotonic());
            } else {
                running.status.set_waiting(Some("the server has started again and looks for the worker".into()));
            }
            if self.0.draining.begun() || self.running().contains_key(&lease.job_row) {
                continue;
            }
            tracing::info!(job = %lease.job_id, attempt = lease.attempt, name, "following a worker of the cluster");
            self.running().insert(lease.job_row, running.clone());
            let launch = Launch { name, started_before: true, ..new_launch(lease, resources(&job, threads), &running) };
            self.spawn_launched(Launch { server: server.to_owned(), ..launch }, running);
        }
        Ok(())
    }

    /// Launches the worker of a queued job whose threads are reserved.
    pub(super) async fn launch(&self, job: &Job, server: &str, running: RunningAttempt) -> Result<(), StartError> {
        let lease = Lease { job_id: job.id, job_row: job.row_id, attempt: running.attempt };
        let launch = Launch { server: server.to_owned(), ..new_launch(lease, resources(job, running.threads), &running) };
        match self.record(launch).await {
            Ok(Some(launch)) => self.spawn_launched(launch, running),
            // Cancelled or paused in the meantime.
            Ok(None) => self.release(lease.job_row),
            Err(error) => {
                self.release(lease.job_row);
                return Err(error);
            }
        }
        Ok(())
    }

    /// A launch with a name and a token of its own, as recorded; `None` if its attempt cannot begin any more.
    async fn record(&self, launch: Launch) -> Result<Option<Launch>, StartError> {
        let Lease { job_id, attempt, .. } = launch.lease;
        let token = new_token()?;
        let digest = token_digest(&token);
        // Everyone sees names. The digest makes this one unique and does not tell the token.
        let name = format!("qedgix-{job_id}-{attempt}-{}", hex::encode(&digest[..4]));
        let recorded = self.0.store.record_launch(launch.lease, digest, &name, self.0.clock.now()).await?;
        let kill = CancellationToken::new();
        Ok(recorded.then_some(Launch { token, name, kill, started_before: false, ..launch }))
    }

    fn spawn_launched(&self, launch: Launch, running: RunningAttempt) {
        let span = tracing::info_span!("attempt", job = %launch.lease.job_id, attempt = launch.lease.attempt);
        let scheduler = self.clone();
        let attempt = async move {
            let job = launch.lease.job_row;
            scheduler.supervise_launched(launch, &running).await;
            scheduler.release(job);
        };
        tokio::spawn(attempt.instrument(span));
    }

    /// Launches a worker until one has called, waits for its end and records it.
    async fn supervise_launched(&self, mut launch: Launch, running: &RunningAttempt) {
        let [mut delay, longest] = LAUNCH_DELAY;
        let lease = launch.lease;
        loop {
            let result = tokio::select! {
                result = self.run_launched(&launch, running) => result,
                never = self.store_log(lease, &running.log) => match never {},
                // The worker goes on, and the next server follows it.
                () = self.0.draining.wait() => return,
            };
            // A launch of its own for the next try: should the worker of this one still come, it is refused.
            launch = match self.record_or_end(launch, &result, running).await {
                Some(launch) => launch,
                None => return,
            };
            let reason = match result {
                WorkerResult::Failed { reason, .. } => reason,
                _ => running.status.waiting().unwrap_or_default(),
            };
            tracing::error!(reason, ?delay, "a worker could not be launched; trying again");
            metrics::counter!("qedgix_worker_start_failures_total").increment(1);
            running.status.set_waiting(Some(format!("{reason}; trying again in {} s", delay.as_secs())));
            if !self.wait_to_retry(lease, running, delay).await {
                if !self.0.draining.begun() {
                    self.forget(lease).await;
                }
                return;
            }
            delay = (delay * 2).min(longest);
        }
    }

    /// Launches a worker once. Returns the result of an attempt whose worker has reported none.
    async fn run_launched(&self, launch: &Launch, running: &RunningAttempt) -> WorkerResult {
        *running.last_heartbeat() = self.0.clock.monotonic();
        match self.0.executor.start(launch.clone()).await {
            Ok(exit) => self.wait(launch.lease, exit, &launch.kill, running).await,
            Err(error) => failed(format!("the cluster has refused the worker: {error}")),
        }
    }

    /// The launch of the next try, or `None` if the attempt has begun or cannot begin any more; then it is ended.
    async fn record_or_end(&self, launch: Launch, result: &WorkerResult, running: &RunningAttempt) -> Option<Launch> {
        let lease = launch.lease;
        loop {
            match self.record(launch.clone()).await {
                Ok(Some(launch)) => return Some(launch),
                Ok(None) => break,
                Err(error) => tracing::error!(error, "a launch could not be recorded; trying again"),
            }
            tokio::time::sleep(RETRY_DELAY).await;
        }
        self.end(lease, result, &running.log).await;
        self.forget(lease).await;
        None
    }

    /// Forgets a launch. Retries until the database works.
    async fn forget(&self, lease: Lease) {
        while let Err(error) = self.0.store.forget_launch(lease).await {
            tracing::error!(%error, "the end of a launch could not be recorded; trying again");
            tokio::time::sleep(RETRY_DELAY).await;
        }
    }
}
