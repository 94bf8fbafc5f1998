//! The budget of bytes in flight: what the server holds of requests that have arrived and of responses that are not sent yet,
//! on both transports together.
//!
//! Only bytes that have arrived count, never announced ones. Each request holds [`BASE`] bytes, which cover its buffers and
//! everything up to that size, so that a small request touches the shared counter twice: when it begins and when it is done.

use std::sync::Arc;
use std::sync::atomic::{AtomicU8, AtomicUsize, Ordering};

/// Bytes that every request holds: about the memory of an open request with a small message.
pub const BASE: usize = 8 << 10;

/// There is no room in the budget; the caller may retry later.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the server holds as many bytes of requests and responses as --max-inflight-bytes allows; retry later")]
pub struct Exhausted;

/// Which part of the budget a request uses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Class {
    /// Requests that need an API key, if the server requires keys.
    Main = 1,
    /// Requests that never need an API key, such as probes. They have a part of their own, so that neither kind of request can
    /// keep the other one out.
    Open = 2,
}

/// The budget. It belongs to one server.
#[derive(Debug)]
pub struct Budget {
    main: Share,
    open: Share,
}

#[derive(Debug)]
struct Share {
    used: AtomicUsize,
    /// Maximum for new requests.
    max: usize,
    /// Maximum for requests and responses larger than [`BASE`]; the rest is kept for small ones.
    max_large: usize,
}

impl Share {
    const fn new(max: usize, max_large: usize) -> Self {
        Self { used: AtomicUsize::new(0), max, max_large }
    }
}

impl Budget {
    /// Smallest budget: room for some requests of each class.
    pub const MIN: usize = 1 << 20;

    /// A budget of `max` bytes. An eighth is for open requests; a quarter of the rest is kept for small requests.
    pub fn new(max: usize) -> Arc<Self> {
        let open = max / 8;
        let main = max - open;
        Arc::new(Self { main: Share::new(main, main / 4 * 3), open: Share::new(open, open / 4 * 3) })
    }

    /// Bytes held now.
    pub fn used(&self) -> usize {
        self.main.used.load(Ordering::Relaxed) + self.open.used.load(Ordering::Relaxed)
    }

    fn share(&self, class: u8) -> &Share {
        if class == Class::Open as u8 { &self.open } else { &self.main }
    }
}

/// What the requests of one peer hold. One peer may hold half of the budget of a class.
#[derive(Debug)]
pub struct Purse {
    budget: Arc<Budget>,
    main: AtomicUsize,
    open: AtomicUsize,
}

impl Purse {
    /// A peer without requests.
    pub fn new(budget: Arc<Budget>) -> Arc<Self> {
        Arc::new(Self { budget, main: AtomicUsize::new(0), open: AtomicUsize::new(0) })
    }

    /// Takes bytes. Returns whether they fit; if not, they have to be given back.
    fn take(&self, class: u8, bytes: usize, large: bool) -> bool {
        let share = self.budget.share(class);
        let of_all = share.used.fetch_add(bytes, Ordering::Relaxed) + bytes;
        let of_peer = self.used(class).fetch_add(bytes, Ordering::Relaxed) + bytes;
        of_all <= if large { share.max_large } else { share.max } && of_peer <= share.max / 2
    }

    fn give_back(&self, class: u8, bytes: usize) {
        self.budget.share(class).used.fetch_sub(bytes, Ordering::Relaxed);
        self.used(class).fetch_sub(bytes, Ordering::Relaxed);
    }

    fn used(&self, class: u8) -> &AtomicUsize {
        if class == Class::Open as u8 { &self.open } else { &self.main }
    }
}

/// The bytes that one request and its response hold. They are given back when this is dropped.
#[derive(Debug)]
pub struct Holding {
    purse: Arc<Purse>,
    /// The [`Class`], 0 before [`Holding::admit`].
    class: AtomicU8,
    bytes: AtomicUsize,
}

impl Holding {
    /// Holds nothing.
    pub fn new(purse: Arc<Purse>) -> Self {
        Self { purse, class: AtomicU8::new(0), bytes: AtomicUsize::new(0) }
    }

    /// Admits the request, which then holds [`BASE`] bytes. To be called once.
    ///
    /// # Errors
    /// [`Exhausted`] when the budget has no room.
    pub fn admit(&self, class: Class) -> Result<(), Exhausted> {
        let (class, taken) = (class as u8, self.bytes.load(Ordering::Relaxed).max(BASE));
        if self.purse.take(class, taken, false) {
            self.class.store(class, Ordering::Relaxed);
            return Ok(());
        }
        self.purse.give_back(class, taken);
        Err(Exhausted)
    }

