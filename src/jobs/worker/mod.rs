//! The worker process: one attempt at one job. It reaches the server only through `WorkerService`, so it can run anywhere.
//!
//! Training has a thread of its own and never waits for the network: what it tells goes through a queue to the reporter,
//! which sends it in order, so that a snapshot on the server never lacks a row that came before it.

mod client;
mod report;
mod training;

use std::any::Any;
use std::io::Read;
use std::panic::AssertUnwindSafe;
use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};
use std::time::Duration;

use tokio::sync::{mpsc, oneshot};

use self::client::{Client, Lost};
use self::training::{End, Outbox, Task};
use super::Directive;
use crate::wire::v1;

/// Environment variable that says where the server's gRPC is.
pub const ENV_SERVER: &str = "QEDGIX_SERVER";
/// Environment variable with the id of the job.
pub const ENV_JOB: &str = "QEDGIX_JOB";
/// Environment variable with the number of the attempt.
pub const ENV_ATTEMPT: &str = "QEDGIX_ATTEMPT";
/// Environment variable with the attempt's secret.
pub const ENV_TOKEN: &str = "QEDGIX_TOKEN";

/// Time between two heartbeats: how long a cancel takes to arrive.
const HEARTBEAT: Duration = Duration::from_millis(400);

/// Which attempt this process is, and where its server is.
#[derive(Clone)]
pub struct Assignment {
    /// The server's gRPC, as `http://127.0.0.1:50051`.
    pub server: String,
    /// The job.
    pub job: String,
    /// The attempt.
    pub attempt: String,
    /// The attempt's secret.
    pub token: String,
}

/// Why a worker could not do its work.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The server refuses it or is gone.
    #[error(transparent)]
    Lost(#[from] Lost),
    /// What the server sent makes no sense to this version.
    #[error("the server sent {what} that cannot be used: {reason}")]
    Work {
        /// Which part.
        what: &'static str,
        /// What is wrong with it.
        reason: String,
    },
    /// The system refuses a thread or a signal handler.
    #[error("starting: {0}")]
    Start(#[from] std::io::Error),
    /// Training failed, and the server knows.
    #[error("{0}")]
    Training(String),
}

/// What training is to do: go on, until somebody says otherwise.
#[derive(Debug, Default)]
pub(crate) struct Orders(AtomicU8);

impl Orders {
    const CONTINUE: u8 = 0;
    const PAUSE: u8 = 1;
    const CANCEL: u8 = 2;

    fn give(&self, directive: Directive) {
        let order = match directive {
            Directive::Continue => Self::CONTINUE,
            Directive::Pause => Self::PAUSE,
            Directive::Cancel => Self::CANCEL,
        };
        // A cancel is final, and a pause is only overruled by a cancel.
        self.0.fetch_max(order, Ordering::Relaxed);
    }

    fn read(&self) -> Directive {
        match self.0.load(Ordering::Relaxed) {
            Self::CONTINUE => Directive::Continue,
            Self::PAUSE => Directive::Pause,
            _ => Directive::Cancel,
        }
    }
}

/// Steps behind whatever serves people on this machine: lower priority, and first to go when memory runs out. To be called
/// before there are threads, which inherit it.
pub fn step_back() {
    // Training works without either; it is only less polite.
    let _ = rustix::process::nice(10);
    let _ = std::fs::write("/proc/self/oom_score_adj", "500");
}

/// Ends this process when standard input does: whoever started it holds the other end and is gone.
///
/// # Errors
/// The system refuses a thread.
pub fn tether() -> std::io::Result<()> {
    let watch = || {
        let mut input = std::io::stdin().lock();
        while let Ok(1..) = input.read(&mut [0; 64]) {}
        eprintln!("the server is gone");
        std::process::exit(3);
    };
    std::thread::Builder::new().name("tether".into()).spawn(watch).map(drop)
}

/// Runs the attempt to its end.
///
/// # Errors
/// The attempt is over, the server is gone, or training failed.
pub async fn run(assignment: Assignment) -> Result<(), Error> {
    let client = Client::new(&assignment)?;
    let orders = Arc::new(Orders::default());
    let mut terminate = tokio::signal::unix::signal(tokio::signal::unix::SignalKind::terminate())?;
    let pause = async {
        terminate.recv().await;
        orders.give(Directive::Pause);
        std::future::pending::<Lost>().await
    };
    // No heartbeat goes with the last call: it would find the attempt over.
    let end = tokio::select! {
        end = work(&client, Arc::clone(&orders)) => end?,
        lost = beat(&client, &orders) => return Err(lost.into()),
        lost = pause => return Err(lost.into()),
    };
    let (outcome, reason, permanent) = match end {
        End::Finished => (v1::Outcome::Succeeded, String::new(), false),
        End::Stopped => (v1::Outcome::Stopped, String::new(), false),
        End::Failed { reason, permanent } => (v1::Outcome::Failed, reason, permanent),
    };
    tracing::info!(?outcome, reason, "done");
    client.finish(v1::FinishRequest { outcome: outcome.into(), reason: reason.clone(), permanent }).await?;
    if outcome == v1::Outcome::Failed { Err(Error::Training(reason)) } else { Ok(()) }
}

/// Says that this worker lives, again and again, and passes on what the server wants.
async fn beat(client: &Client, orders: &Orders) -> Lost {
    loop {
        match client.heartbeat().await {
            Ok(directive) => orders.give(directive),
            Err(lost) => return lost,
        }
        tokio::time::sleep(HEARTBEAT).await;
    }
}

async fn work(client: &Client, orders: Arc<Orders>) -> Result<End, Error> {
    let work = client.fetch().await?;
    let config =
        serde_json::from_str(&work.config).map_err(|e| Error::Work { what: "a configuration", reason: e.to_string() })?;
    let snapshot = match work.snapshot_step {
        Some(_) => Some(client.download_snapshot().await?),
        None => None,
    };
    tracing::info!(threads = work.threads, from_step = work.snapshot_step, "training");
    let snapshot_every = Duration::from_millis(work.snapshot_every_ms);
    let task = Task { config, threads: work.threads as usize, snapshot, snapshot_every };

    let (items, inbox) = mpsc::unbounded_channel();
    let outbox = Outbox::new(items);
    let pending = outbox.snapshot_pending();
    let (ended, end) = oneshot::channel();
    let train = move || {
        let end = std::panic::catch_unwind(AssertUnwindSafe(|| training::train(task, &outbox, &orders)));
        let end = end.unwrap_or_else(|panic| End::Failed { reason: format!("panic: {}", words(&*panic)), permanent: false });
        // Closed before the end is known, so that the reporter ends when it has sent all.
        drop(outbox);
        // Nobody waits where the process is ending.
        let _ = ended.send(end);
    };
    std::thread::Builder::new().name("training".into()).spawn(train)?;
    report::forward(client, inbox, &pending).await?;
    Ok(end.await.expect("training sends its end whatever happens"))
}

/// What a panic said.
fn words(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("no message")
}
