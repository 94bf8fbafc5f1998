//! The memory of policies: a budget in bytes, the shares that policies take from it, and the order of their uses.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};

/// A budget of bytes that policies in memory take together.
#[derive(Debug)]
pub(super) struct Memory {
    budget: usize,
    used: Arc<AtomicUsize>,
    /// Number of the newest use of any policy.
    newest_use: AtomicU64,
}

impl Memory {
    pub(super) fn new(budget: usize) -> Self {
        Self { budget, used: Arc::default(), newest_use: AtomicU64::new(0) }
    }

    pub(super) fn budget(&self) -> usize {
        self.budget
    }

    pub(super) fn used(&self) -> usize {
        self.used.load(Ordering::Relaxed)
    }

    /// Takes `bytes`, unless the budget has fewer left.
    pub(super) fn take(&self, bytes: usize) -> Option<MemoryShare> {
        let fits = |used: usize| used.checked_add(bytes).filter(|&used| used <= self.budget);
        self.used.fetch_update(Ordering::Relaxed, Ordering::Relaxed, fits).ok()?;
        Some(MemoryShare { used: self.used.clone(), bytes })
    }

    /// Notes a use of a policy. Writes nothing if the policy is also the one that was used last.
    pub(super) fn touch(&self, last_use: &AtomicU64) {
        let newest = self.newest_use.load(Ordering::Relaxed);
        if newest == 0 || last_use.load(Ordering::Relaxed) != newest {
            last_use.store(self.newest_use.fetch_add(1, Ordering::Relaxed) + 1, Ordering::Relaxed);
        }
    }
}

/// Bytes that a policy has taken from the budget. They return when the share is dropped.
#[derive(Debug, Default)]
pub struct MemoryShare {
    used: Arc<AtomicUsize>,
    bytes: usize,
}

impl MemoryShare {
    /// The number of bytes.
    pub fn bytes(&self) -> usize {
        self.bytes
    }
}

impl Drop for MemoryShare {
    fn drop(&mut self) {
        self.used.fetch_sub(self.bytes, Ordering::Relaxed);
    }
}
