//! Random schedules on the real scheduler and its database: jobs of random threads, priorities and durations arrive, end, and the CPU
//! budget changes, while the test moves the time and plays the workers. The scheduler keeps order and budget, does not delay the head of
//! the queue for a job behind it, and starves nobody.
//!
//! `QEDGIX_SCHEDULES` (100) is the number of schedules, `QEDGIX_SEED` (0) the first one.

use std::collections::HashMap;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use futures::FutureExt;
use futures::future::{BoxFuture, join_all};
use jiff::Timestamp;
use qedgix::clock::ManualClock;
use qedgix::draining::Draining;
use qedgix::jobs::{Executor, Launch, Scheduler, SchedulerConfig, WorkerExit};
use qedgix::rng;
use qedgix::store::{JobId, JobSpec, NewJob, Store};
use qedgix::train_config::{Algorithm, Preset, TrainConfig};
use rand::{Rng, RngExt};
use tokio::sync::{mpsc, oneshot, watch};

use super::harness::within;

/// A job of a schedule.
#[derive(Clone, Copy, Debug)]
struct Job {
    arrives: u64,
    priority: i64,
    threads: usize,
    runs: u64,
}

/// What happens at a time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Event {
    /// The worker of a running job ends.
    Ends(usize),
    /// The CPU budget changes.
    Budget(usize),
    /// A job is submitted.
    Arrives(usize),
}

/// A job that runs, on `threads` threads until `end`.
#[derive(Clone, Copy, Debug)]
struct Running {
    job: usize,
    threads: usize,
    end: u64,
}

/// The state of a schedule.
#[derive(Clone, Debug, Default)]
struct State {
    /// Jobs in the order of the queue.
    queue: Vec<usize>,
    running: Vec<Running>,
}

impl State {
    fn used(&self) -> usize {
        self.running.iter().map(|running| running.threads).sum()
    }

    /// When `head` starts at the latest: when only heads start, and nothing else happens.
    fn strict_start(mut self, jobs: &[Job], budget: usize, mut now: u64, head: usize) -> u64 {
        loop {
            while let Some(&job) = self.queue.first() {
                let threads = jobs[job].threads.min(budget);
                if self.used() + threads > budget {
                    break;
                }
                if job == head {
                    return now;
                }
                self.queue.remove(0);
                self.running.push(Running { job, threads, end: now + jobs[job].runs });
            }
            now = self.running.iter().map(|running| running.end).min().expect("an idle machine starts the head");
            self.running.retain(|running| running.end > now);
        }
    }
}

/// A schedule: its jobs, and the budget at first and from a time on.
struct Schedule {
    jobs: Vec<Job>,
    budget: usize,
    changes: Vec<(u64, usize)>,
}

impl Schedule {
    fn random(draw: &mut impl Rng) -> Self {
        let most = draw.random_range(1..=12);
        let count = draw.random_range(1..20);
        let mut jobs: Vec<Job> = (0..count)
            .map(|_| Job {
                arrives: draw.random_range(0..50),
                priority: draw.random_range(-1..=1),
                threads: draw.random_range(1..=most),
                runs: draw.random_range(1..30),
            })
            .collect();
        jobs.sort_by_key(|job| job.arrives);
        let changes = draw.random_range(0..3);
        let changes = (0..changes).map(|_| (draw.random_range(0..80), draw.random_range(1..=most))).collect();
        Self { jobs, budget: most, changes }
    }
}

/// A worker that the scheduler has started.
struct Worker {
    job: JobId,
    threads: usize,
    exit: oneshot::Sender<WorkerExit>,
}

/// Passes every worker to the test.
struct Workers(mpsc::UnboundedSender<Worker>);

impl Executor for Workers {
    fn start(&self, launch: Launch) -> BoxFuture<'_, std::io::Result<BoxFuture<'static, WorkerExit>>> {
        let (exit, ended) = oneshot::channel();
        let (job, threads) = (launch.lease.job_id, launch.resources.threads);
        self.0.send(Worker { job, threads, exit }).expect("the test receives workers");
        async move { Ok(async move { ended.await.unwrap_or(WorkerExit::of_worker("dropped by the test")) }.boxed()) }.boxed()
    }
}

