//! Tests of jobs through both transports: submission, scheduling, the protocol of workers, events, and real processes.

mod events;
mod harness;
mod processes;
mod protocol;
mod publishing;
mod scheduling;
mod submission;
