//! The signals that ask a process to stop: ctrl-c (SIGINT) and SIGTERM.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};

use tokio::signal::unix::{Signal, SignalKind, signal};

use super::output::errln;

/// Receives the signals from its creation on; they no longer end the process.
pub struct StopSignals {
    interrupt: Signal,
    terminate: Signal,
}

impl StopSignals {
    /// Begins to receive the signals.
    ///
    /// # Errors
    /// The system refuses the handler.
    pub fn new() -> io::Result<Self> {
        Ok(Self { interrupt: signal(SignalKind::interrupt())?, terminate: signal(SignalKind::terminate())? })
    }

    /// Waits for the next signal. Returns the exit status of a process that it stops, as shells report it: 130 or 143.
    pub async fn next(&mut self) -> u8 {
        tokio::select! {
            _ = self.interrupt.recv() => 130,
            _ = self.terminate.recv() => 143,
        }
    }
}

/// A flag that ctrl-c and SIGTERM set. The second signal ends the process at once.
pub struct StopFlag {
    /// The flag.
    pub flag: Arc<AtomicBool>,
    code: Arc<AtomicU8>,
}

impl StopFlag {
    /// Begins to receive the signals.
    ///
    /// # Errors
    /// The system refuses the handler.
    pub fn new() -> io::Result<Self> {
        let stop = Self { flag: Arc::default(), code: Arc::default() };
        let (flag, code) = (Arc::clone(&stop.flag), Arc::clone(&stop.code));
        let mut signals = StopSignals::new()?;
        tokio::spawn(async move {
            code.store(signals.next().await, Ordering::Relaxed);
            flag.store(true, Ordering::Release);
            errln!("stopping after the work in progress; a second signal ends at once, without a snapshot of it");
            std::process::exit(signals.next().await.into());
        });
        Ok(stop)
    }

    /// The exit status of the signal that set the flag; 0 before.
    pub fn code(&self) -> u8 {
        self.code.load(Ordering::Relaxed)
    }
}