/// A scheduler whose time and workers are those of the test.
struct Bed {
    time: ManualClock,
    store: Store,
    scheduler: Scheduler,
    draining: Draining,
    started: mpsc::UnboundedReceiver<Worker>,
    /// Changes when the scheduler has looked at its queue.
    looks: watch::Receiver<bool>,
    ids: HashMap<JobId, usize>,
    workers: HashMap<usize, Worker>,
}

impl Bed {
    async fn start(store: Store, budget: usize) -> Self {
        let time = ManualClock::new(Timestamp::from_second(1_000).unwrap());
        let (sender, started) = mpsc::unbounded_channel();
        let heartbeat_timeout = Duration::from_secs(1_000_000);
        let config = SchedulerConfig { max_attempts: 1, heartbeat_timeout, ..SchedulerConfig::new(budget) };
        let draining = Draining::default();
        let scheduler = Scheduler::open(store.clone(), config, Arc::new(Workers(sender)), time.clock(), draining.clone());
        let scheduler = scheduler.await.unwrap();
        let mut looks = scheduler.queue_readable();
        tokio::spawn(scheduler.clone().run("http://127.0.0.1:1".into()));
        within(looks.changed()).await.unwrap();
        Self { time, store, scheduler, draining, started, looks, ids: HashMap::new(), workers: HashMap::new() }
    }

    /// Lets something happen, and returns the jobs that the scheduler starts because of it, each with its threads.
    async fn apply(&mut self, event: Event, jobs: &[Job]) -> Vec<(usize, usize)> {
        // The scheduler does nothing at this moment, so its next look sees what happens now.
        self.looks.borrow_and_update();
        match event {
            Event::Ends(job) => {
                let worker = self.workers.remove(&job).unwrap();
                worker.exit.send(WorkerExit::of_worker("an exit of the test")).unwrap();
            }
            Event::Budget(threads) => self.scheduler.set_cpu_budget(threads),
            Event::Arrives(job) => {
                let id = JobId(uuid::Uuid::now_v7());
                self.ids.insert(id, job);
                self.store.submit_job(self.new_job(id, jobs[job])).await.unwrap();
                // Of no job that runs: the queue has changed.
                self.scheduler.job_changed(-1);
            }
        }
        within(self.looks.changed()).await.unwrap();
        let mut begun = Vec::new();
        while self.workers.values().map(|worker| worker.threads).sum::<usize>() != self.scheduler.threads_busy() {
            let worker = within(self.started.recv()).await.unwrap();
            let job = self.ids[&worker.job];
            begun.push((job, worker.threads));
            assert!(self.workers.insert(job, worker).is_none(), "a job has one worker");
        }
        begun
    }

    fn new_job(&self, id: JobId, job: Job) -> NewJob {
        let spec = JobSpec::train(TrainConfig::preset(Algorithm::Qmix, Preset::Practical));
        NewJob {
            id,
            owner: None,
            any_name: false,
            spec: JobSpec { threads: job.threads, priority: job.priority, ..spec },
            notes: String::new(),
            parent: None,
            beginning: None,
            now: self.time.clock().now(),
            idempotency: None,
        }
    }
}

