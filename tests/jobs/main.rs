//! Tests of jobs through both transports: submission, scheduling, the protocol of workers, events, and real processes.

mod command_line;
mod events;
mod experiments;
mod finding;
mod harness;
mod killed_sweep;
mod kinds;
mod lifecycle;
mod limits;
#[path = "../process/mod.rs"]
mod process;
mod processes;
mod protocol;
mod publishing;
mod retention;
mod schedules;
mod scheduling;
mod slurm;
mod space;
mod submission;
mod timing;
mod train_command;
mod unreadable;
mod warm_start;
mod webhooks;
