//! Jobs from outside: submission over both transports, scheduling, the protocol of workers.

mod harness;
mod processes;
mod protocol;
mod scheduling;
mod submission;
