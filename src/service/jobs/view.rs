//! A job as callers see it: its record, why it waits, and how its metrics stand.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use jiff::Timestamp;

use crate::service::progress::{Progress, SPEED};
use crate::service::{App, Error};
use crate::store::{Job, JobSpec, JobState, ListedJob, MetricSummary, UnreadableSpec};

/// Most metrics that a single job shows. Lists show those that are asked for.
pub(super) const MAX_METRICS: u32 = 100;

/// A job, and what is known of it at the moment.
#[derive(Clone, Debug, PartialEq)]
pub struct JobView {
    /// The record.
    pub job: Job,
    /// Its specification, as far as this version can read it.
    pub spec: Result<JobSpec, UnreadableSpec>,
    /// Steps done, and of a running job the speed.
    pub progress: Progress,
    /// Why the job has not started; only for a queued job.
    pub waiting: Option<Waiting>,
    /// The best and the last value of metrics, by name.
    pub metrics: BTreeMap<String, MetricSummary>,
}

/// Why a queued job has not started.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Waiting {
    /// In words: `comes after 1 job that has not succeeded`, `needs 2 threads, 1 free; 3 jobs before it`, or what a cluster says.
    pub reason: String,
    /// Threads that the job needs.
    pub threads: usize,
    /// Threads of the CPU budget that no running job uses.
    pub threads_free: usize,
    /// Jobs that come before it in the queue.
    pub jobs_before: u64,
}

impl Waiting {
    fn new(blocked: u64, not_before: Option<Timestamp>, threads: usize, threads_free: usize, jobs_before: u64) -> Self {
        let plural = |n: u64, what: &str| format!("{n} {what}{}", if n == 1 { "" } else { "s" });
        let mut reason = format!("needs {}, {threads_free} free", plural(threads as u64, "thread"));
        if jobs_before > 0 {
            let _ = write!(reason, "; {} before it", plural(jobs_before, "job"));
        }
        if let Some(time) = not_before {
            reason = format!("waits until {time:.0} after a failed attempt");
        }
        if blocked > 0 {
            let has = if blocked == 1 { "has" } else { "have" };
            reason = format!("comes after {} that {has} not succeeded", plural(blocked, "job"));
        }
        Self { reason, threads, threads_free, jobs_before }
    }
}

/// The view of one job.
pub(super) async fn view(app: &App, job: Job) -> Result<JobView, Error> {
    let metrics: BTreeMap<_, _> = app.store.job_metric_summaries(job.row_id, MAX_METRICS).await?.into_iter().collect();
    let progress = progress(&job, metrics.get(SPEED));
    let waiting = waiting(app, std::iter::once(&job)).await?.remove(&job.row_id);
    Ok(JobView { spec: job.spec.decode(), job, progress, waiting, metrics })
}

fn progress(job: &Job, speed: Option<&MetricSummary>) -> Progress {
    let speed = speed.filter(|_| job.state == JobState::Running).and_then(|speed| speed.last);
    Progress { step: job.step, steps: job.spec.steps, steps_per_second: speed }
}

/// The views of the jobs of a list, with the metrics `names`.
pub(super) async fn views(app: &App, jobs: Vec<ListedJob>, names: &[String]) -> Result<Vec<JobView>, Error> {
    let rows: Vec<i64> = jobs.iter().map(|listed| listed.job.row_id).collect();
    let mut metrics = app.store.metric_summaries(&rows, names).await?;
    let running = jobs.iter().filter(|listed| listed.job.state == JobState::Running).map(|listed| listed.job.row_id);
    let speeds = app.store.metric_summaries(&running.collect::<Vec<_>>(), &[SPEED.to_owned()]).await?;
    let mut waiting = waiting(app, jobs.iter().map(|listed| &listed.job)).await?;
    let view = |ListedJob { job, spec, .. }: ListedJob| {
        let metrics = metrics.remove(&job.row_id).unwrap_or_default().into_iter().collect();
        let speed = speeds.get(&job.row_id).and_then(|speeds| speeds.first());
        let progress = progress(&job, speed.map(|(_, speed)| speed));
        JobView { waiting: waiting.remove(&job.row_id), spec, progress, metrics, job }
    };
    Ok(jobs.into_iter().map(view).collect())
}

/// Why the queued ones among `jobs` wait, by row id.
async fn waiting(app: &App, jobs: impl Iterator<Item = &Job>) -> Result<BTreeMap<i64, Waiting>, Error> {
    let queued: Vec<&Job> = jobs.filter(|job| job.state == JobState::Queued).collect();
    if queued.is_empty() {
        return Ok(BTreeMap::new());
    }
    let before = app.store.jobs_before(&queued.iter().map(|job| job.row_id).collect::<Vec<_>>()).await?;
    let budget = app.scheduler.cpu_budget();
    let free = budget.saturating_sub(app.scheduler.threads_busy());
    let now = app.clock.now();
    let waiting = |job: &&Job| {
        let before = before.get(&job.row_id).copied().unwrap_or_default();
        let not_before = job.not_before.filter(|time| *time > now);
        let waiting = Waiting::new(job.blocked, not_before, job.spec.threads.min(budget), free, before);
        (job.row_id, app.scheduler.waiting(job.row_id).map_or(waiting.clone(), |reason| Waiting { reason, ..waiting }))
    };
    Ok(queued.iter().map(waiting).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reasons_are_sentences() {
        assert_eq!(Waiting::new(0, None, 2, 1, 3).reason, "needs 2 threads, 1 free; 3 jobs before it");
        assert_eq!(Waiting::new(0, None, 1, 0, 0).reason, "needs 1 thread, 0 free");
        assert_eq!(Waiting::new(2, None, 1, 0, 0).reason, "comes after 2 jobs that have not succeeded");
        let time = Some(Timestamp::from_second(1_800_000_000).unwrap());
        assert_eq!(Waiting::new(0, time, 1, 0, 0).reason, "waits until 2027-01-15T08:00:00Z after a failed attempt");
    }
}
