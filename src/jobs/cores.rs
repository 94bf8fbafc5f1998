//! Which cores local workers run on: each on as many as its job has threads, and two workers on the same core only if there are
//! more threads than cores.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// The cores that this process may use, with the number of workers on each; cheap to clone.
#[derive(Clone, Debug, Default)]
pub(super) struct Cores(Arc<Mutex<Vec<Core>>>);

#[derive(Debug)]
struct Core {
    number: usize,
    workers: usize,
}

/// Cores of one worker, which are free again when this is dropped.
#[derive(Debug)]
pub(super) struct TakenCores {
    cores: Cores,
    /// Their numbers; empty if the system does not say which cores this process may use.
    pub numbers: Vec<usize>,
}

impl Cores {
    /// The cores that this process may use.
    pub(super) fn of_this_process() -> Self {
        Self::new(allowed())
    }

    fn new(numbers: Vec<usize>) -> Self {
        Self(Arc::new(Mutex::new(numbers.into_iter().map(|number| Core { number, workers: 0 }).collect())))
    }

    /// The cores for a worker with `threads` threads: those with the fewest workers.
    pub(super) fn take(&self, threads: usize) -> TakenCores {
        let mut all = self.lock();
        all.sort_by_key(|core| (core.workers, core.number));
        let taken = all.iter_mut().take(threads.max(1)).map(|core| {
            core.workers += 1;
            core.number
        });
        TakenCores { numbers: taken.collect(), cores: self.clone() }
    }

    fn lock(&self) -> MutexGuard<'_, Vec<Core>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl TakenCores {
    /// The numbers as the worker reads them: `0,3`.
    pub(super) fn list(&self) -> String {
        self.numbers.iter().map(usize::to_string).collect::<Vec<_>>().join(",")
    }
}

impl Drop for TakenCores {
    fn drop(&mut self) {
        for core in self.cores.lock().iter_mut().filter(|core| self.numbers.contains(&core.number)) {
            core.workers -= 1;
        }
    }
}

#[cfg(target_os = "linux")]
fn allowed() -> Vec<usize> {
    use rustix::thread::{CpuSet, sched_getaffinity};
    // The system refuses if it has more cores than the set.
    let Ok(set) = sched_getaffinity(None) else { return Vec::new() };
    (0..CpuSet::MAX_CPU).filter(|&core| set.is_set(core)).collect()
}

#[cfg(not(target_os = "linux"))]
fn allowed() -> Vec<usize> {
    Vec::new()
}

/// Confines this thread, and all that it starts later, to the cores of a list as `0,3`. Does nothing where the system has no such
/// thing, or has not these cores: training works without.
pub(super) fn confine(list: &str) {
    #[cfg(target_os = "linux")]
    {
        use rustix::thread::{CpuSet, sched_setaffinity};
        let mut set = CpuSet::new();
        let numbers = list.split(',').filter_map(|number| number.parse().ok());
        numbers.filter(|&number: &usize| number < CpuSet::MAX_CPU).for_each(|number| set.set(number));
        if set.count() > 0 {
            let _ = sched_setaffinity(None, &set);
        }
    }
    #[cfg(not(target_os = "linux"))]
    let _ = list;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn workers_share_cores_only_when_there_are_too_few() {
        let cores = Cores::new(vec![0, 2, 5]);
        let (one, two) = (cores.take(1), cores.take(2));
        assert_eq!((one.list().as_str(), two.list().as_str()), ("0", "2,5"));
        let third = cores.take(2);
        assert_eq!(third.numbers, [0, 2]);
        drop(one);
        // One worker is on each core now.
        assert_eq!(cores.take(1).numbers, [0]);
        drop((two, third));
        assert_eq!(cores.take(9).numbers, [0, 2, 5]);
        assert!(cores.lock().iter().all(|core| core.workers == 0));
        assert_eq!(Cores::new(Vec::new()).take(2).list(), "");
    }
}
