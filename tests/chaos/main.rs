//! Jobs on a real server with real workers while the machine fails under them. In the end every job has ended as asked, with the
//! rows and the weights of a run that nothing disturbed; the CPU budget was never exceeded, the database is sound, and no worker
//! is left over.
//!
//! A short form by default. The full form, and a repetition of a run (the same faults; the system decides which process is hit at
//! which step):
//!
//!     QEDGIX_CHAOS_INJECTIONS=200 cargo test --release --test chaos -- --nocapture
//!     QEDGIX_CHAOS_SEED=17 QEDGIX_CHAOS_INJECTIONS=200 cargo test --release --test chaos -- --nocapture
//!
//! `QEDGIX_CHAOS_ONLY=FullDisk,KillServer` injects some of the faults only; `QEDGIX_CHAOS_JOBS` is the number of jobs.

mod disk;
mod faults;
mod jobs;
mod monitor;
#[path = "../process/mod.rs"]
mod process;

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::path::Path;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use rand::RngExt;
use rand::seq::{IndexedRandom, SliceRandom};
use rand_chacha::ChaCha8Rng;
use reqwest::Method;
use serde_json::Value;
use sqlx::{Connection, SqliteConnection};

use self::disk::Disk;
use self::faults::Fault;
use self::jobs::{ENDED, Yield};
use self::monitor::Monitor;
use self::process::rest::Rest;
use self::process::{Process, WorkerProcess};

/// CPU budget of the server.
const BUDGET: usize = 2;
/// Time without a heartbeat after which a worker is replaced.
const LEASE: Duration = Duration::from_secs(2);
/// Time in which the server works again after a fault has ended.
const RECOVERY: Duration = Duration::from_secs(15);
/// Time in which an answer has to come that the test insists on.
const INSIST: Duration = Duration::from_secs(60);
/// Time in which a job has to make progress, or end, once the faults are over.
const PROGRESS: Duration = Duration::from_secs(60);

/// A job that was submitted.
struct ChaosJob {
    id: String,
    /// Whether the server has acknowledged that it is cancelled.
    cancelled: bool,
    /// Whether it is known to have ended.
    ended: bool,
}

struct Chaos {
    rng: ChaCha8Rng,
    /// Whether this is the full form.
    full: bool,
    started: Instant,
    disk: Disk,
    server: Option<Process>,
    rest: Rest,
    /// The kinds of faults that are injected.
    faults: Vec<Fault>,
    specs: Vec<Value>,
    /// By number.
    jobs: Vec<ChaosJob>,
    monitor: Monitor,
    /// Number of answers by method and status.
    answers: Mutex<BTreeMap<String, usize>>,
    skipped: BTreeSet<String>,
    violations: Vec<String>,
    log: tempfile::NamedTempFile,
}

impl Chaos {
    fn say(&self, text: &str) {
        println!("[{:7.1} s] {text}", self.started.elapsed().as_secs_f64());
    }

    fn violation(&mut self, text: String) {
        self.say(&format!("VIOLATION: {text}"));
        self.violations.push(text);
    }

    fn skip(&mut self, text: &str) {
        self.say(&format!("  skipped: {text}"));
        self.skipped.insert(text.to_owned());
    }

