//! Executors: the trait that starts workers, and its types.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::Duration;

use futures::future::BoxFuture;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use crate::store::Lease;

/// What an executor needs to start a worker.
#[derive(Clone)]
pub struct Launch {
    /// The attempt.
    pub lease: Lease,
    /// Secret that the worker presents to the server; empty if an earlier server has started the worker.
    pub token: String,
    /// Address of the server's `WorkerService`, as `http://127.0.0.1:50051`.
    pub server: String,
    /// What the worker needs.
    pub resources: Resources,
    /// Name of the launch, which is unique.
    pub name: String,
    /// Whether an earlier server has started the worker, or was about to.
    pub started_before: bool,
    /// What the executor and the scheduler know of the worker.
    pub status: WorkerStatus,
    /// Receives the output of the worker.
    pub log: LogTail,
    /// Cancelled to kill the worker.
    pub kill: CancellationToken,
}

/// What a worker needs of the machine it runs on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Resources {
    /// Threads that compute.
    pub threads: usize,
    /// Memory in bytes.
    pub memory: u64,
}

/// What the executor and the scheduler know of a worker; cheap to clone.
#[derive(Clone, Debug, Default)]
pub struct WorkerStatus(Arc<Status>);

#[derive(Debug, Default)]
struct Status {
    /// Why the worker does not run.
    waiting: Mutex<Option<String>>,
    /// Monotonic time at which the attempt began.
    began: OnceLock<Duration>,
}

impl WorkerStatus {
    /// Why the worker does not run at present; `None`: it should run.
    pub fn waiting(&self) -> Option<String> {
        self.0.waiting.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Records why the worker does not run at present.
    pub fn set_waiting(&self, reason: Option<String>) {
        *self.0.waiting.lock().unwrap_or_else(PoisonError::into_inner) = reason;
    }

    /// Monotonic time at which the attempt began; `None`: the worker has not called.
    pub fn began(&self) -> Option<Duration> {
        self.0.began.get().copied()
    }

    /// Records that the attempt has begun.
    pub fn set_began(&self, now: Duration) {
        // The first call counts.
        let _ = self.0.began.set(now);
    }
}

/// How a worker ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WorkerExit {
    /// In words: `exit code 1`, `killed by signal 9`.
    pub description: String,
    /// Whether the host or cluster ended it, which is not the fault of its job.
    pub by_host: bool,
}

impl WorkerExit {
    /// The worker ended by itself, because of its job.
    pub fn of_worker(description: impl Into<String>) -> Self {
        Self { description: description.into(), by_host: false }
    }

    /// The host or cluster ended the worker.
    pub fn of_host(description: impl Into<String>) -> Self {
        Self { description: description.into(), by_host: true }
    }
}

/// Starts workers, for example as local processes.
pub trait Executor: Send + Sync + 'static {
    /// Starts a worker, or finds the one that an earlier server has started. The inner future resolves when the worker has ended.
    ///
    /// # Errors
    /// [`std::io::Error`] when the worker cannot be started.
    fn start(&self, launch: Launch) -> BoxFuture<'_, std::io::Result<BoxFuture<'static, WorkerExit>>>;

    /// Whether workers wait in a queue of their own and outlive this server. Then a job stays queued until its worker calls.
    fn is_cluster(&self) -> bool {
        false
    }
}

/// The last part of a worker's output; cheap to clone.
#[derive(Clone, Debug, Default)]
pub struct LogTail(Arc<Shared>);

#[derive(Debug, Default)]
struct Shared {
    tail: Mutex<Tail>,
    /// Bytes that have ever arrived.
    total: watch::Sender<u64>,
}

#[derive(Debug, Default)]
struct Tail {
    bytes: VecDeque<u8>,
    /// Bytes that have ever arrived.
    total: u64,
}

impl LogTail {
    /// Maximum number of bytes kept.
    pub const LIMIT: usize = 64 << 10;

    /// Appends output. Beyond [`LogTail::LIMIT`] the oldest bytes are dropped.
    pub fn push(&self, bytes: &[u8]) {
        let mut tail = self.tail();
        tail.total += bytes.len() as u64;
        tail.bytes.extend(bytes);
        let excess = tail.bytes.len().saturating_sub(Self::LIMIT);
        tail.bytes.drain(..excess);
        let total = tail.total;
        drop(tail);
        self.0.total.send_replace(total);
    }

    /// The number of bytes that have ever arrived; changes when output arrives.
    pub fn subscribe(&self) -> watch::Receiver<u64> {
        self.0.total.subscribe()
    }

    /// Number of bytes that have ever arrived.
    pub fn total(&self) -> u64 {
        self.tail().total
    }

    /// The kept output, from the beginning of a line.
    pub fn text(&self) -> String {
        let tail = self.tail();
        let truncated = tail.total > tail.bytes.len() as u64;
        let skip = if truncated { tail.bytes.iter().position(|&b| b == b'\n').map_or(0, |i| i + 1) } else { 0 };
        let bytes: Vec<u8> = tail.bytes.iter().skip(skip).copied().collect();
        String::from_utf8_lossy(&bytes).replace('\0', "\u{fffd}")
    }

    /// The kept lines after the first `sent` bytes of the output, and the number of bytes of the output up to their end. The last
    /// line may be incomplete if `all`.
    pub fn text_after(&self, sent: u64, all: bool) -> (String, u64) {
        let tail = self.tail();
        let first = tail.total - tail.bytes.len() as u64;
        let skip = sent.saturating_sub(first) as usize;
        let mut bytes: Vec<u8> = tail.bytes.iter().skip(skip).copied().collect();
        // Lines that are no longer kept entirely are left out.
        if sent < first {
            let whole = bytes.iter().position(|&b| b == b'\n').map_or(bytes.len(), |i| i + 1);
            bytes.drain(..whole);
        }
        let mut total = tail.total;
        if !all {
            let whole = bytes.iter().rposition(|&b| b == b'\n').map_or(0, |i| i + 1);
            total -= (bytes.len() - whole) as u64;
            bytes.truncate(whole);
        }
        (String::from_utf8_lossy(&bytes).replace('\0', "\u{fffd}"), total)
    }

    fn tail(&self) -> MutexGuard<'_, Tail> {
        self.0.tail.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::LogTail;

    #[test]
    fn output_is_followed_line_by_line() {
        let log = LogTail::default();
        log.push(b"one\ntw");
        assert_eq!(log.text_after(0, false), ("one\n".into(), 4));
        log.push(b"o\nthree");
        assert_eq!(log.text_after(4, false), ("two\n".into(), 8));
        assert_eq!(log.text_after(8, false), (String::new(), 8));
        assert_eq!(log.text_after(8, true), ("three".into(), 13));
        log.push(&vec![b'x'; LogTail::LIMIT]);
        log.push(b"\nlast\n");
        assert_eq!(log.text_after(8, false).0, "last\n");
    }

    #[test]
    fn long_log_keeps_its_last_lines() {
        let log = LogTail::default();
        for i in 0..20_000 {
            log.push(format!("line {i}\n").as_bytes());
        }
        let text = log.text();
        assert!(text.len() <= LogTail::LIMIT && text.len() > LogTail::LIMIT - 20);
        assert!(text.starts_with("line ") && text.ends_with("line 19999\n"));
    }
}
