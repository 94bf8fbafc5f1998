//! Where attempts run: the trait that every executor fulfils, and what it is told.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};

use futures::future::BoxFuture;
use tokio_util::sync::CancellationToken;

use crate::store::Lease;

/// Everything a worker is started with.
#[derive(Clone)]
pub struct Launch {
    /// The attempt.
    pub lease: Lease,
    /// Secret that it shows to the server.
    pub token: String,
    /// Where it reaches the server's `WorkerService`, as `http://127.0.0.1:50051`.
    pub server: String,
    /// Receives what it prints.
    pub log: LogTail,
    /// Ends it by force.
    pub kill: CancellationToken,
}

/// How a worker ended, in words: `exit code 1`, `killed by signal 9`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Exit(pub String);

/// Starts workers somewhere.
pub trait Executor: Send + Sync + 'static {
    /// Starts one worker; the inner future resolves when it has ended.
    ///
    /// # Errors
    /// It cannot be started.
    fn start(&self, launch: Launch) -> BoxFuture<'_, std::io::Result<BoxFuture<'static, Exit>>>;
}

/// The last part of what a worker printed; cheap to clone.
#[derive(Clone, Debug, Default)]
pub struct LogTail(Arc<Mutex<Tail>>);

#[derive(Debug, Default)]
struct Tail {
    bytes: VecDeque<u8>,
    cut: bool,
}

impl LogTail {
    /// Bytes kept.
    pub const LIMIT: usize = 64 << 10;

    /// Adds output; the oldest goes when there is too much.
    pub fn push(&self, bytes: &[u8]) {
        let mut tail = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        tail.bytes.extend(bytes);
        let excess = tail.bytes.len().saturating_sub(Self::LIMIT);
        if excess > 0 {
            tail.cut = true;
            tail.bytes.drain(..excess);
        }
    }

    /// What is kept, from the beginning of a line.
    pub fn text(&self) -> String {
        let tail = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let skip = if tail.cut { tail.bytes.iter().position(|&b| b == b'\n').map_or(0, |i| i + 1) } else { 0 };
        let bytes: Vec<u8> = tail.bytes.iter().skip(skip).copied().collect();
        String::from_utf8_lossy(&bytes).replace('\0', "\u{fffd}")
    }
}

#[cfg(test)]
mod tests {
    use super::LogTail;

    #[test]
    fn a_long_log_keeps_its_end_from_the_beginning_of_a_line() {
        let log = LogTail::default();
        for i in 0..20_000 {
            log.push(format!("line {i}\n").as_bytes());
        }
        let text = log.text();
        assert!(text.len() <= LogTail::LIMIT && text.len() > LogTail::LIMIT - 20);
        assert!(text.starts_with("line ") && text.ends_with("line 19999\n"));
    }
}
