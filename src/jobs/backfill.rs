//! Which jobs may start before the head of the queue. Pure arithmetic of threads: the scheduler asks. `tests/jobs/schedules.rs`
//! checks the scheduler on random schedules.
//!
//! The head is the first job of the queue. When it does not fit into what is free of the CPU budget, a job behind it may start only
//! if the head starts as early as without it, whatever job ends first: nobody knows how long jobs run.

/// The largest number of threads of a job that may start now before a head that needs `head` threads and does not fit; 0: none may.
/// `running`: the threads of each running job.
///
/// The head starts as soon as the jobs that still run leave it enough room. A further job never delays that if it fits beside the
/// head and beside every set of running jobs that fits beside the head.
pub fn backfill_limit(budget: usize, running: &[usize], head: usize) -> usize {
    let used: usize = running.iter().sum();
    let (free, beside) = (budget.saturating_sub(used), budget.saturating_sub(head));
    if free == 0 || beside == 0 {
        return 0;
    }
    // reachable[n]: some of the running jobs have n threads together.
    let mut reachable = vec![false; beside + 1];
    reachable[0] = true;
    for &threads in running.iter().filter(|&&threads| threads <= beside) {
        for sum in (threads..=beside).rev() {
            reachable[sum] |= reachable[sum - threads];
        }
    }
    let most = (0..=beside).rev().find(|&sum| reachable[sum]).unwrap_or(0);
    free.min(beside - most)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_cannot_delay_the_head_may_start() {
        // Two threads are free after the running job, whatever happens: the head needs three of four.
        assert_eq!(backfill_limit(4, &[2], 3), 1);
        // The head needs all threads, so every other job would delay it.
        assert_eq!(backfill_limit(4, &[3], 4), 0);
        // If the job with two threads ends first, the head fits beside the other, and nothing else does.
        assert_eq!(backfill_limit(4, &[2, 1], 3), 0);
        assert_eq!(backfill_limit(8, &[4, 1], 4), 0);
        // Whatever ends first, the head and one thread more fit beside the other job.
        assert_eq!(backfill_limit(8, &[5, 1], 4), 2);
        assert_eq!(backfill_limit(8, &[4, 2], 6), 0);
        // Budgets can have shrunk below what runs.
        assert_eq!(backfill_limit(2, &[4], 2), 0);
    }
}
