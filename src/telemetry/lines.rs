//! Log lines on their way to standard error. A thread of their own writes them: whoever reads standard error may stall, and must not
//! stop the server. Lines that find the queue full are dropped and counted.

use std::io;
use std::sync::OnceLock;
use std::sync::mpsc::channel;
use std::thread;
use std::time::Duration;

use tracing_appender::non_blocking::{ErrorCounter, NonBlocking, NonBlockingBuilder, WorkerGuard};

/// Lines that wait at most: some MiB.
const QUEUE: usize = 8192;
/// Time for the last lines when the process ends.
const LAST_LINES: Duration = Duration::from_secs(1);

/// Counts the dropped lines of the process, which has one standard error.
static DROPPED: OnceLock<ErrorCounter> = OnceLock::new();

/// Writes the lines that still wait when it is dropped, if they are read in time.
#[derive(Debug)]
#[must_use = "the last lines are written when it is dropped"]
pub struct LogGuard(Option<WorkerGuard>);

impl Drop for LogGuard {
    fn drop(&mut self) {
        let Some(guard) = self.0.take() else { return };
        let (done, written) = channel();
        // On another thread: when the queue is full, the guard prints a complaint, which may stall, too.
        let dropping = thread::Builder::new().spawn(move || {
            drop(guard);
            // Nobody waits any more if it took too long.
            let _ = done.send(());
        });
        if dropping.is_ok() {
            let _ = written.recv_timeout(LAST_LINES);
        }
    }
}

/// The queue of lines, and what writes its rest.
pub(super) fn queue() -> (NonBlocking, LogGuard) {
    let builder = NonBlockingBuilder::default().lossy(true).buffered_lines_limit(QUEUE).thread_name("qedgix-log");
    let (lines, guard) = builder.finish(io::stderr());
    // Only the lines of the first subscriber are written.
    let _ = DROPPED.set(lines.error_counter());
    (lines, LogGuard(Some(guard)))
}

/// Lines dropped since the process started.
pub fn dropped_log_lines() -> u64 {
    DROPPED.get().map_or(0, |dropped| dropped.dropped_lines() as u64)
}
