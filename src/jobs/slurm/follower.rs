//! What follows for a worker from what Slurm says about its job over time. Pure: time comes in, a verdict goes out.
//!
//! Slurm is not always right: jobs are missing in lists for minutes while a controller starts again, and commands hang. So nothing
//! follows from a job that is not listed as long as its worker calls the server, and a job that waits is given up late.

use std::time::Duration;

use super::listing::{Ending, Phase, SlurmJob};
use crate::jobs::WorkerExit;

/// Time for which a job that has never been listed may be missing, if it is not sure that Slurm took it.
const UNSURE_PATIENCE: Duration = Duration::from_secs(60);
/// Time for which a job that Slurm took may be missing before its worker has called.
const PATIENCE: Duration = Duration::from_secs(600);

/// What Slurm says about a job.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Seen {
    /// It is listed.
    Listed(SlurmJob),
    /// Neither `squeue` nor `sacct` knows it.
    Missing,
    /// The commands fail.
    Unknown(String),
}

/// What follows for the worker.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Verdict {
    /// The worker does not run, for this reason.
    Waiting(String),
    /// The worker should run: its heartbeats tell whether it does.
    Running,
    /// The worker has ended.
    Ended(WorkerExit),
}

/// The job of one launch.
#[derive(Debug)]
pub(super) struct Follower {
    /// When Slurm was last known to have the job.
    known_at: Duration,
    patience: Duration,
    /// Whether the script has started.
    ran: bool,
}

impl Follower {
    /// A job that was submitted at `now`. `sure`: Slurm has acknowledged it.
    pub(super) fn new(now: Duration, sure: bool) -> Self {
        Self { known_at: now, patience: if sure { PATIENCE } else { UNSURE_PATIENCE }, ran: false }
    }

    /// The verdict at `now`. `called`: the worker has called the server; `called_before`: before Slurm was asked. A list that is older
    /// than the first call can say that the job waits.
    pub(super) fn observe(&mut self, now: Duration, seen: &Seen, called: bool, called_before: bool) -> Verdict {
        let started = self.ran || called_before;
        match seen {
            Seen::Listed(job) => {
                (self.known_at, self.patience) = (now, PATIENCE);
                match job.phase() {
                    Phase::Waiting if started && job.state.first().is_some_and(|state| state == "PENDING") => {
                        Verdict::Ended(WorkerExit::of_host(format!("{job}: it was queued again")))
                    }
                    Phase::Waiting => Verdict::Waiting(job.to_string()),
                    Phase::Running => {
                        self.ran = true;
                        Verdict::Running
                    }
                    Phase::Requeued => Verdict::Ended(WorkerExit::of_host(format!("{job}: it was queued again"))),
                    Phase::Ended(Ending::OfCluster) => Verdict::Ended(WorkerExit::of_host(job.to_string())),
                    Phase::Ended(Ending::OfJob) => Verdict::Ended(WorkerExit::of_worker(job.to_string())),
                }
            }
            _ if started || called => Verdict::Running,
            Seen::Unknown(reason) => {
                self.known_at = now;
                Verdict::Waiting(format!("Slurm does not answer: {reason}"))
            }
            Seen::Missing if now.saturating_sub(self.known_at) < self.patience => {
                Verdict::Waiting("Slurm does not list the job at the moment".into())
            }
            Seen::Missing => Verdict::Ended(WorkerExit::of_host("Slurm has lost the job")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn listed(state: &str, restarts: u64) -> Seen {
        let state = state.split('+').map(str::to_owned).collect();
        let (id, name, reason, nodes) = ("1".into(), "a".into(), String::new(), String::new());
        Seen::Listed(SlurmJob { id, name, state, reason, restarts, exit: None, nodes })
    }

    /// A letter for each verdict: waiting, running, ended by the worker, ended by the host.
    fn verdicts(follower: &mut Follower, seen: &[(u64, Seen, bool)]) -> String {
        let letter =
            |(at, seen, called): &(u64, Seen, bool)| match follower.observe(Duration::from_secs(*at), seen, *called, *called) {
                Verdict::Waiting(_) => 'w',
                Verdict::Running => 'r',
                Verdict::Ended(exit) if exit.by_host => 'h',
                Verdict::Ended(_) => 'e',
            };
        seen.iter().map(letter).collect()
    }

    fn after(seen: &[(u64, Seen, bool)]) -> String {
        verdicts(&mut Follower::new(Duration::ZERO, true), seen)
    }

    #[test]
    fn a_job_waits_runs_and_ends() {
        let life = ["PENDING", "CONFIGURING", "RUNNING", "COMPLETING", "COMPLETED"].map(|state| (1, listed(state, 0), false));
        assert_eq!(after(&life), "wwrre");
        for state in ["FAILED", "OUT_OF_MEMORY", "TIMEOUT", "CANCELLED"] {
            assert_eq!(after(&[(1, listed("RUNNING", 0), true), (2, listed(state, 0), true)]), "re", "{state}");
        }
        for state in ["NODE_FAIL", "BOOT_FAIL", "PREEMPTED", "REVOKED"] {
            assert_eq!(after(&[(1, listed("RUNNING", 0), true), (2, listed(state, 0), true)]), "rh", "{state}");
        }
    }

    #[test]
    fn a_worker_that_slurm_queued_again_has_ended() {
        assert_eq!(after(&[(1, listed("RUNNING", 0), true), (2, listed("PENDING", 0), true)]), "rh");
        // The server did not run while the job did.
        assert_eq!(after(&[(1, listed("PENDING", 0), true)]), "h");
        assert_eq!(after(&[(1, listed("PENDING", 1), false)]), "h");
        assert_eq!(after(&[(1, listed("RUNNING", 0), true), (2, listed("PREEMPTED+REQUEUED", 0), true)]), "rh");
        // A job that is suspended goes on later.
        assert_eq!(after(&[(1, listed("RUNNING", 0), true), (2, listed("SUSPENDED", 0), true)]), "rw");
    }

    #[test]
    fn a_list_that_is_older_than_the_first_call_ends_nothing() {
        let mut follower = Follower::new(Duration::ZERO, true);
        let mut verdict = |called_before| follower.observe(Duration::from_secs(1), &listed("PENDING", 0), true, called_before);
        assert!(matches!(verdict(false), Verdict::Waiting(_)));
        assert!(matches!(verdict(true), Verdict::Ended(exit) if exit.by_host));
    }

    #[test]
    fn a_job_may_be_missing_for_minutes() {
        assert_eq!(
            after(&[(1, listed("PENDING", 0), false), (500, Seen::Missing, false), (501, listed("RUNNING", 0), false)]),
            "wwr"
        );
        assert_eq!(after(&[(1, listed("PENDING", 0), false), (602, Seen::Missing, false)]), "wh");
        // Calls of the worker say more than the list.
        assert_eq!(after(&[(1, listed("PENDING", 0), false), (9999, Seen::Missing, true)]), "wr");
        assert_eq!(after(&[(1, listed("RUNNING", 0), false), (9999, Seen::Missing, false)]), "rr");
        let mut unsure = Follower::new(Duration::ZERO, false);
        assert_eq!(verdicts(&mut unsure, &[(59, Seen::Missing, false), (60, Seen::Missing, false)]), "wh");
    }

    #[test]
    fn commands_that_fail_say_nothing_about_the_job() {
        let unknown = || Seen::Unknown("timeout".into());
        assert_eq!(after(&[(1, unknown(), false), (99_999, unknown(), false), (100_000, Seen::Missing, false)]), "www");
        assert_eq!(after(&[(1, listed("RUNNING", 0), true), (99_999, unknown(), true)]), "rr");
    }
}
