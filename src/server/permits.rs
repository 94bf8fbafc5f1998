//! Permits of connections: how many there are in all, from one peer, and in the reserve. A peer also has a share of the budget of
//! bytes in flight.

use std::collections::HashMap;
use std::net::{IpAddr, Ipv6Addr};
use std::sync::{Arc, Mutex, PoisonError};

use crate::inflight::{Budget, Purse};

/// Connections beyond the others, one request each, only for probes: a supervisor must not take a server for dead because its
/// connections are in use.
pub(super) const RESERVE: usize = 64;
/// Connections of the reserve that one peer may have.
const RESERVE_PER_PEER: usize = 8;

/// The permits of all listeners together.
#[derive(Debug)]
pub(super) struct Permits {
    max: usize,
    max_per_peer: usize,
    budget: Arc<Budget>,
    taken: Mutex<Taken>,
}

#[derive(Debug, Default)]
struct Taken {
    all: usize,
    reserve: usize,
    /// The peers that have a connection.
    peers: HashMap<IpAddr, Peer>,
}

#[derive(Debug)]
struct Peer {
    connections: usize,
    in_reserve: usize,
    purse: Arc<Purse>,
}

/// The permit of one connection; dropping it gives the permit back.
pub(super) struct Permit {
    permits: Arc<Permits>,
    peer: IpAddr,
    /// Whether the permit is in the reserve.
    pub(super) reserved: bool,
    /// What the requests of the peer hold.
    pub(super) purse: Arc<Purse>,
    gauge: metrics::Gauge,
}

impl Permits {
    pub(super) fn new(max: usize, max_per_peer: usize, budget: Arc<Budget>) -> Arc<Self> {
        Arc::new(Self { max, max_per_peer, budget, taken: Mutex::default() })
    }

    /// The budget of bytes in flight that the peers share.
    pub(super) fn budget(&self) -> &Arc<Budget> {
        &self.budget
    }

    /// A permit for a connection from `address`, in the reserve if the others are taken; `None` if there is none.
    pub(super) fn take(self: &Arc<Self>, address: IpAddr) -> Option<Permit> {
        let key = peer(address);
        let mut guard = self.taken.lock().unwrap_or_else(PoisonError::into_inner);
        let taken = &mut *guard;
        let (connections, in_reserve) = taken.peers.get(&key).map_or((0, 0), |peer| (peer.connections, peer.in_reserve));
        let reserved = taken.all >= self.max || connections >= self.max_per_peer;
        if reserved && (taken.reserve >= RESERVE || in_reserve >= RESERVE_PER_PEER) {
            return None;
        }
        let new = || Peer { connections: 0, in_reserve: 0, purse: Purse::new(self.budget.clone()) };
        let peer = taken.peers.entry(key).or_insert_with(new);
        let purse = peer.purse.clone();
        let (all, of_peer) = peer.counts(&mut taken.all, &mut taken.reserve, reserved);
        (*all, *of_peer) = (*all + 1, *of_peer + 1);
        drop(guard);
        let gauge = metrics::gauge!("qedgix_connections");
        gauge.increment(1.0);
        Some(Permit { permits: self.clone(), peer: key, reserved, purse, gauge })
    }
}

impl Peer {
    /// The counters of all peers and of this one.
    fn counts<'a>(&'a mut self, all: &'a mut usize, reserve: &'a mut usize, reserved: bool) -> (&'a mut usize, &'a mut usize) {
        if reserved { (reserve, &mut self.in_reserve) } else { (all, &mut self.connections) }
    }
}

impl Drop for Permit {
    fn drop(&mut self) {
        let mut guard = self.permits.taken.lock().unwrap_or_else(PoisonError::into_inner);
        let taken = &mut *guard;
        if let Some(peer) = taken.peers.get_mut(&self.peer) {
            let (all, of_peer) = peer.counts(&mut taken.all, &mut taken.reserve, self.reserved);
            (*all, *of_peer) = (*all - 1, *of_peer - 1);
            if (peer.connections, peer.in_reserve) == (0, 0) {
                taken.peers.remove(&self.peer);
            }
        }
        self.gauge.decrement(1.0);
    }
}

/// Who counts as one peer: an IPv4 address, or the 64 bits of an IPv6 address that name a network, because hosts choose the rest.
fn peer(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V6(address) => {
            let [a, b, c, d, ..] = address.segments();
            Ipv6Addr::new(a, b, c, d, 0, 0, 0, 0).into()
        }
        address @ IpAddr::V4(_) => address,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fill(permits: &Arc<Permits>, address: &str) -> Vec<Permit> {
        std::iter::from_fn(|| permits.take(address.parse().unwrap())).collect()
    }

    fn ordinary(permits: &[Permit]) -> usize {
        permits.iter().filter(|permit| !permit.reserved).count()
    }

    #[test]
    fn one_peer_leaves_permits_for_others() {
        let permits = Permits::new(100, 40, Budget::new(Budget::MIN));
        let greedy = fill(&permits, "10.0.0.1");
        assert_eq!((greedy.len(), ordinary(&greedy)), (40 + RESERVE_PER_PEER, 40));
        let second = fill(&permits, "10.0.0.2");
        assert_eq!(ordinary(&second), 40);
        drop(greedy);
        assert_eq!(ordinary(&fill(&permits, "10.0.0.3")), 40);
        drop(second);
        let taken = permits.taken.lock().unwrap();
        assert_eq!((taken.all, taken.reserve, taken.peers.len()), (0, 0, 0));
    }

    #[test]
    fn probes_get_in_when_all_permits_are_taken() {
        let permits = Permits::new(2, 2, Budget::new(Budget::MIN));
        let greedy = fill(&permits, "10.0.0.1");
        assert_eq!(ordinary(&greedy), 2);
        let probe = permits.take("10.0.0.2".parse().unwrap()).unwrap();
        assert!(probe.reserved);
    }

    #[test]
    fn addresses_of_one_network_are_one_peer() {
        for (one, other, same) in [
            ("2001:db8::1", "2001:db8::ffff:1:2:3", true),
            ("2001:db8::1", "2001:db8:0:1::1", false),
            ("::ffff:10.0.0.1", "10.0.0.1", true),
            ("10.0.0.1", "10.0.0.2", false),
        ] {
            assert_eq!(peer(one.parse().unwrap()) == peer(other.parse().unwrap()), same, "{one} {other}");
        }
    }
}
