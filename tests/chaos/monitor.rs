//! Watches from outside, all the time, that running jobs never use more threads than the CPU budget.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use reqwest::Method;
use serde_json::Value;
use tokio::task::JoinHandle;

use crate::process::rest::Rest;
use crate::process::{WorkerProcess, worker_processes};

/// Time between two samples.
const PERIOD: Duration = Duration::from_millis(150);
/// The worker of a killed server needs a moment to notice. The same processes in this many samples in a row are too many.
const SAMPLES: usize = 4;

/// What the monitor has to know, and what it has seen.
#[derive(Default)]
pub struct Seen {
    /// Threads of each job, by id.
    pub threads: HashMap<String, usize>,
    /// Client of the server that runs now.
    pub rest: Option<Rest>,
    /// Most threads that running jobs used: by the process table and by the states of jobs.
    pub most: (usize, usize),
    pub samples: usize,
    pub violations: Vec<String>,
}

impl Seen {
    /// The first violations are enough.
    fn violation(&mut self, text: String) {
        if self.violations.len() < 3 {
            self.violations.push(text);
        }
    }
}

/// Samples until it is dropped.
pub struct Monitor {
    pub seen: Arc<Mutex<Seen>>,
    task: JoinHandle<()>,
}

impl Monitor {
    pub fn start(budget: usize) -> Self {
        let seen = Arc::<Mutex<Seen>>::default();
        Self { task: tokio::spawn(watch(Arc::clone(&seen), budget)), seen }
    }

    /// Workers of the test's jobs in the process table, those that are stopped by a signal excluded.
    pub fn workers(&self) -> Vec<WorkerProcess> {
        let seen = self.seen.lock().unwrap();
        let ours = |worker: &WorkerProcess| !worker.halted && seen.threads.contains_key(&worker.job);
        worker_processes().into_iter().filter(ours).collect()
    }
}

impl Drop for Monitor {
    fn drop(&mut self) {
        self.task.abort();
    }
}

async fn watch(seen: Arc<Mutex<Seen>>, budget: usize) {
    let mut above: Vec<Vec<WorkerProcess>> = Vec::new();
    loop {
        tokio::time::sleep(PERIOD).await;
        let rest = {
            let mut seen = seen.lock().unwrap();
            let mut workers: Vec<_> = worker_processes().into_iter().filter(|w| !w.halted).collect();
            workers.retain(|worker| seen.threads.contains_key(&worker.job));
            // A process that was there in every sample since the budget was exceeded.
            let lasting = |worker: &&WorkerProcess| above.iter().all(|sample| sample.contains(worker));
            let used: usize = workers.iter().filter(lasting).map(|worker| seen.threads[&worker.job]).sum();
            seen.samples += 1;
            if used <= budget {
                above.clear();
                seen.most.0 = seen.most.0.max(used);
            } else if above.len() + 1 >= SAMPLES {
                seen.violation(format!("workers use {used} threads: {workers:?}"));
                seen.most.0 = seen.most.0.max(used);
                above.clear();
            } else {
                above.push(workers);
            }
            seen.rest.clone()
        };
        let Some(used) = running_threads(rest, &seen).await else { continue };
        let mut seen = seen.lock().unwrap();
        seen.most.1 = seen.most.1.max(used);
        if used > budget {
            seen.violation(format!("running jobs have {used} threads"));
        }
    }
}

/// Threads of the jobs that are running by their state, if the server answers.
async fn running_threads(rest: Option<Rest>, seen: &Mutex<Seen>) -> Option<usize> {
    let list = rest?.request(Method::GET, "/v1/jobs?state=running&page_size=1000").timeout(Duration::from_secs(1));
    let list: Value = list.send().await.ok()?.error_for_status().ok()?.json().await.ok()?;
    let seen = seen.lock().unwrap();
    Some(list["jobs"].as_array()?.iter().filter_map(|job| seen.threads.get(job["id"].as_str()?)).sum())
}
