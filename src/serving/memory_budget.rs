//! A bound on the bytes that entries of one kind take together, and on what one owner takes of them.

use std::collections::HashMap;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use super::{Error, Owner};

/// One owner may take this part of the bytes, so that no key can take all of them. Without keys, everything is nobody's.
const OWNER_PART: usize = 4;

/// Bytes that entries of one kind may take together.
#[derive(Debug)]
pub(super) struct MemoryBudget {
    limit: usize,
    used: AtomicUsize,
    /// Bytes that the entries of each owner take.
    used_by_owner: Mutex<HashMap<Owner, Arc<AtomicUsize>>>,
    /// The kind of entry in errors, for example `session`.
    kind: &'static str,
    /// The flag that sets the limit.
    flag: &'static str,
}

impl MemoryBudget {
    pub(super) fn new(limit: usize, kind: &'static str, flag: &'static str) -> Arc<Self> {
        Arc::new(Self { limit, used: AtomicUsize::new(0), used_by_owner: Mutex::default(), kind, flag })
    }

    /// Bytes in use.
    pub(super) fn used(&self) -> usize {
        self.used.load(Ordering::Relaxed)
    }

    /// Takes `bytes` for `owner` until the charge is dropped.
    ///
    /// # Errors
    /// [`Error::Busy`] if fewer are free, or the owner may not take so many.
    pub(super) fn charge(self: &Arc<Self>, owner: &Owner, bytes: usize) -> Result<MemoryCharge, Error> {
        let of_owner = owner.id().map(|_| {
            let mut owners = self.used_by_owner.lock().unwrap_or_else(PoisonError::into_inner);
            owners.entry(owner.clone()).or_default().clone()
        });
        let mut charge = MemoryCharge { budget: self.clone(), of_owner, bytes: 0 };
        charge.resize(bytes)?;
        Ok(charge)
    }

    fn refuse(&self, bytes: usize, who: &str, limit: usize) -> Error {
        let Self { kind, flag, .. } = self;
        let (size, limit) = (bytes.div_ceil(1024), limit / 1024);
        Error::Busy(format!("no memory for {kind} of {size} KiB: {who} may take {limit} KiB together ({flag})"))
    }
}

/// Bytes of a budget that one entry takes. Dropping it gives them back.
#[derive(Debug)]
pub(super) struct MemoryCharge {
    budget: Arc<MemoryBudget>,
    /// Bytes that all entries of the owner take; absent for nobody's entries.
    of_owner: Option<Arc<AtomicUsize>>,
    bytes: usize,
}

/// Adds `more`, unless the sum exceeds `limit`. Returns whether it was added.
fn add(used: &AtomicUsize, more: usize, limit: usize) -> bool {
    let grow = |used: usize| used.checked_add(more).filter(|used| *used <= limit);
    used.fetch_update(Ordering::Relaxed, Ordering::Relaxed, grow).is_ok()
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
        match bytes.checked_sub(self.bytes) {
            None => self.give_back(self.bytes - bytes),
            Some(0) => {}
            Some(more) => {
                let (limit, part) = (self.budget.limit, self.budget.limit / OWNER_PART);
                if self.of_owner.as_ref().is_some_and(|used| !add(used, more, part)) {
                    return Err(self.budget.refuse(bytes, &format!("the {}s of one API key", self.budget.kind), part));
                }
                if !add(&self.budget.used, more, limit) {
                    if let Some(used) = &self.of_owner {
                        used.fetch_sub(more, Ordering::Relaxed);
                    }
                    return Err(self.budget.refuse(bytes, &format!("all {}s", self.budget.kind), limit));
                }
            }
        }
        self.bytes = bytes;
        Ok(())
    }

    fn give_back(&self, bytes: usize) {
        for used in self.of_owner.as_deref().into_iter().chain([&self.budget.used]) {
            used.fetch_sub(bytes, Ordering::Relaxed);
        }
    }
}

impl Drop for MemoryCharge {
    fn drop(&mut self) {
        self.give_back(self.bytes);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn charges_never_exceed_the_limit_and_give_back_what_they_took() {
        let budget = MemoryBudget::new(100, "session", "--session-memory");
        let mut first = budget.charge(&Owner::NOBODY, 60).unwrap();
        assert!(matches!(budget.charge(&Owner::NOBODY, 41), Err(Error::Busy(_))));
        let second = budget.charge(&Owner::NOBODY, 40).unwrap();
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

    #[test]
    fn one_owner_takes_a_quarter_at_most() {
        let budget = MemoryBudget::new(100, "session", "--session-memory");
        let [one, other] = ["one", "other"].map(Owner::new);
        let mut first = budget.charge(&one, 20).unwrap();
        assert!(matches!(budget.charge(&one, 6), Err(Error::Busy(_))));
        let rest: Vec<_> = (0..4).map(|_| budget.charge(&Owner::NOBODY, 20).unwrap()).collect();
        // Refused by the sum, it leaves the share of the owner as it was.
        assert!(budget.charge(&other, 5).is_err());
        drop(rest);
        let second = budget.charge(&other, 25).unwrap();
        assert!(first.resize(26).is_err());
        first.resize(25).unwrap();
        drop((first, second));
        assert_eq!(budget.used(), 0);
        assert!(budget.charge(&one, 25).is_ok());
    }
}
