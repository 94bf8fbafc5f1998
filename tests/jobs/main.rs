//! Jobs from outside: submission over both transports, scheduling, the protocol of workers.

mod events;
mod harness;
mod processes;
mod protocol;
mod scheduling;
mod submission;