    /// Holds `bytes` more.
    ///
    /// # Errors
    /// [`Exhausted`] when the budget has no room; the request then holds as much as before.
    pub fn grow(&self, bytes: usize) -> Result<(), Exhausted> {
        let before = self.bytes.fetch_add(bytes, Ordering::Relaxed);
        let beyond = (before + bytes).max(BASE) - before.max(BASE);
        let class = self.class.load(Ordering::Relaxed);
        if beyond == 0 || class == 0 || self.purse.take(class, beyond, true) {
            return Ok(());
        }
        self.shrink(bytes);
        Err(Exhausted)
    }

    /// Gives `bytes` back.
    pub fn shrink(&self, bytes: usize) {
        if bytes == 0 {
            return;
        }
        let before = self.bytes.fetch_sub(bytes, Ordering::Relaxed);
        let beyond = before.max(BASE) - (before - bytes).max(BASE);
        let class = self.class.load(Ordering::Relaxed);
        if beyond > 0 && class != 0 {
            self.purse.give_back(class, beyond);
        }
    }
}

impl Drop for Holding {
    fn drop(&mut self) {
        let (class, bytes) = (*self.class.get_mut(), *self.bytes.get_mut());
        if class != 0 {
            self.purse.give_back(class, bytes.max(BASE));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn holding(budget: &Arc<Budget>) -> Holding {
        Holding::new(Purse::new(budget.clone()))
    }

    #[test]
    fn small_requests_fit_where_large_ones_do_not() {
        let budget = Budget::new(8 << 20);
        let [first, second, small] = [(); 3].map(|()| holding(&budget));
        for large in [&first, &second] {
            large.admit(Class::Main).unwrap();
        }
        first.grow(3 << 20).unwrap();
        second.grow(2 << 20).unwrap();
        assert_eq!(second.grow(1 << 20), Err(Exhausted));
        assert_eq!(budget.used(), 5 << 20);
        small.admit(Class::Main).unwrap();
        small.grow(BASE).unwrap();
        assert_eq!(budget.used(), (5 << 20) + BASE);
        assert_eq!(small.grow(1 << 20), Err(Exhausted));
        first.shrink(3 << 20);
        assert_eq!(budget.used(), (2 << 20) + 2 * BASE);
        small.grow(1 << 20).unwrap();
        drop((first, second, small));
        assert_eq!(budget.used(), 0);
    }

    #[test]
    fn one_peer_holds_at_most_half() {
        let budget = Budget::new(8 << 20);
        let purse = Purse::new(budget.clone());
        let (one, other) = (Holding::new(purse.clone()), Holding::new(purse));
        one.admit(Class::Main).unwrap();
        other.admit(Class::Main).unwrap();
        one.grow(3 << 20).unwrap();
        assert_eq!((one.grow(1 << 20), other.grow(1 << 20)), (Err(Exhausted), Err(Exhausted)));
        let probe = Holding::new(one.purse.clone());
        assert_eq!(probe.admit(Class::Open), Ok(()));
        let of_another = holding(&budget);
        of_another.admit(Class::Main).unwrap();
        of_another.grow(2 << 20).unwrap();
        drop(one);
        other.grow(3 << 20).unwrap();
    }

    #[test]
    fn open_requests_and_others_do_not_keep_each_other_out() {
        let budget = Budget::new(Budget::MIN);
        for (class, other) in [(Class::Main, Class::Open), (Class::Open, Class::Main)] {
            let admit = |class| {
                let holding = holding(&budget);
                holding.admit(class).map(|()| holding)
            };
            let mut all = Vec::new();
            while let Ok(holding) = admit(class) {
                all.push(holding);
            }
            assert!(all.len() > 4, "{}", all.len());
            assert!(admit(other).is_ok());
        }
        assert_eq!(budget.used(), 0);
    }

    #[test]
    fn what_arrives_before_the_admission_counts() {
        let budget = Budget::new(8 << 20);
        let holding = holding(&budget);
        holding.grow(1 << 20).unwrap();
        assert_eq!(budget.used(), 0);
        holding.admit(Class::Main).unwrap();
        assert_eq!(budget.used(), 1 << 20);
    }
}
