//! Splits the large loops of one computation over threads.
//!
//! A computation uses one thread unless its caller [allows](allow) more. Parts of a loop do not depend on each other, so the result is
//! the same, to the bit, for any number of threads.

use std::cell::Cell;
use std::sync::{Mutex, PoisonError};
use std::thread;

thread_local! {
    static ALLOWED: Cell<usize> = const { Cell::new(1) };
}

/// Parts per thread: parts take different times, and a thread that is done takes the next one.
const PARTS_PER_THREAD: usize = 4;

/// Calls `compute`, whose loops may be split over `threads` threads.
pub fn allow<R>(threads: usize, compute: impl FnOnce() -> R) -> R {
    struct Restore(usize);
    impl Drop for Restore {
        fn drop(&mut self) {
            ALLOWED.set(self.0);
        }
    }
    let _before = Restore(ALLOWED.replace(threads.max(1)));
    compute()
}

/// Items per part of a loop over `len` items, at least 1: all of them if only one thread is allowed.
pub fn part(len: usize) -> usize {
    let parts = if ALLOWED.get() == 1 { 1 } else { PARTS_PER_THREAD * ALLOWED.get() };
    len.div_ceil(parts).max(1)
}

/// Calls `compute` for every part. With one thread, in order and without an allocation. Otherwise on threads that exist only as long as
/// this call and have the priority of the caller; if the system refuses them, this thread computes all parts.
///
/// # Panics
/// If `compute` panics.
pub fn for_each<P: Send>(mut parts: impl Iterator<Item = P> + Send, compute: impl Fn(P) + Sync) {
    let allowed = ALLOWED.get();
    if allowed == 1 {
        parts.for_each(compute);
        return;
    }
    let Some(first) = parts.next() else { return };
    let mut parts = parts.peekable();
    if parts.peek().is_none() {
        compute(first);
        return;
    }
    let parts = Mutex::new(parts);
    let next = || parts.lock().unwrap_or_else(PoisonError::into_inner).next();
    let compute_rest = || {
        while let Some(part) = next() {
            compute(part);
        }
    };
    thread::scope(|scope| {
        for _ in 1..allowed {
            if thread::Builder::new().spawn_scoped(scope, compute_rest).is_err() {
                break;
            }
        }
        allow(1, || {
            compute(first);
            compute_rest();
        });
    });
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;
    use std::sync::Barrier;

    use super::*;

    #[test]
    fn every_part_is_computed_once_by_any_number_of_threads() {
        for threads in [0, 1, 2, 5] {
            for len in [0, 1, 3, 100] {
                let mut numbers = vec![0; len];
                allow(threads, || {
                    let part = part(len);
                    for_each(numbers.chunks_mut(part).enumerate(), |(k, numbers)| {
                        numbers.iter_mut().enumerate().for_each(|(i, x)| *x += k * part + i);
                    });
                });
                assert_eq!(numbers, (0..len).collect::<Vec<_>>(), "{threads} threads");
            }
        }
    }

    #[test]
    fn parts_run_at_the_same_time_on_as_many_threads_as_are_allowed_and_parts_are_not_split_again() {
        let (together, ids) = (Barrier::new(3), Mutex::new(HashSet::new()));
        allow(3, || {
            for_each(0..3, |_| {
                together.wait();
                ids.lock().unwrap().insert(thread::current().id());
                assert_eq!(part(100), 100);
            });
            assert!(part(100) < 100);
        });
        assert_eq!(ids.lock().unwrap().len(), 3);
        assert_eq!(part(100), 100, "the allowance has ended");
    }

    #[test]
    fn a_panic_reaches_the_caller_and_ends_the_allowance() {
        let result = std::panic::catch_unwind(|| allow(2, || for_each(0..8, |k| assert_ne!(k, 5))));
        assert!(result.is_err());
        assert_eq!(part(100), 100);
    }
}