/// Runs a schedule to its end and checks every step. Returns how many jobs were overtaken.
async fn check(seed: u64, store: Store) -> usize {
    let schedule = Schedule::random(&mut rng::stream(seed, "schedule", 0));
    let (jobs, mut budget) = (&schedule.jobs, schedule.budget);
    let mut bed = Bed::start(store, budget).await;
    let (mut state, mut overtaken, mut now) = (State::default(), 0, 0);
    let mut started = vec![None; jobs.len()];
    // The head that waits, and when it starts at the latest.
    let mut promise: Option<(usize, u64)> = None;
    while started.iter().any(Option::is_none) || !state.running.is_empty() {
        assert!(now < 5000, "schedule {seed}: a job starves");
        let ends = state.running.iter().filter(|running| running.end <= now).map(|running| Event::Ends(running.job));
        let changes = schedule.changes.iter().filter(|(at, _)| *at == now).map(|(_, threads)| Event::Budget(*threads));
        let arrivals = (0..jobs.len()).filter(|&job| jobs[job].arrives == now).map(Event::Arrives);
        for event in ends.chain(changes).chain(arrivals).collect::<Vec<_>>() {
            match event {
                Event::Ends(ended) => state.running.retain(|running| running.job != ended),
                Event::Budget(threads) => {
                    budget = threads;
                    promise = None;
                }
                Event::Arrives(job) => {
                    let at = state.queue.iter().position(|&other| jobs[other].priority < jobs[job].priority);
                    state.queue.insert(at.unwrap_or(state.queue.len()), job);
                }
            }
            let (before, used) = (state.clone(), state.used());
            let begun = bed.apply(event, jobs).await;
            let place =
                |job: usize| before.queue.iter().position(|&other| other == job).expect("a job starts once, from the queue");
            // A job that comes before the head, of a higher priority, may take its place.
            if promise.is_some_and(|(head, _)| begun.iter().any(|&(job, _)| place(job) < place(head))) {
                promise = None;
            }
            for &(job, threads) in &begun {
                assert_eq!(threads, jobs[job].threads.min(budget), "schedule {seed} at {now}: threads of {job}");
                started[job] = Some(now);
                state.queue.retain(|&other| other != job);
                state.running.push(Running { job, threads, end: now + jobs[job].runs });
            }
            // A budget that has become smaller ends no job.
            assert!(state.used() <= budget.max(used), "schedule {seed} at {now}: {} threads of {budget}", state.used());
            for &(job, threads) in &begun {
                for &waits in before.queue[..place(job)].iter().filter(|waits| state.queue.contains(waits)) {
                    // Who comes first is overtaken only by jobs that need less.
                    assert!(jobs[waits].threads.min(budget) > threads, "schedule {seed} at {now}: {job} overtakes {waits}");
                    overtaken += 1;
                }
            }
            let head = state.queue.first().copied();
            let fits = head.is_some_and(|head| state.used() + jobs[head].threads.min(budget) <= budget);
            assert!(!fits, "schedule {seed} at {now}: the head {head:?} waits although it fits");
            if let Some((at, (job, latest))) = promise.and_then(|promise| Some((started[promise.0]?, promise))) {
                assert!(at <= latest, "schedule {seed}: {job} was delayed from {latest} to {at}");
            }
            promise = head.map(|head| match promise {
                Some((job, latest)) if job == head => (job, latest),
                // Without overtaking from here on, among the jobs that were there.
                _ => (head, before.strict_start(jobs, budget, now, head)),
            });
        }
        let late = promise.filter(|(_, latest)| *latest <= now);
        assert!(late.is_none(), "schedule {seed} at {now}: {late:?} waits too long");
        now += 1;
        bed.time.advance(Duration::from_secs(1));
    }
    bed.draining.begin();
    overtaken
}

/// Schedules that run at once.
const LANES: u64 = 8;

/// Runs schedules one after another. Returns how many jobs were overtaken.
async fn check_all(seeds: impl Iterator<Item = u64>) -> usize {
    // In memory where there is such a directory: what is checked here does not depend on the disk.
    let memory = Path::new("/dev/shm");
    let dir = if memory.is_dir() { tempfile::tempdir_in(memory) } else { tempfile::tempdir() };
    let dir = dir.unwrap();
    let store = Store::open(dir.path()).await.unwrap();
    let mut overtaken = 0;
    for seed in seeds {
        overtaken += check(seed, store.clone()).await;
    }
    overtaken
}

fn number(variable: &str, default: u64) -> u64 {
    std::env::var(variable).map_or(default, |text| text.parse().unwrap())
}

#[tokio::test]
async fn random_schedules_keep_order_and_budget_and_starve_nobody() {
    let (first, count) = (number("QEDGIX_SEED", 0), number("QEDGIX_SCHEDULES", 100));
    // Several at once, each with a database, because a schedule waits for its database most of the time.
    let overtaken: usize =
        join_all((0..LANES).map(|lane| check_all((first + lane..first + count).step_by(LANES as usize)))).await.iter().sum();
    assert!(overtaken > 0 || count < 100, "no job has started before the head");
}