    /// Starts the server if it was killed, with its monotonic time moved by `clock` seconds, and waits until it works.
    async fn start_server(&mut self, clock: Option<i64>) {
        if let Some(status) = self.server.as_mut().and_then(Process::ended) {
            self.server = None;
            self.violation(format!("the server ended by itself: {status}"));
        }
        if self.server.is_none() {
            let mut command = process::serve(&self.disk.data_dir());
            command.args(["--cpu-budget", &BUDGET.to_string(), "--snapshot-every", "0.3", "--drain-timeout", "5"]);
            command.args(["--heartbeat-timeout", &LEASE.as_secs().to_string(), "--max-attempts", "10"]);
            if let Some(seconds) = clock {
                let steps = [format!("--monotonic={seconds}"), format!("--boottime={seconds}")];
                command = process::run_by(&["unshare", "--time", &steps[0], &steps[1]], &command);
            }
            command.stderr(File::options().append(true).open(self.log.path()).unwrap());
            match Process::try_start(command).await {
                Ok(server) => {
                    self.rest = Rest::new(format!("http://{}", server.http));
                    self.monitor.seen.lock().unwrap().rest = Some(self.rest.clone());
                    self.server = Some(server);
                }
                Err(status) => {
                    self.violation(format!("the server does not start: {status}"));
                    panic!("{}", self.log_tail());
                }
            }
        }
        let ended = Instant::now();
        while self.ask(Method::GET, "/readyz".into(), Duration::from_secs(2)).await.is_none_or(|(status, _)| status != 200) {
            if ended.elapsed() > RECOVERY {
                self.violation(format!("the server does not work {} s after the fault", RECOVERY.as_secs()));
                return;
            }
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    }

    /// A running worker of the test's jobs, which may take a moment to start.
    async fn some_worker(&mut self) -> Option<WorkerProcess> {
        for _ in 0..20 {
            let workers = self.monitor.workers();
            if let Some(worker) = workers.choose(&mut self.rng) {
                self.say(&format!("  worker {} of job {}", worker.pid, worker.job));
                return Some(worker.clone());
            }
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
        self.say("  no worker runs");
        None
    }

    /// Sends a request: the status and the body, if there is an answer.
    async fn ask(&self, method: Method, path: String, timeout: Duration) -> Option<(u16, Value)> {
        let request = self.rest.request(method.clone(), &path).timeout(timeout);
        let answer = async {
            let response = request.send().await.ok()?;
            let status = response.status().as_u16();
            let body = response.text().await.ok()?;
            Some((status, serde_json::from_str(&body).unwrap_or(Value::Null)))
        };
        let answer = answer.await;
        let status = answer.as_ref().map_or_else(|| "no answer".to_owned(), |(status, _)| status.to_string());
        *self.answers.lock().unwrap().entry(format!("{method} {status}")).or_default() += 1;
        answer
    }

    /// Repeats a request until its status is accepted, which it returns.
    async fn insist(&mut self, method: Method, path: &str, accept: impl Fn(u16) -> bool) -> u16 {
        let began = Instant::now();
        loop {
            let answer = self.ask(method.clone(), path.to_owned(), Duration::from_secs(15)).await;
            match answer {
                Some((status, _)) if accept(status) => return status,
                other if began.elapsed() > INSIST => {
                    self.violation(format!("{method} {path} is not possible: {other:?}"));
                    panic!("{}", self.log_tail());
                }
                _ => tokio::time::sleep(Duration::from_millis(100)).await,
            }
        }
    }

    /// Submits the next job. A repeated submission is no second job.
    async fn submit(&mut self) {
        let number = self.jobs.len();
        let began = Instant::now();
        let id = loop {
            let request = self.rest.request(Method::POST, "/v1/jobs").json(&self.specs[number]);
            let request = request.header("idempotency-key", format!("chaos-{number}")).timeout(Duration::from_secs(15));
            if let Ok(response) = request.send().await
                && response.status() == 201
                && let Ok(job) = response.json::<Value>().await
            {
                break job["id"].as_str().expect("a job has an id").to_owned();
            }
            assert!(began.elapsed() < INSIST, "job {number} cannot be submitted; {}", self.log_tail());
            tokio::time::sleep(Duration::from_millis(100)).await;
        };
        self.say(&format!("job {number} is {id}"));
        self.monitor.seen.lock().unwrap().threads.insert(id.clone(), jobs::threads(number));
        self.jobs.push(ChaosJob { id, cancelled: false, ended: false });
    }

    /// The job, as soon as the server tells.
    async fn read(&mut self, number: usize) -> Value {
        let path = format!("/v1/jobs/{}", self.jobs[number].id);
        let began = Instant::now();
        loop {
            match self.ask(Method::GET, path.clone(), Duration::from_secs(5)).await {
                Some((200, job)) => {
                    self.jobs[number].ended |= job["state"].as_str().is_some_and(|state| ENDED.contains(&state));
                    return job;
                }
                other if began.elapsed() > INSIST => {
                    self.violation(format!("job {number} cannot be read: {other:?}"));
                    panic!("{}", self.log_tail());
                }
                _ => tokio::time::sleep(Duration::from_millis(100)).await,
            }
        }
    }

    /// Numbers of the jobs that have not ended.
    async fn unfinished(&mut self) -> Vec<usize> {
        let mut numbers = Vec::new();
        for number in 0..self.jobs.len() {
            if !self.jobs[number].ended {
                self.read(number).await;
            }
            numbers.extend((!self.jobs[number].ended).then_some(number));
        }
        numbers
    }

    /// Injects `count` faults, each kind as often as the others, and submits the jobs meanwhile.
    async fn run(&mut self, count: usize) {
        let mut deck: Vec<Fault> = Vec::new();
        for number in 0..count {
            // Three at first, the others evenly.
            while self.jobs.len() < (3 + number * self.specs.len() / count).min(self.specs.len()) {
                self.submit().await;
            }
            if deck.is_empty() {
                deck.clone_from(&self.faults);
                deck.shuffle(&mut self.rng);
            }
            let pause = self.rng.random_range(0.1..1.2);
            tokio::time::sleep(Duration::from_secs_f64(pause)).await;
            let fault = deck.pop().expect("refilled above");
            self.say(&format!("{:>3} of {count}: {fault:?}", number + 1));
            self.inject(fault).await;
            self.start_server(None).await;
        }
        while self.jobs.len() < self.specs.len() {
            self.submit().await;
        }
    }

    /// Resumes what is paused until every job has ended.
    async fn finish(&mut self) {
        let mut last = (Instant::now(), Vec::new());
        loop {
            let mut progress = Vec::new();
            for number in self.unfinished().await {
                let job = self.read(number).await;
                if job["state"] == "paused" {
                    let path = format!("/v1/jobs/{}/resume", self.jobs[number].id);
                    self.ask(Method::POST, path, Duration::from_secs(15)).await;
                }
                progress.push((number, job["state"].clone(), job["progress"]["step"].clone()));
            }
            if progress.is_empty() {
                return;
            }
            if progress != last.1 {
                last = (Instant::now(), progress);
            } else if last.0.elapsed() > PROGRESS {
                self.violation(format!("jobs do not go on: {progress:?}"));
                return;
            }
            tokio::time::sleep(Duration::from_millis(200)).await;
        }
    }

    /// Compares every job with the undisturbed run.
    async fn compare(&mut self, undisturbed: &[Yield]) {
        for (number, expected) in undisturbed.iter().enumerate() {
            let job = self.read(number).await;
            let state = job["state"].as_str().unwrap_or_default();
            let asked = if self.jobs[number].cancelled { "cancelled" } else { "succeeded" };
            if state != asked {
                self.violation(format!("job {number} is {state}, not {asked}: {}", job["reason"]));
                let logs = self.rest.get(&format!("/v1/jobs/{}/logs", self.jobs[number].id)).await;
                let attempts = logs["attempts"].as_array().cloned().unwrap_or_default();
                for attempt in attempts {
                    println!("  attempt {}: {} {}", attempt["number"], attempt["outcome"], attempt["reason"]);
                }
            }
            let found = Yield::of(&self.rest, &self.jobs[number].id).await;
            let mut differences =
                if asked == "cancelled" { jobs::row_differences(&found.rows, &expected.rows) } else { found.differs(expected) };
            if asked == "cancelled" && found.published.is_some() {
                differences.push("a cancelled job has published a policy".into());
            }
            let events = self.events(number).await;
            differences.extend(events);
            differences.truncate(5);
            for difference in differences {
                self.violation(format!("job {number}: {difference}"));
            }
        }
        let list = self.rest.get("/v1/jobs?page_size=1000").await;
        let stored = list["jobs"].as_array().map_or(0, Vec::len);
        if stored != self.jobs.len() {
            self.violation(format!("{stored} jobs are stored, {} were submitted", self.jobs.len()));
        }
    }

    /// What is wrong with the events of a job that has ended: ids that do not grow, or not exactly one end.
    async fn events(&self, number: usize) -> Option<String> {
        let path = format!("/v1/jobs/{}/events", self.jobs[number].id);
        let text = self.rest.request(Method::GET, &path).timeout(Duration::from_secs(30)).send().await.ok()?.text().await.ok()?;
        let ids: Vec<u64> = text.lines().filter_map(|line| line.strip_prefix("id: ")?.parse().ok()).collect();
        let states = text.lines().filter_map(|line| serde_json::from_str::<Value>(line.strip_prefix("data: ")?).ok());
        let ends = states.filter(|event| event["state"].as_str().is_some_and(|state| ENDED.contains(&state))).count();
        let sorted = ids.is_sorted_by(|a, b| a < b);
        (!sorted || ends != 1).then(|| format!("{} events, sorted: {sorted}, ends: {ends}", ids.len()))
    }

    /// Stops the server, and looks at what it leaves behind.
    async fn leave(&mut self) {
        let mut server = self.server.take().expect("it runs");
        let status = server.terminate().await;
        if !status.success() {
            self.violation(format!("the server ended with {status} on SIGTERM"));
        }
        let left = self.monitor.workers();
        if !left.is_empty() {
            for worker in &left {
                let _ = process::signal("KILL", worker.pid);
            }
            self.violation(format!("workers are left over: {left:?}"));
        }
        for problem in damage(&self.disk.data_dir().join(qedgix::store::FILE)).await {
            self.violation(format!("database: {problem}"));
        }
        let mut seen = self.monitor.seen.lock().unwrap();
        let violations = std::mem::take(&mut seen.violations);
        println!("CPU budget {BUDGET}: at most {:?} threads by processes and states, {} samples", seen.most, seen.samples);
        drop(seen);
        for violation in violations {
            self.violation(violation);
        }
    }

    fn log_tail(&self) -> String {
        let text = std::fs::read_to_string(self.log.path()).unwrap_or_default();
        let lines: Vec<&str> = text.lines().collect();
        format!("the last lines of the server:\n{}", lines[lines.len().saturating_sub(40)..].join("\n"))
    }
}

/// What SQLite finds wrong with the file.
async fn damage(file: &Path) -> Vec<String> {
    let mut database = SqliteConnection::connect(&format!("sqlite://{}", file.display())).await.unwrap();
    let integrity: Vec<String> = sqlx::query_scalar("PRAGMA integrity_check").fetch_all(&mut database).await.unwrap();
    let keys = sqlx::query("PRAGMA foreign_key_check").fetch_all(&mut database).await.unwrap();
    database.close().await.unwrap();
    let mut problems: Vec<String> = integrity.into_iter().filter(|line| line != "ok").collect();
    problems.extend(keys.iter().map(|_| "a foreign key refers to nothing".to_owned()));
    problems
}

fn setting<T: std::str::FromStr>(name: &str) -> Option<T> {
    std::env::var(name).ok().map(|text| text.parse().unwrap_or_else(|_| panic!("{name}: a number")))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_job_ends_as_asked_whatever_happens() {
    let injections: Option<usize> = setting("QEDGIX_CHAOS_INJECTIONS");
    let full = injections.is_some();
    let count = injections.unwrap_or(Fault::ALL.len());
    let seed = setting("QEDGIX_CHAOS_SEED").unwrap_or(if full { uuid::Uuid::now_v7().as_u128() as u64 % 1_000_000 } else { 1 });
    let only = std::env::var("QEDGIX_CHAOS_ONLY").ok();
    let chosen = |fault: &Fault| only.as_ref().is_none_or(|only| only.split(',').any(|name| name == format!("{fault:?}")));
    let (jobs, steps) = if full { (30, 24_000) } else { (6, 8_000) };
    let jobs = setting("QEDGIX_CHAOS_JOBS").unwrap_or(jobs);
    println!("QEDGIX_CHAOS_SEED={seed}: {count} faults, {jobs} jobs of {steps} environment steps");
    let specs: Vec<Value> = (0..jobs).map(|number| jobs::spec(number, steps)).collect();
    let started = Instant::now();
    let undisturbed = jobs::undisturbed(&specs, BUDGET).await;
    println!("undisturbed: {:.1} s", started.elapsed().as_secs_f64());

    let mut chaos = Chaos {
        rng: qedgix::rng::stream(seed, "chaos", 0),
        full,
        started: Instant::now(),
        disk: Disk::new(),
        server: None,
        rest: Rest::new(String::new()),
        faults: Fault::ALL.into_iter().filter(chosen).collect(),
        specs,
        jobs: Vec::new(),
        monitor: Monitor::start(BUDGET),
        answers: Mutex::default(),
        skipped: BTreeSet::new(),
        violations: Vec::new(),
        log: tempfile::NamedTempFile::new().unwrap(),
    };
    chaos.start_server(None).await;
    chaos.run(count).await;
    chaos.say("no more faults");
    chaos.finish().await;
    chaos.compare(&undisturbed).await;
    chaos.leave().await;
    let cancelled = chaos.jobs.iter().filter(|job| job.cancelled).count();
    chaos.say(&format!("{count} faults, {jobs} jobs, {cancelled} of them cancelled"));
    println!("answers: {:?}", chaos.answers.lock().unwrap());
    println!("skipped: {:?}", chaos.skipped);
    assert!(chaos.violations.is_empty(), "QEDGIX_CHAOS_SEED={seed}: {:#?}; {}", chaos.violations, chaos.log_tail());
}
