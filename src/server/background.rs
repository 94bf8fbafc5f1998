//! The thread that answers everything except acting and probes: lists, descriptions, jobs, workers. A flood of such requests waits
//! for that thread, and an `Act` never waits behind them.

use std::io;

use tokio::runtime::{Builder, Handle, Runtime};

/// How much the priority of the thread is lowered: to a third of the processor time of a thread that serves, while both want it.
const NICE: i32 = 5;

/// A runtime with one thread of lower priority. Ends when it is dropped; its tasks end with it.
#[derive(Debug)]
pub(super) struct Background(Option<Runtime>);

impl Background {
    pub(super) fn start() -> io::Result<Self> {
        let runtime = Builder::new_multi_thread()
            .worker_threads(1)
            .thread_name("background")
            // Linux lowers the priority of this thread only. Without permission it stays as it is.
            .on_thread_start(|| {
                let _ = rustix::process::nice(NICE);
            })
            .enable_all()
            .build()?;
        Ok(Self(Some(runtime)))
    }

    pub(super) fn handle(&self) -> Handle {
        self.0.as_ref().expect("it is taken only when dropped").handle().clone()
    }
}

impl Drop for Background {
    fn drop(&mut self) {
        // Waiting is not allowed on the threads of another runtime.
        if let Some(runtime) = self.0.take() {
            runtime.shutdown_background();
        }
    }
}
