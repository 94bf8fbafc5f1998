//! The worker process, which works on one attempt of a job. It reaches the server only through `WorkerService`, so it can run
//! on any machine.
//!
//! Training runs on its own thread. It puts reports into a queue, and a task sends them in order, so the server has all metrics
//! that come before a snapshot. Training waits only when the queue is full, because the server does not answer for long.

mod client;
mod early_stop;
mod evaluation;
mod report;
mod rival;
mod run_report;
mod training;

use std::any::Any;
use std::io::{Read, Write};
use std::panic::AssertUnwindSafe;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};
use std::time::Duration;

use tokio::sync::{mpsc, oneshot};

use self::client::{Client, ClientError};
use self::early_stop::StopRule;
use self::evaluation::EvaluationTask;
pub use self::rival::RivalComparison;
use self::training::{ReportQueue, TrainingTask};
use super::Directive;
use super::evaluation::EvaluationSpec;
use super::{cores, memory};
use crate::store::WorkerResult;
use crate::wire::v1;

/// Environment variable with the address of the server's gRPC.
pub const ENV_SERVER: &str = "QEDGIX_WORKER_SERVER";
/// Environment variable with the id of the job.
pub const ENV_JOB: &str = "QEDGIX_JOB";
/// Environment variable with the number of the attempt.
pub const ENV_ATTEMPT: &str = "QEDGIX_ATTEMPT";
/// Environment variable with the cores that the worker runs on, as `0,3`; absent or empty: any.
pub const ENV_CORES: &str = "QEDGIX_WORKER_CORES";
/// Environment variable with the attempt's secret.
pub const ENV_TOKEN: &str = "QEDGIX_TOKEN";

/// Maximum number of reports in the queue.
const QUEUE: usize = 1024;

/// Time between two heartbeats, and so the maximum delay of a directive.
const HEARTBEAT_INTERVAL: Duration = Duration::from_millis(400);

/// The attempt to work on, and the server to report to.
#[derive(Clone, serde::Serialize, serde::Deserialize)]
pub struct Assignment {
    /// Address of the server's gRPC, as `http://127.0.0.1:50051`.
    pub server: String,
    /// Id of the job.
    pub job: String,
    /// Number of the attempt.
    pub attempt: String,
    /// The attempt's secret.
    pub token: String,
}

impl Assignment {
    /// The assignment as JSON.
    pub fn to_json(&self) -> String {
        serde_json::to_string(self).expect("texts are plain data")
    }

    /// The assignment that [`Assignment::to_json`] wrote.
    ///
    /// # Errors
    /// [`ClientError::Assignment`] for another text.
    pub fn from_json(text: &str) -> Result<Self, ClientError> {
        serde_json::from_str(text).map_err(|error| ClientError::Assignment(error.to_string()))
    }
}

