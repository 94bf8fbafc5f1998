//! A bound on the bytes that entries of one kind take together.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use super::Error;

/// Bytes that entries of one kind may take together.
#[derive(Debug)]
pub(super) struct MemoryBudget {
    limit: usize,
    used: AtomicUsize,
    /// The kind of entry in errors, for example `session`.
    kind: &'static str,
    /// The flag that sets the limit.
    flag: &'static str,
}

impl MemoryBudget {
    pub(super) fn new(limit: usize, kind: &'static str, flag: &'static str) -> Arc<Self> {
        Arc::new(Self { limit, used: AtomicUsize::new(0), kind, flag })
    }

    /// Bytes in use.
    pub(super) fn used(&self) -> usize {
        self.used.load(Ordering::Relaxed)
    }

    /// Takes `bytes` until the charge is dropped.
    ///
    /// # Errors
    /// [`Error::Busy`] if fewer are free.
    pub(super) fn charge(self: &Arc<Self>, bytes: usize) -> Result<MemoryCharge, Error> {
        let mut charge = MemoryCharge { budget: self.clone(), bytes: 0 };
        charge.resize(bytes)?;
        Ok(charge)
    }
}

/// Bytes of a budget that one entry takes. Dropping it gives them back.
#[derive(Debug)]
pub(super) struct MemoryCharge {
    budget: Arc<MemoryBudget>,
    bytes: usize,
}

impl MemoryCharge {
    /// Bytes that the entry takes.
    pub(super) fn bytes(&self) -> usize {
        self.bytes
    }

    /// Takes `bytes` in all from now on.
    ///
    /// # Errors
    /// [`Error::Busy`] if fewer are free; the entry then takes what it took before.
    pub(super) fn resize(&mut self, bytes: usize) -> Result<(), Error> {
        let MemoryBudget { limit, used, kind, flag } = &*self.budget;
        if bytes <= self.bytes {
            if bytes < self.bytes {
                used.fetch_sub(self.bytes - bytes, Ordering::Relaxed);
            }
        } else {
            let grow = |used: usize| used.checked_add(bytes - self.bytes).filter(|used| used <= limit);
            used.fetch_update(Ordering::Relaxed, Ordering::Relaxed, grow).map_err(|_| {
                let (size, limit) = (bytes.div_ceil(1024), limit / 1024);
                Error::Busy(format!("no memory for {kind} of {size} KiB: all {kind}s together may take {limit} KiB ({flag})"))
            })?;
        }
        self.bytes = bytes;
        Ok(())
    }
}

impl Drop for MemoryCharge {
    fn drop(&mut self) {
        self.budget.used.fetch_sub(self.bytes, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn charges_never_exceed_the_limit_and_give_back_what_they_took() {
        let budget = MemoryBudget::new(100, "session", "--session-memory");
        let mut first = budget.charge(60).unwrap();
        assert!(matches!(budget.charge(41), Err(Error::Busy(_))));
        let second = budget.charge(40).unwrap();
        assert!(first.resize(61).is_err());
        assert_eq!((first.bytes(), budget.used()), (60, 100));
        drop(second);
        first.resize(90).unwrap();
        first.resize(10).unwrap();
        assert!(first.resize(usize::MAX).is_err());
        assert_eq!(budget.used(), 10);
        drop(first);
        assert_eq!(budget.used(), 0);
    }
}
