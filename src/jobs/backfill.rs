//! Which jobs may start before the head of the queue. Pure arithmetic of threads: the scheduler asks, and the tests check it on
//! random schedules.
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
    use rand::{Rng, RngExt};

    use super::*;
    use crate::rng;

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

    /// A job of a schedule.
    #[derive(Clone, Copy, Debug)]
    struct Job {
        arrives: u64,
        priority: i64,
        threads: usize,
        runs: u64,
    }

    /// The state of a schedule at a time.
    #[derive(Clone, Debug, Default)]
    struct Model {
        /// Indices of jobs in the order of the queue.
        queue: Vec<usize>,
        /// Indices of jobs and the times when they end.
        running: Vec<(usize, u64)>,
    }

    impl Model {
        /// Starts what may start, as the scheduler does, and returns it. Without `backfill` only heads start.
        fn start(&mut self, jobs: &[Job], budget: usize, now: u64, backfill: bool) -> Vec<usize> {
            let mut started = Vec::new();
            loop {
                let threads = |&i: &usize| jobs[i].threads.min(budget);
                let running: Vec<usize> = self.running.iter().map(|(i, _)| threads(i)).collect();
                let Some(head) = self.queue.first().map(threads) else { return started };
                let fits = running.iter().sum::<usize>() + head <= budget;
                let limit = if fits { head } else { backfill_limit(budget, &running, head) };
                let next = if fits { Some(0) } else { self.queue.iter().position(|i| threads(i) <= limit) };
                let Some(at) = next.filter(|_| fits || backfill) else { return started };
                let job = self.queue.remove(at);
                self.running.push((job, now + jobs[job].runs));
                started.push(job);
            }
        }

        /// When `head` starts if only heads start and no job arrives.
        fn strict_start(mut self, jobs: &[Job], budget: usize, mut now: u64, head: usize) -> u64 {
            loop {
                if self.start(jobs, budget, now, false).contains(&head) {
                    return now;
                }
                now = self.running.iter().map(|(_, end)| *end).min().unwrap();
                self.running.retain(|(_, end)| *end > now);
            }
        }
    }

    fn random_jobs(draw: &mut impl Rng, budget: usize) -> Vec<Job> {
        let job = |draw: &mut _| -> Job {
            let draw: &mut _ = draw;
            Job {
                arrives: RngExt::random_range(draw, 0..100),
                priority: RngExt::random_range(draw, -1..=1),
                threads: RngExt::random_range(draw, 1..=budget),
                runs: RngExt::random_range(draw, 1..30),
            }
        };
        let count = draw.random_range(1..40);
        let mut jobs: Vec<Job> = (0..count).map(|_| job(&mut *draw)).collect();
        jobs.sort_by_key(|job| job.arrives);
        jobs
    }

    #[test]
    fn random_schedules_keep_order_and_budget_and_starve_nobody() {
        let mut backfilled = 0;
        for schedule in 0..1000 {
            let mut draw = rng::stream(schedule, "schedule", 0);
            let budget = draw.random_range(1..=12);
            let jobs = random_jobs(&mut draw, budget);
            let (mut model, mut arrived, mut started) = (Model::default(), 0, vec![None; jobs.len()]);
            // The head that waits, and when it starts at the latest.
            let mut promise: Option<(usize, u64)> = None;
            let mut now = 0;
            while started.iter().any(Option::is_none) {
                assert!(now < 5000, "schedule {schedule}: a job starves");
                model.running.retain(|(_, end)| *end > now);
                while let Some(job) = jobs.get(arrived).filter(|job| job.arrives <= now) {
                    let at = model.queue.iter().position(|&i| jobs[i].priority < job.priority);
                    model.queue.insert(at.unwrap_or(model.queue.len()), arrived);
                    arrived += 1;
                }
                let before = model.clone();
                let head = before.queue.first().copied();
                let begun = model.start(&jobs, budget, now, true);
                // A job that comes before the head, of a higher priority, may take its place.
                let before_head = |&job: &usize, head: usize| (-jobs[job].priority, job) < (-jobs[head].priority, head);
                if promise.is_some_and(|(head, _)| begun.iter().any(|job| before_head(job, head))) {
                    promise = None;
                }
                for job in begun {
                    started[job] = Some(now);
                    for &waits in model.queue.iter().filter(|&&i| before_head(&i, job)) {
                        // Who comes first is overtaken only by jobs that need less.
                        assert!(jobs[waits].threads > jobs[job].threads, "schedule {schedule} at {now}: {job} overtakes {waits}");
                        backfilled += 1;
                    }
                }
                let used: usize = model.running.iter().map(|(i, _)| jobs[*i].threads).sum();
                assert!(used <= budget, "schedule {schedule} at {now}: {used} threads of {budget}");
                let head_fits = model.queue.first().is_some_and(|&head| used + jobs[head].threads <= budget);
                assert!(!head_fits, "schedule {schedule} at {now}: the head waits although it fits");
                if let Some((job, latest)) = promise {
                    match started[job] {
                        Some(at) => assert!(at <= latest, "schedule {schedule}: the head was delayed from {latest} to {at}"),
                        None => assert!(head != Some(job) || now < latest, "schedule {schedule}: the head waits after {latest}"),
                    }
                }
                promise = model.queue.first().map(|&head| match promise {
                    Some((job, latest)) if job == head => (job, latest),
                    // Without backfill from here on, among the jobs that were there.
                    _ => (head, before.clone().strict_start(&jobs, budget, now, head)),
                });
                now += 1;
            }
        }
        assert!(backfilled > 100, "{backfilled} jobs have started before the head");
    }
}