/// Why a worker failed.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A call to the server failed.
    #[error(transparent)]
    Client(#[from] ClientError),
    /// The configuration from the server cannot be parsed.
    #[error("the server sent an invalid configuration: {0}")]
    Configuration(serde_json::Error),
    /// The system refused a thread or a signal handler.
    #[error("starting: {0}")]
    Start(#[from] std::io::Error),
    /// Training failed, and the failure was reported to the server.
    #[error("{0}")]
    Training(String),
}

/// The directive for the training thread. Initially it is [`Directive::Continue`].
#[derive(Debug, Default)]
pub(crate) struct StopSignal {
    directive: AtomicU8,
    /// Set with the first directive to stop: the stop flag of the trainer.
    stop: Arc<AtomicBool>,
}

impl StopSignal {
    const CONTINUE: u8 = 0;
    const PAUSE: u8 = 1;
    const CANCEL: u8 = 2;

    fn set(&self, directive: Directive) {
        let value = match directive {
            Directive::Continue => Self::CONTINUE,
            Directive::Pause => Self::PAUSE,
            Directive::Cancel => Self::CANCEL,
        };
        // A cancel is final. A pause can only be replaced by a cancel.
        self.directive.fetch_max(value, Ordering::Relaxed);
        if directive != Directive::Continue {
            self.stop.store(true, Ordering::Release);
        }
    }

    /// A flag that is set when the training thread has to stop.
    fn flag(&self) -> Arc<AtomicBool> {
        Arc::clone(&self.stop)
    }

    fn directive(&self) -> Directive {
        match self.directive.load(Ordering::Relaxed) {
            Self::CONTINUE => Directive::Continue,
            Self::PAUSE => Directive::Pause,
            _ => Directive::Cancel,
        }
    }
}

/// Lowers the CPU priority of this process, and makes it the first process that the system ends when memory runs out. To be
/// called before threads start, because threads inherit the priority.
pub fn lower_priority() {
    // Errors are ignored: training works without either.
    let _ = rustix::process::nice(10);
    let _ = std::fs::write("/proc/self/oom_score_adj", "500");
}

/// Confines this process to the cores of [`ENV_CORES`]. To be called before threads start, because threads inherit the cores.
pub fn confine_to_cores() {
    if let Ok(list) = std::env::var(ENV_CORES) {
        cores::confine(&list);
    }
}

/// Ends this process when its standard input is closed. The server that started this process holds the other end of the pipe,
/// so the pipe closes when the server ends.
///
/// # Errors
/// [`std::io::Error`] when the system refuses a thread.
pub fn exit_with_stdin() -> std::io::Result<()> {
    let watch = || {
        let mut input = std::io::stdin().lock();
        while let Ok(1..) = input.read(&mut [0; 64]) {}
        // The server also held the other end of standard error, so this write may fail. `eprintln!` would panic then, and the
        // process would go on without a server.
        let _ = writeln!(std::io::stderr(), "the server has ended");
        std::process::exit(3);
    };
    std::thread::Builder::new().name("stdin".into()).spawn(watch).map(drop)
}

/// Runs the attempt to its end.
///
/// # Errors
/// [`Error::Client`] when the attempt has ended or the server does not answer, [`Error::Training`] when training failed.
pub async fn run(assignment: Assignment) -> Result<(), Error> {
    let client = Client::new(&assignment)?;
    let stop = Arc::new(StopSignal::default());
    let mut terminate = tokio::signal::unix::signal(tokio::signal::unix::SignalKind::terminate())?;
    let pause = async {
        terminate.recv().await;
        stop.set(Directive::Pause);
        std::future::pending::<ClientError>().await
    };
    // Heartbeats stop before `finish` is called: after it, a heartbeat would fail because the attempt has ended.
    let (result, document) = tokio::select! {
        result = work(&client, Arc::clone(&stop)) => result?,
        error = send_heartbeats(&client, &stop) => return Err(error.into()),
        error = pause => return Err(error.into()),
    };
    let (outcome, reason, permanent) = match result {
        WorkerResult::Succeeded => (v1::Outcome::Succeeded, String::new(), false),
        WorkerResult::EndedEarly { reason } => (v1::Outcome::Succeeded, reason, false),
        WorkerResult::Stopped => (v1::Outcome::Stopped, String::new(), false),
        WorkerResult::Failed { reason, permanent } => (v1::Outcome::Failed, reason, permanent),
    };
    tracing::info!(?outcome, reason, "training ended");
    let result = document.unwrap_or_default();
    client.finish(v1::FinishRequest { outcome: outcome.into(), reason: reason.clone(), permanent, result }).await?;
    if outcome == v1::Outcome::Failed { Err(Error::Training(reason)) } else { Ok(()) }
}

/// Sends heartbeats and passes on the directives of the server, until a call fails.
async fn send_heartbeats(client: &Client, stop: &StopSignal) -> ClientError {
    loop {
        match client.heartbeat().await {
            Ok(directive) => stop.set(directive),
            Err(error) => return error,
        }
        tokio::time::sleep(HEARTBEAT_INTERVAL).await;
    }
}

/// What the thread of the worker does.
#[allow(clippy::large_enum_variant, reason = "one value, moved once")]
enum Work {
    Train(TrainingTask),
    Evaluate(EvaluationTask),
}

impl Work {
    /// Fetches the task of the attempt and everything that it needs, and the limit of memory in bytes.
    async fn fetch(client: &Client) -> Result<(Self, Option<u64>), Error> {
        let task = client.fetch().await?;
        let threads = task.threads as usize;
        if !task.evaluation.is_empty() {
            let spec: EvaluationSpec = serde_json::from_str(&task.evaluation).map_err(Error::Configuration)?;
            let mut checkpoints = Vec::new();
            for name in spec.policies.iter().filter(|name| name.contains(':')) {
                checkpoints.push((name.clone(), client.download_policy(name).await?));
            }
            tracing::info!(threads, policies = spec.policies.len(), "evaluating");
            return Ok((Self::Evaluate(EvaluationTask { spec, checkpoints, threads }), task.memory));
        }
        let config = serde_json::from_str(&task.config).map_err(Error::Configuration)?;
        let snapshot = match task.snapshot_step {
            Some(_) => Some(client.download_snapshot().await?),
            None => None,
        };
        let initial_weights = match task.snapshot_step {
            None if task.initial_weights => Some(client.download_initial_weights().await?),
            _ => None,
        };
        tracing::info!(threads, from_step = task.snapshot_step, "training");
        let snapshot_every = Duration::from_millis(task.snapshot_every_ms);
        let stop_rule = match task.stop.as_str() {
            "" => None,
            rule => Some(serde_json::from_str(rule).map_err(Error::Configuration)?),
        };
        let observed: Vec<_> = task.observed.iter().map(|metric| (metric.step, metric.value)).collect();
        let stop_rule = stop_rule.map(|rule| StopRule::new(rule, &observed));
        let report = match task.report.as_str() {
            "" => None,
            report => Some(serde_json::from_str(report).map_err(Error::Configuration)?),
        };
        let rival = task.rival;
        let task_memory = task.memory;
        let task = TrainingTask { config, threads, snapshot, initial_weights, snapshot_every, stop_rule, rival, report };
        Ok((Self::Train(task), task_memory))
    }

    /// Does the work. Returns how it ended, and the result as JSON if it has one.
    fn run(self, reports: &ReportQueue, stop: &StopSignal, server: &ServerHandle) -> (WorkerResult, Option<String>) {
        match self {
            Self::Train(task) => training::train(task, reports, stop, server),
            Self::Evaluate(task) => evaluation::evaluate(&task, reports, stop),
        }
    }
}

/// Calls of the server by the thread of the work, which waits for them.
pub(crate) struct ServerHandle {
    client: Client,
    runtime: tokio::runtime::Handle,
}

impl ServerHandle {
    fn rival(&self) -> Result<Option<(String, Vec<u8>)>, ClientError> {
        self.runtime.block_on(self.client.download_rival())
    }
}

/// Does the work of the attempt on a thread of its own, and reports it.
async fn work(client: &Client, stop: Arc<StopSignal>) -> Result<(WorkerResult, Option<String>), Error> {
    let (work, limit) = Work::fetch(client).await?;
    let (sender, receiver) = mpsc::channel(QUEUE);
    let reports = ReportQueue::new(sender);
    let snapshot_pending = reports.snapshot_pending();
    let (result_sender, result) = oneshot::channel();
    let server = ServerHandle { client: client.clone(), runtime: tokio::runtime::Handle::current() };
    let run = move || {
        let result = std::panic::catch_unwind(AssertUnwindSafe(|| work.run(&reports, &stop, &server)));
        let result = result.unwrap_or_else(|panic| {
            let reason = format!("panic: {}", panic_message(&*panic));
            (WorkerResult::Failed { reason, permanent: false }, None)
        });
        // Closes the queue, so that sending ends after the last report.
        drop(reports);
        // The receiver is dropped when the process is ending.
        let _ = result_sender.send(result);
    };
    std::thread::Builder::new().name("training".into()).spawn(run)?;
    let done = async {
        report::send_all(client, receiver, &snapshot_pending).await?;
        Ok(result.await.expect("the thread sends its result even if it panics"))
    };
    let Some(limit) = limit else { return done.await };
    tokio::select! {
        done = done => done,
        used = memory::exceeds(limit) => {
            let [used, limit] = [used, limit].map(|bytes| bytes.div_ceil(1 << 20));
            let reason = format!("the worker uses {used} MiB of memory, more than the limit of the job, {limit} MiB (memory)");
            // Another attempt would need as much.
            Ok((WorkerResult::Failed { reason, permanent: true }, None))
        }
    }
}

/// The message of a panic.
fn panic_message(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("no message")
}
